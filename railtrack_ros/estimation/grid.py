"""Samples in time put on a uniform grid in distance, as they come.

Between samples the signal is interpolated by a windowed sinc; where the samples lie closer than the
grid, the sinc is that of the grid, so that nothing shorter than two grid steps is folded back.
Flat within 0.02 dB down to 2.5 samples or grid steps a wave, whichever is longer.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.compiled import njit

Array = NDArray[np.float64]
SingleArray = NDArray[np.float32]

# Half width of the interpolation kernel in samples (or grid steps), and points of its table.
HALF_WIDTH = 10
TABLE = 512
KAISER = 5.0

# Places of a point between two samples for which the weights are tabulated, so many that the
# nearest one will do, and the factor by which the kernel may be wider than the samples ask for
# before they are tabulated anew.
PHASES = 512
TOLERANCE = 1.01

# The kernel covers at most so many samples on each side.
MOST_SAMPLES = 512

# A position increment above this many times those before it, and 1 mm, is no motion but a gap or
# a correction of the position.
JUMP = 3.0


@dataclass(frozen=True)
class Points:
    """Points of the distance grid.

    values (m, channels): NaN where a sample within the kernel is; position (m,) [m]: the track
    position; spacing (m,) [m]: distance of the samples there.
    """

    values: SingleArray
    position: Array
    spacing: Array


class DistanceGrid:
    """Resamples channels from positions in time to a uniform grid in distance run.

    The grid counts distance run in either direction. A jump of the position changes the track
    position of the points but leaves the grid going.

    Parameters
    ----------
    step
        Of the grid [m].
    channels
        Number of channels.
    """

    def __init__(self, step: float, channels: int) -> None:
        self.step = step
        self._distance: Array = np.zeros(0)
        self._position: Array = np.zeros(0)
        self._values: SingleArray = np.zeros((channels, 0), dtype=np.float32)
        self._next = 0  # number of the next point of the grid
        self._increment = self._moved = 0.0
        self._broken = False
        self._stretch = 1.0
        self._weights: SingleArray = _phases(KERNEL, self._stretch)

    @property
    def next(self) -> int:
        """Number of the next point."""
        return self._next

    def resumed(self, channels: int) -> DistanceGrid:
        """Return a grid that goes on from here with other channels, of which nothing is known."""
        grid = copy.copy(self)
        grid._values = np.full((channels, self._distance.size), np.nan, dtype=np.float32)
        return grid

    def add(self, position: Array, values: NDArray[np.floating]) -> Points:
        """Take samples and return the points that they complete.

        position (n,) [m], NaN where it is not known; values (n, channels), NaN where not valid,
        of which single precision is used.
        """
        known = np.isfinite(position)
        values = np.array(values, dtype=np.float32)
        if not known.all():
            first = np.flatnonzero(known & ~np.concatenate(([not self._broken], known[:-1])))
            values[first] = np.nan
            self._broken = not known[-1]
            position, values = position[known], values[known]
        elif self._broken:
            values[0] = np.nan
            self._broken = False
        if position.size:
            self._append(position, values)
        return self._complete()

    def _append(self, position: Array, values: SingleArray) -> None:
        last = self._position[-1] if self._position.size else position[0]
        start = self._distance[-1] if self._distance.size else 0.0
        distance, self._increment, self._moved = _motion(
            position, float(last), float(start), self._increment, self._moved
        )
        self._distance = np.concatenate((self._distance, distance))
        self._position = np.concatenate((self._position, position))
        self._values = np.concatenate((self._values, values.T), axis=1)

    def _complete(self) -> Points:
        if self._distance.size < 2:
            nothing = np.zeros((0, len(self._values)), dtype=np.float32)
            return Points(nothing, np.zeros(0), np.zeros(0))
        room = max(int(self._distance[-1] / self.step) - self._next + 1, 0)
        found = np.empty((len(self._values), room), dtype=np.float32)
        position, spacing = np.empty(room), np.empty(room)
        made, used, wanted = 0, 0, self._stretch
        while True:
            made, used, wanted = _resample(
                self._distance, self._position, self._values, self._next, self.step,
                self._weights, self._stretch, made, used, found, position, spacing,
            )  # fmt: skip
            if wanted == self._stretch:
                break
            self._stretch, self._weights = wanted, _phases(KERNEL, wanted)
        self._next += made
        drop = max(used - MOST_SAMPLES - 1, 0)
        self._distance = self._distance[drop:]
        self._position = self._position[drop:]
        self._values = np.ascontiguousarray(self._values[:, drop:])
        return Points(found[:, :made].T, position[:made], spacing[:made])


def _kernel() -> Array:
    """Windowed sinc over 0 ... HALF_WIDTH, TABLE points a unit, and two zeros."""
    u = np.arange(HALF_WIDTH * TABLE + 1) / TABLE
    window = np.i0(KAISER * np.sqrt(1.0 - (u / HALF_WIDTH) ** 2)) / np.i0(KAISER)
    return np.concatenate((np.sinc(u) * window, np.zeros(2)))


KERNEL = _kernel()


@njit(cache=True, nogil=True)
def _motion(position, last, run, increment, moved):
    """Distance run; at a jump, unlike both neighbours, the increment before it is repeated."""
    distance = np.empty(position.size)
    for n in range(position.size):
        before, moved = moved, abs(position[n] - last)
        if moved <= JUMP * before + 1e-3 or moved <= JUMP * increment + 1e-3:
            increment = moved
        run += increment
        distance[n] = run
        last = position[n]
    return distance, increment, moved


@njit(cache=True, nogil=True)
def _phases(kernel, stretch):
    """Weights (PHASES + 1, taps) of the samples around a point by its place between the two."""
    half = min(math.ceil(HALF_WIDTH * stretch), MOST_SAMPLES)
    rows = np.empty((PHASES + 1, 2 * half), dtype=np.float32)
    row = np.empty(2 * half)
    for p in range(PHASES + 1):
        total = 0.0
        for j in range(2 * half):
            u = abs(j - half + 1 - p / PHASES) / stretch * TABLE
            cell = min(int(u), kernel.size - 2)
            row[j] = kernel[cell] + (u - cell) * (kernel[cell + 1] - kernel[cell])
            total += row[j]
        for j in range(2 * half):
            rows[p, j] = row[j] / total
    return rows


@njit(cache=True, nogil=True, fastmath={'reassoc', 'contract'})
def _resample(
    distance, position, values, first, step, rows, stretch, made, i, out, out_position, out_spacing
):
    """Fill the points from number `first` on, of which `made` are there, up to sample i.

    Returns how many there are, the sample they reached, and the stretch of the weights to go on
    with: another one, if the samples have become closer or wider.
    """
    channels, samples = values.shape
    half = rows.shape[1] // 2
    closest, widest = step / stretch, step / stretch * TOLERANCE**2
    if stretch == 1.0:
        widest = np.inf
    while True:
        at = (first + made) * step
        while i < samples - 2 and distance[i + 1] <= at:
            i += 1
        if made == out.shape[1] or distance[i + 1] <= at:
            return made, i, stretch
        spacing = distance[i + 1] - distance[i]
        if not closest <= spacing <= widest:
            return made, i, step / spacing * TOLERANCE if spacing < step else 1.0
        if i + half >= samples:
            return made, i, stretch
        fraction = (at - distance[i]) / spacing
        onwards = position[i + 1] - position[i]
        out_position[made] = position[i]
        if abs(onwards) < 2.0 * spacing:
            out_position[made] += fraction * onwards
        out_spacing[made] = spacing
        if i - half + 1 < 0:
            out[:, made] = np.nan
        else:
            # Unsigned, so that no index has to be looked at for counting from the end.
            phase, begin = np.uint64(fraction * PHASES + 0.5), np.uint64(i - half + 1)
            for c in range(channels):
                total = np.float32(0.0)
                for j in range(np.uint64(2 * half)):
                    total += rows[phase, j] * values[c, begin + j]
                out[c, made] = total
        made += 1
