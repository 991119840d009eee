"""The analysis of a recording: zero-phase bands, wheels set apart, axle boxes fused per rail.

It runs over reaches of 400 m (the last one up to 800 m), each with a margin on both sides, so that
a run of any length fits into memory. The wheels' part is estimated and taken off reach by reach;
the odometer and the wheels' slip need to hold a wave together over no more than that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railtrack_ros.estimation import bands as filters
from railtrack_ros.estimation import wavelengths, wheels
from railtrack_ros.estimation.grid import DistanceGrid
from railtrack_ros.estimation.indicators import HasAxleBoxes
from railtrack_ros.estimation.limits import LimitSet, load_limits
from railtrack_ros.estimation.rails import Measured, RailSection, fuse
from railtrack_ros.estimation.section import Judge, Passage, Section
from railtrack_ros.estimation.settings import EstimatorSettings, IndicatorSettings
from railtrack_ros.estimation.timeline import SamplePeriod
from railtrack_ros.estimation.waveforms import Waveforms, along_track
from railtrack_ros.estimation.waves import IMPACT_AROUND
from railtrack_ros.estimation.wheels import WheelRoundness

Array = NDArray[np.float64]
SingleArray = NDArray[np.float32]

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
    waveforms
        Takes the waveforms of the rails, stretch by stretch; None: they are not wanted.
    """

    def __init__(self, vehicle: HasAxleBoxes, settings: IndicatorSettings | None = None,
                 estimator: EstimatorSettings | None = None, limits: LimitSet | None = None,
                 wheel_radius: float | None = None,
                 waveforms: Callable[[Waveforms], None] | None = None) -> None:
        settings = settings or IndicatorSettings()
        self.judge = Judge(settings, estimator or EstimatorSettings(),
                           limits or load_limits(settings.limits))
        self.boxes = vehicle.axle_boxes
        self.found = Analysis()
        self._radius, self._waveforms = wheel_radius, waveforms
        self._step = self.judge.step
        self._grid = DistanceGrid(self._step, len(self.boxes))
        settle = max(filters.settling(band, self._step) for band in self.judge.bands)
        self._around = round(IMPACT_AROUND / self._step)
        offsets = [box.offset for box in self.boxes]
        # A place is complete when the last axle box has passed it.
        behind = max(offsets) - min(offsets) if waveforms else 0.0
        self._margin = round(
            (settings.section_length + behind) / self._step) + settle + self._around
        self._reach = round(max(REACH, 4.0 * settings.section_length) / self._step)
        self._pieces: list[tuple[Array, SingleArray, Array, Array]] = []
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
        points = self._grid.add(position, values)
        if not points.position.size:
            return
        self._pieces.append((points.position, points.values.T, points.spacing,
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
        positions, pieces, spacings, speeds = zip(*self._pieces, strict=True)
        position, spacing, speed = map(np.concatenate, (positions, spacings, speeds))
        values = np.concatenate(pieces, axis=1)
        begin, end = self._ahead, self._ahead + reach
        signals = self._analyse(position, values, spacing, speed, begin, end)
        if self._waveforms is not None:
            known = [
                np.where(self.judge.resolved(band, spacing[::apart], speed[::apart]), signal,
                         np.float32(np.nan))
                for band, signal in zip(self.judge.bands, signals, strict=True)
                if (apart := filters.stride(band, self._step))]
            for found in along_track(position, known, self.judge, self.boxes, begin, end):
                self._waveforms(found)
        keep = max(end - self._margin, 0)
        self._pieces = [(position[keep:], values[:, keep:], spacing[keep:], speed[keep:])]
        self._kept = position.size - keep
        self._ahead = end - keep

    def _analyse(self, position: Array, values: SingleArray, spacing: Array, speed: Array,
                 begin: int, end: int) -> list[SingleArray]:
        """Find the sections whose middle lies in points begin ... end, and the wheels.

        values (boxes, n), the others (n,). Returns the signals of the rails by band.
        """
        cleaned = self._set_wheels_apart(position, values)
        for data in (values, cleaned) if cleaned is not values else (values,):
            signals = filters.zero_phase(data, self.judge.bands, self._step)
            for row, box in enumerate(self.boxes):
                length = self.judge.settings.section_length
                index = np.floor((position + box.offset) / length).astype(np.int64)
                bounds = [0, *(np.flatnonzero(np.diff(index)) + 1).tolist(), index.size]
                for first, last in zip(bounds, bounds[1:], strict=False):
                    if not begin <= (first + last) // 2 < end:
                        continue
                    passage = self._passage(row, data, signals, spacing, speed, first, last)
                    section = self.judge.section(box.name, box.rail, int(index[first]), passage)
                    if all(map(math.isnan, section.rms)):
                        continue
                    if data is values:
                        self.found.combined.append(section)
                    if data is cleaned:
                        self.found.cleaned.append(Measured(
                            section, wavelengths.spectrum(passage.irregularity, self._step),
                            self.judge.shortest(passage), self.judge.longest))
        return signals

    def _passage(self, row: int, data: SingleArray, signals: list[SingleArray], spacing: Array,
                 speed: Array, first: int, last: int) -> Passage:
        """Return what axle box number `row` has met in points first ... last - 1."""
        strides = [filters.stride(band, self._step) for band in self.judge.bands]

        def parts(begin: int, end: int) -> list[SingleArray]:
            begin = max(begin, 0)
            return [signal[row, -(-begin // apart) : -(-end // apart)]
                    for signal, apart in zip(signals, strides, strict=True)]

        inside = slice(first, last)
        return Passage(
            data[row, inside], parts(first, last), self._step,
            (last - first) / float(np.sum(1.0 / speed[inside])), float(spacing[inside].max()),
            float(speed[inside].max()), parts(first - self._around, first),
            parts(last, last + self._around))

    def _set_wheels_apart(self, position: Array, values: SingleArray) -> SingleArray:
        """Return the rails' part of values (boxes, n), and take note of the wheels."""
        run = float(position[-1] - position[0])
        length = position.size * self._step
        if self._radius is None or abs(run) < STRAIGHT * length:
            return values
        cleaned = np.array(values)
        for rail in dict.fromkeys(box.rail for box in self.boxes):
            rows = [r for r, box in enumerate(self.boxes) if box.rail == rail]
            offsets = np.array([self.boxes[r].offset for r in rows]) * math.copysign(1.0, run)
            rails_part, found = wheels.separate(
                values[rows].T.astype(float), self._step, offsets, self._radius)
            if length < wheels.LEAST_REVOLUTIONS * 2.0 * math.pi * self._radius:
                continue
            cleaned[rows] = rails_part.T
            for r, periodic in zip(rows, found, strict=True):
                box = self.boxes[r]
                if np.isfinite(values[r]).mean() < wheels.LEAST_VALID:
                    continue
                self.found.wheels.append(wheels.roundness(
                    periodic, box.name, rail, float(position[0]) + box.offset,
                    float(position[-1]) + box.offset, self._radius,
                    self.judge.estimator.cut_on_wavelength))
        return cleaned
