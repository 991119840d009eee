"""Wheels on a rail, one time step: rigid unsprung masses on Hertzian springs.

Whatever computes the rail (finite elements, convolution, recursion), a time step of the wheels
needs two things of it: the deflection that the rail would have at each wheel if no wheel pressed
on it during this step, and the compliance matrix that one step's contact forces see.  Then

    w_rail = w_free - C f ,   w_wheel by Newmark from  M w'' = f - W ,
    delta = w_rail + r - w_wheel ,   f = K delta^p for delta > 0, else 0          (thesis 2.19)

has one unknown per wheel, the indentation delta.  All forward solvers call :func:`contact_step`.

A damped contact follows Hunt and Crossley: f = K delta^p (1 + c delta' / W), never negative, so
that c is the damping [N s/m] at the static load and force starts and ends at zero without a jump.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.compiled import njit
from railtrack_ros.errors import InputError
from railtrack_ros.vehicle.description import Vehicle

Array = NDArray[np.float64]

# Rows of the wheels' state (5, wheels).
DISPLACEMENT, VELOCITY, ACCELERATION, INDENTATION, EARLIER_INDENTATION = range(5)

MOST_ITERATIONS = 60


class WheelConstants(NamedTuple):
    """What a time step of the wheels needs to know, SI units."""

    mass: float
    static_load: float
    stiffness: float
    exponent: float
    damping_time: float  # contact damping over static load, s/m
    time_step: float
    beta: float
    gamma: float
    tolerance: float  # of an indentation, relative


def wheel_constants(vehicle: Vehicle, time_step: float, beta: float = 0.25, gamma: float = 0.5,
                    tolerance: float = 1e-10) -> WheelConstants:
    """Gather the constants of :func:`contact_step`; Newton stops at a change below tolerance.

    Raises
    ------
    InputError
        A time step [s] that cannot follow the wheel on its contact spring.
    """
    vehicle.require_rigid_wheels('the contact step')
    wheel, contact = vehicle.wheel, vehicle.contact
    longest = longest_time_step(vehicle)
    if not 0.0 < time_step <= longest:
        raise InputError(
            f'time step {time_step:g} s: too long for the contact, at most {longest:.2g} s (an '
            f'eighth of a period of the wheel on its contact spring)' if time_step > 0.0 else
            f'time step: expected a positive number of seconds, got {time_step:g}')
    return WheelConstants(
        mass=float(wheel.mass), static_load=float(wheel.static_load),
        stiffness=float(contact.stiffness), exponent=float(contact.exponent),
        damping_time=contact.damping / wheel.static_load,
        time_step=float(time_step), beta=float(beta), gamma=float(gamma),
        tolerance=float(tolerance),
    )


def longest_time_step(vehicle: Vehicle) -> float:
    """Longest time step [s] that follows the wheel on its contact spring: 1/8 of a period.

    The spring is the contact's tangent at the static load.  On table 3.1 that is 0.5 ms, where
    the standard deviation of the contact force over a dipped joint is off by 0.5 %.
    """
    wheel, contact = vehicle.wheel, vehicle.contact
    indentation = (wheel.static_load / contact.stiffness) ** (1.0 / contact.exponent)
    tangent = contact.exponent * wheel.static_load / indentation
    return 2.0 * math.pi / 8.0 * math.sqrt(wheel.mass / tangent)


def static_indentation(constants: WheelConstants) -> float:
    """Indentation [m] under the static load."""
    return (constants.static_load / constants.stiffness) ** (1.0 / constants.exponent)


def standing_wheels(constants: WheelConstants, rail_deflection: Array, irregularity: Array
                    ) -> Array:
    """State (5, wheels) of wheels at rest on the statically deflected rail [m], (wheels,) each."""
    indentation = static_indentation(constants)
    state = np.zeros((5, np.size(rail_deflection)))
    state[DISPLACEMENT] = rail_deflection + irregularity - indentation
    state[INDENTATION] = state[EARLIER_INDENTATION] = indentation
    return state


def contact_work(wheels: int) -> Array:
    """Scratch for :func:`contact_step`."""
    return np.zeros((wheels, wheels + 3))


@njit(cache=True, fastmath={'contract'}, nogil=True)
def contact_step(rail_free, compliance, irregularity, wheels, constants, force, work):
    """Move the wheels by one time step and find the contact forces.

    The coupled indentations are found by Newton's method with the exact Jacobian; for one wheel
    the equation is monotone and convex and convergence certain from any start.

    Parameters
    ----------
    rail_free
        (n,) rail deflection [m] at the wheels without any contact force in this step.
    compliance
        (n, n) C [m/N]: deflection at wheel i (downwards) by a compressive force at wheel j that
        acts in this step, local flexibility included.
    irregularity
        (n,) combined irregularity [m] under the wheels.
    wheels
        (5, n) state, rows as named above; overwritten.
    force
        (n,) compressive contact forces [N]; overwritten.
    work
        Scratch of contact_work(n).

    Returns
    -------
    int
        Newton iterations, or -1 if they did not converge.
    """
    n = force.size
    mass, load, stiffness, exponent, damping_time, dt, beta, gamma, tolerance = constants
    own = beta * dt * dt / mass
    scale = (load / stiffness) ** (1.0 / exponent)
    free, delta, change = work[:, n], work[:, n + 1], work[:, n + 2]
    for i in range(n):
        a = wheels[2, i]
        wheels[0, i] += dt * wheels[1, i] + (0.5 - beta) * dt * dt * a
        wheels[1, i] += (1.0 - gamma) * dt * a
        free[i] = rail_free[i] + irregularity[i] - wheels[0, i] + own * load
        extrapolated = 2.0 * wheels[3, i] - wheels[4, i]
        delta[i] = extrapolated if extrapolated > 0.0 else free[i]

    iterations = 0
    converged = False
    while not converged:
        if iterations == MOST_ITERATIONS:
            return -1
        iterations += 1
        # Residual delta + C f - free and its Jacobian I + C diag(df / d delta).
        for i in range(n):
            change[i] = free[i] - delta[i]
            for j in range(n):
                work[i, j] = 0.0
            work[i, i] = 1.0
        for j in range(n):
            if delta[j] > 0.0:
                d = delta[j]
                power = math.sqrt(d) if exponent == 1.5 else d ** (exponent - 1.0)
                f, slope = stiffness * power * d, stiffness * power * exponent
                if damping_time > 0.0:
                    rate = (1.5 * d - 2.0 * wheels[3, j] + 0.5 * wheels[4, j]) / dt
                    factor = max(0.0, 1.0 + damping_time * rate)
                    slope = slope * factor + (f * 1.5 * damping_time / dt if factor > 0.0 else 0.0)
                    f *= factor
                for i in range(n):
                    c = compliance[i, j] + (own if i == j else 0.0)
                    change[i] -= c * f
                    work[i, j] += c * slope
        # Elimination without pivoting: I + C D with C symmetric positive, D >= 0 diagonal.
        for k in range(n - 1):
            for i in range(k + 1, n):
                ratio = work[i, k] / work[k, k]
                if ratio != 0.0:
                    for j in range(k + 1, n):
                        work[i, j] -= ratio * work[k, j]
                    change[i] -= ratio * change[k]
        converged = True
        for i in range(n - 1, -1, -1):
            for j in range(i + 1, n):
                change[i] -= work[i, j] * change[j]
            change[i] /= work[i, i]
            delta[i] += change[i]
            small = abs(change[i]) <= tolerance * max(abs(delta[i]), scale)
            if not (small and math.isfinite(change[i])):
                converged = False

    for i in range(n):
        d = delta[i]
        f = 0.0
        if d > 0.0:
            f = stiffness * d * (math.sqrt(d) if exponent == 1.5 else d ** (exponent - 1.0))
            if damping_time > 0.0:
                rate = (1.5 * d - 2.0 * wheels[3, i] + 0.5 * wheels[4, i]) / dt
                f *= max(0.0, 1.0 + damping_time * rate)
        force[i] = f
        a = (f - load) / mass
        wheels[0, i] += beta * dt * dt * a
        wheels[1, i] += gamma * dt * a
        wheels[2, i] = a
        wheels[4, i] = wheels[3, i]
        wheels[3, i] = d
    return iterations
