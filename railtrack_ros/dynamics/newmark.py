"""The full model: Newmark integration of the finite-element track under moving wheels.

    M u'' + C u' + K u = sum_i N(x_i) f_i                                  (thesis 2.3)

On a periodic track the matrix A = M + gamma dt C + beta dt^2 K never changes.  It is factorised
once; a wheel's contact force is a rank-one correction by known columns of A^-1, so the non-linear
problem of a time step has one unknown per wheel (dynamics.contact) and is solved with the exact
Jacobian.  The window of bays travels with the wheels by whole bays (dynamics.window): a run has no
end and its memory does not grow.  Non-linear pads and ballast act as forces on the right-hand side
(dynamics.support_forces).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from numpy.typing import NDArray

from railtrack_ros.dynamics import newmark_kernel as kernel
from railtrack_ros.dynamics.contact import wheel_constants
from railtrack_ros.dynamics.forward import ForwardResult, ForwardSolver, check_setup
from railtrack_ros.dynamics.modes import ring_length
from railtrack_ros.dynamics.support_forces import static_deviation
from railtrack_ros.dynamics.window import TravellingWindow, assemble, make_operator
from railtrack_ros.errors import InputError
from railtrack_ros.track.bay import Bay
from railtrack_ros.track.row import BayRow
from railtrack_ros.vehicle.description import Vehicle

Array = NDArray[np.float64]

__all__ = ['FullModel', 'assemble', 'default_margin', 'nodal_impulse_responses']

LONGEST_MOVE = 0.25  # bays in one time step

# Bays on either side of the outermost wheels.  Measured on ISO 3095 roughness at 40 m/s against a
# window without reflections: 40 bays leave at most 0.03 % of the static load in the contact force
# with the shipped tracks.  A rail without loss on point supports hardly damps its pinned-pinned
# wave, which takes 90 for 0.05 %.  Layers of growing damping at the ends were tried and gained
# less than a few more bays: near the pinned-pinned frequency the group velocity vanishes, and any
# change of the track reflects.  Where waves run further the window goes as far as the slowest to
# decay takes to the end and back.
MARGIN = 40
UNDAMPED_MARGIN = 90
UNDAMPED = 0.005  # rail loss factor below which the latter applies

MOST_STATIC_ITERATIONS = 100

FAILURES = {kernel.CONTACT_FAILED: 'the contact forces did not converge',
            kernel.SUPPORT_FAILED: 'the forces of the supports did not converge',
            kernel.DIVERGED: 'the solution diverged'}


class FullModel(ForwardSolver):
    """Wheels of one rail on the finite-element track, step by step.

    Parameters
    ----------
    track
        A periodic linear track's bay (track.bay.make_bay), or the row of bays of any track
        (track.row.BayRow).
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
        Relative change of an indentation at which the iteration stops, and the share of the
        static load to which forces of non-linear supports fit.
    iteration
        'newton' with the exact Jacobian, or 'fixed' with the constant matrix, see
        dynamics.contact.wheel_constants.

    Attributes
    ----------
    steps, iterations, most_iterations
        Time steps so far, iterations of their contacts, and the most in one of them.
    support_iterations, most_support_iterations
        The same of non-linear supports, each with contacts of its own.

    Raises
    ------
    InputError
        A set-up that cannot run.
    """

    name = 'full model'

    def __init__(self, track: Bay | BayRow, vehicle: Vehicle, offsets: Sequence[float] | Array,
                 time_step: float, start_position: float, margin: int | None = None,
                 beta: float = 0.25, gamma: float = 0.5, tolerance: float = 1e-10,
                 iteration: str = 'newton') -> None:
        offsets = check_setup(offsets, time_step)
        if not (0.5 <= gamma <= 1.0 and 0.25 * (gamma + 0.5) ** 2 - 1e-12 <= beta <= 1.0):
            raise InputError(f'Newmark: beta {beta:g}, gamma {gamma:g} are not unconditionally '
                             'stable: expected gamma >= 1/2 and beta >= (gamma + 1/2)^2 / 4')
        row = track if isinstance(track, BayRow) else BayRow.periodic(track)
        margin = default_margin(row.bay) if margin is None else margin
        if margin < 2:
            raise InputError(f'margin: {margin} bays are too few, at least 2 are needed')
        self.row, self.bay = row, row.bay
        super().__init__(
            wheel_constants(vehicle, time_step, beta, gamma, tolerance, iteration), offsets,
            start_position, LONGEST_MOVE * self.bay.spacing)
        self.most_iterations = 0
        self.support_iterations = self.most_support_iterations = 0

        # Lanes in which each wheel can stand while the reference point is inside its bay.
        behind = np.floor(self.offsets / self.bay.spacing).astype(np.int64)
        home = margin - min(0, int(behind.min()))
        self.bays = home + max(0, int(behind.max())) + 2 + margin
        number, _ = self.bay.locate(self.start_position)
        self._home = np.array([number[0], home], dtype=np.int64)
        self.window = TravellingWindow(row, self.bays, home, behind, int(number[0]) - home,
                                       self.time_step, beta, gamma)
        shape = self.window.compiled.operator.pivot.shape
        self._u, self._v, self._a = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        self._forces = np.zeros((2, shape[1]))

    def _march(self, position: Array, irregularity: Array, wheels: Array, out: ForwardResult
               ) -> tuple[int, str]:
        done = 0
        while True:
            rest = out.part(done, position.size)
            iterations = np.zeros((position.size - done, 2), dtype=np.int64)
            more, status = kernel.run(
                self.window.compiled, self._forces, self.constants, self.window.stay, self._home,
                self.offsets, position[done:], irregularity[done:], self._u, self._v, self._a,
                wheels, *rest.arrays(), iterations)
            done += more
            total, most = iterations.sum(axis=0), iterations.max(axis=0, initial=0)
            self.iterations += int(total[0])
            self.support_iterations += int(total[1])
            self.most_iterations = max(self.most_iterations, int(most[0]))
            self.most_support_iterations = max(self.most_support_iterations, int(most[1]))
            if status != kernel.MOVED:
                return done, FAILURES.get(status, '')
            self._move_to(position[done])

    def _move_to(self, position: float) -> None:
        """Bring the window along, where it comes to another sequence of bays."""
        number, _ = self.bay.locate(position)
        kernel.move(self._u, self._v, self._a, self._forces, self.bays,
                    int(number[0] - self._home[0]))
        self._home[0] = number[0]
        self.window.place(self.first_bay)

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

    def _stand(self, position: Array) -> Array:
        nb = self.bay.dofs
        number, inside = self.bay.locate(position[0] + self.offsets)
        lane = number - self.first_bay
        own = self.row.kind(self.first_bay, self.bays)
        standing = [self.row.kinds[own[k]] for k in lane]
        shape = np.array([bay.shape(x)[0] for bay, x in zip(standing, inside, strict=True)])
        flexibility = np.array([bay.flexibility(x)[0]
                                for bay, x in zip(standing, inside, strict=True)])
        load = np.zeros((self.bays + 1) * nb)
        places = lane[:, None] * nb + np.arange(nb + 2)
        np.add.at(load, places, -self.constants.static_load * shape)
        u = self._static(assemble([self.row.kinds[k].stiffness for k in own], self.bays), load)
        self._u[:nb, :self.bays] = u[:self.bays * nb].reshape(self.bays, nb).T
        deflection: Array = (shape * u[places]).sum(axis=1)
        return deflection - flexibility * self.constants.static_load

    def _static(self, stiffness: scipy.sparse.csc_matrix, load: Array) -> Array:
        """Displacements ((bays + 1) nb,) under a static load, by Newton's method."""
        nb, supports = self.bay.dofs, self.window.compiled.supports
        free = slice(2, self.bays * nb)  # the outermost nodes are clamped
        u = np.zeros_like(load)
        u[free] = scipy.sparse.linalg.spsolve(stiffness[free, free], load[free])
        if supports.row.size == 0:
            return u
        bays = np.arange(self.bays)
        rows = nb * bays[:, None] + supports.row
        sleeper = nb * bays + supports.sleeper[:self.bays]
        weight = supports.weight[:, :self.bays].T
        compression = scipy.sparse.csr_matrix(
            (weight.ravel(), (np.repeat(bays, rows.shape[1]), rows.ravel())),
            shape=(self.bays, u.size))
        def residual(u: Array) -> tuple[Array, Array]:
            laws = np.array([static_deviation(supports, b, e, w) for b, e, w in
                             zip(bays, compression @ u, u[sleeper], strict=True)]).T
            left = load - stiffness @ u - compression.T @ laws[0]
            left[sleeper] += laws[2]
            return np.append(0.0 * left[:2], left[free]), laws

        left, laws = residual(u)
        for _ in range(MOST_STATIC_ITERATIONS):
            released = np.zeros_like(u)
            released[sleeper] = laws[3]
            tangent = (stiffness + compression.T @ scipy.sparse.diags(laws[1]) @ compression
                       - scipy.sparse.diags(released)).tocsc()
            change = np.zeros_like(u)
            change[free] = scipy.sparse.linalg.spsolve(tangent[free, free], left[2:])
            # The energy is convex: go back until its slope along the change has fallen.
            slope, share = left @ change[:left.size], 1.0
            left, laws = residual(u + change)
            while abs(left @ change[:left.size]) > 0.9 * slope and share > 1e-6:
                share *= 0.5
                left, laws = residual(u + share * change)
            u = u + share * change
            if np.abs(left).max() <= 1e-10 * self.constants.static_load:
                self._forces[0, :self.bays], self._forces[1, :self.bays] = laws[0], laws[2]
                return u
        raise InputError('full model: no static equilibrium of the non-linear supports under the '
                         f'wheels at {self.start_position:g} m')


def default_margin(bay: Bay) -> int:
    """Bays beyond the outermost wheels that keep the ends' reflections out of the forces."""
    if bay.track.rail.loss_factor < UNDAMPED:
        return UNDAMPED_MARGIN
    return max(MARGIN, ring_length(bay, [0.0]) // 2)


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
