"""Samples without a gap as columns, and how those of unequal distance in time become uniform."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.ndimage import median_filter

from railtrack_ros.bags.columns import PIECE, Array, Column, Even, pieces
from railtrack_ros.errors import InputError

# A step that is longer than its neighbours, so many on either side, by this factor is a gap.
GAP, AROUND = 1.5, 4
# Samples may lie this part of a sample period off a uniform grid and still count as uniform.
UNIFORMITY = 0.1
# Sample periods of different stretches that differ by more than this part are different rates.
SAME_RATE = 1e-3
# Resampling may make this many times the samples, as a run from walking pace to full speed does.
MOST_ADDED = 50.0
# Samples beyond which the ends of a spline no longer show.
SPLINE_ENDS = 200
# Shorter stretches between gaps hold nothing that could be used.
SHORTEST = 16


@dataclass(frozen=True)
class Stretch:
    """Samples without a gap: time [s], speed [m/s], channels [m/s^2], columns of one size.

    step: mean sample period [s]. shortest: least of the sample periods, single jitters apart.
    uniform: whether all samples lie on a uniform grid, as far as anyone could tell.
    """

    time: Column
    speed: Column
    channels: dict[str, Column]
    step: float
    shortest: float
    uniform: bool

    @property
    def size(self) -> int:
        """Return the number of samples."""
        return self.time.size

    @property
    def first(self) -> float:
        """Return the time of the first sample [s]."""
        return float(self.time[0:1][0])

    @property
    def last(self) -> float:
        """Return the time of the last sample [s]."""
        return float(self.time[self.size - 1:self.size][0])


def _steps(time: Column) -> Iterator[tuple[int, Array, Array]]:
    """Yield the sample periods [s] of a column of times, and what is usual around each.

    With them comes the number of the sample that the first of them leads to.
    """
    count = time.size - 1
    for part in pieces(count):
        begin, end = max(part.start - AROUND, 0), min(part.stop + AROUND, count)
        steps = np.diff(time[begin:end + 1])
        usual = median_filter(steps, size=2 * AROUND + 1, mode='nearest')
        inside = slice(part.start - begin, part.stop - begin)
        yield part.start + 1, steps[inside], usual[inside]


def parts(time: Column) -> list[tuple[int, int]]:
    """Return the stretches of samples between gaps, first and after the last."""
    edges = [0]
    for first, steps, usual in _steps(time):
        edges += (first + np.flatnonzero(steps > GAP * usual)).tolist()
    return list(zip(edges, [*edges[1:], time.size], strict=True))


def stretch_of(time: Column, speed: Column, channels: dict[str, Column]) -> Stretch:
    """Return a stretch with what its times tell."""
    count = time.size
    first, last = float(time[0:1][0]), float(time[count - 1:count][0])
    step = (last - first) / (count - 1)
    off = max(float(np.abs(time[part] - (first + step * np.arange(part.start, part.stop))).max())
              for part in pieces(count))
    shortest = min(float(usual.min()) for _, _, usual in _steps(time))
    return Stretch(time, speed, channels, step, shortest, off <= UNIFORMITY * step)


def equalised(path: Path, stretches: list[Stretch]) -> tuple[list[Stretch], bool]:
    """Return the stretches at one sample rate, and whether they had to be resampled for it.

    Raises
    ------
    InputError
        Resampling would make far more samples than there are.
    """
    steps = np.array([stretch.step for stretch in stretches])
    same = np.ptp(steps) <= SAME_RATE * steps.mean()
    if same and all(stretch.uniform for stretch in stretches):
        return stretches, False
    # The shortest sample period that occurs.
    step = min(stretch.shortest for stretch in stretches)
    before = sum(stretch.size for stretch in stretches)
    after = sum((stretch.last - stretch.first) / step for stretch in stretches)
    if after > MOST_ADDED * before:
        raise InputError(
            f'{path}: the sample period varies so much, from {step:.4g} s on, that resampling '
            f'would make {after / before:.0f} times the samples; import faster stretches alone'
        )
    return [_resampled(stretch, step) for stretch in stretches], True


def _resampled(stretch: Stretch, step: float) -> Stretch:
    """Return a stretch on a uniform grid of time, interpolated by splines of degree 5.

    Between samples next to a missing one nothing is made up: the result is NaN there.
    """
    first = stretch.first
    size = math.floor((stretch.last - first) / step * (1.0 + 1e-12)) + 1
    grid = Even(size, step, first)
    marks = np.array([stretch.time[part][0] for part in pieces(stretch.size)])
    return replace(
        stretch, time=grid, step=step, shortest=step, uniform=True,
        speed=_Interpolated(grid, stretch.time, marks, stretch.speed, 1),
        channels={name: _Interpolated(grid, stretch.time, marks, samples, 5)
                  for name, samples in stretch.channels.items()})


class _Interpolated:
    """A column over other times, by splines of degree 5 or straight lines.

    Missing samples leave the results next to them missing.
    """

    def __init__(self, grid: Column, time: Column, marks: Array, values: Column, degree: int
                 ) -> None:
        self.size = grid.size
        self._grid, self._time, self._values, self._degree = grid, time, values, degree
        self._marks = marks  # time at the beginning of each piece

    def __getitem__(self, part: slice) -> Array:
        """Return a stretch."""
        wanted = self._grid[part]
        if not wanted.size:
            return wanted
        # Pieces that hold the wanted times, and enough before and after for the ends of a spline.
        piece = np.searchsorted(self._marks, wanted[[0, -1]], 'right') - 1
        begin = max(int(piece[0]) * PIECE - SPLINE_ENDS, 0)
        end = min((int(piece[1]) + 1) * PIECE + SPLINE_ENDS, self._time.size)
        time = self._time[begin:end]
        low, high = np.searchsorted(time, wanted[[0, -1]])
        near = slice(max(int(low) - SPLINE_ENDS, 0), int(high) + SPLINE_ENDS)
        time, values = time[near], self._values[begin:end][near]
        known = np.isfinite(values)
        if self._degree == 1:
            return np.interp(wanted, time, values)
        if known.sum() < SHORTEST:
            return np.full(wanted.size, np.nan)
        found = np.asarray(make_interp_spline(time[known], values[known], k=self._degree)(wanted))
        found[np.interp(wanted, time, np.where(known, 0.0, 1.0)) > 0.0] = np.nan
        return found
