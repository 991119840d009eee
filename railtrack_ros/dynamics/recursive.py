"""The rail under moving wheels, step by step, at a cost that does not depend on the memory.

The convolution of the wheel forces with the moving impulse response (thesis 4.4-4.6), evaluated
by recursion over the modes of the ring: with known forces for the estimator, and with wheels on
Hertzian contacts as a forward solver.  The loops and their equations are in `recursion`.

In the forward solver the compliance that the forces of a step see depends on the place alone.  It
is a polynomial of degree six in every stretch of the bay where no wheel crosses a break of the
mesh, and tabulated as such.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railtrack_ros.compiled import njit
from railtrack_ros.dynamics.contact import (
    contact_step,
    contact_work,
    standing_wheels,
    wheel_constants,
)
from railtrack_ros.dynamics.forward import ForwardResult, StepFailure, check_run, check_setup
from railtrack_ros.dynamics.interpolation import ShapeTable, locate
from railtrack_ros.dynamics.modes import TrackModes, make_track_modes, ring_length
from railtrack_ros.dynamics.recursion import (
    SAVED,
    Model,
    State,
    advance,
    begin_step,
    make_model,
    make_state,
    polynomial,
    settle,
    step_of,
)
from railtrack_ros.errors import InputError
from railtrack_ros.track.bay import Bay
from railtrack_ros.vehicle.description import Vehicle

Array = NDArray[np.float64]

MAXIMUM_FREQUENCY = 8000.0
"""Poles up to here [Hz] are kept one by one unless told otherwise."""

FORWARD_HOLDS = ('trapezoidal', 'linear')


class Compliances(NamedTuple):
    """Compliance between the wheels of a rail, over one bay of the reference point.

    start, spacing, breaks, guess, element: as in `interpolation.ShapeTable`; first, second
    (pairs,): wheels.  coefficients (pairs * intervals, 7)
    [m/N]: sum of coefficients s^n.
    """

    start: float
    spacing: float
    breaks: Array
    guess: NDArray[np.int64]
    first: NDArray[np.int64]
    second: NDArray[np.int64]
    intervals: int
    coefficients: Array


def compliances(modes: TrackModes, time_step: float, hold: str, offsets: Array) -> Compliances:
    """Deflection [m/N] at each wheel by a force at each wheel in the same step."""
    bay, table, n = modes.bay, modes.table, offsets.size
    inner = np.mod(table.breaks[None, :-1] - offsets[:, None], bay.spacing).ravel()
    breaks = np.unique(np.round(np.concatenate([[0.0], inner, [bay.spacing]]), 10))
    # Polynomials through seven points within each interval.
    s = 0.5 - 0.5 * np.cos(np.pi * (np.arange(7) + 0.5) / 7)
    fit = np.linalg.inv(s[:, None] ** np.arange(7))
    first, second = np.triu_indices(n)
    step = step_of(modes.poles, time_step, hold)
    share = np.tile(step.p1, 2)
    # Places where a wheel stands above a break leave it in one element.
    model = make_model(modes, time_step, hold)
    values = np.empty((first.size, len(breaks) - 1, 7))
    for i, (low, high) in enumerate(zip(breaks[:-1], breaks[1:], strict=True)):
        x = bay.start + low + s * (high - low)
        c = [modes.weights(x + offset) for offset in offsets]
        for k, (w, v) in enumerate(zip(first, second, strict=True)):
            values[k, i] = ((c[w] * share) * c[v]).sum(axis=1).real
            if w == v:
                interval, local = table_place(modes, x + offsets[w])
                values[k, i] += [polynomial(model.present, j, t)
                                 for j, t in zip(interval, local, strict=True)]
            else:
                values[k, i] += [modes.static_remainder(a + offsets[w], a + offsets[v])
                                 for a in x]
    cells = np.linspace(0.0, bay.spacing, 8 * len(breaks), endpoint=False)
    guess = np.clip(np.searchsorted(breaks, cells, side='right') - 1, 0, len(breaks) - 2)
    return Compliances(bay.start, bay.spacing, breaks, guess.astype(np.int64),
                       first.astype(np.int64), second.astype(np.int64), len(breaks) - 1,
                       (values @ fit.T).reshape(-1, 7))


def table_place(modes: TrackModes, x: Array) -> tuple[NDArray[np.int64], Array]:
    """Interval and local coordinate, (n,) each, of track positions x (n,) [m]."""
    _, inside = modes.bay.locate(x)
    return modes.bay.table.locate(inside)


@njit(cache=True, nogil=True, fastmath=True, _nrt=False)
def compliance_at(table, x, out):
    """Compliance matrix (n, n) [m/N] with the reference point at x [m]."""
    _, interval, s = locate(table, x)
    for k in range(table.first.size):
        value = polynomial(table.coefficients, k * table.intervals + interval, s)
        out[table.first[k], table.second[k]] = value
        out[table.second[k], table.first[k]] = value


@njit(cache=True, nogil=True, fastmath=True, _nrt=False)
def march(model, table, state, pairs, compliance, work, offsets, constants, position,
          irregularity, wheels, force_out, deflection_out, wheel_out, acceleration_out):
    """Wheels and rail together, irregularity given: returns (steps done, Newton iterations)."""
    steps, n = irregularity.shape
    free, force, last = state.free[0], state.present, state.last
    iterations = 0
    for k in range(steps):
        for w in range(n):
            last[0, w] = state.force[0, w, 0]
            state.place[w] = position[k] + offsets[w]
        begin_step(model, table, state, last, state.place, state.free, force)
        compliance_at(pairs, position[k], compliance)
        count = contact_step(free, compliance, irregularity[k], wheels, constants, force, work)
        if count < 0:
            return k, iterations
        iterations += count
        for w in range(n):
            deflection = free[w]
            for v in range(n):
                deflection -= compliance[w, v] * force[v]
            state.force[0, w, 1] = state.force[0, w, 0]
            state.force[0, w, 0] = -force[w]
            force_out[k, w] = force[w]
            deflection_out[k, w] = deflection
            wheel_out[k, w] = wheels[0, w]
            acceleration_out[k, w] = wheels[2, w]
    return steps, iterations


class RecursiveResponse:
    """Rail deflection under the known forces of wheels, block after block.

    The inverse mode's core: no iteration, any speed profile, standstill and reversal.  Results do
    not depend on how the run is cut into blocks.  lines: rails that do not feel each other, whose
    wheels stand side by side; they share the shapes, which are most of the work.
    """

    def __init__(self, modes: TrackModes, time_step: float, wheels: int,
                 hold: str = 'linear', lines: int = 1) -> None:
        """Raise InputError for a time step that is not positive or an unknown hold."""
        if not time_step > 0.0:
            raise InputError(f'time step {time_step} s: must be positive')
        self.modes = modes
        self.time_step = time_step
        self.wheels = wheels
        self.lines = lines
        self._model = make_model(modes, time_step, hold)
        self._state = make_state(self._model, modes.table, wheels, lines)

    @property
    def compiled(self) -> tuple[Model, ShapeTable, State]:
        """What the compiled loops take: model, table, and the state, which they change."""
        return self._model, self.modes.table, self._state

    def settle(self, position: ArrayLike, force: ArrayLike) -> None:
        """Start from the static deflection under constant forces at (wheels,) [m].

        force: (wheels,) or (lines, wheels) [N, upward].
        """
        settle(*self.compiled, np.asarray(position, dtype=float),
               np.atleast_2d(np.asarray(force, dtype=float)))

    def deflection(self, position: ArrayLike, force: ArrayLike) -> Array:
        """Deflection [m, up] at the wheels for the next n steps, of the shape of force.

        position (n, wheels): track position of each wheel [m]; force (n, wheels) or (n, lines,
        wheels): upward force on the rail [N], minus the contact force.  Both must be finite.
        """
        position = np.ascontiguousarray(position, dtype=float)
        force = np.ascontiguousarray(force, dtype=float)
        result = np.empty_like(force)
        shape = (len(force), self.lines, self.wheels)
        advance(*self.compiled, position, force.reshape(shape), result.reshape(shape))
        return result

    def state(self) -> dict[str, Array]:
        """A copy of all that the run has to remember: some kilobytes."""
        return {name: getattr(self._state, name).copy() for name in SAVED}

    def restore(self, state: dict[str, Array]) -> None:
        """Continue from a state saved by `state()`, of the same modes and time step."""
        # An idle step there finds all else, with the rounding of the loop that goes on from it.
        self.deflection(state['place'][None], np.zeros((1, self.lines, self.wheels)))
        for name in SAVED:
            getattr(self._state, name)[:] = state[name]


class RecursiveForward:
    """Wheels of one rail over a given irregularity: contact forces by recursion.

    Same use and results as `newmark.FullModel`; with the trapezoidal hold the same time
    integration too.  Parameters: bay or its modes; vehicle (wheel and contact are used); offsets
    of the wheels from the reference point [m]; time_step [s]; start_position [m], where the wheels
    stand in static equilibrium at the first sample.  Raises InputError.
    """

    def __init__(self, bay: Bay | TrackModes, vehicle: Vehicle, offsets: Sequence[float],
                 time_step: float, start_position: float, hold: str = 'trapezoidal',
                 maximum_frequency: float = MAXIMUM_FREQUENCY) -> None:
        self.offsets = check_setup(offsets, time_step)
        if isinstance(bay, Bay):
            bays = ring_length(bay, self.offsets)
            bay = make_track_modes(bay, bays, maximum_frequency)
        if hold not in FORWARD_HOLDS:
            raise InputError(f'hold {hold!r}: expected one of ' + ', '.join(FORWARD_HOLDS))
        self.modes = bay
        self.start_position = float(start_position)
        self.constants = wheel_constants(vehicle, time_step)
        self.iterations = self.steps = 0
        self._response = RecursiveResponse(self.modes, time_step, self.offsets.size, hold)
        self._compliances = compliances(self.modes, time_step, hold, self.offsets)
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
        wheels = self.offsets.size
        done, iterations = march(
            *response.compiled, self._compliances, np.empty((wheels, wheels)),
            contact_work(wheels), self.offsets, self.constants, position[begin:],
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
