"""Bands of wavelength and their filters: causal for the live stream, zero-phase for analysis.

A band's filter is the Butterworth band-pass of order 4 in wavenumber, -3 dB at the band's ends.
With k the wavenumber, k1 < k2 those of the ends,

    |H|^2 = 1 / (1 + ((q^2 - q1 q2) / (q (q2 - q1)))^8) ,   q = tan(pi k d) ,

where d is the distance of the points on which the filter runs: the grid has five to the shortest
wave of all, and is thinned out by threes for the longer bands as far as ten to a band's shortest
wave allow, each time through a symmetric filter that lets no more than a three thousandth of what
is shorter fold back into the band.

Live the band-pass runs causally, and each value is booked as far back as it delays the middle of
its band. The analysis of a recording multiplies the spectrum of a stretch by |H|: the same gain at
every wavelength and no delay at any.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal

from railtrack_ros.compiled import njit
from railtrack_ros.estimation.kept import Kept

Array = NDArray[np.float64]
SingleArray = NDArray[np.float32]
Band = tuple[float, float]  # shortest and longest wavelength [m]

ORDER = 4

# A band-pass is taken to have settled after so many of its longest wavelengths.
SETTLING = 1.5

# Points in the shortest wave of a band when the grid is thinned out for it, and at least. Finest
# and coarsest grid [m].
POINTS_A_WAVE = 10
FEWEST_A_WAVE = 5
FINEST, COARSEST = 0.001, 0.002

# The filter before every third point alone is kept: flat for waves of 15 points and more, 70 dB
# down for those that would fold back on them.
THIRD = signal.firwin(23, 1.0 / 6.0, window=('kaiser', 6.76), fs=1.0).astype(np.float32)
HALF_THIRD = THIRD.size // 2


def band_name(band: Band) -> str:
    """Return a band's name in columns and topics, such as ``30_100`` (mm)."""
    return '_'.join(f'{1e3 * end:.6g}'.replace('.', 'p') for end in band)


def band_title(band: Band) -> str:
    """Return a band's name for people, such as ``30-100 mm``."""
    return f'{1e3 * band[0]:.6g}-{1e3 * band[1]:.6g} mm'


def grid_step(bands: tuple[Band, ...]) -> float:
    """Return how far apart [m] the points of the grid have to be for some bands."""
    shortest = min(band[0] for band in bands)
    return min(max(shortest / FEWEST_A_WAVE, FINEST), COARSEST)


def stride(band: Band, step: float) -> int:
    """Return how many points of the grid apart those of a band are: a power of three."""
    found = 1
    while 3 * found * step * POINTS_A_WAVE <= band[0] * (1.0 + 1e-9):
        found *= 3
    return found


def design(band: Band, step: float) -> Array:
    """Return the filter of a band for its points on a grid of `step` [m], sections (4, 6)."""
    shortest, longest = band
    apart = stride(band, step) * step
    edges = (1.0 / longest, min(1.0 / shortest, 0.499 / apart))
    return np.asarray(signal.butter(ORDER, edges, 'bandpass', fs=1.0 / apart, output='sos'))


def gain(band: Band, step: float, wavenumber: Array) -> Array:
    """Return the magnitude of the band's filter at wavenumbers [1/m]."""
    apart = stride(band, step) * step
    _, response = signal.sosfreqz(design(band, step), worN=wavenumber, fs=1.0 / apart)
    return np.abs(response)


def settling(band: Band, step: float) -> int:
    """Return the number of points of the grid over which a band's filter settles."""
    return round(SETTLING * band[1] / step)


def delay(band: Band, step: float) -> int:
    """Return the filter's group delay in the middle of the band [points of the grid]."""
    apart = stride(band, step) * step
    middle = 2.0 * math.pi * apart / math.sqrt(band[0] * band[1])
    low, high = 0.999 * middle, 1.001 * middle
    _, response = signal.sosfreqz(design(band, step), worN=np.array([low, high]))
    return round(float(-np.angle(response[1] / response[0]) / (high - low)) * apart / step)


def lag(band: Band, step: float) -> int:
    """Return how many points of the grid later than they are reached a band's points are known."""
    return HALF_THIRD * (stride(band, step) - 1) // 2


class CausalBands:
    """The filters of several bands over several channels, going on from call to call.

    Attributes
    ----------
    signals
        By band: what has come out, points `stride` of the grid apart and numbered from that of
        number 0, NaN where not settled.

    Parameters
    ----------
    bands, step, channels
        What is filtered, and the step of the grid [m].
    begin
        Number of the first point of the grid to come.
    """

    def __init__(self, bands: tuple[Band, ...], step: float, channels: int, begin: int = 0
                 ) -> None:
        strides = [stride(band, step) for band in bands]
        self._levels = [3**n for n in range(1 + round(math.log(max(strides), 3)))]
        self._bands = [[b for b, apart in enumerate(strides) if apart == level]
                       for level in self._levels]  # fmt: skip
        self._sections = [design(band, step) for band in bands]
        self._settling = [math.ceil(settling(band, step) / apart)
                          for band, apart in zip(bands, strides, strict=True)]
        self._state = np.zeros((len(bands), channels, ORDER, 2))
        self._since_bad = np.zeros((len(bands), channels), dtype=np.int64)
        # What waits to be thinned out, with nothing before the first point.
        self._waiting = []
        numbers = {1: begin}
        for level in self._levels[1:]:
            # Every third point from the first one on that has points enough before it.
            before = numbers[level // 3]
            first = -(-before // 3)
            waiting = Kept(channels, begin=3 * first - HALF_THIRD)
            waiting.append(np.full((channels, before - waiting.begin), np.nan, dtype=np.float32))
            self._waiting.append(waiting)
            numbers[level] = first
        self.signals = [Kept(channels, begin=numbers[apart]) for apart in strides]

    def add(self, values: SingleArray) -> None:
        """Take the next points of the grid (channels, n), NaN where not valid."""
        for level, bands in enumerate(self._bands):
            for b in bands:
                out = np.empty(values.shape, dtype=np.float32)
                _filter(values, self._sections[b], self._state[b], self._since_bad[b],
                        self._settling[b], out)
                self.signals[b].append(out)
            if level < len(self._waiting):
                values = self._thinned(self._waiting[level], values)

    def _thinned(self, waiting: Kept, values: SingleArray) -> SingleArray:
        """Return the points that can be told of every third one."""
        waiting.append(values)
        first = (waiting.begin + HALF_THIRD) // 3
        count = max((waiting.end - 1 - HALF_THIRD) // 3 - first + 1, 0)
        out = np.empty((len(values), count), dtype=np.float32)
        _every_third(waiting.part(waiting.begin, waiting.end), THIRD, out)
        waiting.forget(3 * (first + count) - HALF_THIRD)
        return out


@njit(cache=True, nogil=True, fastmath={'reassoc', 'contract'})
def _every_third(values, taps, out):
    for c in range(out.shape[0]):
        for n in range(out.shape[1]):
            total = np.float32(0.0)
            for j in range(taps.size):
                total += taps[j] * values[c, 3 * n + j]
            out[c, n] = total


@njit(cache=True, nogil=True, fastmath={'contract'})
def _filter(values, sections, state, since_bad, settling, out):
    # Coefficients and state in scalars: to and from memory would be most of the work.
    b0, b1, b2, _, b4, b5 = sections[0]
    c0, c1, c2, _, c4, c5 = sections[1]
    d0, d1, d2, _, d4, d5 = sections[2]
    e0, e1, e2, _, e4, e5 = sections[3]
    for channel in range(values.shape[0]):
        since = since_bad[channel]
        (p0, p1), (q0, q1) = state[channel, 0], state[channel, 1]
        (r0, r1), (s0, s1) = state[channel, 2], state[channel, 3]
        for n in range(values.shape[1]):
            x = np.float64(values[channel, n])
            since += 1
            if x != x:
                x, since = np.float64(0.0), 0
            y = b0 * x + p0
            p0, p1 = b1 * x - b4 * y + p1, b2 * x - b5 * y
            x = c0 * y + q0
            q0, q1 = c1 * y - c4 * x + q1, c2 * y - c5 * x
            y = d0 * x + r0
            r0, r1 = d1 * x - d4 * y + r1, d2 * x - d5 * y
            x = e0 * y + s0
            s0, s1 = e1 * y - e4 * x + s1, e2 * y - e5 * x
            out[channel, n] = x if since > settling else np.nan
        state[channel, 0], state[channel, 1] = (p0, p1), (q0, q1)
        state[channel, 2], state[channel, 3] = (r0, r1), (s0, s1)
        since_bad[channel] = since


def zero_phase(values: NDArray[np.floating], bands: tuple[Band, ...], step: float
               ) -> list[SingleArray]:
    """Filter a stretch in every band without delay.

    Parameters
    ----------
    values
        (channels, n), NaN where not valid.
    step
        Of the points [m].

    Returns
    -------
    list
        (channels, ceil(n / stride)) for each band: every stride-th point, NaN within the settling
        distance of a point that is not valid or of an end.
    """
    n = values.shape[1]
    bad = np.isnan(values)
    reach = max(settling(band, step) for band in bands)
    coarsest = max(stride(band, step) for band in bands)
    size = coarsest * fft.next_fast_len(-(-(n + 2 * reach) // coarsest), real=True)
    spectrum = fft.rfft(np.where(bad, np.float32(0.0), values.astype(np.float32)), size)
    wavenumber = fft.rfftfreq(size, step)
    distance = np.minimum(_since(bad), _since(bad[:, ::-1])[:, ::-1])
    found = []
    for band in bands:
        apart = stride(band, step)
        lines = size // apart // 2 + 1
        passed = (gain(band, step, wavenumber[:lines]) / apart).astype(np.float32)
        shaped = fft.irfft(spectrum[:, :lines] * passed, size // apart)
        valid = distance[:, ::apart] > settling(band, step)
        found.append(np.where(valid, shaped[:, : valid.shape[1]], np.float32(np.nan)))
    return found


def _since(bad: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Points (channels, n) since the last that was not valid, or since the beginning."""
    n = np.arange(1, bad.shape[1] + 1)
    return n - np.maximum.accumulate(np.where(bad, n, 0), axis=1)
