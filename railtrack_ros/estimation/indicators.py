"""Corrugation indicators live: the irregularity summed up in sections of track, as it comes.

Each axle box's irregularity is put on a grid of 1 mm along its own track position and goes through
the causal band-passes of :mod:`railtrack_ros.estimation.bands`, whose delay is made up for by
booking each value as far back as the filter delays the middle of its band. A section is
finished when the slowest filter has left it. Live and offline run the same code on the same
single-precision waveforms, so they give the same numbers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railtrack_ros.estimation import bands as filters
from railtrack_ros.estimation.bands import band_name
from railtrack_ros.estimation.grid import DistanceGrid
from railtrack_ros.estimation.limits import LimitSet, load_limits
from railtrack_ros.estimation.section import Judge, Passage, Section, columns
from railtrack_ros.estimation.settings import EstimatorSettings, IndicatorSettings
from railtrack_ros.estimation.timeline import SamplePeriod
from railtrack_ros.estimation.wavelengths import dominant_wavelength
from railtrack_ros.vehicle.description import AxleBox

__all__ = ['BANDS', 'COLUMNS', 'GRID', 'HasAxleBoxes', 'Section', 'SectionIndicators', 'band_name',
           'dominant_wavelength']  # fmt: skip

Array = NDArray[np.float64]

BANDS = IndicatorSettings().wavelengths  # m, unless the settings say otherwise
COLUMNS = columns(BANDS)
GRID = 0.001  # m
# Samples of all channels together that are worked off at a time, and of each one at least.
CHUNK = 8192
LEAST_CHUNK = 2048


class HasAxleBoxes(Protocol):
    """What the indicators need to know of a vehicle."""

    @property
    def axle_boxes(self) -> tuple[AxleBox, ...]:
        """Return names, rails and offsets."""


@dataclass
class _Visit:
    """A section that an axle box is running over: pieces of its signals, and how it ran."""

    signals: list[list[Array]]  # by band
    irregularity: list[Array] = field(default_factory=list)
    points: int = 0
    travel_time: float = 0.0
    coarsest: float = 0.0
    fastest: float = 0.0

    def passage(self) -> Passage:
        """Return what was met."""
        return Passage(
            _joined(self.irregularity), [_joined(pieces) for pieces in self.signals], GRID,
            self.points * GRID / self.travel_time if self.travel_time else math.nan,
            self.coarsest, self.fastest)  # fmt: skip


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
        self.estimator = estimator or EstimatorSettings()
        self.judge = Judge(
            self.settings, self.estimator, limits or load_limits(self.settings.limits))
        self.boxes = vehicle.axle_boxes
        bands = self.judge.bands
        self._offsets = np.array([box.offset for box in self.boxes])
        self._grid = DistanceGrid(GRID, len(self.boxes))
        self._filters = filters.CausalBands(bands, GRID, len(self.boxes))
        self._delays = [filters.delay(band, GRID) for band in bands]
        self._strides = [filters.stride(band, GRID) for band in bands]
        self._waiting: list[tuple[Array, NDArray[np.float32]]] = []
        self._tail = np.zeros((0, len(self.boxes)), dtype=np.int64)
        self._visits: list[dict[int, _Visit]] = [{} for _ in self.boxes]
        self._period = SamplePeriod()
        self._points = 0
        self._samples = 0

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
        size = t.size
        channels = np.empty((len(self.boxes), size), dtype=np.float32)
        for row, box in enumerate(self.boxes):
            channels[row] = irregularity.get(box.name, math.nan)
        self._waiting.append((position, channels))
        self._period.take(stamp_ns, t)
        self._samples += size
        if self._samples < max(CHUNK // len(self.boxes), LEAST_CHUNK):
            return []
        return self._work_off()

    def finish(self) -> list[Section]:
        """Return the sections under way at the end of a run."""
        finished = self._work_off() if self._waiting else []
        for channel, visits in enumerate(self._visits):
            finished += [self._close(channel, index, visits.pop(index)) for index in list(visits)]
        return self._worth(finished)

    def _work_off(self) -> list[Section]:
        positions, channels = zip(*self._waiting, strict=True)
        self._waiting.clear()
        self._samples = 0
        points = self._grid.add(
            np.concatenate(positions), np.concatenate(channels, axis=1).T.astype(float)
        )
        count = points.position.size
        if not count:
            return []
        length = self.settings.section_length
        index = np.floor((points.position[:, None] + self._offsets) / length).astype(np.int64)
        index = np.concatenate((self._tail, index))
        behind = len(self._tail)
        for b, signal in enumerate(self._filters.filter(points.values)):
            # Where the filters have not been delayed for long enough there is no place to book.
            skip = max(self._delays[b] - behind, 0)
            skip += -(self._points + skip) % self._strides[b]
            kept = slice(skip, count, self._strides[b])
            begin = behind - self._delays[b]
            self._book_band(b, index[begin + skip : begin + count : self._strides[b]], signal[kept])
        self._book_points(index[behind:], points.values, points.spacing)
        self._tail = index[-max(self._delays) :]
        self._points += count
        return self._worth(self._leave())

    def _book_band(self, band: int, places: NDArray[np.int64], signal: Array) -> None:
        for channel in range(len(self.boxes)):
            for index, part in _stretches(places[:, channel]):
                self._visit(channel, index).signals[band].append(signal[part, channel])

    def _book_points(self, places: NDArray[np.int64], values: Array, spacing: Array) -> None:
        speed = spacing / self._period.step
        for channel in range(len(self.boxes)):
            for index, part in _stretches(places[:, channel]):
                visit = self._visit(channel, index)
                visit.points += part.stop - part.start
                visit.travel_time += float(np.sum(GRID / speed[part]))
                visit.coarsest = max(visit.coarsest, float(spacing[part].max()))
                visit.fastest = max(visit.fastest, float(speed[part].max()))
                visit.irregularity.append(values[part, channel])

    def _visit(self, channel: int, index: int) -> _Visit:
        visits = self._visits[channel]
        if index not in visits:
            visits[index] = _Visit([[] for _ in self.judge.bands])
        return visits[index]

    def _leave(self) -> list[Section]:
        """Close the sections that neither the axle box nor the slowest filter is in."""
        finished = []
        for channel, visits in enumerate(self._visits):
            present = {index for index, _ in _stretches(self._tail[:, channel])}
            for index in [index for index in visits if index not in present]:
                finished.append(self._close(channel, index, visits.pop(index)))
        return finished

    def _close(self, channel: int, index: int, visit: _Visit) -> Section:
        box = self.boxes[channel]
        return self.judge.section(box.name, box.rail, index, visit.passage())

    def _worth(self, sections: list[Section]) -> list[Section]:
        """Leave out the sections without a single figure."""
        return [section for section in sections if not all(map(math.isnan, section.rms))]


def _stretches(index: NDArray[np.int64]) -> list[tuple[int, slice]]:
    """Return the constant stretches of a row of numbers with their places."""
    if index.size and index[0] == index[-1] and not (index != index[0]).any():
        return [(int(index[0]), slice(0, index.size))]
    bounds = [0, *(np.flatnonzero(np.diff(index)) + 1).tolist(), index.size]
    return [(int(index[i]), slice(i, j)) for i, j in zip(bounds, bounds[1:], strict=False) if j > i]


def _joined(pieces: list[Array]) -> Array:
    return np.concatenate(pieces) if pieces else np.zeros(0)
