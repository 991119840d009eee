"""Wheel against rail: what repeats with a wheel's circumference belongs to the wheel.

Over a stretch of some hundred metres the irregularity under wheel w is

    z_w(x) = r(x) + sum_n Re[ a_wn exp(2 pi i n x / C_w) ] ,

the same rail r under every wheel of a rail, and harmonics (orders n) of each wheel's own
circumference C_w = 2 pi R_w. C_w is searched near its nominal value where the spectrum at all
orders together stands out most. The amplitudes of an order are the generalised least-squares
solution for all wheels of the rail at once: the rail is common to them and random, with the power
of the spectrum beside the order. So differences between wheels, which are free of the rail, count
for much, and their mean for little. What wheels of the same
circumference have in common cannot be told from what the rail has in the same line, nor can that
of one wheel alone: with S the rail's one-sided density no unbiased estimate of an amplitude from a
stretch of length L has less variance than S / L. The window is next to none and the bias of the
magnitude (the rail adds its own square) is taken off, so that this bound is all but reached.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage, signal
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

# Share of either end over which the window of the amplitudes falls off: next to no window, for a
# narrower line holds less of the rail.
TAPER = 0.1

# Variance of what differs between wheels besides their orders, relative to the rail's, at least:
# the circumferences are known to a millionth alone.
LEAST_DIFFERENT = 0.01

# Wheels whose lines of the highest order are closer than this share of a line's width have the
# same circumference; lines closer than half of it are one.
SAME = 0.1

# So much beside what is not valid is left out with it [m].
BESIDE_GAPS = 0.5

# A stretch much rougher than the others beside an order, as a corrugated one, says little of a
# wheel and spoils much. The power is looked at in lengths of this [m], told by their median, and
# those above so many times that weigh less.
LOCAL = 15.0
ROUGHER = 12.0

STEP = 0.02  # m, grid on which the wheels are looked at
PADDING = 4


@dataclass(frozen=True)
class WheelRoundness:
    """Out-of-roundness of one wheel over one stretch of track.

    start, end [m]: the stretch under the wheel. radius [m]: estimated, NaN where no order stood
    out. square [m^2] of the amplitude by order 1 ... 20, freed of what the rail adds to it on
    average (so it may be negative), and uncertainty [m], the standard deviation of the amplitude;
    both corrected for the high-pass of the estimate, NaN where there is no radius. reaches: over
    how many stretches this is the mean.
    """

    axle_box: str
    rail: str
    start: float
    end: float
    revolutions: float
    radius: float
    square: Array
    uncertainty: Array
    reaches: int = 1

    @property
    def amplitude(self) -> Array:
        """Amplitudes (orders,) [m], zero where the rail has more in the line than the wheel."""
        return np.sqrt(np.maximum(self.square, 0.0))


def pooled(wheels: Sequence[WheelRoundness]) -> list[WheelRoundness]:
    """Return each wheel once, the mean over its reaches weighted by their revolutions.

    Over N revolutions in all the rail's share of an amplitude falls with the root of N, as it does
    over one long reach, though neither slip nor odometer have to hold a wave together for so long.
    Reaches in which no order stood out do not count, unless there are no others.
    """
    found = []
    for name in dict.fromkeys(wheel.axle_box for wheel in wheels):
        mine = [wheel for wheel in wheels if wheel.axle_box == name]
        mine = [wheel for wheel in mine if not math.isnan(wheel.radius)] or mine
        weight = np.array([wheel.revolutions for wheel in mine])
        share = weight / weight.sum()
        ends = [place for wheel in mine for place in (wheel.start, wheel.end)]
        found.append(WheelRoundness(
            name, mine[0].rail, min(ends), max(ends), float(weight.sum()),
            float(share @ [wheel.radius for wheel in mine]),
            np.asarray(share @ [wheel.square for wheel in mine]),
            np.sqrt(share**2 @ [wheel.uncertainty**2 for wheel in mine]), len(mine)))
    return found


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
    circumference = _equal_ones_equal(circumference, length)
    whole = np.isfinite(values[: x.size * every, used]).reshape(x.size, every, -1).all(axis=(1, 2))
    whole = ndimage.binary_erosion(whole, iterations=round(BESIDE_GAPS / STEP), border_value=1)
    for w, periodic in _amplitudes(coarse, x, whole, offsets, used, circumference).items():
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
        power = _order_power(windowed, x, circumference)
        return -float(np.sum((power / background)[standing]))

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


def _equal_ones_equal(circumference: dict[int, float], length: float) -> dict[int, float]:
    """Return circumferences with those that cannot be told apart replaced by their mean."""
    found: dict[int, float] = {}
    group: list[int] = []
    for w in sorted(circumference, key=circumference.__getitem__):
        if group and (ORDERS * length * (1.0 / circumference[group[0]] - 1.0 / circumference[w])
                      > SAME):
            group = []
        group.append(w)
        mean = float(np.mean([circumference[one] for one in group]))
        found.update(dict.fromkeys(group, mean))
    return {w: found[w] for w in circumference}


def _amplitudes(coarse: Array, x: Array, whole: NDArray[np.bool_], offsets: Array,
                used: list[int], circumference: dict[int, float]) -> dict[int, _Periodic]:
    """Solve for the amplitudes of all orders of the wheels with a circumference.

    whole (n,): where all wheels used are valid; the rest does not count.
    """
    wheels = list(circumference)
    values, shift = coarse[:, used], offsets[used]
    rows = [used.index(w) for w in wheels]
    window = signal.windows.tukey(x.size, TAPER) * whole
    beside = _Beside(values * window[:, None], x, shift, window)
    amplitude = np.zeros((ORDERS, len(wheels)), dtype=np.complex128)
    variance = np.zeros((ORDERS, len(wheels)))
    for n in range(1, ORDERS + 1):
        own = np.array([n / circumference[w] for w in wheels])
        weights = window * _evenness(values, x, own)
        uneven = not np.array_equal(weights, window)
        apart = _Beside(values * weights[:, None], x, shift, weights) if uneven else beside
        amplitude[n - 1], variance[n - 1] = _solve(
            values * weights[:, None], x, shift, rows, own, weights,
            *apart.density(n, float(own.mean())))
    return {w: _Periodic(circumference[w], amplitude[:, i], variance[:, i])
            for i, w in enumerate(wheels)}


def _solve(windowed: Array, x: Array, shift: Array, rows: list[int], own: Array, window: Array,
           rail: float, different: float) -> tuple[ComplexArray, Array]:
    """Amplitudes (wheels,) of one order and their variances, by generalised least squares.

    windowed (n, used), shift (used,): the data and where its wheels are; rows (wheels,): which of
    them are out of round, at the lines own (wheels,). rail and different: densities.
    """
    total, count = float(window.sum()), len(shift)
    lines = _distinct(own, 0.5 * SAME / float(x[-1]))
    data = _transform(windowed, x, lines).T * np.exp(-2j * math.pi * np.outer(shift, lines))
    # Unknown are the amplitudes a: Re(a e) has a / 2 at its line, spread by the window.
    spread = _at_differences(window, x, np.subtract.outer(lines, own).T)
    turned = np.exp(2j * math.pi * np.multiply.outer(
        shift, np.subtract.outer(own, lines)))  # used, wheels, lines
    design = np.zeros((count, lines.size, len(rows)), dtype=np.complex128)
    for column, row in enumerate(rows):
        design[row, :, column] = 0.5 * turned[row, column] * spread[column] / total
    common = _at_differences(window**2, x, np.subtract.outer(lines, lines)) / total**2
    covariance = rail * np.kron(np.ones((count, count)), common) + different * np.kron(
        np.eye(count), common + 1e-6 * common[0, 0] * np.eye(lines.size))
    matrix = design.reshape(-1, len(rows))
    weighted = np.linalg.solve(covariance, matrix)
    inverse = np.linalg.pinv(matrix.conj().T @ weighted, hermitian=True)
    found = inverse @ (weighted.conj().T @ data.reshape(-1) / total)
    return found, np.maximum(np.diag(inverse).real, 0.0)


def _evenness(values: Array, x: Array, own: Array) -> Array:
    """Weights (n,) near an order, below 1 where the rail is far rougher than elsewhere.

    values (n, wheels) at x (n,), own: lines of the wheels that are out of round [1/m].
    """
    size = max(round(LOCAL / float(x[1])), 1)
    count = x.size // size
    turn = np.exp(-2j * math.pi * float(own.mean()) * x[: count * size])
    pieces = values[: count * size] * turn[:, None]
    local = pieces.reshape(count, size, -1).mean(axis=1)
    # What a wheel adds turns from piece to piece no further than its line is off the mean.
    local = local - np.median(local.real, axis=0) - 1j * np.median(local.imag, axis=0)
    power = (np.abs(local) ** 2).max(axis=1)
    limit = ROUGHER * float(np.median(power))
    if not (power > limit).any():
        return np.ones(x.size)
    weight = np.minimum(1.0, limit / np.maximum(power, 1e-30))
    middles = (np.arange(count) + 0.5) * size * float(x[1])
    return np.interp(x, middles, weight)


def _at_differences(weights: Array, x: Array, lines: Array) -> ComplexArray:
    """Transform of weights (n,) at x (n,) for wavenumbers of any shape [1/m]."""
    return _transform(weights, x, lines.ravel()).reshape(lines.shape)


class _Beside:
    """Power beside the orders: of the rail, common to the wheels, and of what differs.

    windowed (n, wheels) at x (n,), offsets (wheels,) as in :func:`separate`. Densities are per
    point, so that the variance of a weighted sum is the density times the sum of the squared
    weights.
    """

    def __init__(self, windowed: Array, x: Array, offsets: Array, window: Array) -> None:
        hann = np.hanning(x.size)
        size = fft.next_fast_len(PADDING * x.size, real=True)
        self.line = 1.0 / (size * float(x[1]))
        spectra = fft.rfft(windowed * hann[:, None], size, axis=0)
        # Over the same place of the rail.
        spectra *= np.exp(-2j * math.pi * np.outer(np.arange(len(spectra)) * self.line, offsets))
        mean = spectra.mean(axis=1)
        scale = float(np.sum((hann * window) ** 2)) * math.log(2.0)
        self._rail = np.abs(mean) ** 2 / scale
        apart = np.sum(np.abs(spectra - mean[:, None]) ** 2, axis=1)
        self._different = apart / max(offsets.size - 1, 1) / scale

    def density(self, order: int, line: float) -> tuple[float, float]:
        """Densities around an order at a wavenumber [1/m]: of the rail, and of the difference."""
        near, far = (part * line / order / self.line for part in (0.12, 0.4))
        middle = line / self.line
        places = np.concatenate((np.arange(round(middle - far), round(middle - near)),
                                 np.arange(round(middle + near), round(middle + far))))
        rail = max(float(np.median(self._rail[places])), 1e-30)
        different = float(np.median(self._different[places]))
        return rail, min(max(different, LEAST_DIFFERENT * rail), rail)


def _distinct(lines: Array, resolution: float) -> Array:
    kept: list[float] = []
    for line in np.sort(lines):
        if not kept or line - kept[-1] > resolution:
            kept.append(float(line))
    return np.array(kept)


def _transform(values: Array, x: Array, wavenumber: Array) -> ComplexArray:
    """Sums (m, ...) of values (n, ...) times exp(-2 pi i k x) at x (n,) for each k (m,) [1/m]."""
    phases = [2.0 * math.pi * k * x for k in wavenumber]
    return np.array([np.cos(phase) @ values - 1j * (np.sin(phase) @ values) for phase in phases])


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
        periodic.circumference / (2.0 * math.pi),
        (np.abs(periodic.amplitude) ** 2 - periodic.variance) / passed**2,
        np.sqrt(0.5 * periodic.variance) / passed)
