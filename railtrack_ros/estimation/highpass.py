"""High-pass of the irregularity in wavelength, in one pass with the wheel's double integration.

The combined irregularity is y = w_w + u, with w_w the double integral of the measured acceleration
a and u = (indentation - rail deflection) known sample by sample; it is wanted for wavelengths
below a cut-on, through a causal Butterworth high-pass of order 4. On a vehicle at speed v the
cut-on wavelength is the angular frequency

    omega(t) = 2 pi |v(t)| / cut_on_wavelength .

Integrating first and filtering afterwards loses: a bias of the sensor lets w_w grow without bound,
and every unevenness of the measured speed turns the fictitious slope of w_w into irregularity.
Instead the filter's four states are the only integrators there are (y = H(s) (a / s^2 + u)):

    z' = S - b3 omega y          y = z + u
    S' = a - Q - b2 omega^2 y
    Q' = R + b1 omega^3 y
    R' = omega^4 y

For constant speed this is exactly s^4 / (s^4 + b3 omega s^3 + b2 omega^2 s^2 + b1 omega^3 s +
omega^4), the Butterworth high-pass in wavelength. A constant bias ends up in Q, at any speed
profile, and leaves y at zero. Under acceleration dv/dt the filter departs from a
strictly spatial one by the order of (dv/dt) cut_on / (2 pi v^2) at the cut-on wavelength and by
ever less below it: at 10 m/s and 1 m/s2 by 1 % at 3 m and 0.02 % at 1 m.

Discretisation: a trapezoidal rule throughout but for z, whose double integration of the net
acceleration g = a - Q - b2 omega^2 y has the weights of Stoermer and Numerov,
z1 = z0 + h S0 + h^2 (5 g0 + g1) / 12. They make the double integral exact to (omega h)^4 / 240:
0.01 dB at eight samples a wave, where the rule for piecewise linear acceleration is at 0.4 dB.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.compiled import njit

Array = NDArray[np.float64]

# Butterworth polynomial of order 4: s^4 + B3 s^3 + B2 s^2 + B1 s + 1.
B3 = math.sqrt(4.0 + 2.0 * math.sqrt(2.0))
B2 = 2.0 + math.sqrt(2.0)
B1 = B3

# A stream is valid after so many seconds and so many cut-on wavelengths.
SETTLING_TIME = 0.1
SETTLING_WAVELENGTHS = 2.0

# Above this phase of the cut-on frequency per sample the samples are too sparse to filter.
COARSEST = 1.0


@dataclass
class ChannelState:
    """What the channels of a rail carry from sample to sample.

    filter (wheels, 5): z, S, Q, R, y of the module's docstring. acceleration (wheels,): of the
    last sample. run (wheels, 2): samples since the start of the channel and of its filter, -1
    while stopped. distance (wheels, 2): metres run since then. speed (1,): of the last sample.
    """

    filter: Array
    acceleration: Array
    run: NDArray[np.int64]
    distance: Array
    speed: Array

    @classmethod
    def stopped(cls, wheels: int) -> ChannelState:
        """Return the state of channels that have not begun."""
        return cls(
            filter=np.zeros((wheels, 5)),
            acceleration=np.zeros(wheels),
            run=np.full((wheels, 2), -1, dtype=np.int64),
            distance=np.zeros((wheels, 2)),
            speed=np.zeros(1),
        )


def filter_block(
    state: ChannelState,
    acceleration: Array,
    direct: Array,
    alive: NDArray[np.bool_],
    speed: Array,
    step: float,
    cut_on_wavelength: float,
    minimum_speed: float,
) -> tuple[NDArray[np.bool_], Array]:
    """Filter the next n samples of a rail's channels.

    The result does not depend on how a run is cut into blocks.

    Parameters
    ----------
    state
        Carried from call to call.
    acceleration
        (n, wheels) of the wheels [m/s2], finite.
    direct
        (n, wheels) u [m], what is added to the double integral, finite.
    alive
        (n, wheels) whether the sample was measured; a channel starts anew after one that was not.
    speed
        (n,) of the vehicle [m/s], either sign.
    step
        Sample period [s].
    cut_on_wavelength
        -3 dB [m].
    minimum_speed
        [m/s]; the filter stands still below it and starts anew above.

    Returns
    -------
    tuple
        valid (n, wheels): alive for 0.1 s and two cut-on wavelengths; irregularity (n, wheels)
        [m], NaN where not valid or where the filter has not yet run as long since its start.
    """
    valid = np.zeros(acceleration.shape, dtype=np.bool_)
    irregularity = np.empty_like(acceleration)
    _filter_block(
        state.filter,
        state.acceleration,
        state.run,
        state.distance,
        state.speed,
        acceleration,
        direct,
        alive,
        speed,
        step,
        2.0 * math.pi / cut_on_wavelength,
        minimum_speed,
        math.ceil(SETTLING_TIME / step - 1e-6),
        SETTLING_WAVELENGTHS * cut_on_wavelength,
        valid,
        irregularity,
    )
    return valid, irregularity


@njit(cache=True, nogil=True)
def _filter_block(
    filters,
    last_acceleration,
    run,
    distance,
    last_speed,
    acceleration,
    direct,
    alive,
    speed,
    h,
    wave_number,
    minimum_speed,
    settling_samples,
    settling_distance,
    valid,
    irregularity,
):
    samples, wheels = acceleration.shape
    for w in range(wheels):
        z, s, q, r, y = filters[w]
        a0 = last_acceleration[w]
        v0 = abs(last_speed[0])
        for n in range(samples):
            v1 = abs(speed[n])
            a1 = acceleration[n, w]
            irregularity[n, w] = np.nan
            if not alive[n, w]:
                run[w, :] = -1
            else:
                travelled = 0.5 * h * (v0 + v1)
                if run[w, 0] < 0:
                    run[w, 0], distance[w, 0] = 0, 0.0
                else:
                    run[w, 0] += 1
                    distance[w, 0] += travelled
                valid[n, w] = (
                    run[w, 0] >= settling_samples and distance[w, 0] >= settling_distance
                )
                omega1 = wave_number * v1
                if v1 < minimum_speed or omega1 * h > COARSEST:
                    run[w, 1] = -1
                elif run[w, 1] < 0:
                    # The constant part of u is not irregularity: the filter starts from y = 0.
                    run[w, 1], distance[w, 1] = 0, 0.0
                    z, s, q, r, y = -direct[n, w], 0.0, 0.0, 0.0, 0.0
                else:
                    run[w, 1] += 1
                    distance[w, 1] += travelled
                    z, s, q, r, y = _step(
                        z, s, q, r, y, a0, a1, direct[n, w], wave_number * v0, omega1, h
                    )
                    if run[w, 1] >= settling_samples and distance[w, 1] >= settling_distance:
                        irregularity[n, w] = y
            a0, v0 = a1, v1
        filters[w, 0], filters[w, 1], filters[w, 2] = z, s, q
        filters[w, 3], filters[w, 4] = r, y
        last_acceleration[w] = a0
    last_speed[0] = speed[samples - 1]


@njit(cache=True, nogil=True, inline='always')
def _step(z0, s0, q0, r0, y0, a0, a1, u1, omega0, omega1, h):
    """One step: all new states are affine in the new y, which y = z + u then gives."""
    half = 0.5 * h
    square0, square1 = omega0 * omega0, omega1 * omega1

    r1 = r0 + half * square0 * square0 * y0
    r1y = half * square1 * square1
    q1 = q0 + half * (r0 + r1 + B1 * square0 * omega0 * y0)
    q1y = half * (r1y + B1 * square1 * omega1)
    g0 = a0 - q0 - B2 * square0 * y0
    g1 = a1 - q1
    g1y = -q1y - B2 * square1
    s1 = s0 + half * (g0 + g1)
    z1 = z0 + h * s0 + h * h / 12.0 * (5.0 * g0 + g1) - half * B3 * omega0 * y0
    z1y = h * h / 12.0 * g1y - half * B3 * omega1

    y1 = (z1 + u1) / (1.0 - z1y)
    return z1 + z1y * y1, s1 + half * g1y * y1, q1 + q1y * y1, r1 + r1y * y1, y1
