"""A forward run: the wheels of a vehicle over given irregularity at a given speed.

Both rails, chunk after chunk, so that a run of any length needs little memory.
"""

from __future__ import annotations

import csv
import dataclasses
import math
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railtrack_ros.dynamics.forward import ForwardResult, StepFailure
from railtrack_ros.errors import InputError
from railtrack_ros.irregularity.profile import read_columns, reason
from railtrack_ros.irregularity.surface import Part, Surface
from railtrack_ros.track.bay import Bay, Mesh, make_bay
from railtrack_ros.track.description import Track
from railtrack_ros.track.row import BayRow
from railtrack_ros.vehicle.description import Vehicle

Array = NDArray[np.float64]

SOLVERS = ('newmark', 'irf', 'recursive')
CHUNK = 8192  # time steps


@dataclass(frozen=True)
class SpeedHistory:
    """Speed [m/s] at increasing times [s], linear in between; negative is backwards."""

    time: Array
    speed: Array
    name: str = 'speed'

    def __post_init__(self) -> None:
        if not (np.diff(self.time) > 0.0).all():
            first = int(np.argmin(np.diff(self.time) > 0.0))
            raise InputError(f'{self.name}: times have to increase, but {self.time[first + 1]:g} s '
                             f'follows {self.time[first]:g} s')

    @property
    def duration(self) -> float:
        """Time [s] from first to last."""
        return float(self.time[-1] - self.time[0])

    def distance_at(self, t: ArrayLike) -> Array:
        """Displacement [m] at times t (n,) [s] after the first one: the exact integral."""
        return self._integral(np.asarray(t, dtype=float), self.time - self.time[0], self.speed)

    def with_stops(self) -> tuple[Array, Array]:
        """Times after the first [s] and speeds, the instants of zero speed among them."""
        t, v = self.time - self.time[0], self.speed
        turn = np.flatnonzero(v[:-1] * v[1:] < 0.0)
        zero = t[turn] - v[turn] * (t[turn + 1] - t[turn]) / (v[turn + 1] - v[turn])
        return np.insert(t, turn + 1, zero), np.insert(v, turn + 1, 0.0)

    def extent(self, end: float) -> tuple[float, float]:
        """Least and greatest displacement [m] in the first `end` seconds."""
        t, _ = self.with_stops()
        reached = self.distance_at(np.append(t[t < end], end))
        return float(reached.min()), float(reached.max())

    def time_of_distance(self, distance: float) -> float:
        """Time [s] after the first at which the distance run, forth and back, is reached.

        Raises
        ------
        InputError
            The history ends before.
        """
        t, v = self.with_stops()
        speed = np.abs(v)
        run = np.concatenate([[0.0], np.cumsum(0.5 * np.diff(t) * (speed[1:] + speed[:-1]))])
        if run[-1] < distance * (1.0 - 1e-9):
            raise InputError(f'{self.name}: ends after {run[-1]:g} m, before the distance of '
                             f'{distance:g} m')
        i = max(0, int(np.searchsorted(run, distance)) - 1)
        if i == run.size - 1:
            return float(t[-1])
        slope, left = (speed[i + 1] - speed[i]) / (t[i + 1] - t[i]), distance - run[i]
        root = math.sqrt(max(0.0, speed[i] ** 2 + 2.0 * slope * left))
        return float(min(t[i] + (2.0 * left / (speed[i] + root) if left > 0.0 else 0.0), t[-1]))

    @staticmethod
    def _integral(at: Array, t: Array, v: Array) -> Array:
        before = np.concatenate([[0.0], np.cumsum(0.5 * np.diff(t) * (v[1:] + v[:-1]))])
        i = np.clip(np.searchsorted(t, at, side='right') - 1, 0, t.size - 2)
        since = at - t[i]
        slope = (v[i + 1] - v[i]) / (t[i + 1] - t[i])
        return before[i] + since * (v[i] + 0.5 * slope * since)


def constant_speed(speed: float, distance: float) -> SpeedHistory:
    """Speed [m/s] > 0 for a distance [m] > 0."""
    if not (speed > 0.0 and distance > 0.0):
        raise InputError(f'speed {speed:g} m/s: expected more than 0 for a distance of '
                         f'{distance:g} m')
    return SpeedHistory(np.array([0.0, distance / speed]), np.full(2, float(speed)))


def read_speed(path: str | Path) -> SpeedHistory:
    """Read a CSV file of columns ``time_s, speed_m_s``.

    Raises
    ------
    InputError
        It cannot be read; file, line and column are named.
    """
    path = Path(path)
    try:
        with path.open(newline='', encoding='utf-8-sig') as file:
            header = [name.strip() for name in next(csv.reader(file), [])]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f'speed file {path}: cannot be read: {reason(error)}') from error
    names = ['time_s', 'speed_m_s']
    for name in names:
        if name not in header:
            raise InputError(f'speed file {path}: line 1: column {name} is missing, expected '
                             f'time_s, speed_m_s; found {", ".join(header) or "nothing"}')
    values = read_columns(path, header, names, 'speed file')
    return SpeedHistory(values[:, 0], values[:, 1], f'speed file {path}')


class Solver(Protocol):
    """What all forward solvers offer."""

    iterations: int
    steps: int

    def run(self, position: ArrayLike, irregularity: ArrayLike) -> ForwardResult:
        """Step on."""


@dataclass(frozen=True)
class NewmarkOptions:
    """What only the full model takes, see `dynamics.newmark.FullModel`."""

    margin: int | None = None
    beta: float = 0.25
    gamma: float = 0.5
    tolerance: float = 1e-10
    iteration: str = 'newton'


@dataclass(frozen=True)
class OnlineOptions:
    """What only the online solvers take; None for the solver's own default.

    hold: how forces run within a time step. memory [s] of irf; cut_off [Hz] of the poles and
    bays_in_ring of recursive.
    """

    hold: str | None = None
    memory: float | None = None
    cut_off: float | None = None
    bays_in_ring: int | None = None


# What the solvers take of it, and how they call it.
ONLINE: dict[str, dict[str, str]] = {
    'newmark': {}, 'irf': {'hold': 'hold', 'memory': 'memory'},
    'recursive': {'hold': 'hold', 'cut_off': 'maximum_frequency', 'bays_in_ring': 'bays'}}


@dataclass(frozen=True)
class ForwardSettings:
    """What is driven: positions in metres along the track, time step in seconds."""

    solver: str
    speed: SpeedHistory
    start: float
    time_step: float
    distance: float | None = None  # the whole speed history unless given
    irregularity: tuple[Part, ...] = ()  # smooth without
    newmark: NewmarkOptions = field(default_factory=NewmarkOptions)
    online: OnlineOptions = field(default_factory=OnlineOptions)


def make_solver(settings: ForwardSettings, track: Bay | BayRow, vehicle: Vehicle,
                offsets: list[float]) -> Solver:
    """The solver of the settings for the wheels of one rail."""
    dt, start = settings.time_step, settings.start
    online = {name: value for name, value in dataclasses.asdict(settings.online).items()
              if value is not None}
    for name in online:
        if name not in ONLINE[settings.solver]:
            who = ' and '.join(key for key, names in ONLINE.items() if name in names)
            raise InputError(f'{name}: the solver {settings.solver} does not have it, only {who}')
    online = {ONLINE[settings.solver][name]: value for name, value in online.items()}
    if settings.solver == 'newmark':
        from railtrack_ros.dynamics.newmark import FullModel

        return FullModel(track, vehicle, offsets, dt, start,
                         **dataclasses.asdict(settings.newmark))
    for given in dataclasses.fields(NewmarkOptions):
        if getattr(settings.newmark, given.name) != given.default:
            raise InputError(f'{given.name}: the solver {settings.solver} does not have it, '
                             'only newmark has')
    assert isinstance(track, Bay)
    if settings.solver == 'irf':
        from railtrack_ros.dynamics.irf import IrfForward

        return IrfForward(track, vehicle, offsets, dt, start, **online)
    from railtrack_ros.dynamics.recursive import RecursiveForward

    return RecursiveForward(track, vehicle, offsets, dt, start, **online)


@dataclass(frozen=True)
class Chunk:
    """Time steps of all axle boxes: time (n,) [s], arrays (n, axle boxes) in the vehicle's order.

    position is the axle boxes' own place on the track [m].
    """

    time: Array
    position: Array
    result: ForwardResult


class ForwardRun:
    """A run, ready to be iterated over once; raises InputError for one that cannot be.

    steps is the number of time steps of the whole run, seconds the computing time so far.  The
    full model takes any track, the others one that is periodic and linear.
    """

    def __init__(self, track: Track, mesh: Mesh | None, vehicle: Vehicle,
                 settings: ForwardSettings) -> None:
        if settings.solver not in SOLVERS:
            raise InputError(f'solver {settings.solver!r}: expected one of {", ".join(SOLVERS)}')
        model = (BayRow(track, mesh) if settings.solver == 'newmark' else make_bay(track, mesh))
        self.bay = model.bay if isinstance(model, BayRow) else model
        self.track, self.vehicle, self.settings = track, vehicle, settings
        dt = settings.time_step
        self._solvers = {
            rail: make_solver(settings, model, vehicle,
                              [box.offset for box in vehicle.on_rail(rail)])
            for rail in vehicle.rails
        }
        end = (settings.speed.duration if settings.distance is None
               else settings.speed.time_of_distance(settings.distance))
        self.steps = math.floor(end / dt * (1.0 + 1e-12) + 1e-9) + 1
        if self.steps < 2:
            raise InputError(f'time step {dt:g} s: longer than the whole run of {end:g} s')
        self.seconds = 0.0
        low, high = settings.speed.extent(end)
        self._surface = Surface(settings.irregularity, vehicle, settings.start,
                                settings.start + low, settings.start + high)

    @property
    def remark(self) -> str:
        """What limits the accuracy of the run; empty if nothing does."""
        from railtrack_ros.dynamics.irf import LEFT, IrfForward

        solver = next(iter(self._solvers.values()))
        if not (isinstance(solver, IrfForward) and solver.left > LEFT):
            return ''
        return (f'memory of {solver.memory * solver.time_step:.3g} s: {100.0 * solver.left:.2g} % '
                'of a deflection is left when the impulse responses end, the track is damped so '
                'little: a longer --memory takes it in, or --solver newmark or recursive')

    @property
    def iterations_per_step(self) -> float:
        """Mean iterations of the contacts in a time step on one rail."""
        return self._per_step('iterations')

    @property
    def support_iterations_per_step(self) -> float:
        """Mean iterations of non-linear supports in a time step on one rail."""
        return self._per_step('support_iterations')

    @property
    def most_iterations(self) -> tuple[int, int]:
        """Most iterations of contacts and of supports in a time step; the full model counts."""
        most, supports = (max(getattr(solver, name, 0) for solver in self._solvers.values())
                          for name in ('most_iterations', 'most_support_iterations'))
        return most, supports

    def _per_step(self, name: str) -> float:
        steps = sum(solver.steps for solver in self._solvers.values())
        total = sum(getattr(solver, name, 0) for solver in self._solvers.values())
        return total / max(1, steps)

    def __iter__(self) -> Iterator[Chunk]:
        """Yield the chunks; a StepFailure comes after the steps that worked have been yielded."""
        with ThreadPoolExecutor(len(self._solvers)) as pool:
            # A short chunk first: loading or compiling the solver is not its computing time.
            for first, end in pairwise([0, *range(2, self.steps, CHUNK), self.steps]):
                begun = time.perf_counter()
                t = np.arange(first, end, dtype=np.float64) * self.settings.time_step
                position = self.settings.start + self.settings.speed.distance_at(t)
                answers = list(pool.map(lambda rail, x=position: self._advance(rail, x),
                                        self._solvers))
                if first > 0:
                    self.seconds += time.perf_counter() - begun
                done = min(len(answer.contact_force) for answer, _ in answers)
                yield self._chunk(t[:done], position[:done],
                                  [answer.part(0, done) for answer, _ in answers])
                for _, failure in answers:
                    if failure is not None:
                        raise failure

    def _advance(self, rail: str, position: Array) -> tuple[ForwardResult, StepFailure | None]:
        irregularity = np.column_stack([self._surface.at(box, position)
                                        for box in self.vehicle.on_rail(rail)])
        try:
            return self._solvers[rail].run(position, irregularity), None
        except StepFailure as failure:
            return failure.result, failure

    def _chunk(self, t: Array, position: Array, answers: list[ForwardResult]) -> Chunk:
        boxes = self.vehicle.axle_boxes
        order = [boxes.index(box) for rail in self.vehicle.rails
                 for box in self.vehicle.on_rail(rail)]
        back = np.argsort(order)
        merged = ForwardResult(*(np.concatenate(parts, axis=1)[:, back] for parts in
                                 zip(*(answer.arrays() for answer in answers), strict=True)))
        offsets = np.array([box.offset for box in boxes])
        return Chunk(t, position[:, None] + offsets, merged)
