"""The wheel on its contact spring: what the acceleration of the axle box says without the rail."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.compiled import njit
from railtrack_ros.vehicle.description import Vehicle

Array = NDArray[np.float64]


def contact(vehicle: Vehicle, acceleration: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Contact force and indentation of rigid unsprung wheels.

    f = F0 + M a and delta = (max(f, 0) / K)^(1/p) (thesis 2.19), sample by sample in compiled
    code: the value of a sample does not depend on its neighbours in the array.

    Parameters
    ----------
    vehicle
        Its wheel and contact.
    acceleration
        (n, wheels) of the axle boxes [m/s2, up]; one that is not finite becomes zero in place.

    Returns
    -------
    tuple
        Force [N, compression positive], indentation [m] and whether it was measured,
        (n, wheels) each.
    """
    force = np.empty_like(acceleration)
    indentation = np.empty_like(acceleration)
    alive = np.empty(acceleration.shape, dtype=np.bool_)
    _contact(
        acceleration,
        float(vehicle.wheel.mass),
        float(vehicle.wheel.static_load),
        float(vehicle.contact.stiffness),
        1.0 / vehicle.contact.exponent,
        force,
        indentation,
        alive,
    )
    return force, indentation, alive


@njit(cache=True, nogil=True)
def _contact(acceleration, mass, static_load, stiffness, power, force, indentation, alive):
    samples, wheels = acceleration.shape
    for n in range(samples):
        for w in range(wheels):
            alive[n, w] = np.isfinite(acceleration[n, w])
            if not alive[n, w]:
                acceleration[n, w] = 0.0
            f = static_load + mass * acceleration[n, w]
            force[n, w] = f
            indentation[n, w] = (max(f, 0.0) / stiffness) ** power
