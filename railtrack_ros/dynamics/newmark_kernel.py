"""Compiled time step of the full model on a window of bays of one pattern.

Every state array is stored as [degree of freedom in the bay][bay], bays contiguous and padded to
whole vector registers, so that each operation runs over all bays at once.  A bay's matrices act on
its own degrees of freedom followed by the next bay's left node: rows nb and nb + 1 of an array are
that node's values, fetched from the neighbouring lane before a product and added back after it.

The outermost nodes of the window are clamped; the right one lies in the first lane of padding,
which is zero throughout.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.compiled import njit
from railtrack_ros.dynamics.contact import contact_step
from railtrack_ros.dynamics.interpolation import ShapeTable, cubic, interval_at
from railtrack_ros.dynamics.support_forces import (
    MOST_ITERATIONS,
    SupportForces,
    add_forces,
    predict_supports,
    update_forces,
)

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

FINISHED, MOVED, CONTACT_FAILED, SUPPORT_FAILED, DIVERGED = range(5)


class Entries(NamedTuple):
    """Non-zero entries of the bay matrices, two of a row at a time.

    value (n, 2, lanes) at row (n,) and column (n, 2), or (n, 2, 1) where all bays are alike; an
    odd row ends with a zero.
    """

    row: Indices
    column: Indices
    value: Array


class Operator(NamedTuple):
    """The window's matrices, ready for time steps.

    C v + K u is computed as K (u + lag v) + (C - lag K) v, where the second matrix is nearly empty
    if most of C is proportional to K: stiffness is -K, damping -(C - lag K).

    forward, pivot, backward: partial L D L^T of A = M + gamma dt C + beta dt^2 K of a bay, interior
    degrees of freedom first: minus L by rows in the order of elimination, 1 / D (nb + 2, lanes) of
    the interior rows 2 .. nb - 1, and minus L^T in the reverse order.  below, diagonal, above
    (bays + 1, 2, 2): block elimination of the left nodes that remain.
    """

    bays: int
    lag: float
    stiffness: Entries
    damping: Entries
    forward: Entries
    pivot: Array
    backward: Entries
    below: Array
    diagonal: Array
    above: Array


class Columns(NamedTuple):
    """Columns of A^-1 for the nodal forces that a wheel can exert.

    home (wheels,): the first of the two lanes in which a wheel can stand.  first (wheels,): lane
    of the columns' first entry.  value (wheels, 2 nb + 2, nb, reach): column of each degree of
    freedom of the two lanes and of the left node after them, cut off where it has died away.
    """

    home: Indices
    first: Indices
    value: Array


class Window(NamedTuple):
    """Everything that time steps need of the track around the vehicle.

    table: interpolations of all kinds of bays, arrays with a first axis of kinds; kind (lanes,)
    that of each bay; supports: non-linear forces of pads and ballast.
    """

    operator: Operator
    columns: Columns
    table: ShapeTable
    kind: Indices
    supports: SupportForces


@njit(cache=True, fastmath={'contract'}, nogil=True)
def multiply_add(entries, x, y):
    """y += matrix x over all lanes, rows in the order of the entries; x may be y."""
    lanes = x.shape[1]
    if entries.value.shape[2] == 1:
        for n in range(entries.row.size):
            i = entries.row[n]
            j, k = entries.column[n]
            p, q = entries.value[n, 0, 0], entries.value[n, 1, 0]
            for b in range(lanes):
                y[i, b] += p * x[j, b] + q * x[k, b]
    else:
        for n in range(entries.row.size):
            i = entries.row[n]
            j, k = entries.column[n]
            for b in range(lanes):
                y[i, b] += entries.value[n, 0, b] * x[j, b] + entries.value[n, 1, b] * x[k, b]


@njit(cache=True, fastmath={'contract'}, nogil=True)
def fetch_next(x, nb):
    """Copy the left nodes of the following bays into rows nb, nb + 1."""
    lanes = x.shape[1]
    for i in range(2):
        for b in range(lanes - 1):
            x[nb + i, b] = x[i, b + 1]


@njit(cache=True, fastmath={'contract'}, nogil=True)
def solve(op, r):
    """Replace r (nb + 2, lanes) by A^-1 r; rows nb, nb + 1 act on the next bay's left node."""
    nb = r.shape[0] - 2
    lanes = r.shape[1]
    # Interior degrees of freedom of all bays at once.
    multiply_add(op.forward, r, r)
    for i in range(2):
        for b in range(lanes - 1):
            r[i, b + 1] += r[nb + i, b]
    # Left nodes, block by block; the outermost are clamped.
    r[0, 0] = r[1, 0] = 0.0
    x0 = x1 = 0.0
    for b in range(1, op.bays):
        m = op.below[b]
        x0, x1 = (r[0, b] - m[0, 0] * x0 - m[0, 1] * x1, r[1, b] - m[1, 0] * x0 - m[1, 1] * x1)
        r[0, b], r[1, b] = x0, x1
    r[0, op.bays] = r[1, op.bays] = 0.0
    x0 = x1 = 0.0
    for b in range(op.bays - 1, 0, -1):
        d, m = op.diagonal[b], op.above[b]
        z0 = d[0, 0] * r[0, b] + d[0, 1] * r[1, b]
        z1 = d[1, 0] * r[0, b] + d[1, 1] * r[1, b]
        x0, x1 = z0 - m[0, 0] * x0 - m[0, 1] * x1, z1 - m[1, 0] * x0 - m[1, 1] * x1
        r[0, b], r[1, b] = x0, x1
    # Back to the interior.
    fetch_next(r, nb)
    for i in range(2, nb):
        for b in range(lanes):
            r[i, b] *= op.pivot[i, b]
    multiply_add(op.backward, r, r)


@njit(cache=True, fastmath={'contract'}, nogil=True)
def predict(op, u, v, a, ahead, dt, beta, gamma):
    """Newmark's prediction of u, v; a becomes the force -C v - K u that it leaves.

    ahead is scratch of the same shape (nb + 2, lanes).
    """
    nb = u.shape[0] - 2
    lanes = u.shape[1]
    for i in range(nb):
        for b in range(lanes):
            u[i, b] += dt * v[i, b] + (0.5 - beta) * dt * dt * a[i, b]
            v[i, b] += (1.0 - gamma) * dt * a[i, b]
            ahead[i, b] = u[i, b] + op.lag * v[i, b]
    fetch_next(ahead, nb)
    fetch_next(v, nb)
    a[:] = 0.0
    multiply_add(op.stiffness, ahead, a)
    multiply_add(op.damping, v, a)


@njit(cache=True, fastmath={'contract'}, nogil=True)
def correct(u, v, a, dt, beta, gamma):
    """Add the new accelerations to the predicted u, v."""
    for i in range(u.shape[0] - 2):
        for b in range(u.shape[1]):
            u[i, b] += beta * dt * dt * a[i, b]
            v[i, b] += gamma * dt * a[i, b]


@njit(cache=True, nogil=True)
def shift(x, bays, by):
    """Move the window by `by` bays along the track: what leaves is lost, zeros enter."""
    lanes = x.shape[1]
    for i in range(x.shape[0]):
        for k in range(lanes):
            to = k if by > 0 else lanes - 1 - k
            x[i, to] = x[i, to + by] if 0 <= to + by < bays else 0.0


@njit(cache=True, nogil=True)
def move(u, v, a, forces, bays, by):
    """Move the window and all that it carries by `by` bays."""
    shift(forces, bays, by)
    for x in (u, v, a):
        shift(x, bays, by)
        x[0, 0] = x[1, 0] = x[0, bays] = x[1, bays] = 0.0


@njit(cache=True, nogil=True)
def eliminate(ends, bays, below, diagonal, above):
    """Block elimination of the left nodes 1 .. bays - 1 of a window.

    ends (lanes, 4, 4): what remains of each bay's A once its interior is eliminated, its left node
    before the next bay's.  Fills below, diagonal, above of :class:`Operator`.
    """
    below[:] = 0.0
    diagonal[:] = 0.0
    above[:] = 0.0
    for b in range(1, bays):
        before, here = ends[b - 1], ends[b]
        m = np.zeros((2, 2))
        for i in range(2):
            for j in range(2):
                for k in range(2):
                    below[b, i, j] += before[k, 2 + i] * diagonal[b - 1, k, j]
        for i in range(2):
            for j in range(2):
                m[i, j] = here[i, j] + before[2 + i, 2 + j]
                if b > 1:
                    for k in range(2):
                        m[i, j] -= below[b, i, k] * before[k, 2 + j]
        determinant = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
        diagonal[b, 0, 0], diagonal[b, 1, 1] = m[1, 1] / determinant, m[0, 0] / determinant
        diagonal[b, 0, 1], diagonal[b, 1, 0] = -m[0, 1] / determinant, -m[1, 0] / determinant
        if b < bays - 1:
            for i in range(2):
                for j in range(2):
                    for k in range(2):
                        above[b, i, j] += diagonal[b, i, k] * here[k, 2 + j]


@njit(cache=True, nogil=True)
def inverse_columns(op, lane, first, out):
    """Columns of A^-1 for the forces in lane, lane + 1 and the left node after, cut to `out`.

    out (2 nb + 2, nb, reach) from lane `first` on.
    """
    nb, reach = out.shape[1], out.shape[2]
    x = np.zeros_like(op.pivot)
    for k in range(out.shape[0]):
        x[:] = 0.0
        x[k % nb, lane + k // nb] = 1.0
        solve(op, x)
        for i in range(nb):
            for m in range(reach):
                out[k, i, m] = x[i, first + m]


@njit(cache=True, fastmath={'contract'}, nogil=True)
def free_deflections(u, a, lane, dofs, shape, factor, free):
    """Deflection (wheels,) at the wheels by the prediction u and the accelerations a."""
    nb = u.shape[0] - 2
    for w in range(free.size):
        free[w] = 0.0
        for k in range(dofs.shape[1]):
            d = dofs[w, k]
            i, b = (d, lane[w]) if d < nb else (d - nb, lane[w] + 1)
            free[w] += shape[w, k] * (u[i, b] + factor * a[i, b])


@njit(cache=True, fastmath={'contract'}, nogil=True)
def run(window, forces, constants, stay, home_bay, offsets, position, irregularity,
        u, v, a, wheels, force, deflection, displacement, acceleration, iterations):
    """Time steps to position[n] of the reference point with irregularity[n, w] at the wheels.

    The window's lane 0 is bay home_bay[0] - home_bay[1] of the track, home_bay[0] being the bay of
    the reference point and kept up to date; the window holds as it is while that bay lies in
    stay[0] .. stay[1].  u, v, a (nb + 2, lanes), wheels (rows, wheels) and forces (2, lanes), the
    supports' deviations from linear, are the state; force, deflection, displacement, acceleration
    (n, wheels) and iterations (n, 2), of the contacts and of the supports, are filled.  Returns
    the steps done and one of the states above.
    """
    op, columns, table, kind, supports = window
    dt, beta, gamma = constants.time_step, constants.beta, constants.gamma
    nb = u.shape[0] - 2
    count = offsets.size
    reach = columns.value.shape[3]
    width = table.dofs.shape[2]
    shape = np.zeros((count, width))
    dofs = np.zeros((count, width), np.int64)
    lane = np.zeros(count, np.int64)
    flexibility = np.zeros(count)
    column = np.zeros((count, nb * reach))
    free = np.zeros(count)
    compliance = np.zeros((count, count))
    work = np.zeros((count, count + 3))
    now = np.zeros(count)
    ahead = np.zeros_like(u)
    flat = columns.value.reshape((count, 2 * nb + 2, nb * reach))
    nonlinear = supports.row.size > 0
    enough = constants.tolerance * constants.static_load
    before = np.zeros_like(wheels)
    scratch = np.zeros((6, u.shape[1]))

    for n in range(position.size):
        bay = math.floor((position[n] - table.start) / table.spacing)
        if bay != home_bay[0]:
            if not stay[0] <= bay <= stay[1]:
                return n, MOVED
            move(u, v, a, forces, op.bays, bay - home_bay[0])
            home_bay[0] = bay
        predict(op, u, v, a, ahead, dt, beta, gamma)
        if nonlinear:
            add_forces(supports, forces, a)
        solve(op, a)

        # Where the wheels press, the free deflection there, and what a force there would do.
        for w in range(count):
            x = position[n] + offsets[w]
            number = math.floor((x - table.start) / table.spacing)
            inside = min(max(x - table.start - number * table.spacing, 0.0), table.spacing)
            lane[w] = int(number) - home_bay[0] + home_bay[1]
            # A wheel a whole number of bays from the reference point may be rounded out of its
            # two lanes, to a place that is the end of one of them.
            if lane[w] < columns.home[w]:
                lane[w], inside = columns.home[w], 0.0
            elif lane[w] > columns.home[w] + 1:
                lane[w], inside = columns.home[w] + 1, table.spacing
            t = kind[lane[w]]
            interval, s = interval_at(table.breaks[t], table.guess[t], table.spacing, inside)
            flexibility[w] = cubic(table.flexibility[t, interval], s)
            element = table.element[t, interval]
            first = (lane[w] - columns.home[w]) * nb
            for k in range(width):
                d = table.dofs[t, element, k]
                dofs[w, k] = d
                shape[w, k] = cubic(table.coefficients[t, interval, k], s)
                if k == 0:
                    for m in range(nb * reach):
                        column[w, m] = shape[w, k] * flat[w, first + d, m]
                else:
                    for m in range(nb * reach):
                        column[w, m] += shape[w, k] * flat[w, first + d, m]
        free_deflections(u, a, lane, dofs, shape, beta * dt * dt, free)
        for j in range(count):
            for i in range(count):
                compliance[i, j] = flexibility[i] if i == j else 0.0
                for k in range(width):
                    d = dofs[i, k]
                    r, b = (d, lane[i]) if d < nb else (d - nb, lane[i] + 1)
                    b -= columns.first[j]
                    if 0 <= b < reach:
                        compliance[i, j] += (beta * dt * dt * shape[i, k]
                                             * column[j, r * reach + b])
        if nonlinear:
            before[:] = wheels
            fetch_next(u, nb)
            predict_supports(supports, u, v, scratch)
        used = contact_step(free, compliance, irregularity[n], wheels, constants, now, work)
        if used < 0:
            return n, CONTACT_FAILED
        iterations[n, 0] = used
        # The forces of pads and ballast, corrected until they fit the motion that they cause.
        while nonlinear:
            iterations[n, 1] += 1
            left = update_forces(supports, op.bays, a, columns.first, column, now, dt, beta, gamma,
                                 enough, forces, scratch)
            if left <= enough:
                break
            if iterations[n, 1] == MOST_ITERATIONS or not math.isfinite(left):
                return n, SUPPORT_FAILED
            ahead[:] = 0.0
            add_forces(supports, scratch[4:6], ahead)
            solve(op, ahead)
            for i in range(nb + 2):
                for b in range(a.shape[1]):
                    a[i, b] += ahead[i, b]
            free_deflections(u, a, lane, dofs, shape, beta * dt * dt, free)
            wheels[:] = before
            used = contact_step(free, compliance, irregularity[n], wheels, constants, now, work)
            if used < 0:
                return n, CONTACT_FAILED
            iterations[n, 0] += used

        for w in range(count):
            if now[w] != 0.0:
                for i in range(nb):
                    for m in range(reach):
                        a[i, columns.first[w] + m] -= now[w] * column[w, i * reach + m]
        correct(u, v, a, dt, beta, gamma)
        for i in range(count):
            w_rail = free[i]
            for j in range(count):
                w_rail -= compliance[i, j] * now[j]
            if not math.isfinite(w_rail):
                return n, DIVERGED
            force[n, i] = now[i]
            deflection[n, i] = w_rail
            displacement[n, i] = wheels[0, i]
            acceleration[n, i] = wheels[2, i]
    return position.size, FINISHED


@njit(cache=True, fastmath={'contract'}, nogil=True)
def impulse_response(op, dof, lane, first, rows, dt, beta, gamma, out):
    """Answer of the window to a unit nodal force at (dof, lane) that lasts one time step.

    out (rows, bays, steps) receives the displacements of degrees of freedom rows (n,) in lanes
    first, first + 1, ... after each step, that of the force itself included.
    """
    u = np.zeros_like(op.pivot)
    v = np.zeros_like(op.pivot)
    a = np.zeros_like(op.pivot)
    ahead = np.zeros_like(op.pivot)
    for step in range(out.shape[2]):
        if step == 0:
            a[dof, lane] = 1.0
            solve(op, a)
        else:
            predict(op, u, v, a, ahead, dt, beta, gamma)
            solve(op, a)
        correct(u, v, a, dt, beta, gamma)
        for k in range(rows.size):
            for b in range(out.shape[1]):
                out[k, b, step] = u[rows[k], first + b]
