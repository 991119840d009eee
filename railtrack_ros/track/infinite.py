"""The infinite periodic track: identical bays closed by the waves that decay away from the load.

A bay seen from its two end sections is a symmetric 4 x 4 dynamic stiffness with the blocks
A (left, left), B (left, right), B^T and E (right, right).  Free waves take the factor mu from one
bay end to the next,

    [mu B + (A + E) + B^T / mu] u = 0,

which is, for two degrees of freedom an end, a quadratic in sigma = mu + 1/mu - 2.  Both
sigma give one wave that decays to the right and its mirror image.  The matrix W that carries the
two right-going waves over a bay has t = mu1 + mu2 as trace and d = mu1 mu2 as determinant, so that
W^2 = t W - d turns B W^2 + (A + E) W + B^T = 0 into a linear equation.  Nothing here grows
from bay to bay, and coinciding waves need no care.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.track.exact import ComplexArray
from railtrack_ros.track.rail import Array


class HarmonicBay(Protocol):
    """A bay at given frequencies: exact, or of finite elements.

    x and load are metres from the bay's left end; the deflection of the rail at x is
    shape(x) . u + flexibility(x, load) * force.
    """

    spacing: float
    start: float
    ends: NDArray[np.int64]
    sleeper: int
    stiffness: ComplexArray

    def shape(self, x: float) -> ComplexArray:
        """Weights (f, n) of the degrees of freedom."""

    def flexibility(self, x: float, load: float) -> ComplexArray | complex:
        """Deflection per force (f,) [m/N] that the degrees of freedom leave out."""


@dataclass(frozen=True)
class Waves:
    """The waves of an infinite row of identical bays at f frequencies.

    factors: (f, 2) complex, mu of the two waves that decay (or carry energy) to the right;
    right: (f, 2, 2), displacements one bay end further right in a field of those waves;
    left: (f, 2, 2), the same to the left;
    right_stiffness, left_stiffness: (f, 2, 2) dynamic stiffness of the half-infinite rows.
    """

    factors: ComplexArray
    right: ComplexArray
    left: ComplexArray
    right_stiffness: ComplexArray
    left_stiffness: ComplexArray


class CondensedBay:
    """A bay reduced to its end sections: stiffness (f, 4, 4) of both ends' (w, theta)."""

    def __init__(self, bay: HarmonicBay) -> None:
        k, ends = bay.stiffness, bay.ends
        inner = np.setdiff1d(np.arange(k.shape[1]), ends)
        coupling = k[:, inner[:, None], ends]
        self.bay = bay
        self._inner = inner
        self._follow = -np.linalg.solve(k[:, inner[:, None], inner], coupling)
        self.stiffness: ComplexArray = (
            k[:, ends[:, None], ends] + coupling.transpose(0, 2, 1) @ self._follow)

    def displacements(self, ends: ComplexArray) -> ComplexArray:
        """All displacements (f, n) of the bay without load from those of its ends (f, 4)."""
        u = np.empty(self.bay.stiffness.shape[:2], dtype=complex)
        u[:, self.bay.ends] = ends
        u[:, self._inner] = (self._follow @ ends[..., None])[..., 0]
        return u


def bloch_waves(stiffness: ComplexArray) -> Waves:
    """Return the waves of an infinite row of bays of the condensed stiffness (f, 4, 4)."""
    a, b = stiffness[:, :2, :2], stiffness[:, :2, 2:]
    bt, e = b.transpose(0, 2, 1), stiffness[:, 2:, 2:]
    g = a + e
    still = g + b + bt  # what resists when all bays move alike
    skew = 0.5 * (b[:, 0, 1] - b[:, 1, 0])
    mean = 0.5 * (b[:, 0, 1] + b[:, 1, 0])
    b11, b22 = b[:, 0, 0], b[:, 1, 1]
    c2 = b11 * b22 - mean**2 + skew**2
    c1 = (still[:, 0, 0] * b22 + still[:, 1, 1] * b11 - 2.0 * still[:, 0, 1] * mean
          + 4.0 * skew**2)
    c0 = still[:, 0, 0] * still[:, 1, 1] - still[:, 0, 1] ** 2
    root = np.sqrt(c1**2 - 4.0 * c2 * c0)
    root = np.where(np.abs(c1 + root) >= np.abs(c1 - root), root, -root)
    q = -0.5 * (c1 + root)
    sigma = np.stack([c0 / q, q / c2], axis=1)

    swing = np.sqrt(sigma) * np.sqrt(1.0 + 0.25 * sigma)
    one, other = 1.0 + 0.5 * sigma + swing, 1.0 + 0.5 * sigma - swing
    growing = np.where(np.abs(one) >= np.abs(other), one, other)
    mu: ComplexArray = np.reciprocal(growing)
    lossless = np.abs(mu) > 1.0 - 1e-10
    if lossless.any():
        mu = np.where(lossless & (_power(mu, a, b, g) < 0.0), 1.0 / mu, mu)

    t, d = mu.sum(axis=1)[:, None, None], mu.prod(axis=1)[:, None, None]
    right: ComplexArray = np.linalg.solve(g + t * b, d * b - bt)
    left: ComplexArray = np.linalg.solve(g + t * bt, d * bt - b)
    return Waves(mu, right, left, a + b @ right, e + bt @ left)


def _power(mu: ComplexArray, a: ComplexArray, b: ComplexArray, g: ComplexArray) -> Array:
    """Energy flux to the right (f, 2), up to a positive factor, of the waves mu (f, 2)."""
    m = mu[..., None, None]
    a, b, g = a[:, None], b[:, None], g[:, None]
    equation = m * m * b + m * g + b.swapaxes(-1, -2)
    rows = np.abs(equation).max(axis=-1) / np.abs(g).max(axis=-1)
    row = np.where(rows[..., :1] >= rows[..., 1:], equation[..., 0, :], equation[..., 1, :])
    u = np.stack([-row[..., 1], row[..., 0]], axis=-1)
    force = ((a + m * b) @ u[..., None])[..., 0]
    flux: Array = (force * u.conj()).sum(axis=-1).imag
    return flux


class Row:
    """Bays in a row with a unit harmonic force in one of them.

    A subclass knows its bays, the stiffness with which the rest of the row holds one of them, and
    how displacements continue from it into the rest.
    """

    spacing: float
    start: float

    def bay(self, number: int) -> CondensedBay:
        """Return the bay of that number."""
        raise NotImplementedError

    def closures(self, number: int) -> tuple[ComplexArray, ComplexArray]:
        """Stiffness (f, 2, 2) of the rest of the row, left and right of the bay of that number."""
        raise NotImplementedError

    def carry(self, ends: ComplexArray, loaded: int, number: int) -> ComplexArray:
        """End displacements (f, 4) of a bay from those of the loaded bay (f, 4)."""
        raise NotImplementedError

    def locate(self, x: float) -> tuple[int, float]:
        """Bay number of the track position x [m], and the distance from that bay's left end."""
        number = math.floor((x - self.start) / self.spacing)
        inside = x - self.start - number * self.spacing
        return number, min(max(inside, 0.0), self.spacing)

    def excite(self, force: float | Sleeper) -> Response:
        """Return the response to a unit force on the rail at x [m] or on a sleeper."""
        number, inside, load = self.weights(force)
        bay = self.bay(number).bay
        k = bay.stiffness.copy()
        for ends, hold in zip((bay.ends[:2], bay.ends[2:]), self.closures(number), strict=True):
            k[:, ends[:, None], ends] += hold
        u = np.linalg.solve(k, load[..., None])[..., 0]
        return Response(self, number, inside, u)

    def weights(self, point: float | Sleeper) -> tuple[int, float | None, ComplexArray]:
        """Bay number, place in that bay (None: its sleeper) and weights (f, n) of a point."""
        if isinstance(point, Sleeper):
            bay = self.bay(point.number).bay
            weights = np.zeros(bay.stiffness.shape[:2], dtype=complex)
            weights[:, bay.sleeper] = 1.0
            return point.number, None, weights
        number, inside = self.locate(point)
        return number, inside, self.bay(number).bay.shape(inside)


@dataclass(frozen=True)
class Sleeper:
    """A sleeper as a place to push or to measure; sleeper k is centred at x = k * spacing."""

    number: int = 0


@dataclass(frozen=True)
class Response:
    """The answer of a row of bays to a unit harmonic force in the bay `loaded`."""

    row: Row
    loaded: int
    load_inside: float | None
    displacement: ComplexArray

    def at(self, point: float | Sleeper) -> ComplexArray:
        """Displacement (f,) [m/N] of the rail at x [m], or of a sleeper."""
        number, inside, weights = self.row.weights(point)
        u = self.displacement
        loaded = self.row.bay(self.loaded).bay
        if number != self.loaded:
            ends = self.row.carry(u[:, loaded.ends], self.loaded, number)
            u = self.row.bay(number).displacements(ends)
        w: ComplexArray = (weights * u).sum(axis=1)
        if number == self.loaded and inside is not None and self.load_inside is not None:
            w = w + loaded.flexibility(inside, self.load_inside)
        return w


class InfiniteRow(Row):
    """Infinitely many identical bays: no reflection, no end."""

    def __init__(self, bay: HarmonicBay) -> None:
        self.spacing, self.start = bay.spacing, bay.start
        self._bay = CondensedBay(bay)
        self.waves = bloch_waves(self._bay.stiffness)

    def bay(self, number: int) -> CondensedBay:
        """Return the bay, the same for every number."""
        return self._bay

    def closures(self, number: int) -> tuple[ComplexArray, ComplexArray]:
        """Return the stiffness of the half-infinite rows on either side."""
        return self.waves.left_stiffness, self.waves.right_stiffness

    def carry(self, ends: ComplexArray, loaded: int, number: int) -> ComplexArray:
        """Carry end displacements from the loaded bay to another by the decaying waves."""
        if number > loaded:
            near, step = ends[:, 2:, None], self.waves.right
        else:
            near, step = ends[:, :2, None], self.waves.left
        near = np.linalg.matrix_power(step, abs(number - loaded) - 1) @ near
        far = step @ near
        pair = (near, far) if number > loaded else (far, near)
        return np.concatenate(pair, axis=1)[..., 0]
