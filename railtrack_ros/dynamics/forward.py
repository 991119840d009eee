"""What all forward solvers share: their result, what they refuse, and how a run begins and ends.

A forward solver answers with contact forces, deflections and accelerations to a run of positions
and the irregularity under each wheel::

    solver = FullModel(bay, vehicle, offsets, time_step, start_position)
    result = solver.run(position, irregularity)

Successive calls continue where the last one ended, so a run can come in pieces of any size.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railtrack_ros.dynamics.contact import WheelConstants, standing_wheels
from railtrack_ros.errors import InputError

Array = NDArray[np.float64]

SHORTEST_TIME_STEP = 1e-8  # s


@dataclass(frozen=True)
class ForwardResult:
    """Answer at n time steps and the wheels of one rail; every array (n, wheels), SI, z up.

    contact_force is compressive [N], rail_deflection [m] that of the rail under the wheel,
    wheel_displacement [m] and axle_box_acceleration [m/s2] those of the unsprung mass.
    """

    contact_force: Array
    rail_deflection: Array
    wheel_displacement: Array
    axle_box_acceleration: Array

    @staticmethod
    def empty(steps: int, wheels: int) -> ForwardResult:
        """Room for n steps."""
        return ForwardResult(*(np.zeros((steps, wheels)) for _ in range(4)))

    def part(self, begin: int, end: int) -> ForwardResult:
        """Return the steps begin..end - 1."""
        return ForwardResult(*(array[begin:end] for array in self.arrays()))

    def arrays(self) -> tuple[Array, Array, Array, Array]:
        """The four arrays in the order of the fields."""
        return (self.contact_force, self.rail_deflection, self.wheel_displacement,
                self.axle_box_acceleration)


class StepFailure(InputError):
    """A time step without a solution; `result` holds the steps before it."""

    def __init__(self, message: str, result: ForwardResult) -> None:
        super().__init__(message)
        self.result = result


def check_setup(offsets: Sequence[float] | Array, time_step: float) -> Array:
    """Return the wheels' offsets [m] as an array (wheels,).

    Raises
    ------
    InputError
        No wheel, an offset that is not finite, or a time step [s] that is not positive or so
        short that rounding takes over.
    """
    wheels = np.asarray(offsets, dtype=float)
    if wheels.ndim != 1 or wheels.size == 0 or not np.isfinite(wheels).all():
        raise InputError(f'wheel offsets: expected at least one finite number, got {offsets}')
    if not (np.isfinite(time_step) and time_step >= SHORTEST_TIME_STEP):
        raise InputError(f'time step: expected at least {SHORTEST_TIME_STEP:g} s, got '
                         f'{time_step:g}')
    return wheels


def check_run(position: ArrayLike, irregularity: ArrayLike, wheels: int, last: float | None,
              start: float, longest_move: float) -> tuple[Array, Array]:
    """Return position (n,) and irregularity (n, wheels) as arrays that a solver can run.

    `last` is the position where the previous call ended, None before the first.

    Raises
    ------
    InputError
        Shapes that do not match, values that are not finite, a first position other than start,
        or a move of more than `longest_move` [m] in one step.
    """
    position = np.ascontiguousarray(position, dtype=float)
    irregularity = np.ascontiguousarray(irregularity, dtype=float)
    if position.ndim != 1 or irregularity.shape != (position.size, wheels):
        raise InputError(f'run: expected positions (n,) and irregularity (n, {wheels}), got '
                         f'{position.shape} and {irregularity.shape}')
    if not (np.isfinite(position).all() and np.isfinite(irregularity).all()):
        raise InputError('run: a position or an irregularity is not a finite number')
    if position.size == 0:
        return position, irregularity
    if last is None and abs(position[0] - start) > 1e-6:
        raise InputError(f'run: starts at {position[0]:g} m, but the solver was set up to start '
                         f'at {start:g} m')
    move = np.abs(np.diff(position, prepend=position[0] if last is None else last))
    if move.max() > longest_move:
        step = int(np.argmax(move))
        raise InputError(f'run: {move[step]:.3g} m in one time step at {position[step]:g} m is '
                         f'more than {longest_move:.3g} m: the time step is too long for the speed')
    return position, irregularity


class ForwardSolver(ABC):
    """Wheels of one rail over a given irregularity; a solver says how the rail answers.

    offsets (wheels,) [m] from the reference point; time_step [s]; start_position [m], where the
    wheels stand in static equilibrium at the first sample; longest_move [m] in a time step.
    Raises InputError.  steps and iterations count time steps and those of the contact.
    """

    name: ClassVar[str]  # in messages

    def __init__(self, constants: WheelConstants, offsets: Sequence[float] | Array,
                 start_position: float, longest_move: float) -> None:
        self.constants = constants
        self.time_step = constants.time_step
        self.offsets = np.asarray(offsets, dtype=float)
        self.start_position = float(start_position)
        self.longest_move = longest_move
        self.steps = self.iterations = 0
        self._wheels: Array | None = None
        self._last: float | None = None

    def run(self, position: ArrayLike, irregularity: ArrayLike) -> ForwardResult:
        """Step to each position (n,) [m] of the reference point; successive calls continue.

        Parameters
        ----------
        position
            One per time step; the first of the first call is the start position.
        irregularity
            (n, wheels) [m], each at its wheel's own place.

        Raises
        ------
        InputError
            Input of the wrong shape, or a step that moves too far.
        StepFailure
            No convergence, or divergence; it names the step and carries the result so far.  The
            solver cannot go on after it.
        """
        position, irregularity = check_run(
            position, irregularity, self.offsets.size, self._last, self.start_position,
            self.longest_move)
        result = ForwardResult.empty(position.size, self.offsets.size)
        if position.size == 0:
            return result
        begin = 0
        if self._wheels is None:
            deflection = self._stand(position)
            self._wheels = standing_wheels(self.constants, deflection, irregularity[0])
            result.contact_force[0] = self.constants.static_load
            result.rail_deflection[0] = deflection
            result.wheel_displacement[0] = self._wheels[0]
            begin = 1
        done, failure = self._march(
            position[begin:], irregularity[begin:], self._wheels,
            result.part(begin, position.size))
        self.steps += done
        if failure:
            raise StepFailure(
                f'{self.name}: {failure} in time step {self.steps + 1} at position '
                f'{position[begin + done]:.6g} m; a time step shorter than {self.time_step:g} s '
                'is needed, or a smoother irregularity'
                + (', or the iteration newton' if self.constants.fixed else ''),
                result.part(0, begin + done))
        self._last = float(position[-1])
        return result

    @abstractmethod
    def _stand(self, position: Array) -> Array:
        """Put the rail into static equilibrium under the wheels; return their deflection [m].

        position (n,) [m]: of the run that begins, where it begins first.
        """

    @abstractmethod
    def _march(self, position: Array, irregularity: Array, wheels: Array, out: ForwardResult
               ) -> tuple[int, str]:
        """Step to all positions, fill `out`; return the steps done and what went wrong if any.

        wheels: their state, see `contact.contact_step`, which is changed.
        """
