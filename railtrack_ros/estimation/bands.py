"""Bands of wavelength and their filters: causal for the live stream, zero-phase for analysis.

A band's filter is the Butterworth band-pass of order 4 in wavenumber, -3 dB at the band's ends.
With k the wavenumber, k1 < k2 those of the ends and the bilinear warping left aside,

    |H|^2 = 1 / (1 + ((k^2 - k1 k2) / (k (k2 - k1)))^8) .

Live it runs causally, and each value is booked as far back as the filter delays the middle of its
band. The analysis of a recording multiplies the spectrum of a stretch by |H|: the same gain at
every wavelength and no delay at any.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal

from railtrack_ros.compiled import njit

Array = NDArray[np.float64]
Band = tuple[float, float]  # shortest and longest wavelength [m]

ORDER = 4

# A band-pass is taken to have settled after so many of its longest wavelengths.
SETTLING = 1.5

# A band's signal is kept with so many points in its shortest wave at least.
POINTS_A_WAVE = 10


def band_name(band: Band) -> str:
    """Return a band's name in columns and topics, such as ``30_100`` (mm)."""
    return '_'.join(f'{1e3 * end:.6g}'.replace('.', 'p') for end in band)


def band_title(band: Band) -> str:
    """Return a band's name for people, such as ``30-100 mm``."""
    return f'{1e3 * band[0]:.6g}-{1e3 * band[1]:.6g} mm'


def design(band: Band, step: float) -> Array:
    """Return the band's filter for points `step` [m] apart, second-order sections (4, 6)."""
    shortest, longest = band
    edges = (1.0 / longest, min(1.0 / shortest, 0.499 / step))
    return np.asarray(signal.butter(ORDER, edges, 'bandpass', fs=1.0 / step, output='sos'))


def gain(band: Band, step: float, wavenumber: Array) -> Array:
    """Return the magnitude of the band's filter at wavenumbers [1/m]."""
    _, response = signal.sosfreqz(design(band, step), worN=wavenumber, fs=1.0 / step)
    return np.abs(response)


def stride(band: Band, step: float) -> int:
    """Return how many points of the grid apart the values of a band's signal are kept."""
    return max(1, round(band[0] / POINTS_A_WAVE / step))


def settling(band: Band, step: float) -> int:
    """Return the number of points that a band's filter takes to settle."""
    return round(SETTLING * band[1] / step)


def delay(band: Band, step: float) -> int:
    """Return the filter's group delay in the middle of the band [points]."""
    middle = 2.0 * math.pi * step / math.sqrt(band[0] * band[1])
    low, high = 0.999 * middle, 1.001 * middle
    _, response = signal.sosfreqz(design(band, step), worN=np.array([low, high]))
    return round(float(-np.angle(response[1] / response[0]) / (high - low)))


class CausalBands:
    """The filters of several bands over several channels, going on from call to call."""

    def __init__(self, bands: tuple[Band, ...], step: float, channels: int) -> None:
        self._sections = np.ascontiguousarray([design(band, step) for band in bands])
        self._settling = np.array([settling(band, step) for band in bands])
        self._state = np.zeros((channels, len(bands), self._sections.shape[1], 2))
        self._since_bad = np.zeros(channels, dtype=np.int64)

    def filter(self, values: Array) -> Array:
        """Return (bands, n, channels) of values (n, channels); NaN where not settled."""
        out = np.empty((len(self._sections), *values.shape))
        _filter(values, self._sections, self._state, self._since_bad, self._settling, out)
        return out


@njit(cache=True, nogil=True)
def _filter(values, sections, state, since_bad, settling, out):
    bands, orders, _ = sections.shape
    for c in range(values.shape[1]):
        for b in range(bands):
            since = since_bad[c]
            for n in range(values.shape[0]):
                x = values[n, c]
                since += 1
                if x != x:
                    x, since = 0.0, 0
                for k in range(orders):
                    y = sections[b, k, 0] * x + state[c, b, k, 0]
                    state[c, b, k, 0] = (
                        sections[b, k, 1] * x - sections[b, k, 4] * y + state[c, b, k, 1]
                    )
                    state[c, b, k, 1] = sections[b, k, 2] * x - sections[b, k, 5] * y
                    x = y
                out[b, n, c] = x if since > settling[b] else np.nan
        since_bad[c] = since


def zero_phase(values: Array, bands: tuple[Band, ...], step: float) -> list[Array]:
    """Filter a stretch in every band without delay.

    Parameters
    ----------
    values
        (n, channels), NaN where not valid.
    step
        Of the points [m].

    Returns
    -------
    list
        (ceil(n / stride), channels) for each band: every stride-th point, NaN within the settling
        distance of a point that is not valid or of an end.
    """
    n = len(values)
    bad = np.isnan(values)
    reach = max(settling(band, step) for band in bands)
    size = fft.next_fast_len(n + 2 * reach, real=True)
    spectrum = fft.rfft(np.where(bad, 0.0, values), size, axis=0)
    wavenumber = fft.rfftfreq(size, step)
    distance = np.minimum(_since(bad), _since(bad[::-1])[::-1])
    found = []
    for band in bands:
        shaped = fft.irfft(spectrum * gain(band, step, wavenumber)[:, None], size, axis=0)[:n]
        valid = distance > settling(band, step)
        found.append(np.where(valid, shaped, np.nan)[:: stride(band, step)])
    return found


def _since(bad: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Points (n, channels) since the last that was not valid, or since the beginning."""
    n = np.arange(1, len(bad) + 1)[:, None]
    return n - np.maximum.accumulate(np.where(bad, n, 0), axis=0)
