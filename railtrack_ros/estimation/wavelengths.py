"""The spectrum of a section of track over wavelength: levels, and what stands out of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from railtrack_ros.compiled import njit
from railtrack_ros.irregularity.spectra import HALF_BAND, density

Array = NDArray[np.float64]

# Length of the segments that are transformed [m].
SEGMENT = 10.0

# Resolution of the search for the dominant wavelength: share of an octave, and points a band.
PEAK_WIDTH = 1.0 / 6.0
PEAK_POINTS = 6

# A stretch of irregularity resolves wavelengths of at most this share of its length (EN 15610).
LONGEST_SHARE = 0.25

NOTHING = (math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class Spectrum:
    """Power of irregularity over wavenumber, integrated from zero on.

    edges (k + 1,) [1/m] between the spectral lines; energy (k + 1,) [m^2] and moment (k + 1,)
    [m^2/m], the integrals of power and of power times wavenumber up to there. length [m]: of the
    longest stretch without a gap.
    """

    edges: Array
    energy: Array
    moment: Array
    length: float

    def mean_square(self, low: ArrayLike, high: ArrayLike) -> Array:
        """Mean square [m^2] of the irregularity between two wavenumbers [1/m]."""
        return _between(self.energy, self.edges, low, high)

    def levels(self, wavelength: ArrayLike, half_band: float = HALF_BAND) -> Array:
        """Levels [dB re 1 um] in bands (one-third octaves) centred on wavelengths [m]."""
        centre = 1.0 / np.asarray(wavelength, dtype=float)
        square = self.mean_square(centre / half_band, centre * half_band)
        with np.errstate(divide='ignore'):
            return np.asarray(10.0 * np.log10(square / 1e-12))


def spectrum(irregularity: NDArray[np.floating], step: float) -> Spectrum | None:
    """Return the spectrum of the longest stretch without NaN, None where there is none.

    Half-overlapping segments of at most 10 m, each freed of its linear trend and weighted by a
    Hann window; a line's power lies evenly over the interval around it.

    irregularity (n,) [m], `step` [m] apart.
    """
    stretch = longest_finite(irregularity)
    if stretch.size < 8:
        return None
    size = min(stretch.size, round(SEGMENT / step))
    window, scale = _window(size)
    line = 1.0 / (size * step)
    edges = _edges(size, step)
    energy, moment = np.zeros(edges.size), np.zeros(edges.size)
    begins = range(0, stretch.size - size + 1, max(size // 2, 1))
    for begin in begins:
        # In single precision: twice as fast, and its error 120 dB down.
        lines = fft.rfft(_windowed(stretch[begin : begin + size], window))
        _add_power(lines, 2.0 * scale * step * line / len(begins), line, energy, moment)
    return Spectrum(edges, energy, moment, stretch.size * step)


def mean_spectrum(spectra: list[Spectrum]) -> Spectrum:
    """Return the mean of the powers of several stretches, on the lines of the shortest one."""
    short = min(spectra, key=lambda item: item.length)
    energy, moment = (
        np.mean([np.interp(short.edges, s.edges, getattr(s, name)) for s in spectra], axis=0)
        for name in ('energy', 'moment'))  # fmt: skip
    return Spectrum(short.edges, energy, moment, short.length)


def dominant(found: Spectrum | None, shortest: float, longest: float, prominence: float = 0.0
             ) -> tuple[float, float, float]:
    """Return the wavelength that stands out most from the ISO 3095 spectrum.

    The power in sixths of an octave is divided by what the limit of ISO 3095 allows there; the
    peak is refined to the centroid of its power.

    Parameters
    ----------
    found
        The spectrum, None where there is none.
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
    if found is None:
        return NOTHING
    longest = min(longest, LONGEST_SHARE * found.length)
    if longest < shortest * 2.0**PEAK_WIDTH:
        return NOTHING
    centres, low, high, limit = _search(shortest, longest)
    excess = found.mean_square(low, high) / limit
    # A peak has a lower level on either side: a rise towards an end of the range is none.
    peaks = 1 + np.flatnonzero((excess[1:-1] > excess[:-2]) & (excess[1:-1] >= excess[2:]))
    if not peaks.size:
        return NOTHING
    best = int(peaks[np.argmax(excess[peaks])])
    median = float(np.sort(excess)[excess.size // 2])
    if not excess[best] > 0.0 or (
        10.0 * math.log10(excess[best] / max(median, 1e-30)) < prominence
    ):
        return NOTHING
    centre = float(centres[best])
    for _ in range(3):
        low, high = _sixth(centre)
        centroid = float(_between(found.moment, found.edges, low, high)
                         / found.mean_square(low, high))
        centre = min(max(centroid, float(centres[0])), float(centres[-1]))
    square = float(found.mean_square(*_sixth(centre)))
    level = 10.0 * math.log10(square / float(allowed(*_sixth(centre))))
    return 1.0 / centre, math.sqrt(square), level


def dominant_wavelength(irregularity: Array, step: float, shortest: float, longest: float,
                        prominence: float = 0.0) -> tuple[float, float, float]:
    """Return what :func:`dominant` finds in irregularity (n,) [m], `step` [m] apart."""
    return dominant(spectrum(irregularity, step), shortest, longest, prominence)


def allowed(low: ArrayLike, high: ArrayLike) -> Array:
    """Mean square [m^2] that the limit of ISO 3095 allows between two wavenumbers [1/m]."""
    wavenumber, running = _limit()
    return _between(running, wavenumber, low, high)


def longest_finite(values: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the longest stretch of values (n,) without NaN."""
    if math.isfinite(float(values.sum())):
        return values
    bounds = np.flatnonzero(np.diff(np.concatenate(([0], np.isfinite(values), [0]))))
    if not bounds.size:
        return values[:0]
    starts, ends = bounds[::2], bounds[1::2]
    longest = int(np.argmax(ends - starts))
    return values[starts[longest] : ends[longest]]


def _sixth(centre: ArrayLike) -> tuple[Array, Array]:
    half = 2.0 ** (0.5 * PEAK_WIDTH)
    return np.asarray(centre) / half, np.asarray(centre) * half


def _between(running: Array, over: Array, low: ArrayLike, high: ArrayLike) -> Array:
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    return np.asarray(np.interp(high, over, running) - np.interp(low, over, running))


def _running(power: Array) -> Array:
    return np.append(0.0, np.cumsum(power))


@lru_cache(maxsize=64)
def _search(shortest: float, longest: float) -> tuple[Array, Array, Array, Array]:
    """Centres of the sixths of an octave [1/m], their edges, and what the limit allows there."""
    octaves = math.log2(longest / shortest)
    count = max(3, math.ceil(octaves / PEAK_WIDTH * PEAK_POINTS))
    centres = np.asarray(np.exp(np.linspace(-math.log(longest), -math.log(shortest), count)),
                         dtype=np.float64)
    low, high = _sixth(centres)
    return centres, low, high, allowed(low, high)


@lru_cache(maxsize=8)
def _edges(size: int, step: float) -> Array:
    """Wavenumbers [1/m] between the spectral lines of so many points: one for all sections."""
    edges: Array = (np.arange(size // 2 + 2, dtype=np.float64) - 0.5) / (size * step)
    edges.setflags(write=False)
    return edges


@lru_cache(maxsize=8)
def _window(size: int) -> tuple[Array, float]:
    """Hann window, and one over its power."""
    window = 0.5 - 0.5 * np.cos(2.0 * math.pi * np.arange(size) / size)
    return np.asarray(window), 1.0 / float(np.sum(window**2))


@njit(cache=True, nogil=True)
def _windowed(values, window):
    """Values (n,) without their linear trend (least squares), times the window."""
    n = values.size
    middle = 0.5 * (n - 1)
    total, moment = 0.0, 0.0
    for i in range(n):
        total += values[i]
        moment += values[i] * (i - middle)
    mean, slope = total / n, 12.0 * moment / (n * (n * n - 1.0))
    out = np.empty(n, dtype=np.float32)
    for i in range(n):
        out[i] = (values[i] - mean - slope * (i - middle)) * window[i]
    return out


@njit(cache=True, nogil=True)
def _add_power(lines, scale, line, energy, moment):
    """Add the power of spectral lines, and its first moment, to their running sums."""
    total, first = 0.0, 0.0
    even = energy.size - 2  # number of the last line, alone if the length was even
    for k in range(lines.size):
        power = scale * (lines[k].real ** 2 + lines[k].imag ** 2)
        if k == 0 or (k == even and lines[k].imag == 0.0):
            power *= 0.5
        total += power
        first += power * k * line
        energy[k + 1] += total
        moment[k + 1] += first


@lru_cache(maxsize=1)
def _limit() -> tuple[Array, Array]:
    """Wavenumbers [1/m] and the mean square that ISO 3095 allows from the first of them on."""
    wavenumber: Array = np.asarray(np.geomspace(0.05, 2000.0, 6000), dtype=np.float64)
    middle = 0.5 * (wavenumber[1:] + wavenumber[:-1])
    return wavenumber, _running(density(middle) * np.diff(wavenumber))
