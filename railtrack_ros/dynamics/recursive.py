"""The rail under moving wheels, step by step, at a cost that does not depend on the memory.

The convolution of the wheel forces with the moving impulse response (thesis 4.4-4.6) is a sum
over the modes of the ring (`dynamics.modes`), and each term is a first-order recursion:

    s_i(t + dt) = e^{lambda_i dt} s_i(t) + integral of e^{lambda_i (t + dt - tau)} u_i(tau),
    u_i = sum over wheels of b_i(x_w) f_w,   w(x) = Re sum_i c_i(x) s_i + instantaneous part.

With f the upward forces on the rail (a compressive contact force f_c is f = -f_c).  Two ways to
take the integral over a step: 'linear', exact for a drive that is linear within the step, and
'trapezoidal', z = (1 + lambda dt / 2) / (1 - lambda dt / 2), which repeats the Newmark scheme
(1/4, 1/2) mode by mode.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railtrack_ros.compiled import njit
from railtrack_ros.dynamics.contact import contact_step, standing_wheels, wheel_constants
from railtrack_ros.dynamics.forward import ForwardResult, StepFailure, check_run, check_setup
from railtrack_ros.dynamics.interpolation import ShapeTable, cubic, locate
from railtrack_ros.dynamics.modes import ComplexArray, TrackModes, make_track_modes, ring_length
from railtrack_ros.errors import InputError
from railtrack_ros.track.bay import Bay
from railtrack_ros.vehicle.description import Vehicle

Array = NDArray[np.float64]

HOLDS = ('linear', 'trapezoidal')


class Recursion(NamedTuple):
    """Coefficients of s <- e s + p0 u_old + p1 u_new, real and imaginary parts apart, (p,)."""

    e_re: Array
    e_im: Array
    p0_re: Array
    p0_im: Array
    p1_re: Array
    p1_im: Array


class ModalTable(NamedTuple):
    """Mode shapes of the ring, real and imaginary parts apart; see `modes.TrackModes`.

    c, b (nb + 2, p) at the degrees of freedom, phase (bays, p) = e^{iqm}, remainder
    (bays, nb + 2, nb + 2).
    """

    c_re: Array
    c_im: Array
    b_re: Array
    b_im: Array
    phase_re: Array
    phase_im: Array
    remainder: Array


class ModalState(NamedTuple):
    """Everything that a run carries from step to step, for `wheels` wheels on a rail.

    s, u (p,): modal states and last drive.  c, b (wheels, k, p): shapes of the element under each
    wheel, valid for (bay, element) in `place` (wheels, 2).  weights (wheels, k): N(x) there.
    """

    s_re: Array
    s_im: Array
    u_re: Array
    u_im: Array
    c_re: Array
    c_im: Array
    b_re: Array
    b_im: Array
    place: NDArray[np.int64]
    weights: Array


def recursion(poles: ComplexArray, time_step: float, hold: str) -> Recursion:
    """Coefficients for poles (p,) [1/s] and a time step [s]."""
    z: ComplexArray = poles * time_step
    e: ComplexArray
    p0: ComplexArray
    p1: ComplexArray
    if hold == 'trapezoidal':
        e = (1.0 + 0.5 * z) / (1.0 - 0.5 * z)
        p0 = p1 = 0.5 * time_step / (1.0 - 0.5 * z)
    elif hold == 'linear':
        e = np.exp(z)
        phi1 = np.expm1(z) / z
        # (phi1 - 1) / z loses digits for slow poles at short steps: series there.
        phi2: ComplexArray = np.where(
            np.abs(z) < 1e-2, 0.5 + z / 6 + z**2 / 24 + z**3 / 120 + z**4 / 720,
            (phi1 - 1.0) / z)
        p0, p1 = time_step * (phi1 - phi2), time_step * phi2
    else:
        raise InputError(f'hold {hold!r}: expected one of ' + ', '.join(HOLDS))
    return Recursion(*_parts(e), *_parts(p0), *_parts(p1))


def modal_table(modes: TrackModes) -> ModalTable:
    """Arrays of the modes as the compiled loops take them."""
    phase = np.exp(1j * np.outer(np.arange(modes.bays), modes.wave_number))
    return ModalTable(*_parts(modes.response), *_parts(modes.excitation), *_parts(phase),
                      modes.remainder)


def _parts(x: ComplexArray) -> tuple[Array, Array]:
    return np.ascontiguousarray(x.real), np.ascontiguousarray(x.imag)


def modal_state(modes: TrackModes, wheels: int) -> ModalState:
    """The rail at rest and unloaded."""
    p, k = modes.poles.size, modes.table.dofs.shape[1]
    zero, shapes = (np.zeros((4, *shape)) for shape in ((p,), (wheels, k, p)))
    return ModalState(zero[0], zero[1], zero[2], zero[3],
                      shapes[0], shapes[1], shapes[2], shapes[3],
                      place=np.full((wheels, 2), np.iinfo(np.int64).min),
                      weights=np.zeros((wheels, k)))


@njit(cache=True, nogil=True, fastmath=True, inline='always')
def combine(weights, source, out):
    """out[p] = sum_k weights[k] source[k, p]."""
    k = weights.size
    w0, w1, w2, w3 = weights[0], weights[1], weights[2], weights[3]
    for p in range(out.size):
        out[p] = w0 * source[0, p] + w1 * source[1, p] + w2 * source[2, p] + w3 * source[3, p]
    for j in range(4, k):
        w = weights[j]
        for p in range(out.size):
            out[p] += w * source[j, p]


@njit(cache=True, nogil=True, fastmath=True)
def enter(table, modal, state, wheel, bay, element):
    """Take over the mode shapes of the element which the wheel has come to, phase included."""
    m = bay % modal.phase_re.shape[0]
    for k in range(table.dofs.shape[1]):
        dof = table.dofs[element, k]
        for p in range(state.s_re.size):
            r, i = modal.phase_re[m, p], modal.phase_im[m, p]
            state.c_re[wheel, k, p] = modal.c_re[dof, p] * r - modal.c_im[dof, p] * i
            state.c_im[wheel, k, p] = modal.c_re[dof, p] * i + modal.c_im[dof, p] * r
            state.b_re[wheel, k, p] = modal.b_re[dof, p] * r + modal.b_im[dof, p] * i
            state.b_im[wheel, k, p] = modal.b_im[dof, p] * r - modal.b_re[dof, p] * i
    state.place[wheel, 0] = bay
    state.place[wheel, 1] = element


@njit(cache=True, nogil=True, fastmath=True, inline='always')
def place_wheel(table, modal, state, wheel, x):
    """Put a wheel at track position x [m]: N(x) into the state, returns the flexibility F(x)."""
    bay, interval, s = locate(table, x)
    element = table.element[interval]
    if state.place[wheel, 0] != bay or state.place[wheel, 1] != element:
        enter(table, modal, state, wheel, bay, element)
    for k in range(state.weights.shape[1]):
        state.weights[wheel, k] = cubic(table.coefficients[interval, k], s)
    return cubic(table.flexibility[interval], s)


@njit(cache=True, nogil=True, fastmath=True, inline='always')
def remainder_between(table, modal, state, response, force):
    """Static flexibility [m/N] of the cut-off poles between two placed wheels."""
    d = (state.place[response, 0] - state.place[force, 0]) % modal.remainder.shape[0]
    there, here = state.place[response, 1], state.place[force, 1]
    total = 0.0
    for i in range(state.weights.shape[1]):
        row = modal.remainder[d, table.dofs[there, i]]
        part = 0.0
        for j in range(state.weights.shape[1]):
            part += row[table.dofs[here, j]] * state.weights[force, j]
        total += state.weights[response, i] * part
    return total


@njit(cache=True, nogil=True, fastmath=True, inline='always')
def decay(step, state):
    """First half of a step, s <- e s + p0 u_old: what the past leaves behind."""
    for p in range(state.s_re.size):
        r, i = state.s_re[p], state.s_im[p]
        ur, ui = state.u_re[p], state.u_im[p]
        state.s_re[p] = (step.e_re[p] * r - step.e_im[p] * i
                         + step.p0_re[p] * ur - step.p0_im[p] * ui)
        state.s_im[p] = (step.e_re[p] * i + step.e_im[p] * r
                         + step.p0_re[p] * ui + step.p0_im[p] * ur)


@njit(cache=True, nogil=True, fastmath=True, inline='always')
def take(step, state, u_re, u_im):
    """Second half, s <- s + p1 u_new: what the present force adds."""
    for p in range(state.s_re.size):
        state.s_re[p] += step.p1_re[p] * u_re[p] - step.p1_im[p] * u_im[p]
        state.s_im[p] += step.p1_re[p] * u_im[p] + step.p1_im[p] * u_re[p]
        state.u_re[p] = u_re[p]
        state.u_im[p] = u_im[p]


@njit(cache=True, nogil=True, fastmath=True)
def advance(table, modal, step, state, position, force, deflection):
    """Deflection (n, wheels) under known upward forces (n, wheels) at positions (n, wheels)."""
    steps, wheels = position.shape
    size = state.s_re.size
    c_re, c_im = np.empty((wheels, size)), np.empty((wheels, size))
    a_re, a_im = np.empty(size), np.empty(size)
    new_re, new_im = np.empty(size), np.empty(size)
    local = np.empty(wheels)
    for n in range(steps):
        new_re[:] = 0.0
        new_im[:] = 0.0
        for w in range(wheels):
            local[w] = place_wheel(table, modal, state, w, position[n, w])
            combine(state.weights[w], state.c_re[w], c_re[w])
            combine(state.weights[w], state.c_im[w], c_im[w])
            combine(state.weights[w], state.b_re[w], a_re)
            combine(state.weights[w], state.b_im[w], a_im)
            f = force[n, w]
            for p in range(size):
                new_re[p] += f * a_re[p]
                new_im[p] += f * a_im[p]
        decay(step, state)
        take(step, state, new_re, new_im)
        for w in range(wheels):
            total = local[w] * force[n, w]
            for v in range(wheels):
                total += remainder_between(table, modal, state, w, v) * force[n, v]
            for p in range(size):
                total += c_re[w, p] * state.s_re[p] - c_im[w, p] * state.s_im[p]
            deflection[n, w] = total


@njit(cache=True, nogil=True, fastmath=True)
def march(table, modal, step, state, offsets, constants, position, irregularity, wheels,
          force_out, deflection_out, wheel_out, acceleration_out):
    """Wheels and rail together, irregularity given: returns (steps done, Newton iterations).

    The first half of a step gives the deflection without the present force, the second half the
    compliance; between them `contact_step` finds the forces.
    """
    steps, n = irregularity.shape
    size = state.s_re.size
    c_re, c_im = np.empty((n, size)), np.empty((n, size))
    b_re, b_im = np.empty((n, size)), np.empty((n, size))
    gain_re, gain_im = np.empty(size), np.empty(size)
    free, force = np.empty(n), np.empty(n)
    compliance, work = np.empty((n, n)), np.zeros((n, n + 3))
    iterations = 0
    for k in range(steps):
        decay(step, state)
        for w in range(n):
            local = place_wheel(table, modal, state, w, position[k] + offsets[w])
            combine(state.weights[w], state.c_re[w], c_re[w])
            combine(state.weights[w], state.c_im[w], c_im[w])
            combine(state.weights[w], state.b_re[w], b_re[w])
            combine(state.weights[w], state.b_im[w], b_im[w])
            compliance[w, w] = local
            total = 0.0
            for p in range(size):
                total += c_re[w, p] * state.s_re[p] - c_im[w, p] * state.s_im[p]
            free[w] = total
        for v in range(n):
            for p in range(size):
                gain_re[p] = step.p1_re[p] * b_re[v, p] - step.p1_im[p] * b_im[v, p]
                gain_im[p] = step.p1_re[p] * b_im[v, p] + step.p1_im[p] * b_re[v, p]
            for w in range(n):
                total = remainder_between(table, modal, state, w, v)
                for p in range(size):
                    total += c_re[w, p] * gain_re[p] - c_im[w, p] * gain_im[p]
                compliance[w, v] = total + (compliance[w, v] if w == v else 0.0)
        count = contact_step(free, compliance, irregularity[k], wheels, constants, force, work)
        if count < 0:
            return k, iterations
        iterations += count
        gain_re[:] = 0.0
        gain_im[:] = 0.0
        for v in range(n):
            for p in range(size):
                gain_re[p] -= force[v] * b_re[v, p]
                gain_im[p] -= force[v] * b_im[v, p]
        take(step, state, gain_re, gain_im)
        for w in range(n):
            deflection = free[w]
            for v in range(n):
                deflection -= compliance[w, v] * force[v]
            force_out[k, w] = force[w]
            deflection_out[k, w] = deflection
            wheel_out[k, w] = wheels[0, w]
            acceleration_out[k, w] = wheels[2, w]
    return steps, iterations


class RecursiveResponse:
    """Rail deflection under the known forces of the wheels of one rail, block after block.

    The inverse mode's core: no iteration, any speed profile, standstill and reversal.  Results do
    not depend on how the run is cut into blocks.
    """

    def __init__(self, modes: TrackModes, time_step: float, wheels: int,
                 hold: str = 'linear') -> None:
        """Raise InputError for a time step that is not positive or an unknown hold."""
        if not time_step > 0.0:
            raise InputError(f'time step {time_step} s: must be positive')
        self.modes = modes
        self.time_step = time_step
        self.wheels = wheels
        self._table: ShapeTable = modes.table
        self._modal = modal_table(modes)
        self._step = recursion(modes.poles, time_step, hold)
        self._state = modal_state(modes, wheels)

    @property
    def compiled(self) -> tuple[ShapeTable, ModalTable, Recursion, ModalState]:
        """What the compiled loops take: tables, coefficients and the state, which they change."""
        return self._table, self._modal, self._step, self._state

    def settle(self, position: ArrayLike, force: ArrayLike) -> None:
        """Start from the static deflection under constant forces (wheels,) at (wheels,) [m]."""
        _, b = self.modes.weights(np.asarray(position, dtype=float))
        drive = np.asarray(force, dtype=float) @ b
        still = -drive / self.modes.poles
        self._state.u_re[:], self._state.u_im[:] = drive.real, drive.imag
        self._state.s_re[:], self._state.s_im[:] = still.real, still.imag

    def deflection(self, position: ArrayLike, force: ArrayLike) -> Array:
        """Deflection [m, up] at the wheels for the next n steps.

        position (n, wheels): track position of each wheel [m]; force (n, wheels): upward force on
        the rail [N], minus the contact force.  Both must be finite.
        """
        position = np.ascontiguousarray(position, dtype=float)
        force = np.ascontiguousarray(force, dtype=float)
        result = np.empty_like(position)
        advance(*self.compiled, position, force, result)
        return result

    def state(self) -> dict[str, Array]:
        """A copy of what the run has to remember: modal states and last drive, (p,) each."""
        return {name: getattr(self._state, name).copy()
                for name in ('s_re', 's_im', 'u_re', 'u_im')}

    def restore(self, state: dict[str, Array]) -> None:
        """Continue from a state saved by `state()`, of the same modes and time step."""
        for name, value in state.items():
            getattr(self._state, name)[:] = value


class RecursiveForward:
    """Wheels of one rail over a given irregularity: contact forces by recursion.

    Same use and results as `newmark.FullModel`; with the trapezoidal hold the same time
    integration too.  Parameters: bay or its modes; vehicle (wheel and contact are used); offsets
    of the wheels from the reference point [m]; time_step [s]; start_position [m], where the wheels
    stand in static equilibrium at the first sample.  Raises InputError.
    """

    def __init__(self, bay: Bay | TrackModes, vehicle: Vehicle, offsets: Sequence[float],
                 time_step: float, start_position: float, hold: str = 'trapezoidal',
                 maximum_frequency: float = 16000.0) -> None:
        self.offsets = check_setup(offsets, time_step)
        if isinstance(bay, Bay):
            bays = ring_length(bay, self.offsets)
            bay = make_track_modes(bay, bays, maximum_frequency)
        self.modes = bay
        self.start_position = float(start_position)
        self.constants = wheel_constants(vehicle, time_step)
        self.iterations = self.steps = 0
        self._response = RecursiveResponse(self.modes, time_step, self.offsets.size, hold)
        self._wheels: Array | None = None
        self._last: float | None = None

    def run(self, position: ArrayLike, irregularity: ArrayLike) -> ForwardResult:
        """Step to each position (n,) [m] with irregularity (n, wheels) [m] under the wheels.

        Successive calls continue.  Raises InputError, or StepFailure with the result so far.
        """
        position, irregularity = check_run(
            position, irregularity, self.offsets.size, self._last, self.start_position,
            0.25 * self.modes.bay.spacing)
        result = ForwardResult.empty(position.size, self.offsets.size)
        if position.size == 0:
            return result
        begin = 0
        response = self._response
        if self._wheels is None:
            places = position[0] + self.offsets
            load = np.full(self.offsets.size, -self.constants.static_load)
            response.settle(places, load)
            # Constant forces keep a settled rail where it is.
            deflection = response.deflection(places[None], load[None])[0]
            self._wheels = standing_wheels(self.constants, deflection, irregularity[0])
            result.contact_force[0] = self.constants.static_load
            result.rail_deflection[0] = deflection
            result.wheel_displacement[0] = self._wheels[0]
            begin = 1
        done, iterations = march(
            *response.compiled, self.offsets, self.constants, position[begin:],
            irregularity[begin:], self._wheels, *result.part(begin, position.size).arrays())
        self.steps += done
        self.iterations += iterations
        if begin + done < position.size:
            raise StepFailure(
                f'recursive solver: the contact forces did not converge in time step '
                f'{self.steps + 1} at position {position[begin + done]:.6g} m',
                result.part(0, begin + done))
        self._last = float(position[-1])
        return result
