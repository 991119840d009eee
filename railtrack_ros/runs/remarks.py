"""What there is to say on an input: its defects, and remarks on what is normal operation."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

# Lines of a kind that are told one by one.
MOST_TOLD = 12

# What the estimator says of events that it is made for: gaps in the stamps, repeated blocks and
# those out of order, axle boxes without a channel, speeds that come too late.
NORMAL = re.compile(
    r'gap of .* start anew|block dropped: it has the stamp of the last one'
    r'|block dropped: \S+ s before the last one|.*: no channel: .*|.*: good samples again'
    r'|speed message \S+ s too late .*|the speed is back: start anew'
)
# A gap of several seconds looks like a clock that jumps until the block after it.
GAP = re.compile(r'gap of ')
LEAP = re.compile(r'block dropped: stamped \S+ s after the expected time')


@dataclass
class Remarks:
    """The lines on an input, each in the order of the recording.

    defects: what is wrong with it, such as samples that are no number or messages that cannot be
    read. remarks: what the estimator takes in normal operation.
    """

    defects: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)

    def note(self, note: str, when: str = '') -> None:
        """Take a note of the estimator, told with `when` before it."""
        if GAP.match(note) and self.defects and LEAP.search(self.defects[-1]):
            self.remarks.append(self.defects.pop())
        # Where the whole recording has a gap, the speed has it too.
        same_gap = note.startswith('no speed for ') and bool(
            self.remarks and self.remarks[-1].startswith(f'{when}gap of '))
        normal = same_gap or bool(NORMAL.fullmatch(note))
        (self.remarks if normal else self.defects).append(f'{when}{note}')

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
