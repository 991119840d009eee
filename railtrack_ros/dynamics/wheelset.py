"""A wheel with primary suspension and flexible modes, as a linear system under its contact force.

Degrees of freedom x = (w, z, q_1 ... q_k): rigid lift of the unsprung mass, sprung mass, modes.
Contact point and axle box move as

    w_contact = w + sum phi_contact,i q_i ,      w_box = w + sum phi_box,i q_i ,

the suspension stretches by w_box - z, the modes are mass-normalised and orthogonal to the rigid
lift, and the wheelset is driven by what the contact force exceeds the static load by:

    M x'' + C x' + K x = c (f - W) ,    c = (1, 0, phi_contact,1, ...) .

With the static load constant, x is counted from the static state, in which all strains are zero.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.vehicle.description import Wheel

Array = NDArray[np.float64]


class WheelsetStep(NamedTuple):
    """What one time step of a wheelset needs; empty arrays for a rigid wheel.

    With A = M + gamma dt C + beta dt^2 K of m degrees of freedom: stiffness, damping (m, m) are
    A^-1 K and A^-1 C, drive (m,) is A^-1 c.  contact, box (m,): shapes at contact point and axle
    box.  rigid (m,): 1 where a degree of freedom moves with a lift of the whole, else 0.
    """

    stiffness: Array
    damping: Array
    drive: Array
    contact: Array
    box: Array
    rigid: Array


def wheelset_step(wheel: Wheel, time_step: float, beta: float = 0.25, gamma: float = 0.5
                  ) -> WheelsetStep:
    """Prepare Newmark steps [s] of a wheel; a rigid one needs nothing."""
    if wheel.suspension is None and not wheel.modes:
        nothing, square = np.zeros(0), np.zeros((0, 0))
        return WheelsetStep(square, square, nothing, nothing, nothing, nothing)
    mass, damping, stiffness, contact, box = wheelset_matrices(wheel)
    inverse = np.linalg.inv(mass + gamma * time_step * damping + beta * time_step**2 * stiffness)
    rigid = np.zeros(contact.size)
    rigid[:contact.size - len(wheel.modes)] = 1.0
    return WheelsetStep(np.ascontiguousarray(inverse @ stiffness),
                        np.ascontiguousarray(inverse @ damping), inverse @ contact,
                        contact, box, rigid)


def wheelset_matrices(wheel: Wheel) -> tuple[Array, Array, Array, Array, Array]:
    """Mass, damping, stiffness (m, m) [SI] and shapes at contact point and axle box (m,)."""
    modes, suspension = wheel.modes, wheel.suspension
    first = 1 if suspension is None else 2
    m = first + len(modes)
    mass = np.eye(m)
    damping, stiffness = np.zeros((m, m)), np.zeros((m, m))
    contact, box = np.zeros(m), np.zeros(m)
    mass[0, 0] = wheel.mass
    contact[0] = box[0] = 1.0
    for i, mode in enumerate(modes, start=first):
        omega = 2.0 * math.pi * mode.frequency
        stiffness[i, i], damping[i, i] = omega**2, 2.0 * mode.damping_ratio * omega
        contact[i], box[i] = mode.contact_shape, mode.axle_box_shape
    if suspension is not None:
        mass[1, 1] = suspension.sprung_mass
        stretch = box.copy()
        stretch[1] = -1.0
        stiffness += suspension.stiffness * np.outer(stretch, stretch)
        damping += suspension.damping * np.outer(stretch, stretch)
    return mass, damping, stiffness, contact, box


def effective_mass(wheel: Wheel) -> float:
    """Mass [kg] that the contact point offers to a sudden force."""
    return 1.0 / (1.0 / wheel.mass + sum(mode.contact_shape**2 for mode in wheel.modes))
