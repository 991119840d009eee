"""What there is to say on an input: its defects, and remarks on what is normal operation."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from railtrack_ros.estimation.notes import Kind, Note

# Lines of a kind that are told one by one.
MOST_TOLD = 12


@dataclass
class Remarks:
    """The lines on an input, each in the order of the recording.

    defects: what is wrong with it, such as samples that are no number or messages that cannot be
    read. remarks: what the estimator takes in normal operation.
    """

    defects: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    _leap: str = ''  # the line on stamps that leap, if that was the last note
    _gap: tuple[str, str] = ('', '')  # when the last gap was, and the line on it

    def note(self, note: Note, when: str = '') -> None:
        """Take a note of the estimator, told with `when` before it."""
        line = f'{when}{note}'
        if note.kind is Kind.LONG_GAP and self.defects and self.defects[-1] == self._leap:
            # The block after the first sign of it tells that it was no jump of the clock.
            self.remarks.append(self.defects.pop())
        if note.kind in (Kind.GAP, Kind.LONG_GAP):
            self._gap = when, line
        # Where the whole recording has a gap, the speed has it too.
        same_gap = (note.kind is Kind.SILENCE and self._gap[0] == when
                    and self.remarks[-1:] == [self._gap[1]])
        normal = same_gap or note.kind in (Kind.NORMAL, Kind.GAP, Kind.LONG_GAP)
        (self.remarks if normal else self.defects).append(line)
        self._leap = line if note.kind is Kind.LEAP else ''

    def join(self, later: Remarks) -> None:
        """Take the lines on a later part."""
        self.defects += later.defects
        self.remarks += later.remarks

    def all(self) -> list[str]:
        """Return all lines, the defects first."""
        return [*self.defects, *self.remarks]


def told(lines: Iterable[str], path: str | Path) -> list[str]:
    """Return the first of the lines with the recording named, and how many more there are."""
    lines = list(lines)
    if len(lines) > MOST_TOLD:
        lines = [*lines[:MOST_TOLD], f'and {len(lines) - MOST_TOLD} more remarks on the input']
    return [line if line.startswith(str(path)) else f'{path}: {line}' for line in lines]
