"""What the estimator has to say on its input: one line each, and of which kind it is."""

from __future__ import annotations

from enum import Enum


class Kind(Enum):
    """What a note is about."""

    DEFECT = 'something is wrong with the input'
    NORMAL = 'an event that the estimator is made for'
    GAP = 'a time without blocks, which is normal'
    LONG_GAP = 'the same, so long that the block after it was taken for a leap'
    LEAP = 'stamps that leap: a clock that jumps, or the first sign of a long gap'
    SILENCE = 'no speed for too long: a defect, unless blocks are missing too'


class Note(str):
    """A line of text with its kind."""

    kind: Kind

    def __new__(cls, text: str, kind: Kind = Kind.DEFECT) -> Note:
        """Return the text as a note."""
        note = super().__new__(cls, text)
        note.kind = kind
        return note
