"""Corrugation indicators live: the irregularity summed up in sections of track, as it comes.

Each axle box's irregularity is put on a grid along its own track position and goes through the
causal band-passes of :mod:`railtrack_ros.estimation.bands`, whose delay is made up for by booking
each value as far back as the filter delays the middle of its band. A section is finished when the
slowest filter has left it, and what follows is known as far as needed to tell a blow near its end
from corrugation that begins there. Live and offline run the same code on the same single-precision
waveforms, so they give the same numbers, whatever the blocks.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railtrack_ros.estimation import bands as filters
from railtrack_ros.estimation.bands import band_name
from railtrack_ros.estimation.grid import DistanceGrid
from railtrack_ros.estimation.kept import Kept
from railtrack_ros.estimation.limits import LimitSet, load_limits
from railtrack_ros.estimation.section import Judge, Passage, Section, columns
from railtrack_ros.estimation.settings import EstimatorSettings, IndicatorSettings
from railtrack_ros.estimation.timeline import SamplePeriod
from railtrack_ros.estimation.wavelengths import dominant_wavelength
from railtrack_ros.estimation.waves import IMPACT_AROUND
from railtrack_ros.vehicle.description import AxleBox

__all__ = ['BANDS', 'COLUMNS', 'HasAxleBoxes', 'Section', 'SectionIndicators', 'band_name',
           'dominant_wavelength']  # fmt: skip

Array = NDArray[np.float64]

BANDS = IndicatorSettings().wavelengths  # m, unless the settings say otherwise
COLUMNS = columns(BANDS)
# Samples of all channels together that are worked off at a time, and of each one at least.
CHUNK = 8192
LEAST_CHUNK = 2048

# Sections that are summed up with one block; others that have ended with them wait for the next
# ones, so that no block takes long. A long block takes its share.
AT_ONCE = 2


def _chunk(channels: int) -> int:
    return max(CHUNK // channels, LEAST_CHUNK)


class HasAxleBoxes(Protocol):
    """What the indicators need to know of a vehicle."""

    @property
    def axle_boxes(self) -> tuple[AxleBox, ...]:
        """Return names, rails and offsets."""


@dataclass
class _Visit:
    """A section that an axle box runs over: from which point of the grid to which, run by run."""

    runs: list[tuple[int, int]]

    @property
    def end(self) -> int:
        """The point after its last one so far."""
        return self.runs[-1][1]


class Way:
    """Follows how a run goes over the grid, so that sections can resume there.

    Parameters
    ----------
    axle_boxes
        Their number.
    step
        Of the grid [m].
    """

    def __init__(self, axle_boxes: int, step: float) -> None:
        self.period = SamplePeriod()
        self.samples = 0  # that wait to be worked off
        self._chunk = _chunk(axle_boxes)
        self._grid = DistanceGrid(step, 0)
        self._waiting: list[Array] = []

    def feed(self, t: Array, position: Array, stamp_ns: int) -> None:
        """Follow a block, as :meth:`SectionIndicators.feed` takes it."""
        self.period.take(stamp_ns, t)
        self._waiting.append(position)
        self.samples += t.size
        if self.samples >= self._chunk:
            self.samples = 0
            self.grid()

    def grid(self) -> DistanceGrid:
        """Return the grid up to here."""
        if self._waiting:
            position = np.concatenate(self._waiting)
            self._grid.add(position, np.zeros((position.size, 0), dtype=np.float32))
            self._waiting.clear()
        return self._grid


class SectionIndicators:
    """Indicators per section and axle box from the stream of irregularity.

    Parameters
    ----------
    vehicle
        The vehicle, or whatever knows its axle boxes.
    settings, estimator
        How sections are made, and what the estimate could resolve.
    limits
        By which a section is judged; None: those that the settings name.

    Raises
    ------
    InputError
        The settings name limits that cannot be read.
    """

    def __init__(
        self,
        vehicle: HasAxleBoxes,
        settings: IndicatorSettings | None = None,
        estimator: EstimatorSettings | None = None,
        limits: LimitSet | None = None,
    ) -> None:
        self.settings = settings or IndicatorSettings()
        self.judge = Judge(self.settings, estimator or EstimatorSettings(),
                           limits or load_limits(self.settings.limits))
        self.boxes = vehicle.axle_boxes
        bands, count = self.judge.bands, len(self.boxes)
        step = self.judge.step
        self._grid = DistanceGrid(step, count)
        self._delays = [filters.delay(band, step) for band in bands]
        self._strides = [filters.stride(band, step) for band in bands]
        self._around = round(IMPACT_AROUND / step)
        # So many points after its end a section is finished.
        self._wait = self._around + max(
            behind + filters.lag(band, step)
            for band, behind in zip(bands, self._delays, strict=True))
        self._chunk = _chunk(count)
        # What waits to be worked off, as far as `waiting`; `samples` have come since the last time.
        self._positions: Array = np.empty(2 * self._chunk)
        self._channels: NDArray[np.float32] = np.empty((count, 2 * self._chunk), dtype=np.float32)
        self._visits: list[dict[int, _Visit]] = [{} for _ in self.boxes]
        self._closed: list[tuple[int, int, int, _Visit]] = []
        self._inside: list[int | None] = [None] * count  # section in which each axle box is
        self._period = SamplePeriod()
        self._waiting = self._samples = 0
        self._begin(0)

    def _begin(self, number: int) -> None:
        """Begin with point `number` of the grid."""
        count = len(self.boxes)
        self._filters = filters.CausalBands(self.judge.bands, self.judge.step, count, number)
        self._irregularity = Kept(count, begin=number)
        # Distance of the samples [m], and time that a point takes [s].
        self._motion = Kept(2, np.float64, number)

    def resume(self, way: Way) -> None:
        """Go on, with nothing known of the irregularity, where the way of a run is by now."""
        self._grid = way.grid().resumed(len(self.boxes))
        self._period, self._samples = copy.copy(way.period), way.samples
        self._begin(self._grid.next)

    def feed(
        self, t: ArrayLike, position: ArrayLike, irregularity: Mapping[str, ArrayLike],
        stamp_ns: int = 0,
    ) -> list[Section]:
        """Take the next block and return the sections that it finishes.

        Parameters
        ----------
        t
            (n,) times [s].
        position
            (n,) track position of the vehicle's reference point [m], NaN where not known.
        irregularity
            (n,) [m] by axle box, NaN where not valid; a missing axle box is not valid. Rounded to
            single precision, as it is published and recorded.
        stamp_ns
            Time that `t` counts from [ns]; blocks of one sample need it.
        """
        t, position = np.asarray(t, dtype=float), np.asarray(position, dtype=float)
        first, last = self._waiting, self._waiting + t.size
        if last > self._positions.size:
            self._make_room(last)
        self._positions[first:last] = position
        for row, box in zip(self._channels, self.boxes, strict=True):
            row[first:last] = irregularity.get(box.name, math.nan)
        self._period.take(stamp_ns, t)
        self._waiting = last
        self._samples += t.size
        if self._samples >= self._chunk:
            self._work_off()
        if not self._closed:
            return []
        return self._finished(max(AT_ONCE, math.ceil(len(self._closed) * t.size / self._chunk)))

    def _make_room(self, samples: int) -> None:
        more = samples - self._positions.size
        self._positions = np.pad(self._positions, (0, more))
        self._channels = np.pad(self._channels, ((0, 0), (0, more)))

    def finish(self) -> list[Section]:
        """Return the sections under way at the end of a run."""
        if self._waiting:
            self._work_off()
        for channel, visits in enumerate(self._visits):
            for index in list(visits):
                self._close(channel, index)
        self._inside = [None] * len(self.boxes)
        self._closed.sort(key=lambda item: item[:3])
        return self._finished(len(self._closed))

    def _work_off(self) -> None:
        """Take what waits to the grid and through the filters, and close sections."""
        waiting, self._waiting, self._samples = self._waiting, 0, 0
        points = self._grid.add(self._positions[:waiting], self._channels[:, :waiting].T)
        count = points.position.size
        if not count:
            return
        values = points.values.T
        begin = self._irregularity.end
        self._irregularity.append(values)
        self._filters.add(values)
        # A point takes as long as so many samples.
        self._motion.append(np.stack(
            (points.spacing, self.judge.step * self._period.step / points.spacing)))
        self._follow(points.position, begin)
        for channel, visits in enumerate(self._visits):
            over = [index for index, visit in visits.items() if index != self._inside[channel]
                    and visit.end + self._wait <= begin + count]
            for index in over:
                self._close(channel, index)
        self._closed.sort(key=lambda item: item[:3])
        self._forget()

    def _follow(self, position: Array, begin: int) -> None:
        """Note the sections the axle boxes are in at positions (n,) [m] from point `begin` on."""
        length = self.settings.section_length
        lowest, highest = float(position.min()), float(position.max())
        for channel, box in enumerate(self.boxes):
            index = math.floor((lowest + box.offset) / length)
            if index == math.floor((highest + box.offset) / length):
                self._run(channel, index, begin, begin + position.size)
                continue
            indices = np.floor((position + box.offset) / length)
            bounds = [0, *(np.flatnonzero(np.diff(indices)) + 1).tolist(), position.size]
            for first, last in zip(bounds, bounds[1:], strict=False):
                self._run(channel, int(indices[first]), begin + first, begin + last)

    def _run(self, channel: int, index: int, first: int, last: int) -> None:
        visits = self._visits[channel]
        self._inside[channel] = index
        if index in visits and visits[index].end + self._wait <= first:
            self._close(channel, index)  # it has come back after the section was over
        if index not in visits:
            visits[index] = _Visit([(first, last)])
        elif visits[index].end == first:
            visits[index].runs[-1] = (visits[index].runs[-1][0], last)
        else:
            visits[index].runs.append((first, last))

    def _close(self, channel: int, index: int) -> None:
        visit = self._visits[channel].pop(index)
        self._closed.append((visit.end, channel, index, visit))

    def _finished(self, count: int) -> list[Section]:
        """Return the first of the closed sections, those with at least one figure."""
        closed, self._closed = self._closed[:count], self._closed[count:]
        found = [self._section(channel, index, visit) for _, channel, index, visit in closed]
        return [section for section in found if not all(map(math.isnan, section.rms))]

    def _section(self, channel: int, index: int, visit: _Visit) -> Section:
        box, around = self.boxes[channel], self._around
        (first, _), (_, last) = visit.runs[0], visit.runs[-1]
        motion = [self._motion.part(*run) for run in visit.runs]
        spacing, seconds = motion[0] if len(motion) == 1 else np.concatenate(motion, axis=1)
        shortest_time = float(seconds.min())
        passage = Passage(
            _joined([self._irregularity.part(*run)[channel] for run in visit.runs]),
            [_joined([self._signal(b, channel, *run) for run in visit.runs])
             for b in range(len(self._strides))],
            self.judge.step, spacing.size * self.judge.step / float(seconds.sum()),
            float(spacing.max()), self.judge.step / shortest_time,
            [self._signal(b, channel, first - around, first) for b in range(len(self._strides))],
            [self._signal(b, channel, last, last + around) for b in range(len(self._strides))])
        return self.judge.section(box.name, box.rail, index, passage)

    def _signal(self, band: int, channel: int, first: int, last: int) -> NDArray[np.float32]:
        """Signal of a band that is booked on points first ... last - 1 of the grid."""
        behind, apart = self._delays[band], self._strides[band]
        return self._filters.signals[band].part(
            -(-(first + behind) // apart), -(-(last + behind) // apart))[channel]

    def _forget(self) -> None:
        """Let go of the points before the first section that is not finished."""
        visits = [visit for each in self._visits for visit in each.values()]
        visits += [visit for *_, visit in self._closed]
        oldest = min((visit.runs[0][0] for visit in visits), default=self._irregularity.end)
        self._irregularity.forget(oldest)
        self._motion.forget(oldest)
        for kept, behind, apart in zip(
            self._filters.signals, self._delays, self._strides, strict=True
        ):
            kept.forget((oldest - self._around + behind) // apart)


def _joined(pieces: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    return pieces[0] if len(pieces) == 1 else np.concatenate(pieces)
