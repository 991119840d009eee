"""Roughness levels in one-third octaves, the contact filter, and the noise index.

What is estimated is the combined irregularity of wheel and rail as the contact patch filters it,
measured indirectly. Divided by the contact filter it compares with the limit of ISO 3095, down to
20 mm: below, the correction exceeds 12 dB, and nothing is called absolute roughness.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import integrate, special

from railtrack_ros.errors import InputError
from railtrack_ros.irregularity.spectra import iso3095_limit

Array = NDArray[np.float64]

# Exact centres of the one-third octaves from 1 m down to 10 mm [m].
CENTRES = 10.0 ** (-np.arange(0, 21) / 10.0)

SHORTEST_ABSOLUTE = 0.02  # m

# Contact filters of Directive (EU) 2015/996, table G-2 (CNOSSOS A3), wheel of 920 mm [dB], for the
# one-third octaves from 2 m to 0.8 mm and wheel loads of 25, 50 and 100 kN.
TABLE_WAVELENGTH = 10.0 ** (-np.arange(-3, 32) / 10.0)
TABLE_LOAD = (25e3, 50e3, 100e3)
TABLE_FILTER = np.array([
    [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -0.1, -0.3, -0.5, -1.1,
     -1.8, -3.3, -5.3, -7.9, -12.8, -16.8, -17.7, -18.2, -20.5, -22.0, -22.8, -24.2, -24.5, -25.0,
     -27.4, -28.2, -29.0],
    [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -0.1, -0.1, -0.3, -0.6, -1.1, -1.3,
     -3.5, -5.3, -8.0, -12.0, -16.8, -17.7, -18.0, -21.5, -21.8, -22.8, -24.0, -24.5, -25.0, -27.3,
     -28.1, -28.9, -29.7],
    [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -0.1, -0.2, -0.3, -0.6, -1.0, -1.8,
     -3.2, -5.4, -8.7, -12.2, -16.7, -17.7, -17.8, -20.7, -22.1, -22.8, -24.0, -24.5, -24.7,
     -27.0, -27.8, -28.6, -29.4, -30.2],
])  # fmt: skip

FILTERS = ('cnossos', 'remington', 'none')

# For the contact ellipse of Remington's filter: steel, and the transverse radius of the rail head.
PLANE_STRAIN_MODULUS = 210e9 / (1.0 - 0.3**2)
RAIL_HEAD_RADIUS = 0.3  # m

# The noise index is given where the bands that are resolved make up this share of the energy that
# the weighted limit of ISO 3095 has between these wavelengths [m].
NOISE_RANGE = (SHORTEST_ABSOLUTE, 0.4)
NOISE_SHARE = 0.8

# The rule of +2 dB (levels relative to the curve of ISO 3095) and its lengths [m].
TRIGGER = 2.0
CLEAR = 1.0
SHORT_STRETCH = 50.0
NEIGHBOURHOOD = 200.0


def contact_filter(kind: str, wavelength: ArrayLike, load: float, radius: float) -> Array:
    """Return what the contact patch takes off the roughness level [dB, negative].

    Parameters
    ----------
    kind
        'cnossos': the table, over the logarithm of the load between 25 and 100 kN, nearest beyond;
        'remington': the analytical filter of a circular patch; 'none': zero.
    wavelength
        [m], any shape.
    load, radius
        Wheel load [N] and wheel radius [m]. The table is that of a wheel of 0.46 m.

    Raises
    ------
    InputError
        Another kind.
    """
    wavelength = np.asarray(wavelength, dtype=float)
    if kind == 'none':
        return np.zeros(wavelength.shape)
    if kind == 'remington':
        patch = contact_radius(load, radius)
        flat = [remington(2.0 * math.pi / w * patch) for w in wavelength.ravel()]
        return np.array(flat).reshape(wavelength.shape)
    if kind != 'cnossos':
        raise InputError(f'contact filter: expected one of {", ".join(FILTERS)}, got {kind!r}')
    where = -np.log10(wavelength)
    each = [np.interp(where, -np.log10(TABLE_WAVELENGTH), row) for row in TABLE_FILTER]
    place = float(np.interp(math.log(load), np.log(TABLE_LOAD), (0.0, 1.0, 2.0)))
    low = min(int(place), 1)
    return np.asarray(each[low] + (place - low) * (each[low + 1] - each[low]))


def contact_radius(load: float, radius: float) -> float:
    """Return the radius [m] of the contact patch, a = (3 W R / (4 E*))^(1/3) after Hertz.

    1/R is the mean curvature of wheel and rail head; E* that of two bodies of steel.
    """
    together = 2.0 / (1.0 / radius + 1.0 / RAIL_HEAD_RADIUS)
    return (3.0 * load * together / (4.0 * 0.5 * PLANE_STRAIN_MODULUS)) ** (1.0 / 3.0)


def remington(ka: float, alpha: float = 1.0) -> float:
    """Return Remington's contact filter [dB] at wavenumber times patch radius.

    |H|^2 = 4 / (alpha (ka)^2) int_0^atan(alpha) J1(ka sec psi)^2 dpsi, alpha the decay of the
    correlation across the rail.
    """
    value, _ = integrate.quad(
        lambda psi: special.j1(ka / math.cos(psi)) ** 2, 0.0, math.atan(alpha), limit=200)
    return 10.0 * math.log10(4.0 / (alpha * ka**2) * value)


def a_weighting(frequency: ArrayLike) -> Array:
    """Return the A-weighting [dB] of IEC 61672-1 at frequencies [Hz]."""
    f = np.asarray(frequency, dtype=float) ** 2
    gain = 12194.0**2 * f**2 / (
        (f + 20.6**2) * np.sqrt((f + 107.7**2) * (f + 737.9**2)) * (f + 12194.0**2))
    return np.asarray(20.0 * np.log10(gain) + 2.0)


def noise_index(wavelength: Array, level: Array, speed: float) -> float:
    """Return by how many dB the rolling noise excited is above that of the ISO 3095 curve.

    10 lg sum 10^((L + A(v / lambda)) / 10) over the one-third octaves from 20 mm to 0.4 m, less the
    same of the limit: energy sums of the roughness level and the A-weighting at the frequency
    v / lambda that it excites.

    Parameters
    ----------
    wavelength, level
        (bands,) centres [m] and levels without the contact filter [dB re 1 um], NaN where not
        resolved.
    speed
        Of the traffic [m/s].

    Returns
    -------
    float
        [dB], NaN where the bands that are resolved say too little.
    """
    inside = (wavelength >= NOISE_RANGE[0] * 0.99) & (wavelength <= NOISE_RANGE[1] * 1.01)
    weight = a_weighting(speed / wavelength)
    allowed = 10.0 ** (0.1 * (iso3095_limit(wavelength) + weight))
    given = inside & np.isfinite(level)
    if not given.any() or allowed[given].sum() < NOISE_SHARE * allowed[inside].sum():
        return math.nan
    measured = 10.0 ** (0.1 * (level[given] + weight[given]))
    return float(10.0 * np.log10(measured.sum() / allowed[given].sum()))


def grinding_due(start: Array, end: Array, index: Array) -> list[str]:
    """Apply the rule of +2 dB to the noise index along a rail.

    A stretch at +2 dB or more is due ('grind') unless it is no longer than 50 m and the 200 m on
    either side are known and below ('short'). From +1 dB on a stretch is to be watched ('watch'):
    one that was due before stays so. Below it is 'clear'.

    Parameters
    ----------
    start, end, index
        (n,) of neighbouring sections in order [m] and their noise index [dB], NaN where unknown.

    Returns
    -------
    list
        (n,) words, empty where the index is unknown.
    """
    words = [
        '' if math.isnan(i) else 'grind' if i >= TRIGGER else 'watch' if i >= CLEAR else 'clear'
        for i in index]
    loud = [word == 'grind' for word in words]
    first = 0
    while first < len(words):
        if not loud[first]:
            first += 1
            continue
        last = first
        while last + 1 < len(words) and loud[last + 1] and start[last + 1] <= end[last] + 1e-6:
            last += 1
        if end[last] - start[first] <= SHORT_STRETCH + 1e-6:
            beside = ((end > start[first] - NEIGHBOURHOOD) & (end <= start[first] + 1e-6)) | (
                (start < end[last] + NEIGHBOURHOOD) & (start >= end[last] - 1e-6))
            known = beside & np.isfinite(index)
            reach = float(np.sum((end - start)[known]))
            if reach >= 2.0 * NEIGHBOURHOOD - 1e-6 and not np.any(index[known] >= TRIGGER):
                words[first : last + 1] = ['short'] * (last + 1 - first)
        first = last + 1
    return words
