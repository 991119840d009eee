"""Wheels on a rail, one time step: unsprung masses or flexible wheelsets on Hertzian springs.

Whatever computes the rail (finite elements, convolution, recursion), a time step of the wheels
needs two things of it: the deflection that the rail would have at each wheel if no wheel pressed
on it during this step, and the compliance matrix that one step's contact forces see.  Then

    w_rail = w_free - C f ,   w_wheel by Newmark from  M w'' = f - W ,
    delta = w_rail + r - w_wheel ,   f = K delta^p for delta > 0, else 0          (thesis 2.19)

has one unknown per wheel, the indentation delta.  All forward solvers call :func:`contact_step`.

A wheel may carry a primary suspension and flexible modes (`dynamics.wheelset`).  It stays a linear
system between its contact force and its contact point, advanced by the same Newmark parameters, so
the unknown of a time step is still the indentation alone.

A damped contact follows Hunt and Crossley: f = K delta^p (1 + c delta' / W), never negative, so
that c is the damping [N s/m] at the static load and force starts and ends at zero without a jump.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.compiled import njit
from railtrack_ros.dynamics.wheelset import WheelsetStep, effective_mass, wheelset_step
from railtrack_ros.errors import InputError
from railtrack_ros.vehicle.description import Vehicle

Array = NDArray[np.float64]

# First rows of the wheels' state: displacement and velocity of the wheel at its contact point,
# acceleration of the axle box (a rigid wheel moves as one), and the last two indentations.
DISPLACEMENT, VELOCITY, ACCELERATION, INDENTATION, EARLIER_INDENTATION = range(5)
# A wheelset of m degrees of freedom has 3 m rows more: displacements, velocities, accelerations.
FIRST_OWN = 5

MOST_ITERATIONS = 60
MOST_FIXED_ITERATIONS = 1000  # they converge by a factor at best
ITERATIONS = ('newton', 'fixed')


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
    own_flexibility: float  # of the wheel at its contact point in one time step, m/N
    fixed: bool  # iterate with the constant matrix, without the contact's tangent
    wheelset: WheelsetStep


def wheel_constants(vehicle: Vehicle, time_step: float, beta: float = 0.25, gamma: float = 0.5,
                    tolerance: float = 1e-10, iteration: str = 'newton') -> WheelConstants:
    """Gather the constants of :func:`contact_step`, which stops at a change below tolerance.

    iteration: 'newton' has the exact Jacobian; 'fixed' the constant matrix of the thesis, with
    the contact forces of the last iterate on the right-hand side.

    Raises
    ------
    InputError
        A time step [s] that cannot follow the wheel on its contact spring, a tolerance that is
        not between 0 and 0.01, or an unknown iteration.
    """
    wheel, contact = vehicle.wheel, vehicle.contact
    longest = longest_time_step(vehicle)
    if not 0.0 < time_step <= longest:
        raise InputError(
            f'time step {time_step:g} s: too long for the contact, at most {longest:.2g} s (an '
            f'eighth of a period of the wheel on its contact spring)' if time_step > 0.0 else
            f'time step: expected a positive number of seconds, got {time_step:g}')
    if not 1e-14 <= tolerance <= 0.01:
        raise InputError(f'tolerance {tolerance:g}: expected 1e-14 to 0.01')
    if iteration not in ITERATIONS:
        raise InputError(f'iteration {iteration!r}: expected one of {", ".join(ITERATIONS)}')
    wheelset = wheelset_step(wheel, time_step, beta, gamma)
    own = beta * time_step * time_step / wheel.mass
    if wheelset.contact.size:
        own = beta * time_step**2 * float(wheelset.contact @ wheelset.drive)
    return WheelConstants(
        mass=float(wheel.mass), static_load=float(wheel.static_load),
        stiffness=float(contact.stiffness), exponent=float(contact.exponent),
        damping_time=contact.damping / wheel.static_load,
        time_step=float(time_step), beta=float(beta), gamma=float(gamma),
        tolerance=float(tolerance), own_flexibility=own, fixed=iteration == 'fixed',
        wheelset=wheelset,
    )


def longest_time_step(vehicle: Vehicle) -> float:
    """Longest time step [s] that follows the wheel on its contact spring: 1/8 of a period.

    The spring is the contact's tangent at the static load.  On table 3.1 that is 0.5 ms, where
    the standard deviation of the contact force over a dipped joint is off by 0.5 %.
    """
    wheel, contact = vehicle.wheel, vehicle.contact
    indentation = (wheel.static_load / contact.stiffness) ** (1.0 / contact.exponent)
    tangent = contact.exponent * wheel.static_load / indentation
    return 2.0 * math.pi / 8.0 * math.sqrt(effective_mass(wheel) / tangent)


def static_indentation(constants: WheelConstants) -> float:
    """Indentation [m] under the static load."""
    return (constants.static_load / constants.stiffness) ** (1.0 / constants.exponent)


def standing_wheels(constants: WheelConstants, rail_deflection: Array, irregularity: Array
                    ) -> Array:
    """State (rows, wheels) of wheels at rest on the statically deflected rail [m], (wheels,)."""
    indentation = static_indentation(constants)
    wheelset = constants.wheelset
    state = np.zeros((FIRST_OWN + 3 * wheelset.contact.size, np.size(rail_deflection)))
    state[DISPLACEMENT] = rail_deflection + irregularity - indentation
    # A lift of the whole wheelset strains neither suspension nor modes.
    for row in np.flatnonzero(wheelset.rigid):
        state[FIRST_OWN + row] = state[DISPLACEMENT]
    state[INDENTATION] = state[EARLIER_INDENTATION] = indentation
    return state


def contact_work(wheels: int) -> Array:
    """Scratch for :func:`contact_step`."""
    return np.zeros((wheels, wheels + 3))


@njit(cache=True, fastmath={'contract'}, nogil=True)
def predict_wheelset(wheelset, state, dt, beta, gamma):
    """Newmark's prediction of one wheelset, and its contact point's place under no new force.

    state (5 + 3 m,).  The own accelerations become those that suspension and modes cause.
    """
    m = wheelset.contact.size
    u, v, a = state[5:5 + m], state[5 + m:5 + 2 * m], state[5 + 2 * m:]
    for k in range(m):
        u[k] += dt * v[k] + (0.5 - beta) * dt * dt * a[k]
        v[k] += (1.0 - gamma) * dt * a[k]
    place = 0.0
    for k in range(m):
        a[k] = 0.0
        for j in range(m):
            a[k] -= wheelset.stiffness[k, j] * u[j] + wheelset.damping[k, j] * v[j]
        place += wheelset.contact[k] * (u[k] + beta * dt * dt * a[k])
    state[0] = place


@njit(cache=True, fastmath={'contract'}, nogil=True)
def correct_wheelset(wheelset, state, force, dt, beta, gamma):
    """Add what the force [N] beyond the static load does, and read off the first three rows."""
    m = wheelset.contact.size
    u, v, a = state[5:5 + m], state[5 + m:5 + 2 * m], state[5 + 2 * m:]
    state[0] = state[1] = state[2] = 0.0
    for k in range(m):
        a[k] += wheelset.drive[k] * force
        u[k] += beta * dt * dt * a[k]
        v[k] += gamma * dt * a[k]
        state[0] += wheelset.contact[k] * u[k]
        state[1] += wheelset.contact[k] * v[k]
        state[2] += wheelset.box[k] * a[k]


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
        (5 or more, n) state, rows as named above; overwritten.
    force
        (n,) compressive contact forces [N]; overwritten.
    work
        Scratch of contact_work(n).

    Returns
    -------
    int
        Iterations, or -1 if they did not converge.
    """
    n = force.size
    (mass, load, stiffness, exponent, damping_time, dt, beta, gamma, tolerance, own, fixed,
     wheelset) = constants
    flexible = wheelset.contact.size > 0
    most = MOST_FIXED_ITERATIONS if fixed else MOST_ITERATIONS
    scale = (load / stiffness) ** (1.0 / exponent)
    free, delta, change = work[:, n], work[:, n + 1], work[:, n + 2]
    for i in range(n):
        if flexible:
            predict_wheelset(wheelset, wheels[:, i], dt, beta, gamma)
        else:
            a = wheels[2, i]
            wheels[0, i] += dt * wheels[1, i] + (0.5 - beta) * dt * dt * a
            wheels[1, i] += (1.0 - gamma) * dt * a
        free[i] = rail_free[i] + irregularity[i] - wheels[0, i] + own * load
        extrapolated = 2.0 * wheels[3, i] - wheels[4, i]
        delta[i] = extrapolated if extrapolated > 0.0 else free[i]

    iterations = 0
    converged = False
    while not converged:
        if iterations == most:
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
                    if not fixed:
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
            # Newton's next change is about the square of this one, which need not be made.
            loaded = delta[i] > 0.0 and delta[i] > change[i]
            left = change[i] * change[i] / delta[i] if loaded and not fixed else abs(change[i])
            small = left <= tolerance * max(abs(delta[i]), scale)
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
        if flexible:
            correct_wheelset(wheelset, wheels[:, i], f - load, dt, beta, gamma)
        else:
            a = (f - load) / mass
            wheels[0, i] += beta * dt * dt * a
            wheels[1, i] += gamma * dt * a
            wheels[2, i] = a
        wheels[4, i] = wheels[3, i]
        wheels[3, i] = d
    return iterations
