"""The wheel on its contact spring: what the acceleration of the axle box says without the rail.

For a rigid unsprung wheel the contact force is f = W + M a. With a primary suspension and flexible
modes (`dynamics.wheelset`) the box moves by a = G(s) (f - W) and the contact point by
a_c = G_c(s) (f - W), both rational in s; the suspension stretch and the modes are their states,
and the free lift cancels, so that a constant error of the sensor stays a constant error. Then

    f - W = a / G ,    a_c = (G_c / G) a ,

two filters whose poles are the zeros of G, the antiresonances of the wheelset as the box feels it.
Where the box moves against the contact point a zero lies on the unstable side; it is mirrored,
which keeps the magnitude of f at every frequency and delays it. Antiresonances are given a damping
ratio of at least LEAST_DAMPING, which bounds the noise that the filter blows up at frequencies
where the box hardly moves whatever the force.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from railtrack_ros.compiled import njit
from railtrack_ros.errors import InputError
from railtrack_ros.vehicle.description import Vehicle, Wheel

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LEAST_DAMPING = 0.005

# Iterations for the indentation of a damped contact.
MOST_ITERATIONS = 30


class WheelInverse:
    """Contact force, indentation and contact point's acceleration of `wheels` channels, streamed.

    Results do not depend on how a run is cut into blocks. Raises InputError where the axle box
    does not follow a sudden force at the contact in its direction.
    """

    def __init__(self, vehicle: Vehicle, time_step: float, wheels: int) -> None:
        self.vehicle = vehicle
        self.time_step = time_step
        self.sections: list[Array] = []
        wheel = vehicle.wheel
        if wheel.suspension is not None or wheel.modes:
            self.sections = [_discrete(*part, 1.0 / time_step) for part in inverse_filters(wheel)]
        self.filters: list[Array] = [np.zeros((len(sos), 2, wheels)) for sos in self.sections]
        load, contact = wheel.static_load, vehicle.contact
        still = (load / contact.stiffness) ** (1.0 / contact.exponent)
        self.indentation: Array = np.full((2, wheels), still)

    def __call__(self, acceleration: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Take the next samples.

        Parameters
        ----------
        acceleration
            (n, wheels) of the axle boxes [m/s2, up]; becomes that of the contact points in place,
            zero where it is not finite.

        Returns
        -------
        tuple
            Force [N, compression positive], indentation [m] and whether it was measured,
            (n, wheels) each.
        """
        alive = np.isfinite(acceleration)
        acceleration[~alive] = 0.0
        wheel, contact = self.vehicle.wheel, self.vehicle.contact
        if self.sections:
            excess, self.filters[0] = signal.sosfilt(
                self.sections[0], acceleration, axis=0, zi=self.filters[0])
            acceleration[:], self.filters[1] = signal.sosfilt(
                self.sections[1], acceleration, axis=0, zi=self.filters[1])
        else:
            excess = wheel.mass * acceleration
        force = wheel.static_load + excess
        indentation = np.empty_like(force)
        _indentation(force, float(contact.stiffness), float(contact.exponent),
                     contact.damping / wheel.static_load, self.time_step, self.indentation,
                     indentation)
        return force, indentation, alive

    def state(self) -> dict[str, Any]:
        """A copy of what has to be remembered."""
        return {'filters': [x.copy() for x in self.filters],
                'indentation': self.indentation.copy()}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a state of the same vehicle and time step."""
        self.filters = [x.copy() for x in state['filters']]
        self.indentation = state['indentation'].copy()


def inverse_filters(wheel: Wheel) -> list[tuple[ComplexArray, ComplexArray, float]]:
    """Zeros, poles [rad/s] and gain of f - W [N] and of a_c [m/s2] over the box's acceleration."""
    # States (stretch of the suspension, its rate, q, q'), driven by the box's acceleration a.
    spring, n = wheel.suspension, len(wheel.modes)
    first = 0 if spring is None else 2
    size = first + 2 * n
    omega = np.array([2.0 * np.pi * mode.frequency for mode in wheel.modes])
    ratio = np.array([mode.damping_ratio for mode in wheel.modes])
    contact = np.array([mode.contact_shape for mode in wheel.modes])
    box = np.array([mode.axle_box_shape for mode in wheel.modes])
    suspension = np.zeros(size)  # force of the suspension, downwards on the wheelset
    if spring is not None:
        suspension[:2] = spring.stiffness, spring.damping
    restoring = np.zeros((n, size))  # 2 zeta omega q' + omega^2 q
    for i in range(n):
        restoring[i, first + i], restoring[i, first + n + i] = omega[i]**2, 2*ratio[i]*omega[i]
    through = 1.0 / wheel.mass + box @ contact
    if not through > 0.01 / wheel.mass:
        raise InputError('wheel.modes: a sudden force at the contact does not lift the axle box: '
                         'the force cannot be found from its acceleration')
    # a = through g - (1/M + box.box) Fs - box . restoring, q'' = contact g - box Fs - restoring
    lost = (1.0 / wheel.mass + box @ box) * suspension + box @ restoring
    force = lost / through  # g = a / through + force . state
    a_matrix, drive = np.zeros((size, size)), np.zeros(size)
    if spring is not None:
        a_matrix[0, 1] = 1.0
        a_matrix[1] = -suspension / spring.sprung_mass
        drive[1] = 1.0
    for i in range(n):
        a_matrix[first + i, first + n + i] = 1.0
        a_matrix[first + n + i] = contact[i] * force - box[i] * suspension - restoring[i]
        drive[first + n + i] = contact[i] / through
    poles = np.asarray(np.linalg.eigvals(a_matrix), dtype=complex)
    # Zeros: poles of the system whose output is held at zero.
    direct = 1.0 / wheel.mass + contact @ contact  # a_c = direct g - ...
    lost_c = (1.0 / wheel.mass + contact @ box) * suspension + contact @ restoring
    outputs = [(force, 1.0 / through), (direct * force - lost_c, direct / through)]
    return [(np.linalg.eigvals(a_matrix - np.outer(drive, row) / gain), _stable(poles), gain)
            for row, gain in outputs]


def _stable(poles: ComplexArray) -> ComplexArray:
    """Poles mirrored to the stable side and damped by at least LEAST_DAMPING."""
    size = np.abs(poles)
    real = -np.maximum(np.abs(poles.real), LEAST_DAMPING * size)
    return np.asarray(real + 1j * np.sign(poles.imag) * np.sqrt(np.maximum(size**2 - real**2, 0)))


def _discrete(zeros: ComplexArray, poles: ComplexArray, gain: float, rate: float) -> Array:
    """Second-order sections of a filter at a sample rate [Hz].

    A bilinear transform of roots that are shifted beforehand, so that resonances and
    antiresonances stay at their frequencies; the gain for slow signals is kept.
    """
    shifted = [2.0 * rate * np.tanh(roots / (2.0 * rate)) for roots in (zeros, poles)]
    for roots, new, sign in ((zeros, shifted[0], 1), (poles, shifted[1], -1)):
        moved = np.abs(roots) > 1e-6
        gain *= float(np.prod(roots[moved] / new[moved]).real) ** sign
    return np.asarray(signal.zpk2sos(*signal.bilinear_zpk(*shifted, gain, rate)))


@njit(cache=True, nogil=True)
def _indentation(force, stiffness, exponent, damping_time, step, last, indentation):
    """Indentation of f = K d^p (1 + c d' / W), its rate from the last two as the forward solvers.

    Each sample comes from the ones before it alone.
    """
    samples, wheels = force.shape
    for n in range(samples):
        for w in range(wheels):
            f = max(force[n, w], 0.0)
            d = (f / stiffness) ** (1.0 / exponent)
            if damping_time > 0.0 and f > 0.0:
                for _ in range(MOST_ITERATIONS):
                    rate = (1.5 * d - 2.0 * last[0, w] + 0.5 * last[1, w]) / step
                    factor = 1.0 + damping_time * rate
                    # At least a tenth: a contact about to part is not followed by Newton's method.
                    factor = max(factor, 0.1)
                    spring = stiffness * d ** exponent
                    slope = spring * (exponent / d * factor + 1.5 * damping_time / step)
                    change = (f - spring * factor) / slope
                    d = max(d + change, 0.1 * d)
                    if abs(change) < 1e-12 * d:
                        break
            last[1, w] = last[0, w]
            last[0, w] = d
            indentation[n, w] = d
