"""One bay of the track, exact at given frequencies: no mesh error.

Between two sections that carry no point support the rail obeys, at angular frequency omega,

    w' = theta + Q / (kappa A G)      Q' = (kd - rho A omega^2) w - kd ws
    theta' = M / EI                   M' = -Q - rho I omega^2 theta        P' = kd (ws - w)

with kd the complex stiffness per length of the pad under it (zero between the pads), ws the
sleeper's displacement and P the force which the pad asks of the sleeper.  The state
(w, theta, Q, M, ws, P) at one end follows from the other by a matrix exponential, and a
dynamic stiffness follows from that.  Pieces are kept shorter than a quarter wavelength, so that
neither the growing exponentials nor the clamped resonances of a piece cost digits, and the
exponential is summed as a power series, which stays exact down to zero frequency.

Rail loss is hysteretic, E (1 + i eta) and G (1 + i eta); time dependence is exp(i omega t).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railtrack_ros.errors import InputError
from railtrack_ros.track.description import Rail, Track
from railtrack_ros.track.rail import Array

ComplexArray = NDArray[np.complexfloating[Any, Any]]

LONGEST_PIECE = 1.5  # of a piece, times the largest wavenumber: a quarter wavelength is 1.57


class ExactElement:
    """A piece of rail, with or without a pad under it, at the angular frequencies omega (f,).

    Degrees of freedom (w1, theta1, w2, theta2, ws): both ends of the rail and the sleeper.
    foundation: complex pad stiffness per length kd (f,) [N/m^2], or None between the pads.
    """

    def __init__(
        self, rail: Rail, omega: Array, length: float, foundation: ComplexArray | None = None,
    ) -> None:
        self.length = length
        loss = 1.0 + 1j * rail.loss_factor
        ei, kag = rail.bending_stiffness * loss, rail.shear_stiffness * loss
        kd = np.zeros(omega.size, dtype=complex) if foundation is None else foundation

        # Per xi = x / L, for the state (w, theta L, Q L^3/EI, M L^2/EI, ws, P L^3/EI).
        a = np.zeros((omega.size, 6, 6), dtype=complex)
        a[:, 0, 1], a[:, 0, 2] = 1.0, ei / (kag * length**2)
        a[:, 1, 3] = 1.0
        a[:, 2, 0] = (kd - rail.mass_per_length * omega**2) * length**4 / ei
        a[:, 2, 4] = -kd * length**4 / ei
        a[:, 3, 1], a[:, 3, 2] = -rail.rotary_inertia * omega**2 * length**2 / ei, -1.0
        a[:, 5, 0], a[:, 5, 4] = -kd * length**4 / ei, kd * length**4 / ei
        self._generator = a
        self._force_unit = ei / length**3

        # The states at the left end for unit degrees of freedom, then those at the right end.
        self._end = self._transfer(1.0)
        start = np.zeros((omega.size, 6, 5), dtype=complex)
        start[:, 0, 0], start[:, 1, 1], start[:, 4, 4] = 1.0, length, 1.0
        wanted = np.zeros((2, 5))
        wanted[0, 2], wanted[1, 3] = 1.0, length
        start[:, 2:4] = np.linalg.solve(self._end[:, :2, 2:4], wanted - self._end[:, :2] @ start)
        end = self._end @ start
        forces = np.stack(
            [-start[:, 2], -start[:, 3] * length, end[:, 2], end[:, 3] * length, end[:, 5]],
            axis=1) * self._force_unit
        self._start = start
        self.stiffness: ComplexArray = 0.5 * (forces + forces.transpose(0, 2, 1))

    def shape(self, x: float) -> ComplexArray:
        """Weights (f, 5) of the degrees of freedom in the deflection at x [m from the left]."""
        return (self._transfer(x / self.length)[:, :1] @ self._start)[:, 0]

    def flexibility(self, x: float, load: float) -> ComplexArray:
        """Deflection (f,) at x [m] per unit force at `load`, ends and sleeper held [m/N]."""
        x, load = min(x, load), max(x, load)  # reciprocal: the response is left of the load
        step = self._transfer(1.0 - load / self.length)[:, :2, 2:3]
        reaction = np.linalg.solve(self._end[:, :2, 2:4], step)
        left = (self._transfer(x / self.length)[:, :1, 2:4] @ reaction)[:, 0, 0]
        return left / self._force_unit

    def _transfer(self, xi: float) -> ComplexArray:
        """exp(generator xi) (f, 6, 6), as a power series."""
        a = self._generator * xi
        total: ComplexArray = a + np.eye(6, dtype=complex)
        term = a
        for n in range(2, 80):
            term = term @ a / n
            total += term
            if np.abs(term).max() < 1e-18 * np.abs(total).max():
                break
        return total


class ExactBay:
    """The bay from mid-span to mid-span around a sleeper at x = 0, at the given frequencies.

    Degrees of freedom: (w, theta) at the ends of all pieces in order, then the sleeper.

    stiffness: (f, n, n) dynamic stiffness, symmetric [N/m, N, N m];
    ends: the four degrees of freedom (w, theta) of the left and right end;
    sleeper: the sleeper's degree of freedom.
    """

    def __init__(self, track: Track, frequencies: ArrayLike) -> None:
        track.require_periodic('the exact infinite track')
        track.require_linear('the exact infinite track')
        omega = 2.0 * math.pi * np.atleast_1d(np.asarray(frequencies, dtype=float))
        rail, support = track.rail, track.support
        if not support.pad_length < support.spacing:
            raise InputError(f'support.pad_length: expected less than the sleeper spacing of '
                             f'{support.spacing:g} m, got {support.pad_length:g}')
        self.spacing, self.start = support.spacing, -0.5 * support.spacing
        pad = support.pad_stiffness + 1j * omega * support.pad_damping
        distributed = support.kind == 'distributed'
        foundation = pad / support.pad_length

        # Sections where something changes, and the point springs on them.
        half = 0.5 * support.pad_length
        shares = np.array([1.0])
        springs = np.array([0.0])
        if support.kind == 'multipoint':
            springs = np.linspace(-half, half, 5)
            shares = np.array([0.125, 0.25, 0.25, 0.25, 0.125])
        marks = np.array([-half, half]) if distributed else springs
        sections = np.concatenate([[self.start], marks, [-self.start]])

        # Pieces between them, each short enough, one description for all that are equal.
        nodes, pieces = [self.start], []
        made: dict[tuple[float, bool], ExactElement] = {}
        for i, (left, right) in enumerate(zip(sections[:-1], sections[1:], strict=True)):
            over_pad = distributed and i == 1
            under = float(np.abs(foundation).max()) if over_pad else 0.0
            count = math.ceil(_wavenumber(rail, float(omega.max()), under)
                              * (right - left) / LONGEST_PIECE)
            length = (right - left) / count
            key = (round(length, 12), over_pad)
            if key not in made:
                made[key] = ExactElement(rail, omega, length, foundation if over_pad else None)
            nodes += list(np.linspace(left, right, count + 1)[1:])
            pieces += [made[key]] * count
        self.nodes = np.array(nodes)
        self._pieces = pieces

        n = 2 * self.nodes.size + 1
        self.sleeper = n - 1
        self.ends = np.array([0, 1, n - 3, n - 2])
        d = np.zeros((omega.size, n, n), dtype=complex)
        for i, piece in enumerate(pieces):
            slots = self._slots(i)
            d[:, slots[:, None], slots] += piece.stiffness
        s = self.sleeper
        d[:, s, s] += (support.ballast_stiffness + 1j * omega * support.ballast_damping
                       - omega**2 * support.sleeper_mass)
        if not distributed:
            for x, share in zip(springs, shares, strict=True):
                w = 2 * int(np.abs(self.nodes - x).argmin())
                d[:, w, w] += share * pad
                d[:, s, s] += share * pad
                d[:, w, s] -= share * pad
                d[:, s, w] -= share * pad
                if support.kind == 'concentrated_rotational':
                    d[:, w + 1, w + 1] += pad * support.pad_length**2 / 12.0
        self.stiffness: ComplexArray = d
        self._shapes: dict[float, ComplexArray] = {}

    def shape(self, x: float) -> ComplexArray:
        """Weights (f, n) of the degrees of freedom in the deflection at x [m from the left]."""
        if x not in self._shapes:
            i, inside = self._find(x)
            result = np.zeros(self.stiffness.shape[:2], dtype=complex)
            result[:, self._slots(i)] = self._pieces[i].shape(inside)
            self._shapes[x] = result
        return self._shapes[x]

    def flexibility(self, x: float, load: float) -> ComplexArray | complex:
        """Deflection of the piece itself (f,) [m/N] at x for a force at `load`, its ends held."""
        i, inside = self._find(x)
        j, load_inside = self._find(load)
        return self._pieces[i].flexibility(inside, load_inside) if i == j else 0.0

    def _find(self, x: float) -> tuple[int, float]:
        """Find the piece that holds x, and the distance from its left end."""
        absolute = x + self.start
        i = int(np.searchsorted(self.nodes, absolute, side='right')) - 1
        i = min(max(i, 0), len(self._pieces) - 1)
        return i, min(max(absolute - float(self.nodes[i]), 0.0), self._pieces[i].length)

    def _slots(self, piece: int) -> NDArray[np.int64]:
        """Return the degrees of freedom of a piece."""
        first = 2 * piece
        return np.array([first, first + 1, first + 2, first + 3, self.sleeper])


def _wavenumber(rail: Rail, omega: float, foundation: float) -> float:
    """Bound the wavenumbers [1/m] of the rail from above, up to omega on that foundation."""
    restoring = foundation + rail.mass_per_length * omega**2
    bending = math.sqrt(restoring / rail.bending_stiffness)
    shear = restoring / rail.shear_stiffness
    longitudinal = rail.rotary_inertia * omega**2 / rail.bending_stiffness
    return math.sqrt(bending + shear + longitudinal)
