"""The full model: Newmark integration of the finite-element track under moving wheels.

    M u'' + C u' + K u = sum_i N(x_i) f_i                                  (thesis 2.3)

On a periodic track the matrix A = M + gamma dt C + beta dt^2 K never changes.  It is factorised
once; a wheel's contact force is a rank-one correction by known columns of A^-1, so the non-linear
problem of a time step has one unknown per wheel (dynamics.contact) and is solved with the exact
Jacobian.  The window of bays travels with the wheels by whole bays: a run has no end and its
memory does not grow.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import zip_longest

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from numpy.typing import ArrayLike, NDArray

from railtrack_ros.dynamics import newmark_kernel as kernel
from railtrack_ros.dynamics.contact import standing_wheels, wheel_constants
from railtrack_ros.dynamics.forward import (
    ForwardResult,
    StepFailure,
    check_run,
    check_setup,
)
from railtrack_ros.dynamics.interpolation import shape_table
from railtrack_ros.errors import InputError
from railtrack_ros.track.bay import Bay
from railtrack_ros.vehicle.description import Vehicle

Array = NDArray[np.float64]

VECTOR = 8  # doubles in a vector register; lanes are a multiple of it
NEGLIGIBLE = 1e-18  # where columns of A^-1 are cut off, relative to their peak
LONGEST_MOVE = 0.25  # bays in one time step

# Bays on either side of the outermost wheels.  Measured on ISO 3095 roughness at 40 m/s against a
# window without reflections: 40 bays leave at most 0.03 % of the static load in the contact force
# with the shipped tracks.  A rail without loss on point supports hardly damps its pinned-pinned
# wave, which takes 90 for 0.05 %.  Layers of growing damping at the ends were tried and gained
# less than a few more bays: near the pinned-pinned frequency the group velocity vanishes, and any
# change of the track reflects.
MARGIN = 40
UNDAMPED_MARGIN = 90
UNDAMPED = 0.005  # rail loss factor below which the latter applies


class FullModel:
    """Wheels of one rail on the finite-element track, step by step.

    Parameters
    ----------
    bay
        The track's bay (track.bay.make_bay).
    vehicle
        Wheel and contact; its axle boxes are not used.
    offsets
        Metres of the wheels from the reference point.
    time_step
        Seconds.
    start_position
        Reference point at the first sample [m]: wheels and track are in static equilibrium.
    margin
        Bays of track beyond the outermost wheels at either end of the travelling window; 40, or
        90 on a rail without loss, unless given.
    beta, gamma
        Newmark's parameters, 1/4 and 1/2: unconditionally stable, second order, no damping.
    tolerance
        Relative change of an indentation at which Newton's iteration stops.

    Raises
    ------
    InputError
        A set-up that cannot run.
    """

    def __init__(self, bay: Bay, vehicle: Vehicle, offsets: Sequence[float], time_step: float,
                 start_position: float, margin: int | None = None, beta: float = 0.25,
                 gamma: float = 0.5, tolerance: float = 1e-10) -> None:
        self.offsets = check_setup(offsets, time_step)
        if not (0.5 <= gamma <= 1.0 and 0.25 * (gamma + 0.5) ** 2 - 1e-12 <= beta <= 1.0):
            raise InputError(f'Newmark: beta {beta:g}, gamma {gamma:g} are not unconditionally '
                             'stable: expected gamma >= 1/2 and beta >= (gamma + 1/2)^2 / 4')
        margin = default_margin(bay) if margin is None else margin
        if margin < 2:
            raise InputError(f'margin: {margin} bays are too few, at least 2 are needed')
        self.bay = bay
        self.time_step = float(time_step)
        self.start_position = float(start_position)
        self.constants = wheel_constants(vehicle, time_step, beta, gamma, tolerance)
        self.iterations = 0  # Newton iterations of the steps so far, and the most in one step
        self.most_iterations = 0
        self.steps = 0

        # Lanes in which each wheel can stand while the reference point is inside its bay.
        behind = np.floor(self.offsets / bay.spacing).astype(np.int64)
        home = margin - min(0, int(behind.min()))
        self.bays = home + max(0, int(behind.max())) + 2 + margin
        self.operator = make_operator(bay, self.bays, self.time_step, beta, gamma)
        self.columns = _wheel_columns(self.operator, bay.dofs, home + behind)
        self._table = shape_table(bay)
        number, _ = bay.locate(self.start_position)
        self._home = np.array([number[0], home], dtype=np.int64)
        shape = self.operator.pivot.shape
        self._u, self._v, self._a = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        self._wheels: Array | None = None
        self._last: float | None = None

    def run(self, position: ArrayLike, irregularity: ArrayLike) -> ForwardResult:
        """Step to each position (n,) [m] of the reference point.

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
            model cannot go on after it.
        """
        wheels = self.offsets.size
        position, irregularity = check_run(
            position, irregularity, wheels, self._last, self.start_position,
            LONGEST_MOVE * self.bay.spacing)
        result = ForwardResult.empty(position.size, wheels)
        if position.size == 0:
            return result
        begin = 0
        if self._wheels is None:
            self._wheels = self._stand(position[0], irregularity[0])
            for array, value in zip(result.arrays(), (
                    self.constants.static_load, self._wheels[0] - irregularity[0]
                    + self._wheels[3], self._wheels[0], 0.0), strict=True):
                array[0] = value
            begin = 1
        rest = result.part(begin, position.size)
        iterations = np.zeros(position.size - begin, dtype=np.int64)
        done, status = kernel.run(
            self.operator, self.columns, self._table, self.constants, self._home, self.offsets,
            position[begin:], irregularity[begin:], self._u, self._v, self._a, self._wheels,
            *rest.arrays(), iterations)
        self.steps += done
        self.iterations += int(iterations.sum())
        self.most_iterations = max(self.most_iterations, int(iterations.max(initial=0)))
        if status != kernel.FINISHED:
            reason = ('the contact forces did not converge' if status == kernel.CONTACT_FAILED
                      else 'the solution diverged')
            raise StepFailure(
                f'full model: {reason} in time step {self.steps + 1} at position '
                f'{position[begin + done]:.6g} m; a time step shorter than {self.time_step:g} s '
                'is needed, or a smoother irregularity', result.part(0, begin + done))
        self._last = float(position[-1])
        return result

    def track_state(self) -> tuple[Array, Array, Array]:
        """Displacement, velocity and acceleration of the window, each ((bays + 1) nb,).

        Degrees of freedom in the order of :func:`assemble`; the window starts at bay
        `first_bay` of the track.
        """
        nb = self.bay.dofs
        u, v, a = (np.append(x[:nb, :self.bays].T.ravel(), np.zeros(nb))
                   for x in (self._u, self._v, self._a))
        return u, v, a

    @property
    def first_bay(self) -> int:
        """Number of the track's bay at the left end of the window now."""
        return int(self._home[0] - self._home[1])

    def _stand(self, position: float, irregularity: Array) -> Array:
        """Put the track into static equilibrium under the wheels; return the wheels' state."""
        nb = self.bay.dofs
        number, inside = self.bay.locate(position + self.offsets)
        shape = self.bay.shape(inside)
        lane = number - self._home[0] + self._home[1]
        load = np.zeros((self.bays + 1) * nb)
        places = lane[:, None] * nb + np.arange(nb + 2)
        np.add.at(load, places, -self.constants.static_load * shape)
        stiffness = assemble(self.bay.stiffness, self.bays)
        free = slice(2, self.bays * nb)  # the outermost nodes are clamped
        u = np.zeros_like(load)
        u[free] = scipy.sparse.linalg.spsolve(stiffness[free, free], load[free])
        self._u[:nb, :self.bays] = u[:self.bays * nb].reshape(self.bays, nb).T
        deflection = ((shape * u[places]).sum(axis=1)
                      - self.bay.flexibility(inside) * self.constants.static_load)
        return standing_wheels(self.constants, deflection, irregularity)


def default_margin(bay: Bay) -> int:
    """Bays beyond the outermost wheels that keep the ends' reflections out of the forces."""
    return MARGIN if bay.track.rail.loss_factor >= UNDAMPED else UNDAMPED_MARGIN


def assemble(matrix: Array, bays: int) -> scipy.sparse.csc_matrix:
    """Matrix (nb + 2, nb + 2) of a bay for a row of bays, ((bays + 1) nb,) squared.

    Degree of freedom d of bay b is row b nb + d.  Of the last nb rows only the first two, the
    right end's node, belong to the track; the others are empty.
    """
    nb = matrix.shape[0] - 2
    row, column = np.nonzero(matrix)
    first = nb * np.arange(bays)[:, None]
    values = np.tile(matrix[row, column], bays)
    size = (bays + 1) * nb
    return scipy.sparse.coo_matrix(
        (values, ((first + row).ravel(), (first + column).ravel())), shape=(size, size)).tocsc()


def make_operator(bay: Bay, bays: int, time_step: float, beta: float = 0.25, gamma: float = 0.5
                  ) -> kernel.Operator:
    """Matrices and factors of a window of `bays` bays for time steps [s]."""
    nb = bay.dofs
    lag = _common_ratio(bay.damping, bay.stiffness)
    rest = bay.damping - lag * bay.stiffness
    rest[np.abs(rest) < 1e-12 * np.abs(bay.damping)] = 0.0
    a = bay.mass + gamma * time_step * bay.damping + beta * time_step**2 * bay.stiffness

    # Partial L D L^T of a bay: the interior goes, the left node and the next one's stay.
    order = _elimination_order(a != 0.0, nb)
    lower = np.zeros_like(a)
    pivot = np.zeros((nb + 2, VECTOR * math.ceil((bays + 1) / VECTOR)))
    kept = list(range(nb + 2))
    for j in order:
        kept.remove(j)
        pivot[j, :bays] = 1.0 / a[j, j]
        lower[kept, j] = a[kept, j] / a[j, j]
        a[np.ix_(kept, kept)] -= np.outer(lower[kept, j], a[j, kept])

    # Block elimination of the left nodes 1 .. bays - 1.
    left, right = slice(0, 2), slice(nb, nb + 2)
    under, diagonal, above = (np.zeros((bays + 1, 2, 2)) for _ in range(3))
    coupling = a[left, right]
    for b in range(1, bays):
        under[b] = coupling.T @ diagonal[b - 1]
        diagonal[b] = np.linalg.inv(a[left, left] + a[right, right] - under[b] @ coupling)
        above[b] = diagonal[b] @ coupling
    above[bays - 1] = 0.0
    return kernel.Operator(
        bays=bays, lag=lag, stiffness=_entries(-bay.stiffness, range(nb + 2)),
        damping=_entries(-rest, range(nb + 2)),
        forward=_entries(-lower, [*order, 0, 1, nb, nb + 1]), pivot=pivot,
        backward=_entries(-lower.T, order[::-1]),
        below=under, diagonal=diagonal, above=above)


def _common_ratio(damping: Array, stiffness: Array) -> float:
    """Ratio C / K [s] that most entries have in common; 0 if C is not mostly proportional to K."""
    ratio = damping[stiffness != 0.0] / stiffness[stiffness != 0.0]
    group = np.round(ratio / max(np.abs(ratio).max(), 1e-300), 9)
    values, count = np.unique(group, return_counts=True)
    common = float(np.median(ratio[group == values[np.argmax(count)]]))
    rest = np.abs(damping - common * stiffness) > 1e-9 * np.abs(damping)
    return common if rest.sum() < np.count_nonzero(damping) else 0.0


def _elimination_order(pattern: NDArray[np.bool_], nb: int) -> list[int]:
    """Interior degrees of freedom 2 .. nb - 1 by least degree, which keeps the factors sparse."""
    pattern = pattern.copy()
    left = set(range(2, nb))
    order = []
    while left:
        j = min(left, key=lambda i: (pattern[i].sum(), i))
        order.append(j)
        left.remove(j)
        neighbours = np.flatnonzero(pattern[j])
        pattern[np.ix_(neighbours, neighbours)] = True
        pattern[j, :] = pattern[:, j] = False
    return order


def _entries(matrix: Array, rows: Sequence[int]) -> kernel.Entries:
    """Non-zero entries of a bay's matrix (nb + 2, nb + 2) in pairs, rows in the given order."""
    row, column, value = [], [], []
    for i in rows:
        occupied = np.flatnonzero(matrix[i])
        for j, k in zip_longest(occupied[::2], occupied[1::2]):
            row.append(i)
            column.append((j, j if k is None else k))
            value.append((matrix[i, j], 0.0 if k is None else matrix[i, k]))
    size = len(row)
    return kernel.Entries(
        np.array(row, dtype=np.int64), np.array(column, dtype=np.int64).reshape(size, 2),
        np.array(value, dtype=float).reshape(size, 2, 1))


def _wheel_columns(operator: kernel.Operator, nb: int, home: NDArray[np.int64]) -> kernel.Columns:
    """Columns of A^-1 for wheels that stand in lanes home or home + 1."""
    lanes = operator.pivot.shape[1]
    forces = [(k // nb, k % nb) for k in range(2 * nb + 2)]
    whole: dict[tuple[int, int], Array] = {}
    for first in np.unique(home):
        for ahead, dof in forces:
            lane = int(first) + ahead
            if (lane, dof) not in whole:
                column = np.zeros((nb + 2, lanes))
                column[dof, lane] = 1.0
                kernel.solve(operator, column)
                whole[lane, dof] = column[:nb]

    # The columns have died away within a few bays; how many, the slowest tells.
    distance = 0
    for (lane, _), rows in whole.items():
        strong = np.abs(rows) > NEGLIGIBLE * np.abs(rows).max(axis=1, keepdims=True)
        occupied = np.flatnonzero(strong.any(axis=0))
        distance = max(distance, int(np.abs(occupied - lane).max()))
    reach = min(lanes, VECTOR * math.ceil((2 * distance + 3) / VECTOR))
    first_lane = np.clip(home - distance, 0, lanes - reach)
    value = np.array([[whole[int(h) + ahead, dof][:, f:f + reach] for ahead, dof in forces]
                      for h, f in zip(home, first_lane, strict=True)])
    return kernel.Columns(home=home.astype(np.int64), first=first_lane.astype(np.int64),
                          value=np.ascontiguousarray(value))


def nodal_impulse_responses(bay: Bay, time_step: float, steps: int, reach: int,
                            dofs: Sequence[int] | None = None, margin: int | None = None,
                            beta: float = 0.25, gamma: float = 0.5) -> Array:
    """Answers of the track to unit nodal forces that last one time step, by the same recursion.

    h[s, r, reach + m, k] is the displacement [m/N] of degree of freedom dofs[r] in the m-th bay
    ahead of the force, k steps after a unit force on dofs[s] during one step (k = 0: at the end of
    that step).  Then u_n = sum_k h_k f_(n-k) is the full model's answer exactly, as long as the
    sum runs over all steps and nothing comes back from the ends of the window.

    Parameters
    ----------
    steps
        Length of the memory.
    reach
        Bays on either side of the force, m = -reach .. reach.
    dofs
        Degrees of freedom of a bay, all bay.dofs unless given.
    margin
        Bays beyond the reach at either end of the window; the full model's unless given.

    Returns
    -------
    ndarray
        (dofs, dofs, 2 reach + 1, steps).
    """
    margin = default_margin(bay) if margin is None else margin
    chosen = np.arange(bay.dofs) if dofs is None else np.asarray(dofs, dtype=np.int64)
    operator = make_operator(bay, 2 * (reach + margin) + 1, time_step, beta, gamma)
    out = np.zeros((chosen.size, chosen.size, 2 * reach + 1, steps))
    for s, dof in enumerate(chosen):
        kernel.impulse_response(operator, int(dof), reach + margin, margin,
                                chosen.astype(np.int64), time_step, beta, gamma, out[s])
    return out
