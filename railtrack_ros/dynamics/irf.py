"""The rail by convolution with element impulse responses, the thesis' own online method.

    w(x_j, t_n) = N(x_j) sum_k h(e_k, e_j, t_n - t_k) N(x_k)^T f_k  +  F(x_j) f_n       (4.4)

h is the answer of the discrete full model to a unit nodal force that lasts one time step, so the
sum repeats Newmark's result for any support and local system; what remains is the end of the
memory.  Between the force's element and the wheel's only the difference in bays matters: the
responses of one bay serve the whole track, at any speed profile.  With the hold `linear` h is
instead the exact answer of the modes of the ring to a force that rises and falls linearly within
two time steps (`recursion`).

At a constant speed the wheel meets its own impulse always at the same distance behind it, and
h, N and N^T shrink to the moving impulse response h_m(x, t) = N(x + v t) h(t) N(x)^T    (4.5-4.8).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railtrack_ros.compiled import njit
from railtrack_ros.dynamics import (
    cache,
    newmark,
    newmark_kernel,
    recursion,
    window,
)
from railtrack_ros.dynamics import (
    modes as ring_modes,
)
from railtrack_ros.dynamics.contact import contact_step, wheel_constants
from railtrack_ros.dynamics.forward import ForwardResult, ForwardSolver, check_setup
from railtrack_ros.dynamics.interpolation import cubic, locate, shape_table
from railtrack_ros.dynamics.modes import make_track_modes, ring_length
from railtrack_ros.dynamics.newmark import nodal_impulse_responses
from railtrack_ros.dynamics.recursion import step_of
from railtrack_ros.errors import InputError
from railtrack_ros.track.bay import Bay
from railtrack_ros.vehicle.description import Vehicle

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Of the deflection under a load this share may be left when the impulse responses end; they are
# between these lengths [s] unless a memory is given.
LEFT = 1e-3
MEMORY = 0.1, 0.3

# Poles [Hz] that tell what is left, and the time step [s] in which it is followed.
SLOW_POLES = 2000.0
DECAY_STEP = 5e-4

HOLDS = ('trapezoidal', 'linear')

# All poles up to here are in the responses of the hold `linear` [Hz]; the others act at once.
MAXIMUM_FREQUENCY = 12000.0


def deflection_left(bay: Bay, end: float) -> tuple[Array, Array]:
    """What is left of the deflection under a standing load after it has been taken off.

    Returns
    -------
    tuple
        Times (n,) [s] from 0 to at least `end`, and (n,) the largest share of the static
        deflection from that time on, at a sleeper or midspan, within half as long again.
    """
    modes = make_track_modes(bay, ring_length(bay, [0.0]), SLOW_POLES)
    weights = modes.weights([0.0, 0.5 * bay.spacing])
    poles = np.concatenate([modes.poles, modes.poles])
    gain = -weights**2 / poles
    static = gain.sum(axis=1).real
    t = DECAY_STEP * np.arange(math.ceil(1.5 * end / DECAY_STEP) + 1)
    share = np.empty(t.size)
    for first in range(0, t.size, 64):
        age = np.exp(np.outer(poles, t[first:first + 64]))
        share[first:first + 64] = np.abs((gain @ age).real / static[:, None]).max(axis=0)
    largest = np.maximum.accumulate(share[::-1])[::-1]
    inside = t <= end + DECAY_STEP
    return np.asarray(t[inside], dtype=np.float64), largest[inside]


def memory_of(bay: Bay) -> float:
    """Length of the impulse responses [s] after which 0.1 % of the deflection is left, bounded."""
    t, left = deflection_left(bay, MEMORY[1])
    enough = t[left < LEFT]
    return max(MEMORY[0], min(float(enough[0]), MEMORY[1])) if enough.size else MEMORY[1]


def element_impulse_responses(bay: Bay, time_step: float, steps: int, reach: int,
                              hold: str = 'trapezoidal') -> Array:
    """h (nb, nb, reach + 1, steps) [m/N]: degree of freedom of force, of response, bays ahead, age.

    Kept on disk in single precision.  hold: `trapezoidal` for the full model's own answer to a
    force of one time step, `linear` for the exact one to a force that is linear in between.
    """
    sources = [module.__file__ for module in (newmark, newmark_kernel, window, ring_modes,
                                              recursion)] + [__file__]
    digest = cache.key([str(name) for name in sources], bay.stiffness, bay.damping, bay.mass,
                       bay.dofs, time_step, steps, reach, hold)

    def compute() -> dict[str, NDArray[np.float32]]:
        if hold == 'linear':
            h = _modal_responses(bay, time_step, steps, reach)
        else:
            # A wave that comes back from an end has run twice the margin: as round a ring.
            margin = max(newmark.default_margin(bay), ring_length(bay, [0.0]) // 2 + 1)
            h = nodal_impulse_responses(
                bay, time_step, steps, reach, margin=margin)[:, :, reach:]
        return {'h': np.ascontiguousarray(h, dtype=np.float32)}

    return np.asarray(cache.stored('responses', digest, compute)['h'], dtype=float)


def _modal_responses(bay: Bay, time_step: float, steps: int, reach: int) -> Array:
    """The same from the modes of a ring that is long enough, for the hold `linear`."""
    bays = ring_length(bay, [0.0, reach * bay.spacing])
    modes = make_track_modes(bay, bays, MAXIMUM_FREQUENCY)
    step, n = step_of(modes.poles, time_step, 'linear'), bay.dofs
    age = np.exp(np.outer(modes.poles * time_step, np.arange(steps - 1)))
    here = np.hstack([modes.first[:n], modes.second[:n]])
    h = np.empty((n, n, reach + 1, steps))
    for m in range(reach + 1):
        cos, sin = np.cos(m * modes.wave_number), np.sin(m * modes.wave_number)
        there = np.hstack([cos * modes.first[:n] + sin * modes.second[:n],
                           cos * modes.second[:n] - sin * modes.first[:n]])
        gains = here[:, None, :] * there[None, :, :]
        gains = gains[..., :modes.poles.size] + gains[..., modes.poles.size:]
        h[:, :, m, 0] = (gains @ step.p1).real + modes.remainder[m % bays, :n, :n].T
        h[:, :, m, 1:] = ((gains * step.gain).reshape(n * n, -1) @ age).real.reshape(n, n, -1)
    return h


def moving_impulse_response(bay: Bay, time_step: float, steps: int, speed: float,
                            places: ArrayLike, hold: str = 'trapezoidal') -> Array:
    """h_m (n, steps) [m/N]: deflection under a wheel that moves on from where an impulse was.

    The impulse, 1 N for one time step [s], acts at places (n,) [m]; the wheel is at
    place + speed * time_step * k in step k.  Its sum with the forces of a wheel at this constant
    speed is the deflection under the wheel (thesis 4.5, 4.6).
    """
    places = np.atleast_1d(np.asarray(places, dtype=float))
    reach = math.ceil(abs(speed) * time_step * steps / bay.spacing) + 2
    h = element_impulse_responses(bay, time_step, steps, reach, hold)
    n = bay.dofs
    age = np.arange(steps)
    result = np.empty((places.size, steps))
    for i, place in enumerate(places):
        bay_here, inside = bay.locate([place])
        source = bay.shape(inside)[0]
        bays, insides = bay.locate(place + speed * time_step * age)
        shapes = bay.shape(insides)
        result[i] = 0.0
        for s, weight in enumerate(source):
            if weight == 0.0:
                continue
            for r in np.flatnonzero(np.any(shapes != 0.0, axis=0)):
                apart = bays + r // n - bay_here[0] - s // n
                ahead = h[s % n, r % n, np.maximum(apart, 0), age]
                back = h[r % n, s % n, np.maximum(-apart, 0), age]
                result[i] += weight * shapes[:, r] * np.where(apart >= 0, ahead, back)
        result[i, 0] += bay.flexibility(inside)[0]
    return result


class History(NamedTuple):
    """What the convolution remembers of every wheel.

    drive (wheels, k, 2 memory): f N_i, newest first from index `head`, each entry stored twice so
    that a whole memory is always contiguous.  A segment is a stretch of time in one element:
    bay, element and first step (wheels, segments), a ring of which `newest` (wheels,) is the last.
    """

    drive: Array
    bay: Indices
    element: Indices
    first_step: Indices
    newest: Indices


@njit(cache=True, nogil=True, inline='always')
def remember(history, wheel, bay, element, step):
    """Open a new segment where the wheel has come to another element."""
    last = history.newest[wheel]
    if history.bay[wheel, last] != bay or history.element[wheel, last] != element:
        last = (last + 1) % history.bay.shape[1]
        history.newest[wheel] = last
        history.bay[wheel, last] = bay
        history.element[wheel, last] = element
        history.first_step[wheel, last] = step


@njit(cache=True, nogil=True, inline='always')
def response_row(h, force_dof, force_bay, dof, bay):
    """h over the memory between two degrees of freedom; reciprocity gives what lies behind."""
    own = h.shape[0]
    if force_dof >= own:
        force_dof, force_bay = force_dof - own, force_bay + 1
    if dof >= own:
        dof, bay = dof - own, bay + 1
    if bay >= force_bay:
        return h[force_dof, dof, bay - force_bay]
    return h[dof, force_dof, force_bay - bay]


@njit(cache=True, nogil=True, fastmath=True)
def dot(a, b):
    """sum_n a[n] b[n]."""
    total = 0.0
    for n in range(a.size):
        total += a[n] * b[n]
    return total


@njit(cache=True, nogil=True, fastmath=True)
def convolve(table, h, history, wheel, dofs, bay, weights, step, head):
    """Deflection at a place by the past drive (ages 1 .. memory - 1) of one wheel, upward drive."""
    memory = h.shape[3]
    segments = history.bay.shape[1]
    segment = history.newest[wheel]
    begin = 1
    total = 0.0
    while begin < memory:
        end = min(memory, step - history.first_step[wheel, segment] + 1)
        source = table.dofs[history.element[wheel, segment]]
        for i in range(weights.size):
            drive = history.drive[wheel, i, head + begin:head + end]
            for j in range(weights.size):
                row = response_row(h, source[i], history.bay[wheel, segment], dofs[j], bay)
                total += weights[j] * dot(row[begin:end], drive)
        begin = max(begin, end)
        segment = (segment - 1) % segments
    return total


@njit(cache=True, nogil=True, fastmath=True)
def march(table, h, history, first_step, offsets, constants, position, irregularity, wheels,
          force_out, deflection_out, wheel_out, acceleration_out):
    """Convolve, step the contact, remember; returns (steps done, Newton iterations).

    h (dofs, dofs, reach + 1, memory): force's degree of freedom, response's, bays ahead, age.
    """
    steps, n = irregularity.shape
    memory, width = h.shape[3], table.dofs.shape[1]
    free, force = np.empty(n), np.empty(n)
    weights, element, bays = np.empty((n, width)), np.empty(n, np.int64), np.empty(n, np.int64)
    compliance, work = np.empty((n, n)), np.zeros((n, n + 3))
    iterations = 0
    for k in range(steps):
        step = first_step + k
        head = memory - 1 - step % memory
        for w in range(n):
            bay, interval, s = locate(table, position[k] + offsets[w])
            bays[w], element[w] = bay, table.element[interval]
            for j in range(width):
                weights[w, j] = cubic(table.coefficients[interval, j], s)
            compliance[w, w] = cubic(table.flexibility[interval], s)
            remember(history, w, bay, element[w], step)
        for w in range(n):
            here = table.dofs[element[w]]
            free[w] = 0.0
            for v in range(n):
                free[w] += convolve(table, h, history, v, here, bays[w], weights[w], step, head)
                now = compliance[w, w] if v == w else 0.0
                for i in range(width):
                    for j in range(width):
                        now += weights[v, i] * weights[w, j] * response_row(
                            h, table.dofs[element[v], i], bays[v], here[j], bays[w])[0]
                compliance[w, v] = now
        count = contact_step(free, compliance, irregularity[k], wheels, constants, force, work)
        if count < 0:
            return k, iterations
        iterations += count
        for w in range(n):
            deflection = free[w]
            for v in range(n):
                deflection -= compliance[w, v] * force[v]
            for i in range(width):
                history.drive[w, i, head] = -force[w] * weights[w, i]
                history.drive[w, i, head + memory] = -force[w] * weights[w, i]
            force_out[k, w] = force[w]
            deflection_out[k, w] = deflection
            wheel_out[k, w] = wheels[0, w]
            acceleration_out[k, w] = wheels[2, w]
    return steps, iterations


class IrfForward(ForwardSolver):
    """Wheels of one rail over a given irregularity: contact forces by convolution.

    Same use and results as `newmark.FullModel`.  Parameters: bay; vehicle (wheel and contact are
    used); offsets of the wheels from the reference point [m]; time_step [s]; start_position [m],
    where the wheels have stood at the first sample; memory [s], None for `memory_of`; hold.
    Raises InputError.  `left` is the share of a deflection that the memory cuts off.
    """

    name = 'IRF solver'

    def __init__(self, bay: Bay, vehicle: Vehicle, offsets: Sequence[float] | Array,
                 time_step: float, start_position: float, memory: float | None = None,
                 hold: str = 'trapezoidal') -> None:
        offsets = check_setup(offsets, time_step)
        memory = memory_of(bay) if memory is None else float(memory)
        if not memory >= 10.0 * time_step:
            raise InputError(f'memory: {memory:g} s is too short, at least ten time steps '
                             f'({10.0 * time_step:g} s) are needed')
        if hold not in HOLDS:
            raise InputError(f'hold {hold!r}: expected one of ' + ', '.join(HOLDS))
        super().__init__(wheel_constants(vehicle, time_step), offsets, start_position,
                         0.25 * bay.spacing)
        self.bay, self.hold = bay, hold
        self.memory = math.ceil(memory / time_step)
        self.left = float(deflection_left(bay, memory)[1][-1])
        self._table = shape_table(bay)
        self._responses: Array = np.zeros((bay.dofs, bay.dofs, 0, self.memory))
        n, k = self.offsets.size, self._table.dofs.shape[1]
        shape = (n, self.memory + 2)
        self._history = History(
            drive=np.zeros((n, k, 2 * self.memory)),
            bay=np.zeros(shape, np.int64), element=np.zeros(shape, np.int64),
            first_step=np.zeros(shape, np.int64), newest=np.zeros(n, np.int64))
        self._recent: Array = np.zeros(0)

    def _march(self, position: Array, irregularity: Array, wheels: Array, out: ForwardResult
               ) -> tuple[int, str]:
        track = np.concatenate([self._recent, position])
        self._reach_over(track)
        self._recent = track[-self.memory:]
        done, iterations = march(
            self._table, self._responses, self._history, self.memory + self.steps, self.offsets,
            self.constants, position, irregularity, wheels, *out.arrays())
        self.iterations += iterations
        return done, '' if done == position.size else 'the contact forces did not converge'

    def _reach_over(self, position: Array) -> None:
        """Have the impulse responses as far along the track as one memory of this run covers."""
        blocks = max(1, position.size // self.memory)
        edges = np.linspace(0, position.size, blocks + 1).astype(int)
        # Two neighbouring blocks span every window of one memory.
        spans = [np.ptp(position[edges[i]:edges[min(i + 2, blocks)]]) for i in range(blocks)]
        reach = math.ceil((max(spans) + np.ptp(self.offsets)) / self.bay.spacing) + 2
        if reach >= self._responses.shape[2]:
            # A few lengths serve all runs.
            self._responses = element_impulse_responses(
                self.bay, self.time_step, self.memory, -(-reach // 8) * 8, self.hold)

    def _stand(self, position: Array) -> Array:
        self._reach_over(position)
        self._recent = position[:1]
        load = -self.constants.static_load
        number, inside = self.bay.locate(position[0] + self.offsets)
        interval, s = self.bay.table.locate(inside)
        weights = np.einsum('wkc,wc->wk', self._table.coefficients[interval],
                            s[:, None] ** np.arange(4))
        element = self._table.element[interval]
        history = self._history
        history.drive[:] = load * weights[:, :, None]
        history.bay[:, 0], history.element[:, 0] = number, element
        deflection = load * self.bay.flexibility(inside)
        for w in range(self.offsets.size):
            here = self._table.dofs[element[w]]
            for v in range(self.offsets.size):
                there = self._table.dofs[element[v]]
                for i, source in enumerate(there):
                    for j, dof in enumerate(here):
                        row = response_row(self._responses, source, number[v], dof, number[w])
                        deflection[w] += load * weights[v, i] * weights[w, j] * row.sum()
        return deflection
