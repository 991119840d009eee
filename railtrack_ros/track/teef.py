"""The rail over a rail-pad: Timoshenko beam element on an elastic foundation (TEEF).

The pad is a continuous foundation of stiffness kd [N/m^2] which rides on the sleeper.  The
element's degrees of freedom are (w1, theta1, w2, theta2, ws): the two ends of the rail and the
sleeper's vertical displacement (thesis chapter 3.2).  Its shape functions are the exact static
solution of

    w' = theta + Q / (kappa A G),  theta' = M / EI,  Q' = kd (w - ws),  M' = -Q,

which is thesis (3.3)-(3.16) as a first-order system; its matrix exponential covers every case of
the characteristic roots, and tends to TIM4 as the foundation vanishes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from railtrack_ros.track.description import Rail
from railtrack_ros.track.rail import Array, gauss, shear_ratio


@dataclass(frozen=True)
class StaticField:
    """Fields along the element for unit degrees of freedom, each of shape (n, 5).

    deflection [m], rotation [rad], bending moment [N m] and shear force [N].
    """

    deflection: Array
    rotation: Array
    moment: Array
    shear: Array


def _state_matrix(rail: Rail, length: float, foundation: float) -> Array:
    """d/dxi of the state (w, theta L, Q L^3/EI, M L^2/EI, ws): all of one order of magnitude."""
    kappa = foundation * length**4 / rail.bending_stiffness
    a = np.zeros((5, 5))
    a[0, 1], a[0, 2] = 1.0, shear_ratio(rail, length) / 12.0
    a[1, 3] = 1.0
    a[2, 0], a[2, 4] = kappa, -kappa
    a[3, 2] = -1.0
    return a


def static_field(rail: Rail, length: float, foundation: float, x: ArrayLike) -> StaticField:
    """Exact static fields at x (n,) [m from the left end]; foundation kd in N/m^2.

    Thesis (3.10)-(3.16): the first four columns are N_EF, the fifth the function N_s of a
    unit sleeper displacement under clamped ends.
    """
    a = _state_matrix(rail, length, foundation)
    end = expm(a)
    # (Q, M) at the left end which make (w, theta) at the right end take the wanted value.
    start = np.zeros((5, 5))
    start[0, 0], start[1, 1], start[4, 4] = 1.0, 1.0, 1.0
    wanted = np.zeros((2, 5))
    wanted[0, 2], wanted[1, 3] = 1.0, 1.0
    free = end[:2, [0, 1, 4]] @ start[[0, 1, 4]]
    start[2:4] = np.linalg.solve(end[:2, 2:4], wanted - free)
    start[:, [1, 3]] *= length

    xi = np.atleast_1d(np.asarray(x, dtype=float)) / length
    state = expm(a[None] * xi[:, None, None]) @ start
    ei = rail.bending_stiffness
    return StaticField(
        deflection=state[:, 0],
        rotation=state[:, 1] / length,
        shear=state[:, 2] * ei / length**3,
        moment=state[:, 3] * ei / length**2,
    )


@dataclass(frozen=True)
class TeefMatrices:
    """Matrices (5, 5) of a TEEF; rail_stiffness is the rail's own share of the strain energy.

    damping_shape times the pad's damping per length cd [N s/m^2] gives the damping matrix.
    """

    stiffness: Array
    rail_stiffness: Array
    damping_shape: Array
    mass: Array


def teef_matrices(rail: Rail, length: float, foundation: float) -> TeefMatrices:
    """Stiffness, damping and mass of a TEEF of that length on kd = foundation [N/m^2].

    All five functions enter the strain energy, so that a rigid-body motion of rail and sleeper
    together strains nothing (the thesis' (3.17)-(3.21) leave N_s out).
    """
    x, weight = gauss(length)
    field = static_field(rail, length, foundation, x)

    def integral(f: Array, g: Array) -> Array:
        return f.T @ (weight[:, None] * g)

    rail_stiffness = (integral(field.moment, field.moment) / rail.bending_stiffness
                      + integral(field.shear, field.shear) / rail.shear_stiffness)
    stretch = field.deflection.copy()
    stretch[:, 4] -= 1.0
    shape = integral(stretch, stretch)
    mass = (rail.mass_per_length * integral(field.deflection, field.deflection)
            + rail.rotary_inertia * integral(field.rotation, field.rotation))
    return TeefMatrices(
        stiffness=rail_stiffness + foundation * shape,
        rail_stiffness=rail_stiffness,
        damping_shape=shape,
        mass=mass,
    )


def clamped_flexibility(rail: Rail, length: float, foundation: float, x: ArrayLike) -> Array:
    """Static point flexibility F_sta(x) [m/N] of the clamped beam on its foundation.

    The sleeper is held.  Two clamped pieces of lengths x and L - x meet at the load; the joint's
    (w, w) flexibility is taken.  x: (n,) metres from the left end; zero at both ends.
    """
    x = np.atleast_1d(np.asarray(x, dtype=float))
    result = np.zeros(x.size)
    inside = (x > 0.0) & (x < length)
    a = _state_matrix(rail, length, foundation)[:4, :4]

    def end_stiffness(piece: Array) -> Array:
        transfer = expm(a[None] * (piece / length)[:, None, None])
        return transfer[:, 2:, 2:] @ np.linalg.inv(transfer[:, :2, 2:])

    if inside.any():
        mirror = np.diag([1.0, -1.0])  # The right piece is a left one seen from the other end.
        joint = (end_stiffness(x[inside])
                 + mirror @ end_stiffness(length - x[inside]) @ mirror)
        # Rows (Q, M) against columns (w, theta): the scaled state of _state_matrix.
        flexibility = np.linalg.inv(joint)[:, 0, 0]
        result[inside] = flexibility * length**3 / rail.bending_stiffness
    return result
