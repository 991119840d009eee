"""Columns of any length: arrays on disk, and what is computed from them piece by piece.

A column is asked for a stretch of it, `column[first:last]`, and reads or computes just that.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PIECE = 1 << 16  # samples of a column that are in memory at a time


class Column(Protocol):
    """Numbers of which a stretch can be asked for."""

    @property
    def size(self) -> int:
        """Return how many there are."""

    def __getitem__(self, part: slice) -> Array:
        """Return those from part.start to part.stop, as far as there are any; part.step is None."""


def pieces(size: int, length: int = 0) -> Iterator[slice]:
    """Yield slices of at most `length` (0: `PIECE`) that cover so many samples."""
    length = length or PIECE
    for start in range(0, size, length):
        yield slice(start, min(start + length, size))


class Stored:
    """A column in a file, which grows at its end."""

    def __init__(self, path: Path) -> None:
        self.size = 0
        self._file = path.open('wb+', buffering=0)

    def append(self, values: Array) -> None:
        """Add values (n,) at the end."""
        self._file.seek(8 * self.size)
        left = np.ascontiguousarray(values, np.float64).data.cast('B')
        while left:
            left = left[self._file.write(left):]
        self.size += values.size

    def __getitem__(self, part: slice) -> Array:
        """Return a stretch."""
        start, stop, _ = part.indices(self.size)
        self._file.seek(8 * start)
        return np.fromfile(self._file, np.float64, max(stop - start, 0))

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class Part:
    """A stretch of a column as a column of its own."""

    def __init__(self, column: Column, first: int, last: int) -> None:
        self.size = last - first
        self._column, self._first = column, first

    def __getitem__(self, part: slice) -> Array:
        """Return a stretch."""
        start, stop, _ = part.indices(self.size)
        return self._column[self._first + start:self._first + max(stop, start)]


class Even:
    """Numbers of equal distance: first, first + step, ..."""

    def __init__(self, size: int, step: float, first: float = 0.0) -> None:
        self.size = size
        self._step, self._first = step, first

    def __getitem__(self, part: slice) -> Array:
        """Return a stretch."""
        start, stop, _ = part.indices(self.size)
        numbers = np.arange(start, max(stop, start), dtype=np.float64)
        return self._first + self._step * numbers


class Scaled:
    """A column less an offset, times a factor; what is not finite is missing (NaN)."""

    def __init__(self, column: Column, offset: float, factor: float) -> None:
        self.size = column.size
        self._column, self._offset, self._factor = column, offset, factor

    def __getitem__(self, part: slice) -> Array:
        """Return a stretch."""
        values = (self._column[part] - self._offset) * self._factor
        values[~np.isfinite(values)] = np.nan
        return values


class Thinned:
    """Every `factor`-th number of a column."""

    def __init__(self, column: Column, factor: int) -> None:
        self.size = -(-column.size // factor)
        self._column, self._factor = column, factor

    def __getitem__(self, part: slice) -> Array:
        """Return a stretch."""
        start, stop, _ = part.indices(self.size)
        factor = self._factor
        return self._column[start * factor:(max(stop, start + 1) - 1) * factor + 1][
            ::factor][:max(stop - start, 0)]


class Folder:
    """A folder for columns that are computed."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._columns: list[Stored] = []

    def column(self) -> Stored:
        """Return an empty column."""
        found = Stored(self._path / str(len(self._columns)))
        self._columns.append(found)
        return found

    def close(self) -> None:
        """Close all files."""
        for column in self._columns:
            column.close()
