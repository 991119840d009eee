"""Two results over the same track held against each other, aligned by position.

Odometers differ by metres and wheels wear, so the second result is shifted, window after window,
to where its irregularity agrees best with that of the first: the peak of the cross-correlation of
all axle boxes together. Both are then compared where they are, at the same place of the rail.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from railtrack_ros.bags.bag import Paths, open_bag, paths_of
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.section import SAMPLES_A_WAVE
from railtrack_ros.runs import comparison
from railtrack_ros.runs.comparison import Band, Error
from railtrack_ros.runs.result_stream import ResultStream, Source, find_source
from railtrack_ros.vehicle.description import Vehicle

Array = NDArray[np.float64]

FIRST, SECOND = 'first', 'second'
STEP = 1e-3                 # m, grid along the track
LONGEST = 10.0**0.15        # m, upper edge of the 1.25 m one-third octave
SHORTEST = 10.0**-2.05      # m, lower edge of the 10 mm one-third octave
WINDOW = 50.0               # m
SEARCH = 5.0                # m, how far apart odometers usually are
ALIGNED_BELOW = 0.3         # m, wavelengths that shifts are found by
FOLLOW = 0.3                # m by which the shift may change from one window to the next
LEAST_CORRELATION = 0.3     # below it two irregularities are not of the same rail
TINY = 1e-30
ALIGNED_BY = 'irregularity'


@dataclass(frozen=True)
class Shift:
    """How far the second result lies behind the first [m] in a window, and how sure that is."""

    begin: float
    end: float
    shift: float
    correlation: float


@dataclass
class Compared:
    """What two results over the same track have in common.

    shown: by quantity and axle box the start [m] of the window in which they differ most, and
    both signals on the grid there. most: how much that is, relative to the first.
    """

    first: Source
    second: Source
    axle_boxes: list[str]
    quantities: list[str]
    band: Band
    errors: list[Error] = field(default_factory=list)
    shifts: list[Shift] = field(default_factory=list)
    shown: dict[str, dict[str, tuple[float, Array, Array]]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    most: float = -1.0

    @property
    def extent(self) -> tuple[float, float]:
        """Track positions [m] between which both have results."""
        places = [(e.begin, e.end) for e in self.errors if e.band == 'section']
        return min(p[0] for p in places), max(p[1] for p in places)


def compare(
    first: Paths, second: Paths, prefixes: tuple[str | None, str | None] = (None, None),
    vehicle: Vehicle | None = None, search: float | None = None, section_length: float = 10.0,
    progress: Callable[[float], None] = lambda metres: None,
) -> Compared:
    """Compare two results along the track.

    Parameters
    ----------
    first, second
        Recordings with results: of the estimator, of a replay, or with truth; one recording may
        be both.
    prefixes
        Whose results in each, such as '/full_model'; None: the usual one.
    vehicle
        Its axle boxes; None: as the recordings tell.
    search
        How far apart the two may be at the beginning [m]; 0: positions are right as they are.
        None: 5 m, and 0 for two results of one recording.
    section_length
        Of the sections that errors are summed up over [m].
    progress
        Called with the metres that are compared.

    Raises
    ------
    InputError
        A recording has no such results, or the two have no quantity, no axle box, or no stretch
        of track in common.
    """
    if search is None:
        search = 0.0 if paths_of(first) == paths_of(second) else SEARCH
    with open_bag(first) as one, open_bag(second) as other:
        sources = find_source(one, prefixes[0], vehicle), find_source(other, prefixes[1], vehicle)
        quantities = [q for q in sources[0].quantities if q in sources[1].quantities]
        names = [[box.name for box in source.axle_boxes] for source in sources]
        boxes = [name for name in names[0] if name in names[1]]
        told = f'{sources[0].bag.path} and {sources[1].bag.path}'
        if not quantities:
            raise InputError(f'{told}: no quantity in common: '
                             f'{", ".join(sources[0].quantities)} and '
                             f'{", ".join(sources[1].quantities)}')
        if not boxes:
            raise InputError(f'{told}: no axle box in common: {", ".join(names[0])} and '
                             f'{", ".join(names[1])}')
        pair = ResultStream(sources[0]), ResultStream(sources[1])
        work = _Comparison(pair, boxes, quantities, search, section_length)
        found = Compared(*sources, boxes, quantities, Band(1.0 / LONGEST, 1.0 / SHORTEST, STEP))
        work.run(found, progress)
        found.notes += [note for bag in (one, other) for note in bag.notes]
    found.errors = comparison.merged([found.errors])
    if not any(e.band == 'all' for e in found.errors):
        raise InputError(f'{told}: nothing in common from {work.begin:.1f} m to {work.end:.1f} m: '
                         'no stretch of track of which both have valid results'
                         + (f' (the two are looked for within {search:g} m)' if search else ''))
    return found


class _Comparison:
    """Goes along the track, window by window."""

    def __init__(self, pair: tuple[ResultStream, ResultStream], boxes: list[str],
                 quantities: list[str], search: float, section_length: float) -> None:
        self._pair, self._boxes, self._quantities = pair, boxes, quantities
        self._search, self._section = search, section_length
        self._shift: float | None = None
        self._margin = comparison.EDGE * LONGEST + 1.0
        self.begin = self.end = math.nan

    def run(self, found: Compared, progress: Callable[[float], None]) -> None:
        """Compare all windows."""
        firsts = [stream.begin() for stream in self._pair]
        if not all(map(math.isfinite, firsts)):
            return
        start = self.begin = self.end = float(max(firsts[0], firsts[1] - self._search))
        going = True
        while going:
            stop = start + WINDOW
            reach = stop + self._margin
            going = self._pair[0].read_to(reach)
            going &= self._pair[1].read_to(reach + (abs(self._shift or 0.0)) + self._search)
            self._window(found, start, stop)
            start = self.end = stop
            for stream in self._pair:
                stream.forget(start - self._margin - self._search - abs(self._shift or 0.0))
            progress(start - self.begin)

    def _window(self, found: Compared, start: float, stop: float) -> None:
        grid: Array = np.arange(start - self._margin, stop + self._margin, STEP, np.float64)
        shift, correlation = self._aligned(grid)
        self._shift = shift
        core = slice(*np.searchsorted(grid, [start, stop]))
        band = self._band()
        shown: dict[str, dict[str, tuple[float, Array, Array]]] = {}
        score = -1.0
        for quantity in self._quantities:
            for box in self._boxes:
                curves = [stream.curves[quantity][box] for stream in self._pair]
                raw = curves[0].at(grid), curves[1].at(grid + shift)
                first, second = (band.limit(values)[core] for values in raw)
                lines = _errors(quantity, box, first, second, grid[core], band, self._section)
                found.errors += lines
                if lines:
                    shown.setdefault(quantity, {})[box] = (start, raw[0][core], raw[1][core])
                    score = max(score, lines[0].rms_difference / max(lines[0].rms_reference, TINY))
        if shown:
            found.band = band
            found.shifts.append(Shift(start, stop, shift, correlation))
        if score > found.most:
            found.most, found.shown = score, shown

    def _band(self) -> Band:
        """Return the wavenumbers that speed and sample rate of both resolve so far."""
        resolved = [max(SAMPLES_A_WAVE * stream.fastest * stream.time_step,
                        stream.fastest / comparison.HIGHEST) for stream in self._pair]
        shortest = max(SHORTEST, *resolved)
        if shortest > 0.5 * LONGEST:
            raise InputError(f'the two resolve no wave in common: the shortest is {shortest:.2g} m '
                             f'long, the longest {LONGEST:.2g} m')
        return Band(1.0 / LONGEST, 1.0 / shortest, STEP)

    def _aligned(self, grid: Array) -> tuple[float, float]:
        """Return the shift [m] of the second result against the first, and the correlation."""
        before = self._shift or 0.0
        reach = self._search if self._shift is None else min(self._search, FOLLOW)
        if self._search == 0.0:
            reach = 0.0
        quantity = ALIGNED_BY if ALIGNED_BY in self._quantities else self._quantities[0]
        lags = round(reach / STEP)
        short = signal.butter(2, 1.0 / ALIGNED_BELOW, 'high', fs=1.0 / STEP, output='sos')
        wide: Array = grid[0] + before - reach + STEP * np.arange(grid.size + 2 * lags)
        total, energy = np.zeros(2 * lags + 1), np.zeros((2, 2 * lags + 1))
        for box in self._boxes:
            one = self._pair[0].curves[quantity][box].at(grid)
            other = self._pair[1].curves[quantity][box].at(wide)
            known = [np.isfinite(one).astype(float), np.isfinite(other).astype(float)]
            one, other = (signal.sosfilt(short, np.nan_to_num(x)) * k
                          for x, k in zip((one, other), known, strict=True))
            total += _correlate(other, one)
            energy[0] += _correlate(known[1], one**2)
            energy[1] += _correlate(other**2, known[0])
        with np.errstate(divide='ignore', invalid='ignore'):
            correlation = np.where((energy > 0.0).all(axis=0),
                                   total / np.sqrt(np.abs(energy[0] * energy[1])), 0.0)
        # Where the two hardly overlap a few samples may agree by chance.
        correlation[energy.min(axis=0) < 0.2 * energy.max()] = 0.0
        best = int(np.argmax(correlation))
        if correlation[best] < LEAST_CORRELATION or reach == 0.0:
            return before, float(correlation[lags]) if correlation.size else math.nan
        return (before + (best - lags + _between(correlation, best)) * STEP,
                float(correlation[best]))


def _correlate(wide: Array, one: Array) -> Array:
    return np.asarray(signal.correlate(wide, one, 'valid', 'fft'))


def _between(values: Array, best: int) -> float:
    """Return where the parabola through a peak and its neighbours is highest, in samples."""
    if not 0 < best < values.size - 1:
        return 0.0
    left, top, right = values[best - 1:best + 2]
    curvature = left - 2.0 * top + right
    return float(0.5 * (left - right) / curvature) if curvature < 0.0 else 0.0


def _errors(quantity: str, box: str, first: Array, second: Array, place: Array, band: Band,
            section_length: float) -> list[Error]:
    """Error table of the second signal against the first in one window."""
    both = np.isfinite(first) & np.isfinite(second)
    part = comparison.longest_piece(both)
    if part.stop - part.start < 4.0 * LONGEST / STEP:
        return []
    names = (quantity, box, SECOND, FIRST)
    a, b = second[part], first[part]
    size = part.stop - part.start
    lines = [Error(*names, 'all', np.nan, np.nan, comparison.rms(second[both]),
                   comparison.rms(first[both]), comparison.rms((second - first)[both]),
                   int(both.sum()))]
    levels = comparison.band_levels(a, b, STEP, LONGEST, 1.0 / band.high)
    if levels is not None:
        lines += [Error(*names, 'wavelength', np.nan, c, x, y, xy, size, coherence)
                  for c, x, y, xy, coherence in levels.lines()]
    return lines + comparison.section_errors(
        quantity, box, (SECOND, second), (FIRST, first), place, section_length)


def shifted_by(found: Compared) -> Mapping[str, float]:
    """Return median, lowest and highest shift [m] of the windows that could be aligned."""
    sure = [s.shift for s in found.shifts if s.correlation >= LEAST_CORRELATION]
    if not sure:
        return {}
    return {'median': float(np.median(sure)), 'lowest': min(sure), 'highest': max(sure)}


def name_of(source: Source) -> str:
    """Return what a result is called in reports."""
    return f'{Path(source.bag.path).name}, {source.prefix}'
