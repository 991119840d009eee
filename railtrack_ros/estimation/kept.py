"""The latest points of several channels, numbered from the beginning of a stream."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray


class Kept:
    """Points of `channels` channels, from number `begin` up to number `end`.

    What has been appended stays until it is forgotten; a part of a channel is one piece of memory.
    """

    def __init__(self, channels: int, dtype: DTypeLike = np.float32, begin: int = 0) -> None:
        self.begin = self.end = begin
        self._points: NDArray[Any] = np.empty((channels, 256), dtype=dtype)
        self._first = 0  # column of number `begin`

    def append(self, values: NDArray[Any]) -> None:
        """Take the next points (channels, n)."""
        count, kept = values.shape[1], self.end - self.begin
        if self._first + kept + count > self._points.shape[1]:
            self._make_room(kept, count)
        begin = self._first + kept
        self._points[:, begin : begin + count] = values
        self.end += count

    def part(self, first: int, last: int) -> NDArray[Any]:
        """Return the points (channels, m) first ... last - 1, as far as they are there.

        They stay as they are until the next points are appended.
        """
        first, last = max(first, self.begin), min(last, self.end)
        shift = self._first - self.begin
        return self._points[:, first + shift : max(first, last) + shift]

    def forget(self, number: int) -> None:
        """Forget the points before a number."""
        number = min(max(number, self.begin), self.end)
        self._first += number - self.begin
        self.begin = number

    def _make_room(self, kept: int, count: int) -> None:
        live = self._points[:, self._first : self._first + kept]
        size = self._points.shape[1]
        if 2 * (kept + count) > size:
            size = 2 * (kept + count)
        points = np.empty((len(live), size), dtype=self._points.dtype)
        points[:, :kept] = live
        self._points, self._first = points, 0
