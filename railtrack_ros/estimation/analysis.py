"""The analysis of a recording: zero-phase bands, wheels set apart, axle boxes fused per rail.

It runs over reaches of 400 m (the last one up to 800 m), each with a margin on both sides, so that
a run of any length fits into memory. The wheels' part is estimated and taken off reach by reach;
the odometer and the wheels' slip need to hold a wave together over no more than that.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railtrack_ros.estimation import bands as filters
from railtrack_ros.estimation import wavelengths, wheels
from railtrack_ros.estimation.grid import DistanceGrid
from railtrack_ros.estimation.indicators import GRID, HasAxleBoxes
from railtrack_ros.estimation.limits import LimitSet, load_limits
from railtrack_ros.estimation.rails import Measured, RailSection, fuse
from railtrack_ros.estimation.section import Judge, Passage, Section
from railtrack_ros.estimation.settings import EstimatorSettings, IndicatorSettings
from railtrack_ros.estimation.timeline import SamplePeriod
from railtrack_ros.estimation.wheels import WheelRoundness

Array = NDArray[np.float64]

REACH = 400.0  # m

# A reach over which the vehicle turns back or stands is not looked at for wheels.
STRAIGHT = 0.99


@dataclass
class Analysis:
    """What an analysis has found.

    combined: sections of the axle boxes as measured; cleaned: with the wheels' part taken off,
    where a radius is known; rails: those fused; wheels: by axle box and reach.
    """

    combined: list[Section] = field(default_factory=list)
    cleaned: list[Measured] = field(default_factory=list)
    rails: list[RailSection] = field(default_factory=list)
    wheels: list[WheelRoundness] = field(default_factory=list)


class TrackAnalysis:
    """Analyses irregularity block by block; what it finds is complete after `finish`.

    Parameters
    ----------
    vehicle
        Whatever knows the axle boxes.
    settings, estimator, limits
        As for the live indicators.
    wheel_radius
        Nominal radius [m]; None: the wheels are not set apart.
    """

    def __init__(self, vehicle: HasAxleBoxes, settings: IndicatorSettings | None = None,
                 estimator: EstimatorSettings | None = None, limits: LimitSet | None = None,
                 wheel_radius: float | None = None) -> None:
        settings = settings or IndicatorSettings()
        self.judge = Judge(settings, estimator or EstimatorSettings(),
                           limits or load_limits(settings.limits))
        self.boxes = vehicle.axle_boxes
        self.found = Analysis()
        self._radius = wheel_radius
        self._grid = DistanceGrid(GRID, len(self.boxes))
        settle = max(filters.settling(band, GRID) for band in self.judge.bands)
        self._margin = round(settings.section_length / GRID) + settle
        self._reach = round(max(REACH, 4.0 * settings.section_length) / GRID)
        self._pieces: list[tuple[Array, NDArray[np.float32], Array, Array]] = []
        self._kept = 0  # points in the pieces
        self._ahead = 0  # of them before the reach: 0 at the beginning, then a margin
        self._period = SamplePeriod()

    def feed(self, t: ArrayLike, position: ArrayLike, irregularity: Mapping[str, ArrayLike],
             stamp_ns: int = 0) -> None:
        """Take the next block, as :meth:`SectionIndicators.feed` does."""
        t, position = np.asarray(t, dtype=float), np.asarray(position, dtype=float)
        values = np.full((t.size, len(self.boxes)), np.nan, dtype=np.float32)
        for column, box in enumerate(self.boxes):
            if box.name in irregularity:
                values[:, column] = irregularity[box.name]
        self._period.take(stamp_ns, t)
        points = self._grid.add(position, values.astype(float))
        if not points.position.size:
            return
        self._pieces.append((points.position, points.values.astype(np.float32), points.spacing,
                             points.spacing / self._period.step))
        self._kept += points.position.size
        # The last reach is between one and two of them long.
        if self._kept >= self._ahead + 2 * self._reach + self._margin:
            self._work_off(self._reach)

    def finish(self) -> Analysis:
        """Work off what is left and fuse the axle boxes of each rail."""
        if self._kept > self._ahead:
            self._work_off(self._kept - self._ahead)
        order = {box.name: number for number, box in enumerate(self.boxes)}
        self.found.combined.sort(key=lambda s: (order[s.axle_box], s.start))
        self.found.rails = fuse(self.found.cleaned, self.judge)
        return self.found

    def _work_off(self, reach: int) -> None:
        position, values, spacing, speed = (
            np.concatenate(parts) for parts in zip(*self._pieces, strict=True))
        begin, end = self._ahead, self._ahead + reach
        self._analyse(position, values.astype(float), spacing, speed, begin, end)
        keep = max(end - self._margin, 0)
        self._pieces = [(position[keep:], values[keep:], spacing[keep:], speed[keep:])]
        self._kept = position.size - keep
        self._ahead = end - keep

    def _analyse(self, position: Array, values: Array, spacing: Array, speed: Array, begin: int,
                 end: int) -> None:
        """Find the sections whose middle lies in points begin ... end, and the wheels."""
        cleaned = self._set_wheels_apart(position, values)
        for data in (values, cleaned) if cleaned is not values else (values,):
            signals = filters.zero_phase(data, self.judge.bands, GRID)
            for column, box in enumerate(self.boxes):
                length = self.judge.settings.section_length
                index = np.floor((position + box.offset) / length).astype(np.int64)
                bounds = [0, *(np.flatnonzero(np.diff(index)) + 1).tolist(), index.size]
                for first, last in zip(bounds, bounds[1:], strict=False):
                    if not begin <= (first + last) // 2 < end:
                        continue
                    part = slice(first, last)
                    passage = Passage(
                        data[part, column],
                        [signal[_strided(part, filters.stride(band, GRID)), column]
                         for band, signal in zip(self.judge.bands, signals, strict=True)],
                        GRID, GRID * (last - first) / float(np.sum(GRID / speed[part])),
                        float(spacing[part].max()), float(speed[part].max()))  # fmt: skip
                    section = self.judge.section(box.name, box.rail, int(index[first]), passage)
                    if all(map(math.isnan, section.rms)):
                        continue
                    if data is values:
                        self.found.combined.append(section)
                    if data is cleaned:
                        self.found.cleaned.append(Measured(
                            section, wavelengths.spectrum(passage.irregularity, GRID),
                            self.judge.shortest(passage), self.judge.longest))

    def _set_wheels_apart(self, position: Array, values: Array) -> Array:
        """Return the rails' part of values (n, boxes), and take note of the wheels."""
        run = float(position[-1] - position[0])
        length = position.size * GRID
        if self._radius is None or abs(run) < STRAIGHT * length:
            return values
        cleaned = np.array(values)
        for rail in dict.fromkeys(box.rail for box in self.boxes):
            columns = [c for c, box in enumerate(self.boxes) if box.rail == rail]
            offsets = np.array([self.boxes[c].offset for c in columns]) * math.copysign(1.0, run)
            rails_part, found = wheels.separate(values[:, columns], GRID, offsets, self._radius)
            if length < wheels.LEAST_REVOLUTIONS * 2.0 * math.pi * self._radius:
                continue
            cleaned[:, columns] = rails_part
            for c, periodic in zip(columns, found, strict=True):
                box = self.boxes[c]
                if np.isfinite(values[:, c]).mean() < wheels.LEAST_VALID:
                    continue
                self.found.wheels.append(wheels.roundness(
                    periodic, box.name, rail, float(position[0]) + box.offset,
                    float(position[-1]) + box.offset, self._radius,
                    self.judge.estimator.cut_on_wavelength))
        return cleaned


def _strided(part: slice, stride: int) -> slice:
    """Return where the points of a slice are among every stride-th point."""
    return slice(-(-part.start // stride), -(-part.stop // stride))
