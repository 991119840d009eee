"""Closed forms of a rail on a continuous elastic foundation, to hold models against.

Deflections count in the direction of the force; the rail has no loss, the foundation no mass.
"""

from __future__ import annotations

import cmath
import math

import numpy as np
from numpy.typing import ArrayLike

from railtrack_ros.errors import InputError
from railtrack_ros.track.description import Rail, Support
from railtrack_ros.track.rail import Array


def smeared_foundation(support: Support) -> float:
    """Return the static stiffness per length [N/m^2] of pad and ballast in series, spread out."""
    series = 1.0 / (1.0 / support.pad_stiffness + 1.0 / support.ballast_stiffness)
    return series / support.spacing


def critical_speed(rail: Rail, foundation: float) -> float:
    """Return the speed [m/s] at which a moving force meets the slowest wave, Euler-Bernoulli.

    v_cr = (4 k EI / m^2)^(1/4); foundation k in N/m^2.
    """
    return (4.0 * foundation * rail.bending_stiffness / rail.mass_per_length**2) ** 0.25


def euler_winkler(
    rail: Rail, foundation: float, force: float, distance: ArrayLike = 0.0, speed: float = 0.0,
) -> Array:
    """Deflection (n,) [m] at `distance` [m] from a force [N] moving steadily, Euler-Bernoulli.

    With b = (k / 4EI)^(1/4) and e = v / v_cr < 1, w = F / (8 EI b^3 sqrt(1 - e^2))
    exp(-b sqrt(1 - e^2) |s|) [cos(b sqrt(1 + e^2) s) + sqrt((1 - e^2)/(1 + e^2)) sin(... |s|)].

    Raises InputError from the critical speed on.
    """
    e = speed / critical_speed(rail, foundation)
    if e >= 1.0:
        raise InputError(f'speed: {speed:g} m/s is not below the critical {speed / e:.1f} m/s')
    b = (foundation / (4.0 * rail.bending_stiffness)) ** 0.25
    decay, wave = b * math.sqrt(1.0 - e * e), b * math.sqrt(1.0 + e * e)
    s = np.abs(np.asarray(distance, dtype=float))
    amplitude = force / (8.0 * rail.bending_stiffness * b * b * decay)
    result: Array = amplitude * np.exp(-decay * s) * (
        np.cos(wave * s) + decay / wave * np.sin(wave * s))
    return result


def timoshenko_winkler(
    rail: Rail, foundation: float, force: float, distance: ArrayLike = 0.0, speed: float = 0.0,
) -> Array:
    """Deflection (n,) [m] at `distance` [m] from a force [N] moving steadily, Timoshenko.

    In the moving frame w(s) = F / 2 pi integral (B' q^2 + S) e^{iqs} / D(q) dq with S = kappa A G,
    B' = EI - rho I v^2, D = (S - m v^2) B' q^4 + (k B' - S m v^2) q^2 + k S; its two residues.

    Raises InputError from the speed on at which waves run along with the force.
    """
    s_, v2 = rail.shear_stiffness, speed**2
    bending = rail.bending_stiffness - rail.rotary_inertia * v2
    shear = s_ - rail.mass_per_length * v2
    quartic = shear * bending
    square = foundation * bending - s_ * rail.mass_per_length * v2
    constant = foundation * s_
    root = cmath.sqrt(square * square - 4.0 * quartic * constant)
    squares = [(-square + sign * root) / (2.0 * quartic) for sign in (1.0, -1.0)]
    if bending <= 0.0 or shear <= 0.0 or any(q2.imag == 0.0 and q2.real >= 0.0 for q2 in squares):
        raise InputError(f'speed: at {speed:g} m/s waves run along with the force')
    s = np.abs(np.asarray(distance, dtype=float))
    total = np.zeros(s.shape, dtype=complex)
    for q2 in squares:
        q = cmath.sqrt(q2)
        q = q if q.imag > 0.0 else -q
        total += (bending * q2 + s_) * np.exp(1j * q * s) / (
            2.0 * q * (2.0 * quartic * q2 + square))
    return (1j * force * total).real
