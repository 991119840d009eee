"""What all forward solvers share: their result, and what they refuse.

A forward solver answers with contact forces, deflections and accelerations to a run of positions
and the irregularity under each wheel::

    solver = FullModel(bay, vehicle, offsets, time_step, start_position)
    result = solver.run(position, irregularity)

Successive calls continue where the last one ended, so a run can come in pieces of any size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
