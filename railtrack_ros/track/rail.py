"""The rail: Timoshenko beam elements.

A rail element of length L carries the degrees of freedom (w1, theta1, w2, theta2): deflection
(up positive) and rotation of the cross-section at its two ends.  The two-node element TIM4
(thesis 2.1-2.6) uses the exact static solution of the unloaded beam as shape functions, so its
stiffness is exact and only its inertia is approximate.

What the two nodes cannot represent inside an element, the deflection of the beam clamped at both
ends, is the business of the *local system* (thesis chapter 2.2): a static flexibility, or the
clamped vibration modes computed by :func:`clamped_modes`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Legendre, Polynomial
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import eigh

from railtrack_ros.track.description import Rail

Array = NDArray[np.float64]

GAUSS_POINTS = 20
"""Points of the Gauss-Legendre rule used for every element integral."""


def gauss(length: float) -> tuple[Array, Array]:
    """Gauss-Legendre points and weights on 0..length [m], exact to polynomial degree 39."""
    x, weight = np.polynomial.legendre.leggauss(GAUSS_POINTS)
    return 0.5 * length * (x + 1.0), 0.5 * length * weight


def shear_ratio(rail: Rail, length: float) -> float:
    """Phi = 12 EI / (kappa A G L^2), the weight of shear in an element of that length."""
    return 12.0 * rail.bending_stiffness / (rail.shear_stiffness * length**2)


def shape_functions(rail: Rail, length: float, x: ArrayLike) -> tuple[Array, Array]:
    """Deflection and rotation along a TIM4 element for unit values of its degrees of freedom.

    x: (n,) metres from the left node.  Returns (deflection (n, 4), rotation (n, 4)) for the
    degrees of freedom (w1, theta1, w2, theta2); thesis (2.3)-(2.6), rotation by (2.17).
    """
    phi = shear_ratio(rail, length)
    d = 1.0 + phi
    # Each row: coefficients of 1, xi, xi^2, xi^3.
    rows = np.array([
        [1.0 + phi, -phi, -3.0, 2.0],
        [0.0, length * (1.0 + 0.5 * phi), -length * (2.0 + 0.5 * phi), length],
        [0.0, phi, 3.0, -2.0],
        [0.0, -length * 0.5 * phi, -length * (1.0 - 0.5 * phi), length],
    ]) / d
    xi = np.atleast_1d(np.asarray(x, dtype=float)) / length
    deflection = np.empty((xi.size, 4))
    rotation = np.empty((xi.size, 4))
    for k, row in enumerate(rows):
        n = Polynomial(row)
        deflection[:, k] = n(xi)
        rotation[:, k] = (n.deriv(1)(xi) + phi / 12.0 * n.deriv(3)(xi)) / length
    return deflection, rotation


def stiffness_matrix(rail: Rail, length: float) -> Array:
    """Stiffness (4, 4) of TIM4 [N/m, N, N m]: the exact static stiffness of the beam."""
    phi = shear_ratio(rail, length)
    a, b, c = 6.0 * length, (4.0 + phi) * length**2, (2.0 - phi) * length**2
    factor = rail.bending_stiffness / (length**3 * (1.0 + phi))
    return factor * np.array([
        [12.0, a, -12.0, a],
        [a, b, -a, c],
        [-12.0, -a, 12.0, -a],
        [a, c, -a, b],
    ])


def mass_matrix(rail: Rail, length: float) -> Array:
    """Consistent mass (4, 4) of TIM4 [kg, kg m, kg m^2], translation and rotary inertia."""
    x, weight = gauss(length)
    deflection, rotation = shape_functions(rail, length, x)
    return (rail.mass_per_length * deflection.T @ (weight[:, None] * deflection)
            + rail.rotary_inertia * rotation.T @ (weight[:, None] * rotation))


def clamped_flexibility(rail: Rail, length: float, x: ArrayLike) -> Array:
    """Static point flexibility F_sta(x) [m/N] of the beam clamped at both ends.

    x: (n,) metres from the left end.  Deflection under a unit force at x; the clean form of
    thesis (2.15), L^3 e (Phi(1 + Phi) + Phi e + 4 e^2) / (12 EI (1 + Phi)) with e = xi(1 - xi).
    """
    phi = shear_ratio(rail, length)
    xi = np.atleast_1d(np.asarray(x, dtype=float)) / length
    e = xi * (1.0 - xi)
    return (length**3 * e * (phi * (1.0 + phi) + phi * e + 4.0 * e**2)
            / (12.0 * rail.bending_stiffness * (1.0 + phi)))


def pinned_pinned_frequency(rail: Rail, half_wave: float) -> float:
    """Lowest pinned-pinned frequency [Hz] of the free rail with half a wave over `half_wave` [m].

    Smaller root of (mJ/(kAG EI)) w^4 - (m/EI + q^2 (m/kAG + J/EI)) w^2 + q^4 = 0, q = pi / l.
    """
    ei, kag = rail.bending_stiffness, rail.shear_stiffness
    m, j = rail.mass_per_length, rail.rotary_inertia
    q2 = (math.pi / half_wave) ** 2
    a, b, c = m * j / (kag * ei), m / ei + q2 * (m / kag + j / ei), q2**2
    squared = 2.0 * c / (b + math.sqrt(b * b - 4.0 * a * c))
    return math.sqrt(squared) / (2.0 * math.pi)


@dataclass(frozen=True)
class ClampedModes:
    """Mass-normalised vibration modes of an element with both ends held (thesis 2.11-2.13).

    angular_frequency: (modes,) rad/s, ascending.  The shapes are kept as Legendre series.
    """

    length: float
    angular_frequency: Array
    _deflection: tuple[Legendre, ...]
    _rotation: tuple[Legendre, ...]

    def shapes(self, x: ArrayLike) -> tuple[Array, Array]:
        """Deflection W and rotation Theta at x (n,) [m]: two arrays (n, modes)."""
        x = np.atleast_1d(np.asarray(x, dtype=float))
        w = np.stack([f(x) for f in self._deflection], axis=1)
        theta = np.stack([f(x) for f in self._rotation], axis=1)
        return w, theta


def clamped_modes(
    rail: Rail, length: float, modes: int, foundation: float = 0.0, terms: int = 26,
) -> ClampedModes:
    """Modes of the Timoshenko beam clamped at both ends, on a foundation [N/m^2] if given.

    Legendre-Galerkin: deflection and rotation are expanded in the bubble polynomials
    P_{j+2} - P_j, which vanish at both ends.  The expansion converges spectrally, so one method
    serves below and above the cut-off frequency sqrt(kappa A G / rho I) (thesis 2.11 and 2.12,
    and their counterpart on an elastic foundation, which the thesis leaves as future work).
    """
    domain = [0.0, length]
    bubbles = [Legendre.basis(j + 2, domain) - Legendre.basis(j, domain) for j in range(terms)]
    points, weights = np.polynomial.legendre.leggauss(terms + 8)
    x, weight = 0.5 * length * (points + 1.0), 0.5 * length * weights
    value: Array = np.stack([b(x) for b in bubbles], axis=1)
    slope: Array = np.stack([b.deriv()(x) for b in bubbles], axis=1)

    def integral(left: Array, right: Array) -> Array:
        return left.T @ (weight[:, None] * right)

    # Rotation is expanded as theta * length so that both unknowns are metres.
    ei, kag = rail.bending_stiffness, rail.shear_stiffness
    ww = kag * integral(slope, slope) + foundation * integral(value, value)
    wt = -kag * integral(slope, value) / length
    tt = (ei * integral(slope, slope) + kag * integral(value, value)) / length**2
    stiffness = np.block([[ww, wt], [wt.T, tt]])
    zero = np.zeros((terms, terms))
    mass = np.block([
        [rail.mass_per_length * integral(value, value), zero],
        [zero, rail.rotary_inertia * integral(value, value) / length**2],
    ])
    squared, vectors = eigh(stiffness, mass, subset_by_index=(0, modes - 1))

    def series(coefficients: Array) -> Legendre:
        total = np.zeros(terms + 2)
        total[2:] += coefficients
        total[:terms] -= coefficients
        return Legendre(total, domain)

    return ClampedModes(
        length=length,
        angular_frequency=np.sqrt(squared),
        _deflection=tuple(series(vectors[:terms, i]) for i in range(modes)),
        _rotation=tuple(series(vectors[terms:, i] / length) for i in range(modes)),
    )
