"""The rail under moving wheels, step by step, at a cost that does not depend on the memory.

The convolution of the wheel forces with the moving impulse response (thesis 4.4-4.6), evaluated
by recursion over the modes of the ring: with known forces for the estimator, and with wheels on
Hertzian contacts as a forward solver.  The loops and their equations are in `recursion`.

In the forward solver the compliance that the forces of a step see depends on the place alone.  It
is a polynomial of degree six in every stretch of the bay where no wheel crosses a break of the
mesh, and tabulated as such.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railtrack_ros.compiled import njit
from railtrack_ros.dynamics import cache, recursion
from railtrack_ros.dynamics.contact import contact_step, contact_work, wheel_constants
from railtrack_ros.dynamics.forward import ForwardResult, ForwardSolver, check_setup
from railtrack_ros.dynamics.interpolation import first_guess, locate
from railtrack_ros.dynamics.modes import TrackModes, make_track_modes, ring_length
from railtrack_ros.dynamics.recursion import (
    BATCH,
    SAVED,
    Model,
    State,
    begin,
    make_model,
    make_state,
    pieces,
    settle,
    step_of,
)
from railtrack_ros.errors import InputError
from railtrack_ros.track.bay import Bay
from railtrack_ros.vehicle.description import Vehicle

Array = NDArray[np.float64]

MAXIMUM_FREQUENCY = 6000.0
"""Poles up to here [Hz] are kept one by one unless told otherwise."""

PIECES = 72  # of a bay, at least, in which the compliance at a wheel is of degree six

FORWARD_HOLDS = ('trapezoidal', 'linear')


class Compliances(NamedTuple):
    """Compliance between the wheels of a rail, over one bay of the reference point.

    start, spacing, breaks, guess: as in `interpolation.ShapeTable`; first, second (pairs,): wheels.
    coefficients (pairs, intervals, 7) [m/N]: sum of coefficients s^n.
    """

    start: float
    spacing: float
    breaks: Array
    guess: NDArray[np.int64]
    first: NDArray[np.int64]
    second: NDArray[np.int64]
    coefficients: Array


def compliances(modes: TrackModes, time_step: float, hold: str, offsets: Array) -> Compliances:
    """Deflection [m/N] at each wheel by a force at each wheel in the same step."""
    if hold == 'corrected':
        hold = 'linear'  # with the same coefficients
    digest = cache.key([__file__, recursion.__file__], modes, time_step, hold, offsets)
    return Compliances(modes.table.start, modes.table.spacing, **cache.stored(
        'compliances', digest, lambda: _compliances(modes, time_step, hold, offsets)))


def _compliances(modes: TrackModes, time_step: float, hold: str, offsets: Array
                 ) -> dict[str, NDArray[Any]]:
    """Arrays of the compliances: a quarter of a second of work."""
    bay, n = modes.bay, offsets.size
    inner = np.mod(pieces(modes.table, PIECES)[None, :-1] - offsets[:, None], bay.spacing).ravel()
    breaks = np.unique(np.round(np.concatenate([[0.0], inner, [bay.spacing]]), 10))
    # Polynomials through seven points within each interval.
    s = 0.5 - 0.5 * np.cos(np.pi * (np.arange(7) + 0.5) / 7)
    fit = np.linalg.inv(s[:, None] ** np.arange(7))
    x = bay.start + (breaks[:-1, None] + s * np.diff(breaks)[:, None]).ravel()
    share = np.tile(step_of(modes.poles, time_step, hold).p1, 2)
    oscillators = step_of(modes.oscillators, time_step, hold).p1
    at_once = np.tensordot(oscillators, modes.amplitude, 1).real

    number, shape, flexibility = np.empty((n, x.size), int), [], []
    for w, offset in enumerate(offsets):
        number[w], inside = bay.locate(x + offset)
        shape.append(bay.shape(inside))
        flexibility.append(bay.flexibility(inside))
    weights = [modes.weights(x + offset) for offset in offsets]
    first, second = np.triu_indices(n)
    values = np.empty((first.size, x.size))
    for k, (w, v) in enumerate(zip(first, second, strict=True)):
        values[k] = ((weights[w] * share) * weights[v]).sum(axis=1).real
        if w == v:
            values[k] += flexibility[w] + np.einsum('xi,ij,xj->x', shape[w], at_once, shape[w])
        else:
            for apart in np.unique(number[w] - number[v]):
                at = number[w] - number[v] == apart
                values[k, at] += np.einsum('xi,ij,xj->x', shape[w][at],
                                           modes.remainder[apart % modes.bays], shape[v][at])
    return {'breaks': breaks, 'guess': first_guess(breaks, bay.spacing), 'first': first,
            'second': second, 'coefficients': values.reshape(first.size, -1, 7) @ fit.T}


@njit(cache=True, nogil=True, fastmath=True, _nrt=False)
def polynomial(c, k, row, s):
    """Sum of c[k, row, n] s^n over seven terms."""
    return (((((c[k, row, 6] * s + c[k, row, 5]) * s + c[k, row, 4]) * s + c[k, row, 3]) * s
             + c[k, row, 2]) * s + c[k, row, 1]) * s + c[k, row, 0]


@njit(cache=True, nogil=True, inline='always')
def compliance_at(table, x, out):
    """Compliance matrix (n, n) [m/N] with the reference point at x [m]."""
    _, interval, s = locate(table, x)
    for k in range(table.first.size):
        value = polynomial(table.coefficients, k, interval, s)
        out[table.first[k], table.second[k]] = value
        out[table.second[k], table.first[k]] = value


@njit(cache=True, nogil=True, fastmath=True, _nrt=False)
def advance(model, offsets, state, pairs, compliance, position, force, deflection):
    """Deflection (n, lines, wheels) under known upward forces (n, lines, wheels), n <= BATCH."""
    begin(model, offsets, state, position, force)
    count, lines, wheels = force.shape
    for k in range(count):
        compliance_at(pairs, position[k], compliance)
        for n in range(lines):
            for w in range(wheels):
                total = state.free[k, n, w]
                for v in range(wheels):
                    total += compliance[w, v] * force[k, n, v]
                deflection[k, n, w] = total


@njit(cache=True, nogil=True, fastmath=True, _nrt=False)
def march(model, offsets, state, pairs, compliance, idle, force, work, constants, position,
          irregularity, wheels, force_out, deflection_out, wheel_out, acceleration_out):
    """Wheels and rail together, irregularity given: returns (steps done, Newton iterations)."""
    steps, n = irregularity.shape
    free = state.free[0, 0]
    iterations = 0
    for k in range(steps):
        state.place[0] = position[k]
        begin(model, offsets, state, state.place, idle)
        compliance_at(pairs, position[k], compliance)
        count = contact_step(free, compliance, irregularity[k], wheels, constants, force, work)
        if count < 0:
            return k, iterations
        iterations += count
        for w in range(n):
            deflection = free[w]
            for v in range(n):
                deflection -= compliance[w, v] * force[v]
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

    def __init__(self, modes: TrackModes, time_step: float, offsets: Sequence[float] | Array,
                 hold: str = 'linear', lines: int = 1) -> None:
        """Raise InputError for a time step that is not positive or an unknown hold."""
        self.offsets = check_setup(offsets, time_step)
        self.modes = modes
        self.time_step = time_step
        self.lines = lines
        self._model = make_model(modes, time_step, hold)
        self._state = make_state(self._model, self.offsets.size, lines)
        self._pairs = compliances(modes, time_step, hold, self.offsets)
        self._compliance = np.empty((self.offsets.size, self.offsets.size))

    @property
    def compiled(self) -> tuple[Model, Array, State, Compliances, Array]:
        """What the compiled loops take first: tables, and the state, which they change."""
        return self._model, self.offsets, self._state, self._pairs, self._compliance

    def settle(self, position: float, force: ArrayLike) -> None:
        """Start from the static deflection with the reference point at a position [m].

        force: (wheels,) or (lines, wheels) [N, upward].
        """
        self._idle_at(position)
        settle(self._model, self._state, np.atleast_2d(np.asarray(force, dtype=float)))

    def _idle_at(self, position: float) -> None:
        """Find what follows from the wheels' places, by an idle step there.

        So it has the rounding of the loop that goes on from it.
        """
        idle = np.zeros((1, self.lines, self.offsets.size))
        advance(*self.compiled, np.full(1, float(position)), idle, np.empty_like(idle))

    def deflection(self, position: ArrayLike, force: ArrayLike) -> Array:
        """Deflection [m, up] at the wheels for the next n steps, of the shape of force.

        position (n,): track position of the reference point [m]; force (n, wheels) or (n, lines,
        wheels): upward force on the rail [N], minus the contact force.  Both must be finite.
        """
        position = np.ascontiguousarray(position, dtype=float)
        force = np.ascontiguousarray(force, dtype=float)
        result = np.empty_like(force)
        shape = (len(force), self.lines, self.offsets.size)
        forces, results = force.reshape(shape), result.reshape(shape)
        for first in range(0, len(force), BATCH):
            batch = slice(first, first + BATCH)
            advance(*self.compiled, position[batch], forces[batch], results[batch])
        return result

    def state(self) -> dict[str, Array]:
        """A copy of all that the run has to remember: some kilobytes."""
        return {name: getattr(self._state, name).copy() for name in SAVED}

    def restore(self, state: dict[str, Array]) -> None:
        """Continue from a state saved by `state()`, of the same modes and time step."""
        self._idle_at(state['place'][0])
        for name in SAVED:
            getattr(self._state, name)[:] = state[name]


class RecursiveForward(ForwardSolver):
    """Wheels of one rail over a given irregularity: contact forces by recursion.

    Same use and results as `newmark.FullModel`; with the trapezoidal hold the same time
    integration too.  Parameters: bay or its modes; vehicle (wheel and contact are used); offsets
    of the wheels from the reference point [m]; time_step [s]; start_position [m], where the wheels
    stand in static equilibrium at the first sample; hold; highest frequency [Hz] of the poles that
    are kept one by one, and bays in the ring, for a bay.  Raises InputError.
    """

    name = 'recursive solver'

    def __init__(self, bay: Bay | TrackModes, vehicle: Vehicle, offsets: Sequence[float] | Array,
                 time_step: float, start_position: float, hold: str = 'trapezoidal',
                 maximum_frequency: float = MAXIMUM_FREQUENCY, bays: int | None = None) -> None:
        offsets = check_setup(offsets, time_step)
        if isinstance(bay, Bay):
            least = math.ceil(np.ptp(offsets) / bay.spacing) + 3
            if bays is not None and bays < least:
                raise InputError(f'bays in the ring: expected at least {least} for these wheels, '
                                 f'got {bays}')
            bays = ring_length(bay, offsets) if bays is None else bays
            bay = make_track_modes(bay, bays, maximum_frequency)
        if hold not in FORWARD_HOLDS:
            raise InputError(f'hold {hold!r}: expected one of ' + ', '.join(FORWARD_HOLDS))
        super().__init__(wheel_constants(vehicle, time_step), offsets, start_position,
                         0.25 * bay.bay.spacing)
        self.modes = bay
        self._response = RecursiveResponse(self.modes, time_step, offsets, hold)

    def _stand(self, position: Array) -> Array:
        load = np.full(self.offsets.size, -self.constants.static_load)
        self._response.settle(position[0], load)
        # Constant forces keep a settled rail where it is.
        return self._response.deflection(position[:1], load[None])[0]

    def _march(self, position: Array, irregularity: Array, wheels: Array, out: ForwardResult
               ) -> tuple[int, str]:
        n = self.offsets.size
        done, iterations = march(
            *self._response.compiled, np.zeros((1, 1, n)), np.empty(n), contact_work(n),
            self.constants, position, irregularity, wheels, *out.arrays())
        self.iterations += iterations
        return done, '' if done == position.size else 'the contact forces did not converge'

    def state(self) -> dict[str, Array]:
        """A copy of all that the run has to remember: some kilobytes."""
        wheels, last = ((np.zeros(0), np.zeros(0)) if self._wheels is None else
                        (self._wheels.copy(), np.array([self._last])))
        return self._response.state() | {'wheels': wheels, 'last': last}

    def restore(self, state: dict[str, Array]) -> None:
        """Continue from a state saved by `state()`, of the same modes, wheels and time step."""
        self._response.restore(state)
        begun = state['last'].size > 0
        self._wheels = state['wheels'].copy() if begun else None
        self._last = float(state['last'][0]) if begun else None

    def restart(self, position: float) -> None:
        """Let the next run begin at a position [m], from static equilibrium as the first one."""
        self.start_position = float(position)
        self._wheels = self._last = None
