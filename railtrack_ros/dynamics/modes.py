"""Modes of the periodic track: N equal bays closed to a ring, wave number by wave number.

On a ring every motion is a sum of Bloch waves u_m = v e^{iqm}, q = 2 pi j / N.  For each q the
bay's matrices shrink to one cell, (lambda^2 m + lambda c + k) v = 0, whose poles and vectors give
the impulse response between any two places of the track in closed form.  The matrices are
symmetric, so that the wave of q and that of -q share their poles and excite each other's shapes;
their sum and difference g1, g2 are excited just as they respond:

    h(x, x', t) = Re sum_i g_i(x) g_i(x') e^{lambda_i t}.

The sum follows the load at any speed profile, which is what the recursive solver lives on
(thesis 4.4-4.6 as a recursion).  A ring has no ends to reflect; it is long enough when the waves
have died away before they come round.

Poles above a cut-off are not kept one by one.  What they do below it hardly leaves the place of
the force: a few oscillators stand for all of them, with the right compliance and the right
inertia.  Their frequencies are those that stand best for the poles'.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railtrack_ros.dynamics import cache
from railtrack_ros.dynamics.interpolation import ShapeTable, shape_table
from railtrack_ros.errors import InputError
from railtrack_ros.track.bay import Bay

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Oscillators that stand for the poles that are not kept.
OSCILLATORS = 3
DAMPING_RATIO = 0.3  # of theirs, for the waves that run away; 0.2 to 0.4 serve as well

LOWEST_CUT_OFF = 500.0  # Hz


@dataclass(frozen=True)
class TrackModes:
    """Poles and shapes of the ring.

    bays: N.  poles (p,) [1/s], none of negative imaginary part; wave_number (p,) q [rad per bay].
    first, second (nb + 2, p): g1, g2 at the degrees of freedom of bay 0; in bay m they are turned,
    cos(qm) g1 + sin(qm) g2 and cos(qm) g2 - sin(qm) g1.  oscillators (k,): poles [1/s] of those
    that stand for all others; amplitude (k, nb + 2, nb + 2): their
    residues [m/(N s)] within a bay.
    remainder (N, nb + 2, nb + 2): static flexibility [m/N] of the poles that are not kept, between
    degrees of freedom so many bays apart.  table: N(x) and F(x) of the bay.
    """

    bay: Bay
    bays: int
    maximum_frequency: float
    poles: ComplexArray
    wave_number: Array
    first: ComplexArray
    second: ComplexArray
    oscillators: ComplexArray
    amplitude: ComplexArray
    remainder: Array
    table: ShapeTable

    def weights(self, x: ArrayLike) -> ComplexArray:
        """g_i(x) (n, 2p), all g1 before all g2, at track positions x (n,) [m]."""
        number, inside = self.bay.locate(x)
        shape = self.bay.shape(inside)
        angle = number[:, None] * self.wave_number
        first, second = shape @ self.first, shape @ self.second
        return np.hstack([np.cos(angle) * first + np.sin(angle) * second,
                          np.cos(angle) * second - np.sin(angle) * first])

    def impulse_response(self, t: ArrayLike, response_at: ArrayLike, force_at: ArrayLike) -> Array:
        """Deflection (n,) [m/(N s)] at times t (n,) [s] > 0 after an impulse; places broadcast.

        That of the kept poles; what the others add dies away within a fraction of a millisecond.
        """
        t, there, here = np.broadcast_arrays(
            np.atleast_1d(np.asarray(t, dtype=float)), response_at, force_at)
        poles = np.concatenate([self.poles, self.poles])
        gain = self.weights(there) * self.weights(here)
        return np.asarray((gain * np.exp(t[:, None] * poles)).sum(axis=1).real)

    def static_remainder(self, response_at: float, force_at: float) -> float:
        """Static deflection [m/N] by the poles that are not kept, and F(x) at the load itself."""
        number, inside = self.bay.locate([response_at, force_at])
        there, here = self.bay.shape(inside)
        value = float(there @ self.remainder[(number[0] - number[1]) % self.bays] @ here)
        if response_at == force_at:
            value += self.bay.flexibility(inside[1])[0]
        return value

    def receptance(self, frequency: ArrayLike, response_at: float, force_at: float) -> ComplexArray:
        """Receptance [m/N] of kept poles and remainder at frequencies (n,) [Hz]."""
        gain = (self.weights([response_at]) * self.weights([force_at]))[0]
        s = 2j * math.pi * np.atleast_1d(np.asarray(frequency, dtype=float))[:, None]
        h = _response(s, np.concatenate([self.poles, self.poles]), gain)
        h = h + self.static_remainder(response_at, force_at)
        if response_at == force_at:
            _, inside = self.bay.locate([force_at])
            here = self.bay.shape(inside)[0]
            amplitude = here @ self.amplitude @ here
            h += _response(s, self.oscillators, amplitude)
            h -= _response(np.zeros((1, 1), complex), self.oscillators, amplitude)
        return h


def _response(s: ComplexArray, poles: ComplexArray, gain: ComplexArray) -> ComplexArray:
    """Transform of Re sum gain e^{pole t} at s (n, 1)."""
    both = gain / (s - poles) + gain.conj() / (s - poles.conj())
    return np.asarray(0.5 * both.sum(axis=1))


def _amplitudes(poles: ComplexArray, moments: Array) -> ComplexArray:
    """Residues (k, ...) of a_i / (s - pole_i) + conjugate with moments (2k, ...) about s = 0."""
    powers = -poles ** -(np.arange(2.0 * poles.size)[:, None] + 1.0)
    system = np.hstack([powers.real, -powers.imag])
    real, imaginary = np.split(np.einsum('ab,bij->aij', np.linalg.inv(system), moments), 2)
    return np.asarray(real + 1j * imaginary)


def make_track_modes(bay: Bay, bays: int = 61, maximum_frequency: float = 5000.0) -> TrackModes:
    """Modes of a ring of `bays` bays.

    Kept are the bands of poles that reach below |lambda| = 2 pi maximum_frequency [Hz] at any wave
    number, whole.
    """
    if bays < 3:
        raise InputError(f'bays in the ring: {bays} is too few, at least 3 are needed')
    if not maximum_frequency >= LOWEST_CUT_OFF:
        raise InputError(f'cut-off of the poles: {maximum_frequency:g} Hz is too low, expected at '
                         f'least {LOWEST_CUT_OFF:g} Hz')
    shape = bay.shape(bay.spacing * (np.arange(240) + 0.5) / 240)
    mean = shape.T @ shape / len(shape)
    digest = cache.key([__file__], bay.stiffness, bay.damping, bay.mass, bay.dofs, bays,
                       maximum_frequency, mean)
    arrays = cache.stored('modes', digest, lambda: _compute(bay, bays, maximum_frequency, mean))
    return TrackModes(bay=bay, bays=bays, maximum_frequency=maximum_frequency,
                      table=shape_table(bay), **arrays)


def _compute(bay: Bay, bays: int, maximum_frequency: float, mean: Array
             ) -> dict[str, NDArray[Any]]:
    """Arrays of the modes; mean (nb + 2, nb + 2): N^T N averaged over the bay."""
    n = bay.dofs
    limit = 2.0 * math.pi * maximum_frequency
    solved = [_cell(bay, 2.0 * math.pi * j / bays) for j in range(bays // 2 + 1)]
    # The same number of poles at every wave number keeps the remainder smooth in q, so short in x.
    count = max(int((np.abs(value) <= limit).sum()) for value, *_ in solved)

    poles, numbers, firsts, seconds = [], [], [], []
    static = np.zeros((bays, n + 2, n + 2))
    moments = np.zeros((2 * OSCILLATORS, n + 2, n + 2))  # of the others' receptance: powers of s
    # Mean static compliance of the others, times powers of (limit / pole)^2.
    spectrum = np.zeros(2 * OSCILLATORS)
    for j, (value, response, excitation, compliance) in enumerate(solved):
        alone = j == 0 or 2 * j == bays
        weight = (1.0 if alone else 2.0) / bays
        q = 2.0 * math.pi * j / bays
        kept = count
        if kept < value.size and np.isclose(value[kept], value[kept - 1].conj(), rtol=1e-6):
            kept += 1
        upper = np.flatnonzero(value[:kept].imag > -1e-9 * np.abs(value[:kept]))
        # A real pole stands for itself, the others for their conjugates too.
        share = np.where(value[upper].imag > 1e-9 * np.abs(value[upper]), weight, 0.5 * weight)
        first, second = _standing_waves(response[:, upper], excitation[upper].T)
        poles.append(value[upper].real + 1j * np.maximum(value[upper].imag, 0.0))
        numbers.append(np.full(upper.size, q))
        firsts.append(first * np.sqrt(share))
        seconds.append(second * np.sqrt(share))
        rest = compliance + response[:, :kept] @ (excitation[:kept] / value[:kept, None])
        turn = np.exp(1j * q * np.arange(bays))
        static += weight * (turn[:, None, None] * rest).real
        moments[0] += weight * rest.real
        for power in range(1, 2 * OSCILLATORS):
            moments[power] -= weight * (response[:, kept:] @ (
                excitation[kept:] / value[kept:, None] ** (power + 1))).real
        share_of = -((mean @ response[:, kept:]).T * excitation[kept:]).sum(axis=1) / value[kept:]
        spectrum += weight * share_of.real @ np.abs(limit / value[kept:, None]) ** (
            2 * np.arange(2 * OSCILLATORS))

    omega = limit * _frequencies(spectrum)
    unit = complex(-DAMPING_RATIO, math.sqrt(1.0 - DAMPING_RATIO**2))
    oscillators = np.asarray(omega * unit, dtype=complex)
    return {
        'poles': np.concatenate(poles), 'wave_number': np.concatenate(numbers),
        'first': np.concatenate(firsts, axis=1), 'second': np.concatenate(seconds, axis=1),
        'oscillators': oscillators, 'amplitude': _amplitudes(oscillators, moments),
        'remainder': static,
    }


def _frequencies(spectrum: Array) -> Array:
    """Frequencies (k,) of a few oscillators that stand for many, over the cut-off.

    spectrum (2k,): moments of the many's compliance over (cut-off / frequency)^2; those of the few
    are the same, which makes them a Gaussian quadrature.
    """
    k = spectrum.size // 2
    if spectrum[0] <= 0.0:
        return np.asarray(1.0 + 0.5 * np.arange(1.0, k + 1.0))  # no pole lies above
    hankel = spectrum[np.arange(k)[:, None] + np.arange(k)]
    polynomial = np.append(np.linalg.solve(hankel, -spectrum[k:]), 1.0)
    nodes = np.sort(np.roots(polynomial[::-1]).real)[::-1]
    return np.asarray(1.0 / np.sqrt(np.clip(nodes, 1e-3, 1.0)))


def _cell(bay: Bay, q: float) -> tuple[ComplexArray, ComplexArray, ComplexArray, ComplexArray]:
    """Poles [1/s] by magnitude, responses, excitations and static compliance at a wave number.

    The receptance between degrees of freedom is sum_i response_i excitation_i / (s - pole_i).
    """
    n, scale = bay.dofs, 1.0e4  # time in units of 0.1 ms: displacement and velocity alike
    fold = np.zeros((n + 2, n), dtype=complex)
    fold[:n] = np.eye(n)
    fold[n, 0] = fold[n + 1, 1] = np.exp(1j * q)
    k, c, m = (fold.conj().T @ x @ fold for x in (bay.stiffness, bay.damping, bay.mass))
    inverse = np.linalg.inv(m)
    a = np.block([[np.zeros((n, n)), np.eye(n)],
                  [-inverse @ k / scale**2, -inverse @ c / scale]])
    value, vector = np.linalg.eig(a)
    drive = np.linalg.solve(vector, np.vstack([np.zeros((n, n)), inverse / scale]))
    order = np.argsort(np.abs(value), kind='stable')
    compliance = fold @ np.linalg.solve(k, fold.conj().T)
    parts = (value[order] * scale, fold @ vector[:n, order], drive[order] @ fold.conj().T)
    poles, response, excitation = (np.asarray(part, dtype=complex) for part in parts)
    return poles, response, excitation, np.asarray(compliance)


def _standing_waves(c: ComplexArray, b: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Shapes g1, g2 with g1 g1' + g2 g2' = c b' + b c', columns of (nb + 2, p) each."""
    ratio = np.linalg.norm(b, axis=0) / np.linalg.norm(c, axis=0)
    alpha = np.sqrt(ratio * np.exp(1j * np.angle((c.conj() * b).sum(axis=0))))
    return ((alpha * c + b / alpha) / math.sqrt(2.0),
            1j * (alpha * c - b / alpha) / math.sqrt(2.0))


def slowest_wave(bay: Bay, frequency: ArrayLike) -> Array:
    """Factor (n,) below 1 by which a free wave shrinks from bay to bay, of the slowest to decay.

    At frequencies (n,) [Hz], with the damping of the time domain: the bay is condensed to its end
    sections, which gives a quadratic eigenvalue problem of size two for e^{iq}.
    """
    n = bay.dofs
    ends, inner = [0, 1, n, n + 1], list(range(2, n))
    result = []
    for omega in 2.0 * math.pi * np.atleast_1d(np.asarray(frequency, dtype=float)):
        d = bay.stiffness + 1j * omega * bay.damping - omega**2 * bay.mass
        if inner:
            d = d[np.ix_(ends, ends)] - d[np.ix_(ends, inner)] @ np.linalg.solve(
                d[np.ix_(inner, inner)], d[np.ix_(inner, ends)])
        # (Drl + rho (Dll + Drr) + rho^2 Dlr) u = 0
        left, middle, right = d[2:, :2], d[:2, :2] + d[2:, 2:], d[:2, 2:]
        companion = np.block([[np.zeros((2, 2)), np.eye(2)],
                              [-np.linalg.solve(right, left), -np.linalg.solve(right, middle)]])
        size = np.abs(np.linalg.eigvals(companion))
        result.append(size[size < 1.0].max(initial=0.0))
    return np.array(result)


def ring_length(bay: Bay, offsets: ArrayLike, accuracy: float = 1e-3) -> int:
    """Bays of a ring that is long enough for wheels at these offsets [m].

    From the last wheel round to the first one, either way, what is left of the slowest wave is
    `accuracy` in the root mean square over 20 to 3000 Hz. An odd number, so
    that only q = 0 stands alone; at most 301 bays beyond the vehicle, for a rail without loss.
    """
    offsets = np.asarray(offsets, dtype=float)
    factor = slowest_wave(bay, np.arange(20.0, 3000.0, 20.0))
    free = 11
    while free < 301 and 2.0 * np.sqrt(np.mean(factor ** (2 * free))) > accuracy:
        free += 2
    occupied = math.ceil((offsets.max() - offsets.min()) / bay.spacing)
    return (free + occupied) // 2 * 2 + 1
