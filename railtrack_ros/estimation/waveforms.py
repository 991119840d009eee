"""Band-limited waveforms of the rails over track position, from the signals of the axle boxes.

The zero-phase signals of the axle boxes of a rail, each with its own place on the track, are
brought to common positions, multiples of the grid's step, by cubic splines; their mean is taken.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from railtrack_ros.estimation import bands as filters
from railtrack_ros.estimation.section import Judge
from railtrack_ros.vehicle.description import AxleBox

Array = NDArray[np.float64]
SingleArray = NDArray[np.float32]

# A piece of a run goes on as long as its points are no further apart than so many steps.
JOINED = 2.5


@dataclass(frozen=True)
class Waveforms:
    """A stretch of track: positions (n,) [m] in the order in which they were passed.

    rails: by rail, (bands, n) [m], the mean of its axle boxes, NaN where none is valid.
    """

    position: Array
    rails: dict[str, SingleArray]


def along_track(position: Array, signals: Sequence[SingleArray], judge: Judge,
                boxes: Sequence[AxleBox], begin: int, end: int) -> Iterator[Waveforms]:
    """Yield the waveforms of the places that the last axle box passes in points begin ... end.

    Parameters
    ----------
    position
        (n,) of the reference point [m], `judge.step` apart but for corrections and gaps.
    signals
        By band: (boxes, m), every `stride`-th point.
    begin, end
        In front of them are points enough for the first axle box to have been there. What only
        the axle boxes in front have reached is given where the run turns, or ends.
    """
    step = judge.step
    moved = np.diff(position)
    joined = (np.abs(moved) > 0.2 * step) & (np.abs(moved) < JOINED * step)
    way = np.sign(moved)
    breaks = np.flatnonzero(~joined | np.concatenate(([False], way[1:] != way[:-1]))) + 1
    offsets = [box.offset for box in boxes]
    for first, last in zip([0, *breaks.tolist()], [*breaks.tolist(), position.size], strict=True):
        inside = slice(max(first, begin), min(last, end))
        if inside.stop - inside.start < 2 or last - first < 8:
            continue
        forwards = position[last - 1] > position[first]
        behind, ahead = (min(offsets), max(offsets)) if forwards else (max(offsets), min(offsets))
        reached = position[inside.stop] + behind if last > end else position[last - 1] + ahead
        begun = position[inside.start] + behind
        low, high = sorted((begun, reached))
        # Each multiple of the step belongs to one stretch alone.
        x = step * np.arange(math.ceil(low / step), math.ceil(high / step))
        if not forwards:
            x = x[::-1]
        if x.size:
            yield Waveforms(x, {
                rail: _mean([_at(x, position, signals, judge, row, boxes[row].offset, first, last)
                             for row in range(len(boxes)) if boxes[row].rail == rail])
                for rail in dict.fromkeys(box.rail for box in boxes)})


def _at(x: Array, position: Array, signals: Sequence[SingleArray], judge: Judge, row: int,
        offset: float, first: int, last: int) -> SingleArray:
    """Signals (bands, n) of an axle box at its places x (n,) in points first ... last - 1."""
    found = np.full((len(signals), x.size), np.nan, dtype=np.float32)
    for b, (band, signal) in enumerate(zip(judge.bands, signals, strict=True)):
        apart = filters.stride(band, judge.step)
        points = np.arange(-(-first // apart), -(-last // apart))
        if points.size < 4:
            continue
        places, values = position[points * apart] + offset, signal[row, points]
        if places[0] > places[-1]:
            places, values = places[::-1], values[::-1]
        good = np.isfinite(values)
        if not good.any():
            continue
        cell = np.clip(np.searchsorted(places, x) - 1, 0, places.size - 2)
        valid = (x >= places[0]) & (x <= places[-1]) & good[cell] & good[cell + 1]
        curve = CubicSpline(places, np.where(good, values, 0.0))
        found[b, valid] = curve(x[valid])
    return found


def _mean(values: Sequence[SingleArray]) -> SingleArray:
    """Mean of what is valid, NaN where nothing is."""
    count = np.sum([np.isfinite(item) for item in values], axis=0)
    total = np.sum([np.nan_to_num(item) for item in values], axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32)
