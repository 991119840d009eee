"""Roughness levels by wavelength: the limit of ISO 3095 and one-third octaves of a profile.

Levels are 10 lg(r_rms^2 / (1 um)^2) dB in one-third octaves centred on the wavenumbers 10^(k/10)
1/m with edges 10^(k/10 +- 1/20) 1/m (EN 15610:2009).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import signal

from railtrack_ros.errors import InputError

Array = NDArray[np.float64]

REFERENCE = 1e-6  # m, RMS of 0 dB
HALF_BAND = 10.0**0.05  # edge over centre of a one-third octave

# Limit of EN ISO 3095:2013 figure 2 by the exact centre wavelengths 10^(-k/10) m: the standard's
# 0.4 m to 3.15 mm (k = 4 to 25), continued to 2 m and to 0.8 mm as Directive (EU) 2015/996
# table G-1 does.
LIMIT_WAVELENGTH = 10.0 ** (-np.arange(-3, 32) / 10.0)
LIMIT_LEVEL = np.array([
    17.1, 17.1, 17.1, 17.1, 17.1, 17.1, 17.1,
    17.1, 15.0, 13.0, 11.0, 9.0, 7.0, 4.9, 2.9, 0.9, -1.1, -3.2,
    -5.0, -5.6, -6.2, -6.8, -7.4, -8.0, -8.6, -9.2, -9.8, -10.4, -11.0,
    -11.6, -12.2, -12.8, -13.4, -14.0, -14.0,
])


def iso3095_limit(wavelength: ArrayLike) -> Array:
    """Limit level [dB re 1 um] of ISO 3095:2013 in the one-third octave at wavelength [m].

    Linear in dB over the logarithm of the wavelength between the bands' centres, constant beyond
    2 m and 0.8 mm.
    """
    where = -np.log10(np.asarray(wavelength, dtype=float))
    return np.interp(where, -np.log10(LIMIT_WAVELENGTH), LIMIT_LEVEL)


def density(wavenumber: ArrayLike) -> Array:
    """One-sided spectral density [m^3] of the ISO 3095 limit at wavenumbers [1/m].

    Its integral over a one-third octave is the mean square that the limit allows there.
    """
    wavenumber = np.asarray(wavenumber, dtype=float)
    width = wavenumber * (HALF_BAND - 1.0 / HALF_BAND)
    return REFERENCE**2 * 10.0 ** (iso3095_limit(1.0 / wavenumber) / 10.0) / width


def third_octave_levels(irregularity: ArrayLike, step: float, longest: float = 1.0
                        ) -> tuple[Array, Array]:
    """One-third-octave roughness levels of a uniformly sampled profile.

    Power spectra of half-overlapping segments of 16 times the longest wavelength (or the whole
    record if that is shorter), each freed of its linear trend and weighted by a Hann window, are
    averaged; a spectral line across a band's edge is shared between the bands.

    Parameters
    ----------
    irregularity
        Samples (n,) [m], `step` [m] apart.
    longest
        Longest centre wavelength [m] wanted.  A record resolves a quarter of its own length.

    Returns
    -------
    tuple
        Exact centre wavelengths [m], from long to short, and levels [dB re 1 um], (bands,) each.

    Raises
    ------
    InputError
        A record without a single band between a quarter of its length and two samples.
    """
    irregularity = np.asarray(irregularity, dtype=float)
    if irregularity.ndim != 1 or not np.isfinite(irregularity).all():
        raise InputError('roughness levels: expected one row of finite values')
    segment = min(irregularity.size, round(16.0 * longest / step))
    first = np.ceil(10.0 * np.log10(max(1.0 / longest, 4.0 / (segment * step))) - 1e-9)
    last = np.floor(10.0 * np.log10(0.5 / step / HALF_BAND) + 1e-9)
    if segment < 8 or last < first:
        raise InputError(f'roughness levels: {irregularity.size} samples {step:g} m apart resolve '
                         'no one-third octave')
    wavenumber, power = signal.welch(irregularity, fs=1.0 / step, window='hann', nperseg=segment,
                                     detrend=_without_trend, scaling='density')
    centre = 10.0 ** (np.arange(first, last + 1.0) / 10.0)
    # The running integral of the spectrum, each line spread over the interval around it.
    spacing = wavenumber[1]
    edges = np.append(wavenumber - 0.5 * spacing, wavenumber[-1] + 0.5 * spacing)
    running = np.append(0.0, np.cumsum(power) * spacing)
    mean_square = (np.interp(centre * HALF_BAND, edges, running)
                   - np.interp(centre / HALF_BAND, edges, running))
    with np.errstate(divide='ignore'):
        level = 10.0 * np.log10(mean_square / REFERENCE**2)
    return 1.0 / centre, level


def _without_trend(segments: Array) -> Array:
    """Segments (..., n) without their linear trends (least squares)."""
    ramp = np.arange(segments.shape[-1]) - 0.5 * (segments.shape[-1] - 1)
    slope = (segments @ ramp)[..., None] / (ramp @ ramp)
    return segments - segments.mean(axis=-1, keepdims=True) - slope * ramp
