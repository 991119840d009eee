"""Modes of the periodic track: N equal bays closed to a ring, wave number by wave number.

On a ring every motion is a sum of Bloch waves u_m = v e^{iqm}, q = 2 pi j / N.  For each q the
bay's matrices shrink to one cell, (lambda^2 m + lambda c + k) v = 0, whose poles and vectors give
the impulse response between any two places of the track in closed form:

    h(x, x', t) = Re sum_i c_i(x) e^{lambda_i t} b_i(x').

The sum follows the load at any speed profile, which is what the recursive solver lives on
(thesis 4.4-4.6 as a recursion).  A ring has no ends to reflect; it is long enough when the waves
have died away before they come round.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railtrack_ros.dynamics.interpolation import ShapeTable, shape_table
from railtrack_ros.errors import InputError
from railtrack_ros.track.bay import Bay

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class TrackModes:
    """Poles and vectors of the ring.

    bays: N.  poles (p,) [1/s]; wave_number (p,) q [rad per bay].  response and excitation
    (nb + 2, p): deflection at a degree of freedom of bay m per unit modal state is
    response e^{iqm}; excitation e^{-iqm} is the modal drive per unit nodal force; factors of two
    for the waves running the other way are in excitation.  remainder (N, nb + 2, nb + 2): static
    flexibility [m/N] of the poles that are not kept, between degrees of freedom so many bays
    apart.  table: N(x) and F(x) of the bay.
    """

    bay: Bay
    bays: int
    maximum_frequency: float
    poles: ComplexArray
    wave_number: Array
    response: ComplexArray
    excitation: ComplexArray
    remainder: Array
    table: ShapeTable

    def weights(self, x: ArrayLike) -> tuple[ComplexArray, ComplexArray]:
        """c_i(x) and b_i(x), each (n, p), at track positions x (n,) [m]."""
        number, inside = self.bay.locate(x)
        shape = self.bay.shape(inside)
        phase = np.exp(1j * number[:, None] * self.wave_number)
        return (shape @ self.response) * phase, (shape @ self.excitation) * phase.conj()

    def instantaneous_flexibility(self, response_at: float, force_at: float) -> float:
        """Deflection [m/N] that follows a force at once: remainder, and F(x) at the load itself."""
        number, inside = self.bay.locate([response_at, force_at])
        there, here = self.bay.shape(inside)
        value = there @ self.remainder[(number[0] - number[1]) % self.bays] @ here
        if response_at == force_at:
            value += self.bay.flexibility(inside[1])[0]
        return float(value)

    def receptance(self, frequency: ArrayLike, response_at: float, force_at: float) -> ComplexArray:
        """Receptance [m/N] of the kept poles and the residual at frequencies (n,) [Hz]."""
        c, _ = self.weights([response_at])
        _, b = self.weights([force_at])
        omega = 2.0 * math.pi * np.atleast_1d(np.asarray(frequency, dtype=float))
        # The real part of a sum over poles, carried to the frequency domain pole by pole.
        gain = c[0] * b[0]
        s = 1j * omega[:, None]
        h = 0.5 * (gain / (s - self.poles) + gain.conj() / (s - self.poles.conj())).sum(axis=1)
        return h + self.instantaneous_flexibility(response_at, force_at)


def ring_length(bay: Bay, offsets: ArrayLike) -> int:
    """Bays of a ring that is long enough for wheels at these offsets [m].

    At least 61 bays, and 41 bays of track between the last wheel and the first one round the ring;
    an odd number, so that only q = 0 stands alone.
    """
    offsets = np.asarray(offsets, dtype=float)
    occupied = math.ceil((offsets.max() - offsets.min()) / bay.spacing)
    return max(61, 41 + occupied) // 2 * 2 + 1


def make_track_modes(bay: Bay, bays: int = 61, maximum_frequency: float = 5000.0) -> TrackModes:
    """Modes of a ring of `bays` bays.

    Kept are the bands of poles that reach below |lambda| = 2 pi maximum_frequency [Hz] at any wave
    number, whole; of what is cut off the static share stays, as the remainder.
    """
    if bays < 3:
        raise InputError(f'bays in the ring: {bays} is too few, at least 3 are needed')
    n = bay.dofs
    limit = 2.0 * math.pi * maximum_frequency
    scale = 1.0e4  # Time in units of 0.1 ms: displacement and velocity of one order of magnitude.
    solved = []
    for j in range(bays // 2 + 1):
        q = 2.0 * math.pi * j / bays
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
        solved.append((q, value[order] * scale, fold @ vector[:n, order],
                       drive[order] @ fold.conj().T, fold @ np.linalg.solve(k, fold.conj().T)))
    # The same number of poles at every wave number keeps the remainder smooth in q, so short in x.
    count = max(int((np.abs(value) <= limit).sum()) for _, value, *_ in solved)

    poles, numbers, responses, excitations = [], [], [], []
    remainder = np.zeros((bays, n + 2, n + 2))
    for j, (q, value, response, excitation, compliance) in enumerate(solved):
        alone = j == 0 or 2 * j == bays
        weight = (1.0 if alone else 2.0) / bays
        poles.append(value[:count])
        numbers.append(np.full(count, q))
        responses.append(response[:, :count])
        excitations.append(weight * excitation[:count].T)
        rest = compliance + response[:, :count] @ (excitation[:count] / value[:count, None])
        turn = np.exp(1j * q * np.arange(bays))
        remainder += weight * (turn[:, None, None] * rest).real

    return TrackModes(
        bay=bay, bays=bays, maximum_frequency=maximum_frequency, poles=np.concatenate(poles),
        wave_number=np.concatenate(numbers),
        response=np.concatenate(responses, axis=1),
        excitation=np.concatenate(excitations, axis=1),
        remainder=remainder, table=shape_table(bay),
    )
