"""Wheel against rail: what repeats with a wheel's circumference belongs to the wheel.

Over a stretch of some hundred metres the irregularity under wheel w is

    z_w(x) = r(x) + sum_n Re[ a_wn exp(2 pi i n x / C_w) ] ,

the same rail r under every wheel of a rail, and harmonics (orders n) of each wheel's own
circumference C_w = 2 pi R_w. C_w is searched near its nominal value where the spectrum at all
orders together stands out most. The amplitudes of an order are the generalised least-squares
solution for all wheels of the rail at once: the rail is common to them and random, with the power
of the spectrum beside the order. So differences between wheels, which are free of the rail, count
for much, and their mean for little. One wheel alone keeps the rail's share in the line,
-10 lg(revolutions) dB of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.optimize import minimize_scalar

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

ORDERS = 20

# The circumference is searched within this share of the nominal one.
SEARCH = 0.03

# Fewest revolutions, and the least valid share of the stretch.
LEAST_REVOLUTIONS = 20.0
LEAST_VALID = 0.8

# A circumference is believed if at least so many orders stand out of the spectrum beside them by so
# many dB, and not as multiples of one order alone: waves of the sleeper spacing do that.
STANDING_OUT = 10.0
LEAST_ORDERS = 3

# Variance of what differs between wheels besides their orders, relative to the rail's.
DIFFERENT = 0.01

STEP = 0.02  # m, grid on which the wheels are looked at
PADDING = 4


@dataclass(frozen=True)
class WheelRoundness:
    """Out-of-roundness of one wheel over one stretch of track.

    start, end [m]: the stretch under the wheel. radius [m]: estimated, NaN where no order stood
    out. amplitude and uncertainty (standard deviation) by order 1 ... 20 [m], corrected for the
    high-pass of the estimate, NaN where there is none.
    """

    axle_box: str
    rail: str
    start: float
    end: float
    revolutions: float
    radius: float
    amplitude: Array
    uncertainty: Array


@dataclass(frozen=True)
class _Periodic:
    """Complex amplitudes (orders,) by exp(2 pi i n x / circumference) and their variances."""

    circumference: float
    amplitude: ComplexArray
    variance: Array

    def at(self, x: Array) -> Array:
        """Displacement [m] at x; an amplitude counts as far as it is above its uncertainty."""
        power = np.abs(self.amplitude) ** 2
        share = np.clip(1.0 - self.variance / np.maximum(power, 1e-30), 0.0, 1.0)
        turn = np.exp(2j * math.pi * x / self.circumference)
        total: ComplexArray = np.zeros(x.size, dtype=np.complex128)
        for weight in (share * self.amplitude)[::-1]:
            total = (total + weight) * turn
        return np.asarray(total.real)


def separate(values: Array, step: float, offsets: Array, radius: float
             ) -> tuple[Array, list[_Periodic | None]]:
    """Take the wheels' part from the irregularity of one rail.

    Parameters
    ----------
    values
        (n, wheels) [m] at the same instants, on a grid in distance run; NaN where not valid.
    step, offsets
        Of the grid [m], and of the wheels along the track (wheels,) [m], in the direction in which
        the distance grows.
    radius
        Nominal wheel radius [m].

    Returns
    -------
    tuple
        The rail's part (n, wheels), and what was taken from each wheel: None for one that is round
        as far as can be told.
    """
    n, wheels = values.shape
    found: list[_Periodic | None] = [None] * wheels
    nominal = 2.0 * math.pi * radius
    every = max(1, round(STEP / step))
    coarse = _decimated(np.where(np.isnan(values), 0.0, values), every)
    valid = np.mean(np.isfinite(values), axis=0) if n else np.zeros(wheels)
    length = n * step
    if length < LEAST_REVOLUTIONS * nominal:
        return values, found
    x: Array = np.arange(len(coarse), dtype=np.float64) * every * step
    window = np.hanning(x.size)
    circumference = {}
    for w in np.flatnonzero(valid >= LEAST_VALID):
        estimate = _circumference(coarse[:, w] * window, x, nominal)
        if not math.isnan(estimate):
            circumference[int(w)] = estimate
    if not circumference:
        return values, found
    used = [int(w) for w in np.flatnonzero(valid >= LEAST_VALID)]
    for w, periodic in _amplitudes(coarse, x, offsets, used, circumference).items():
        found[w] = periodic
    cleaned = np.array(values)
    fine = np.arange(n) * step
    for w, item in enumerate(found):
        if item is not None:
            cleaned[:, w] -= item.at(fine + offsets[w])
    return cleaned, found


def _decimated(values: Array, every: int) -> Array:
    """Every so-many-th point (m, channels) of values (n, channels), without what is shorter."""
    n = len(values) // every * every
    lines = fft.rfft(values[:n], axis=0)[: n // every // 2 + 1]
    return np.asarray(fft.irfft(lines, n // every, axis=0)) / every


def _circumference(windowed: Array, x: Array, nominal: float) -> float:
    """Return the circumference [m] whose orders stand out most, NaN where they do not."""
    size = fft.next_fast_len(PADDING * x.size, real=True)
    power = np.abs(fft.rfft(windowed, size)) ** 2
    line = 1.0 / (size * (x[1] - x[0]))
    orders = np.arange(1, ORDERS + 1)
    background = np.array([
        np.median(power[round((n - 0.5) / nominal / line) : round((n + 0.5) / nominal / line)])
        for n in orders]) / math.log(2.0)  # fmt: skip
    length = x[-1]
    count = math.ceil(2.0 * SEARCH * 8.0 * ORDERS * length / nominal)
    candidates = nominal * np.linspace(1.0 - SEARCH, 1.0 + SEARCH, count)
    at = np.interp(orders[:, None] / candidates / line, np.arange(power.size), power)
    score = np.log1p(at / background[:, None]).sum(axis=0)
    best = float(candidates[int(np.argmax(score))])

    def standing_out(circumference: float) -> NDArray[np.bool_]:
        lines = _order_power(windowed, x, circumference)
        return np.asarray(lines > 10.0 ** (0.1 * STANDING_OUT) * background)

    # From here on the orders that stand out alone say where they do so most.
    standing = standing_out(best)
    if np.count_nonzero(standing) < LEAST_ORDERS:
        return math.nan

    def missed(circumference: float) -> float:
        return -float(np.log(_order_power(windowed, x, circumference)[standing]).sum())

    around = 4.0 * (candidates[1] - candidates[0])
    result = minimize_scalar(missed, bounds=(best - around, best + around), method='bounded',
                             options={'xatol': 1e-7 * nominal})  # fmt: skip
    best = float(result.x)
    found = orders[standing_out(best)].tolist()
    return best if len(found) >= LEAST_ORDERS and math.gcd(*found) == 1 else math.nan


def _order_power(windowed: Array, x: Array, circumference: float) -> Array:
    """Squared magnitudes (orders,) of the transform of windowed (n,) at the orders."""
    turn = np.exp(-2j * math.pi * x / circumference)
    turned = windowed.astype(np.complex128)
    power = np.empty(ORDERS)
    for n in range(ORDERS):
        turned *= turn
        power[n] = abs(turned.sum()) ** 2
    return power


def _amplitudes(coarse: Array, x: Array, offsets: Array, used: list[int],
                circumference: dict[int, float]) -> dict[int, _Periodic]:
    """Solve for the amplitudes of all orders of the wheels with a circumference."""
    wheels = list(circumference)
    windowed = coarse[:, used] * np.hanning(x.size)[:, None]
    length, total = float(x[-1]), 0.5 * (x.size - 1)
    shift = offsets[used]
    spectra = _Padded(windowed, float(x[1]))
    amplitude = np.zeros((ORDERS, len(wheels)), dtype=np.complex128)
    variance = np.zeros((ORDERS, len(wheels)))
    for n in range(1, ORDERS + 1):
        own = np.array([n / circumference[w] for w in wheels])
        # Lines closer than a tenth of the window's resolution are one.
        lines = _distinct(own, 0.1 / length)
        data = _transform(windowed, x, lines).T * np.exp(-2j * math.pi * np.outer(shift, lines))
        # Unknown are the amplitudes a: Re(a e) has a / 2 at its line, spread by the window.
        spread = _hann(np.subtract.outer(own, lines) * length, HANN)
        turned = np.exp(2j * math.pi * np.multiply.outer(
            shift, np.subtract.outer(own, lines)))  # used, wheels, lines
        design = np.zeros((len(used), lines.size, len(wheels)), dtype=np.complex128)
        for column, w in enumerate(wheels):
            row = used.index(w)
            design[row, :, column] = 0.5 * turned[row, column] * spread[column]
        common = _hann(np.subtract.outer(lines, lines) * -length, HANN_SQUARED)
        beside = spectra.beside(n, float(own.mean())) / total**2
        covariance = beside * (
            np.kron(np.ones((len(used), len(used))), common)
            + DIFFERENT * np.kron(np.eye(len(used)), common + 1e-6 * np.eye(lines.size)))
        matrix = design.reshape(-1, len(wheels))
        weighted = np.linalg.solve(covariance, matrix)
        inverse = np.linalg.pinv(matrix.conj().T @ weighted, hermitian=True)
        amplitude[n - 1] = inverse @ (weighted.conj().T @ data.reshape(-1) / total)
        variance[n - 1] = np.maximum(np.diag(inverse).real, 0.0)
    return {w: _Periodic(circumference[w], amplitude[:, i], variance[:, i])
            for i, w in enumerate(wheels)}


# Fourier coefficients of the Hann window and of its square.
HANN = (0.5, -0.25)
HANN_SQUARED = (0.375, -0.25, 0.0625)


def _hann(lines: Array, coefficients: tuple[float, ...]) -> ComplexArray:
    """Transform of a window at `lines` spectral lines off its middle, 1 there."""
    total = coefficients[0] * np.sinc(lines)
    for k, weight in enumerate(coefficients[1:], 1):
        sign = (-1.0) ** k
        total = total + sign * weight * (np.sinc(lines - k) + np.sinc(lines + k))
    return np.asarray(total / coefficients[0] * np.exp(1j * math.pi * lines))


class _Padded:
    """Power spectra of windowed signals (n, channels), `step` apart, on a fine grid."""

    def __init__(self, windowed: Array, step: float) -> None:
        size = fft.next_fast_len(PADDING * len(windowed), real=True)
        self.power = np.abs(fft.rfft(windowed, size, axis=0)) ** 2
        self.line = 1.0 / (size * step)

    def beside(self, order: int, line: float) -> float:
        """Mean power between an order, at a wavenumber [1/m], and its neighbours: the rail's."""
        near, far = (part * line / order / self.line for part in (0.12, 0.4))
        middle = line / self.line
        places = np.concatenate((np.arange(round(middle - far), round(middle - near)),
                                 np.arange(round(middle + near), round(middle + far))))
        return max(float(np.median(self.power[places])) / math.log(2.0), 1e-30)


def _distinct(lines: Array, resolution: float) -> Array:
    kept: list[float] = []
    for line in np.sort(lines):
        if not kept or line - kept[-1] > resolution:
            kept.append(float(line))
    return np.array(kept)


def _transform(values: Array, x: Array, wavenumber: Array) -> ComplexArray:
    """Sums (m, ...) of values (n, ...) times exp(-2 pi i k x) at x (n,) for each k (m,) [1/m]."""
    return np.array([np.exp(-2j * math.pi * k * x) @ values for k in wavenumber])


def roundness(periodic: _Periodic | None, axle_box: str, rail: str, start: float, end: float,
              nominal_radius: float, cut_on_wavelength: float) -> WheelRoundness:
    """Return a wheel's out-of-roundness, corrected for the high-pass of the estimate.

    That is a Butterworth high-pass of order 4 in wavelength, -3 dB at the cut-on.
    """
    run = abs(end - start)
    if periodic is None:
        nothing = np.full(ORDERS, math.nan)
        return WheelRoundness(axle_box, rail, start, end, run / (2.0 * math.pi * nominal_radius),
                              math.nan, nothing, nothing)
    orders = np.arange(1, ORDERS + 1)
    passed = 1.0 / np.sqrt(
        1.0 + (periodic.circumference / (orders * cut_on_wavelength)) ** 8)
    return WheelRoundness(
        axle_box, rail, start, end, run / periodic.circumference,
        periodic.circumference / (2.0 * math.pi), np.abs(periodic.amplitude) / passed,
        np.sqrt(periodic.variance) / passed)
