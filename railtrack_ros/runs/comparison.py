"""Two descriptions of the same run held against each other: in what band, and how far apart.

Both signals of a pair pass through the same zero-phase filters first, so that a level difference
speaks of the signals and not of the filters.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from railtrack_ros.errors import InputError
from railtrack_ros.irregularity.spectra import HALF_BAND, REFERENCE, third_octave_levels

Array = NDArray[np.float64]

LOWEST = 20.0              # Hz, a force from acceleration under a constant static load holds above
HIGHEST = 10.0**3.45       # Hz, upper edge of the 2.5 kHz one-third octave, the models' last
USABLE = 0.4               # of the sample rate
EDGE = 3.0                 # periods of the lowest frequency lost at either end of a filtered piece
OVERSAMPLING = 2.56        # samples per period of the band's upper end
SHORTEST = 100             # samples: a shorter piece is not compared
COHERENCE_PERIODS = 4.0    # longest periods in a segment of the spectra that coherence is of
FEWEST_SEGMENTS = 8        # of half-overlapping segments: fewer make any two signals coherent


@dataclass(frozen=True)
class Band:
    """The frequencies in which signals are compared, low..high [Hz], at a sample period [s].

    High-pass: Butterworth of order 4, low-pass: Butterworth of order 8, both forwards and
    backwards, so without phase and with twice the attenuation.
    """

    low: float
    high: float
    time_step: float

    @property
    def edge(self) -> int:
        """Samples at either end of a piece that the filters' transients take."""
        return round(EDGE / self.low / self.time_step)

    @property
    def every(self) -> int:
        """Samples of which one is enough to hold a signal that is limited to the band."""
        return max(1, math.floor(1.0 / (OVERSAMPLING * self.high * self.time_step)))

    def low_pass(self, values: Array) -> Array:
        """Values (n,) without what lies above the band; static part kept, NaN kept."""
        return self._filtered(values, self._sections(8, self.high, 'lowpass'), static=True)

    def limit(self, values: Array) -> Array:
        """Values (n,) within the band; NaN kept, and put where a filter's transient is."""
        result = self._filtered(self.low_pass(values), self._sections(4, self.low, 'highpass'),
                                static=False)
        for begin, end in pieces(np.isfinite(values)):
            result[begin:begin + self.edge] = np.nan
            result[max(begin, end - self.edge):end] = np.nan
        return result

    def describe(self) -> str:
        """Say what the filters are, for the record."""
        return (f'Butterworth high-pass of order 4 at {self.low:.4g} Hz and low-pass of order 8 at '
                f'{self.high:.4g} Hz, both forwards and backwards (zero phase)')

    def _sections(self, order: int, frequency: float, kind: Literal['lowpass', 'highpass']
                  ) -> Array:
        return np.asarray(signal.butter(order, frequency, kind, fs=1.0 / self.time_step,
                                        output='sos'))

    @staticmethod
    def _filtered(values: Array, sections: Array, static: bool) -> Array:
        """Filter each gapless piece about its mean (a static 1e5 N would ring at its ends)."""
        result = np.full(np.shape(values), np.nan)
        for begin, end in pieces(np.isfinite(values)):
            if end - begin > SHORTEST:
                mean = np.mean(values[begin:end], dtype=float)
                moving = signal.sosfiltfilt(sections, values[begin:end] - mean)
                result[begin:end] = moving + mean if static else moving
        return result


def band_for(speed: float, cut_on_wavelength: float, time_step: float) -> Band:
    """Band in which an estimate and the full model driven by its irregularity can agree.

    Below twice the cut-on frequency v / cut_on of the irregularity the full model has no
    excitation, below 20 Hz the estimated force no suspension; above 2.8 kHz the models, and above
    0.4 of the sample rate the samples resolve nothing.

    Raises
    ------
    InputError
        Nothing is left, because of the speed [m/s] or of the sample period [s].
    """
    low = max(LOWEST, 2.0 * speed / cut_on_wavelength)
    high = min(HIGHEST, USABLE / time_step)
    if low * HALF_BAND**4 > high:
        raise InputError(f'at {speed:.3g} m/s and {1.0 / time_step:.4g} Hz there is no frequency '
                         f'to compare: it would have to be above {low:.3g} Hz (high-pass of the '
                         f'irregularity) and below {high:.3g} Hz (sample rate)')
    return Band(low, high, time_step)


def pieces(valid: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Return begin and end of each run of True in (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], valid, [False]]).astype(np.int8)))
    return iter([(int(a), int(b)) for a, b in edges.reshape(-1, 2)])


def longest_piece(valid: NDArray[np.bool_]) -> slice:
    """Return the longest run of True in (n,), empty if there is none."""
    begin, end = max(pieces(valid), key=lambda p: p[1] - p[0], default=(0, 0))
    return slice(begin, end)


@dataclass(frozen=True)
class BandLevels:
    """Two signals in one-third octaves of 1/step: levels and the level of their difference.

    centre (k,): exact centres in units of `step` (period [s] or wavelength [m]), from long to
    short; RMS values (k,) in the signals' own unit; coherence (k,) from 0 to 1, NaN where the
    record is too short to tell.
    """

    centre: Array
    compared: Array
    reference: Array
    difference: Array
    coherence: Array

    @property
    def level_difference(self) -> Array:
        """Level of the compared signal minus level of the reference (k,) [dB]."""
        return decibels(self.compared, self.reference)

    def lines(self) -> Iterator[tuple[float, float, float, float, float]]:
        """Return centre, the three RMS values and coherence, band by band."""
        return iter(zip(*(x.tolist() for x in (
            self.centre, self.compared, self.reference, self.difference, self.coherence)),
            strict=True))


def band_levels(compared: Array, reference: Array, step: float, longest: float,
                shortest: float) -> BandLevels | None:
    """Compare two gapless signals (n,) in the one-third octaves between two periods.

    Returns None where the record is too short for any band.
    """
    try:
        centre, *levels = _levels(step, longest, compared, reference, compared - reference)
    except InputError:
        return None
    inside = (centre * HALF_BAND <= longest * 1.0001) & (centre / HALF_BAND >= shortest * 0.9999)
    if not inside.any():
        return None
    first, second, difference = (REFERENCE * 10.0 ** (v[inside] / 20.0) for v in levels)
    return BandLevels(centre[inside], first, second, difference,
                      band_coherence(compared, reference, step, longest, centre[inside]))


def band_coherence(compared: Array, reference: Array, step: float, longest: float,
                   centre: Array) -> Array:
    """Return the coherence (k,) of two gapless signals (n,) in one-third octaves.

    The magnitude-squared coherence of averaged Hann-weighted spectra (half-overlapping segments of
    four times the longest period), averaged over each band with the power of the reference as
    weight: 1 where one signal is the other through a linear filter, near 0 for strangers.
    """
    segment = round(COHERENCE_PERIODS * longest / step)
    if segment < 8 or compared.size < (FEWEST_SEGMENTS + 1) * segment // 2:
        return np.full(centre.size, np.nan)
    frequency, cross = signal.csd(reference, compared, fs=1.0 / step, nperseg=segment)
    power = [signal.welch(x, fs=1.0 / step, nperseg=segment)[1] for x in (reference, compared)]
    with np.errstate(divide='ignore', invalid='ignore'):
        coherence = np.abs(cross) ** 2 / (power[0] * power[1])
    known = np.isfinite(coherence)
    weight = np.where(known, power[0], 0.0)
    running = [np.append(0.0, np.cumsum(x)) for x in (np.where(known, coherence, 0.0) * weight,
                                                      weight)]
    edges = np.append(frequency, 2.0 * frequency[-1] - frequency[-2]) - 0.5 * frequency[1]

    def within(table: Array) -> Array:
        return np.asarray(np.interp(HALF_BAND / centre, edges, table)
                          - np.interp(1.0 / HALF_BAND / centre, edges, table))

    with np.errstate(divide='ignore', invalid='ignore'):
        return within(running[0]) / within(running[1])


def _levels(step: float, longest: float, *signals: Array) -> list[Array]:
    found = [third_octave_levels(s, step, longest) for s in signals]
    return [found[0][0], *(level for _, level in found)]


def rms(values: Array) -> float:
    """Root mean square of the finite values."""
    return float(np.sqrt(np.mean(np.square(values[np.isfinite(values)]))))


def decibels(compared: Array | float, reference: Array | float) -> Array:
    """20 lg(compared / reference); two zeros are 0 dB apart."""
    compared, reference = np.asarray(compared, dtype=float), np.asarray(reference, dtype=float)
    with np.errstate(divide='ignore', invalid='ignore'):
        level = 20.0 * np.log10(compared / reference)
    return np.where((compared == 0.0) & (reference == 0.0), 0.0, level)


@dataclass(frozen=True)
class Error:
    """One line of the error table.

    band: 'all', 'section' (all frequencies, one section of track from `begin` to `end` [m] at the
    axle box's own place), 'frequency' or 'wavelength' (which of the two centres is exact; the
    other one follows from the mean speed); RMS values in the quantity's own unit. samples: how
    many it is over, the weight where lines of several pieces are put together.
    """

    quantity: str
    axle_box: str
    compared: str
    reference: str
    band: str
    frequency: float
    wavelength: float
    rms_compared: float
    rms_reference: float
    rms_difference: float
    samples: int = 0
    coherence: float = math.nan
    begin: float = math.nan
    end: float = math.nan

    @property
    def level_difference(self) -> float:
        """Level of the compared signal minus level of the reference [dB]."""
        return float(decibels(self.rms_compared, self.rms_reference))

    @property
    def difference_level(self) -> float:
        """Level of the difference signal re the reference [dB]."""
        return float(decibels(self.rms_difference, self.rms_reference))


def errors(quantity: str, axle_box: str, compared: tuple[str, Array], reference: tuple[str, Array],
           distance: Array, band: Band) -> list[Error]:
    """Error table of a pair of band-limited signals (n,), NaN where there is nothing to compare.

    Parameters
    ----------
    compared, reference
        Name and band-limited samples of each.
    distance
        (n,) distance run [m], for the wavelengths; not decreasing.

    Returns
    -------
    list
        One line over all, then the one-third octaves of frequency and those of wavelength over the
        longest gapless piece; empty if nothing can be compared.
    """
    both = np.isfinite(compared[1]) & np.isfinite(reference[1])
    part = longest_piece(both)
    if part.stop - part.start < SHORTEST:
        return []
    step = band.time_step * band.every
    a, b = compared[1][part][::band.every], reference[1][part][::band.every]
    run = distance[part][::band.every] - distance[part.start]
    speed = run[-1] / (step * (run.size - 1))
    names = (quantity, axle_box, compared[0], reference[0])
    count, size = int(both.sum()), part.stop - part.start
    lines = [Error(*names, 'all', np.nan, np.nan, rms(compared[1][both]), rms(reference[1][both]),
                   rms((compared[1] - reference[1])[both]), count)]
    found = band_levels(a, b, step, 1.0 / band.low, 1.0 / band.high)
    if found is not None:
        lines += [Error(*names, 'frequency', 1.0 / c, speed * c, x, y, xy, size, coherence)
                  for c, x, y, xy, coherence in found.lines()]
    if speed > 0.0 and (np.diff(run) > 0.0).all():
        grid = np.arange(0.0, run[-1], speed * step)
        found = band_levels(np.interp(grid, run, a), np.interp(grid, run, b), speed * step,
                            speed / band.low, speed / band.high)
        if found is not None:
            lines += [Error(*names, 'wavelength', speed / c, c, x, y, xy, size, coherence)
                      for c, x, y, xy, coherence in found.lines()]
    return lines


def section_errors(quantity: str, axle_box: str, compared: tuple[str, Array],
                   reference: tuple[str, Array], place: Array, length: float) -> list[Error]:
    """Error table of a pair of band-limited signals (n,) by sections of `length` [m] of track.

    Parameters
    ----------
    place
        (n,) the axle box's own track position [m].
    """
    both = np.isfinite(compared[1]) & np.isfinite(reference[1]) & np.isfinite(place)
    index = np.floor(place[both] / length).astype(np.int64)
    a, b = compared[1][both], reference[1][both]
    lines = []
    for number in np.unique(index):
        there = index == number
        if there.sum() >= SHORTEST:
            lines.append(Error(
                quantity, axle_box, compared[0], reference[0], 'section', np.nan, np.nan,
                rms(a[there]), rms(b[there]), rms((a - b)[there]), int(there.sum()),
                begin=float(number * length), end=float((number + 1) * length)))
    return lines


def merged(tables: Iterable[Sequence[Error]]) -> list[Error]:
    """Return one error table of those of several pieces of a run.

    Mean squares and coherence are averaged with the samples as weights, line by line.
    """
    together: dict[tuple[Any, ...], list[Error]] = {}
    for line in itertools.chain.from_iterable(tables):
        exact = line.wavelength if line.band == 'wavelength' else line.frequency
        centre = None if math.isnan(exact) else round(10.0 * math.log10(exact))
        begin = None if math.isnan(line.begin) else line.begin
        together.setdefault((line.quantity, line.axle_box, line.compared, line.reference,
                             line.band, centre, begin), []).append(line)
    return [_mean(lines) if len(lines) > 1 else lines[0] for lines in together.values()]


def _mean(lines: Sequence[Error]) -> Error:
    weight = np.array([line.samples for line in lines], dtype=float)

    def mean(values: Iterable[float]) -> float:
        x = np.array(list(values))
        known = np.isfinite(x)
        return float(np.average(x[known], weights=weight[known])) if known.any() else math.nan

    squares: dict[str, Any] = {name: math.sqrt(mean(getattr(line, name) ** 2 for line in lines))
               for name in ('rms_compared', 'rms_reference', 'rms_difference')}
    means: dict[str, Any] = {name: mean(getattr(line, name) for line in lines)
             for name in ('frequency', 'wavelength', 'coherence')}
    return replace(lines[0], **squares, **means, samples=int(weight.sum()))
