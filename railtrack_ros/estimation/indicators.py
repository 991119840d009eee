"""Corrugation indicators: the irregularity summed up in sections of track, as it comes.

Each axle box's irregularity is put on a grid of 1 mm along its own track position and goes through
causal band-passes (Butterworth, order 4, -3 dB at the band's edges), whose delay is made up for by
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
from scipy import signal

from railtrack_ros.estimation.grid import DistanceGrid
from railtrack_ros.estimation.settings import EstimatorSettings, IndicatorSettings
from railtrack_ros.irregularity.spectra import density
from railtrack_ros.vehicle.description import AxleBox

Array = NDArray[np.float64]

BANDS = ((0.01, 0.03), (0.03, 0.1), (0.1, 0.3), (0.3, 1.0))  # m, shortest and longest wavelength
GRID = 0.001  # m
CHUNK = 4096  # samples worked off at a time

# Resolved are waves of at least so many samples, and those this much shorter than the cut-on.
SAMPLES_A_WAVE = 2.5
CUT_ON_MARGIN = 1.5

# A band-pass is taken to have settled after so many of its longest wavelengths.
SETTLING = 1.5

# Resolution of the search for the dominant wavelength: share of an octave, and points a band.
PEAK_WIDTH = 1.0 / 6.0
PEAK_POINTS = 6

# A stretch of irregularity resolves wavelengths of at most this share of its length (EN 15610).
LONGEST_SHARE = 0.25


def band_name(band: tuple[float, float]) -> str:
    """Return a band's name in columns and topics, such as ``30_100`` (mm)."""
    return f'{band[0] * 1e3:.0f}_{band[1] * 1e3:.0f}'


COLUMNS = (
    'axle_box', 'rail', 'from_m', 'to_m', 'speed_m_s',
    *(f'rms_{band_name(band)}_um' for band in BANDS),
    'dominant_wavelength_m', 'dominant_rms_um', 'dominant_above_iso3095_db', 'valid_fraction',
)  # fmt: skip


@dataclass(frozen=True)
class Section:
    """Indicators of one section under one axle box; NaN stands for what cannot be resolved.

    start, end [m]: place on the track. speed [m/s]: mean. rms (bands,) [m] of the irregularity in
    `BANDS`. dominant_wavelength [m]: peak of the spectrum relative to the ISO 3095 limit,
    with the RMS [m] in the sixth of an octave around it and its level above the limit [dB].
    valid_fraction: share of the section with irregularity.
    """

    axle_box: str
    rail: str
    start: float
    end: float
    speed: float
    rms: tuple[float, ...]
    dominant_wavelength: float
    dominant_rms: float
    dominant_above_limit: float
    valid_fraction: float

    def row(self) -> dict[str, str | float | None]:
        """Return the values by the names of `COLUMNS`; None where not resolved."""
        values = (
            self.start, self.end, self.speed, *(1e6 * rms for rms in self.rms),
            self.dominant_wavelength, 1e6 * self.dominant_rms, self.dominant_above_limit,
            self.valid_fraction,
        )  # fmt: skip
        known = (None if math.isnan(value) else value for value in values)
        return dict(zip(COLUMNS, (self.axle_box, self.rail, *known), strict=True))


class HasAxleBoxes(Protocol):
    """What the indicators need to know of a vehicle."""

    @property
    def axle_boxes(self) -> tuple[AxleBox, ...]:
        """Return names, rails and offsets."""


@dataclass
class _Visit:
    """A section that an axle box is running over."""

    squares: Array  # (bands,)
    counts: Array  # (bands,)
    points: int = 0
    travel_time: float = 0.0
    coarsest: float = 0.0
    fastest: float = 0.0
    pieces: list[Array] = field(default_factory=list)


class SectionIndicators:
    """Indicators per section and axle box from the stream of irregularity.

    Parameters
    ----------
    vehicle
        The vehicle, or whatever knows its axle boxes.
    settings, estimator
        How sections are made, and what the estimate could resolve.
    """

    def __init__(
        self,
        vehicle: HasAxleBoxes,
        settings: IndicatorSettings | None = None,
        estimator: EstimatorSettings | None = None,
    ) -> None:
        self.settings = settings or IndicatorSettings()
        self.estimator = estimator or EstimatorSettings()
        self.boxes = vehicle.axle_boxes
        self._offsets = np.array([box.offset for box in self.boxes])
        self._grid = DistanceGrid(GRID, len(self.boxes))
        edges = [(1.0 / longest, 1.0 / shortest) for shortest, longest in BANDS]
        self._filters = [
            signal.butter(4, edge, 'bandpass', fs=1.0 / GRID, output='sos') for edge in edges
        ]
        self._delays = [
            _group_delay(sos, GRID * math.sqrt(edge[0] * edge[1]))
            for sos, edge in zip(self._filters, edges, strict=True)
        ]
        self._settling = [round(SETTLING * longest / GRID) for _, longest in BANDS]
        channels = len(self.boxes)
        self._states = [np.zeros((len(sos), 2, channels)) for sos in self._filters]
        self._since_bad = np.zeros(channels, dtype=np.int64)
        self._waiting: list[tuple[Array, NDArray[np.float32]]] = []
        self._tail = np.zeros((0, channels), dtype=np.int64)
        self._visits: list[dict[int, _Visit]] = [{} for _ in self.boxes]
        self._step = math.nan

    def feed(
        self, t: ArrayLike, position: ArrayLike, irregularity: Mapping[str, ArrayLike]
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
        """
        t, position = np.asarray(t, dtype=float), np.asarray(position, dtype=float)
        missing = np.full(t.size, np.nan)
        columns = [irregularity.get(box.name, missing) for box in self.boxes]
        self._waiting.append((position, np.array(columns, dtype=np.float32)))
        if t.size > 1:
            self._step = (t[-1] - t[0]) / (t.size - 1)
        if sum(position.size for position, _ in self._waiting) < CHUNK:
            return []
        return self._work_off()

    def finish(self) -> list[Section]:
        """Return the sections under way at the end of a run."""
        finished = self._work_off() if self._waiting else []
        for channel, visits in enumerate(self._visits):
            finished += [self._close(channel, index, visits.pop(index)) for index in list(visits)]
        return self._worth(finished)

    def _work_off(self) -> list[Section]:
        positions, columns = zip(*self._waiting, strict=True)
        self._waiting.clear()
        points = self._grid.add(
            np.concatenate(positions), np.concatenate(columns, axis=1).T.astype(float)
        )
        values, position, spacing = points.values, points.position, points.spacing
        if not position.size:
            return []
        speed = spacing / self._step
        length = self.settings.section_length
        index = np.floor((position[:, None] + self._offsets) / length).astype(np.int64)
        index = np.concatenate((self._tail, index))
        behind = len(self._tail)

        bad = np.isnan(values)
        clean = np.where(bad, 0.0, values)
        settled = self._run_since_bad(bad)
        for b, sos in enumerate(self._filters):
            filtered, self._states[b] = signal.sosfilt(sos, clean, axis=0, zi=self._states[b])
            valid = settled > self._settling[b]
            # Where the filters have not been delayed for long enough there is no place to book.
            skip = max(self._delays[b] - behind, 0)
            begin = behind - self._delays[b] + skip
            places = index[begin : begin + len(values) - skip]
            self._book_band(b, places, filtered[skip:], valid[skip:])
        self._book_points(index[behind:], clean, bad, spacing, speed)
        self._tail = index[-max(self._delays) :]
        return self._worth(self._leave())

    def _run_since_bad(self, bad: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Points (n, channels) since the last one that was not valid."""
        n = np.arange(1, len(bad) + 1)[:, None]
        last_bad = np.maximum.accumulate(np.where(bad, n, 0), axis=0)
        since = np.where(last_bad > 0, n - last_bad, n + self._since_bad)
        self._since_bad = since[-1]
        return since

    def _book_band(
        self, band: int, places: NDArray[np.int64], filtered: Array, valid: NDArray[np.bool_]
    ) -> None:
        for channel, visits in enumerate(self._visits):
            for index, part in _stretches(places[:, channel]):
                visit = visits.setdefault(index, _new_visit())
                good = filtered[part, channel][valid[part, channel]]
                visit.squares[band] += good @ good
                visit.counts[band] += good.size

    def _book_points(
        self,
        places: NDArray[np.int64],
        clean: Array,
        bad: NDArray[np.bool_],
        spacing: Array,
        speed: Array,
    ) -> None:
        for channel, visits in enumerate(self._visits):
            for index, part in _stretches(places[:, channel]):
                visit = visits.setdefault(index, _new_visit())
                visit.points += part.stop - part.start
                visit.travel_time += float(np.sum(GRID / speed[part]))
                visit.coarsest = max(visit.coarsest, float(spacing[part].max()))
                visit.fastest = max(visit.fastest, float(speed[part].max()))
                visit.pieces.append(np.where(bad[part, channel], np.nan, clean[part, channel]))

    def _leave(self) -> list[Section]:
        """Close the sections that neither the axle box nor the slowest filter is in."""
        finished = []
        for channel, visits in enumerate(self._visits):
            present = set(np.unique(self._tail[:, channel]))
            for index in [index for index in visits if index not in present]:
                finished.append(self._close(channel, index, visits.pop(index)))
        return finished

    def _close(self, channel: int, index: int, visit: _Visit) -> Section:
        length, box = self.settings.section_length, self.boxes[channel]
        enough = self.settings.minimum_valid * length / GRID
        rms = [
            math.sqrt(visit.squares[b] / visit.counts[b])
            if visit.counts[b] >= enough and self._resolved(band, visit)
            else math.nan
            for b, band in enumerate(BANDS)
        ]
        irregularity = np.concatenate(visit.pieces) if visit.pieces else np.zeros(0)
        valid = np.count_nonzero(np.isfinite(irregularity)) * GRID / length
        shortest = max(BANDS[0][0], self._shortest(visit))
        wavelength, peak, level = dominant_wavelength(
            irregularity, GRID, shortest, min(BANDS[-1][1], self._longest()),
            self.settings.minimum_prominence,
        ) if valid >= self.settings.minimum_valid else (math.nan,) * 3  # fmt: skip
        return Section(
            axle_box=box.name, rail=box.rail, start=index * length, end=(index + 1) * length,
            speed=visit.points * GRID / visit.travel_time if visit.travel_time else math.nan,
            rms=tuple(rms), dominant_wavelength=wavelength, dominant_rms=peak,
            dominant_above_limit=level, valid_fraction=min(valid, 1.0),
        )  # fmt: skip

    def _shortest(self, visit: _Visit) -> float:
        by_model = visit.fastest / self.estimator.maximum_frequency
        return max(SAMPLES_A_WAVE * visit.coarsest, by_model)

    def _longest(self) -> float:
        return self.estimator.cut_on_wavelength / CUT_ON_MARGIN

    def _resolved(self, band: tuple[float, float], visit: _Visit) -> bool:
        return band[0] >= self._shortest(visit) and band[1] <= self._longest()

    def _worth(self, sections: list[Section]) -> list[Section]:
        """Leave out the sections without a single figure."""
        return [section for section in sections if not all(map(math.isnan, section.rms))]


def dominant_wavelength(
    irregularity: Array,
    step: float,
    shortest: float,
    longest: float,
    prominence: float = 0.0,
) -> tuple[float, float, float]:
    """Return the wavelength that stands out most from the ISO 3095 spectrum.

    The power spectrum of the longest stretch without NaN (Hann window, linear trend removed,
    segments of at most 10 m) is integrated over sixths of an octave and divided by what the limit
    of ISO 3095 allows there; the peak is refined to the centroid of its power.

    Parameters
    ----------
    irregularity
        (n,) [m], `step` [m] apart.
    shortest, longest
        Range of the search [m]; the stretch must be four times as long as a wavelength.
    prominence
        [dB] by which the peak must exceed the median over the range.

    Returns
    -------
    tuple
        Wavelength [m], RMS [m] in the sixth of an octave around it and level above the limit
        [dB]; NaN each if nothing stands out or the range is empty.
    """
    nothing = (math.nan, math.nan, math.nan)
    stretch = _longest_finite(irregularity)
    longest = min(longest, LONGEST_SHARE * stretch.size * step)
    if longest < shortest * 2.0**PEAK_WIDTH:
        return nothing
    segment = min(stretch.size, round(10.0 / step))
    wave_number, power = signal.welch(
        stretch, 1.0 / step, 'hann', segment, detrend='linear', scaling='density'
    )
    line = wave_number[1]
    edges: Array = np.append(wave_number - 0.5 * line, wave_number[-1] + 0.5 * line)
    energy: Array = np.append(0.0, np.cumsum(power) * line)
    moment: Array = np.append(0.0, np.cumsum(power * wave_number) * line)
    fine: Array = np.exp(np.linspace(math.log(0.5 / longest), math.log(2.0 / shortest), 2000))
    limit = density(0.5 * (fine[1:] + fine[:-1])) * np.diff(fine)
    allowed: Array = np.append(0.0, np.cumsum(limit))

    def within(table: Array, over: Array, centre: ArrayLike) -> Array:
        low, high = (np.asarray(centre) * 2.0 ** (0.5 * end * PEAK_WIDTH) for end in (-1, 1))
        return np.asarray(np.interp(high, over, table) - np.interp(low, over, table))

    octaves = math.log2(longest / shortest)
    count = max(3, math.ceil(octaves / PEAK_WIDTH * PEAK_POINTS))
    centres = np.geomspace(1.0 / longest, 1.0 / shortest, count)
    excess = within(energy, edges, centres) / within(allowed, fine, centres)
    best = int(np.argmax(excess))
    if not excess[best] > 0.0 or 10.0 * math.log10(
        excess[best] / max(float(np.median(excess)), 1e-30)
    ) < prominence:
        return nothing
    centre = centres[best]
    for _ in range(3):
        centroid = float(within(moment, edges, centre) / within(energy, edges, centre))
        centre = min(max(centroid, centres[0]), centres[-1])
    square = float(within(energy, edges, centre))
    level = 10.0 * math.log10(square / float(within(allowed, fine, centre)))
    return 1.0 / centre, math.sqrt(square), level


def _longest_finite(values: Array) -> Array:
    bounds = np.flatnonzero(np.diff(np.concatenate(([0], np.isfinite(values), [0]))))
    if not bounds.size:
        return values[:0]
    starts, ends = bounds[::2], bounds[1::2]
    longest = int(np.argmax(ends - starts))
    return values[starts[longest] : ends[longest]]


def _stretches(index: NDArray[np.int64]) -> list[tuple[int, slice]]:
    """Return the constant stretches of a row of numbers with their places."""
    bounds = [0, *(np.flatnonzero(np.diff(index)) + 1).tolist(), index.size]
    return [(int(index[i]), slice(i, j)) for i, j in zip(bounds, bounds[1:], strict=False) if j > i]


def _group_delay(sos: Array, frequency: float) -> int:
    """Delay of a filter in samples at a frequency [cycles a sample], rounded."""
    low, high = 2.0 * math.pi * frequency * np.array([0.999, 1.001])
    _, response = signal.sosfreqz(sos, worN=np.array([low, high]))
    return round(float(-np.angle(response[1] / response[0]) / (high - low)))


def _new_visit() -> _Visit:
    return _Visit(np.zeros(len(BANDS)), np.zeros(len(BANDS)))
