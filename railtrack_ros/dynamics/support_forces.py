"""Forces of pads and ballast that are not proportional to displacements.

The full model's matrix holds every support with its tangent at rest and stays constant.  What a
support's force differs from that linear one is a local force on the right-hand side:

    pad:      h(e) = P(d0 + e) - P(d0) - Kp e ,   P(d) = k1 d + k3 d^3 for d > 0, else 0,
              e = w_sleeper - w_rail   (mean over the pad: compression beyond that by the preload)
    ballast:  s(q) = max(0, B - q) - max(0, B) + q ,   q = Kb w_sleeper + Cb w_sleeper'

with P(d0) the fastening's preload, P'(d0) = Kp the pad stiffness, and B the dead weight on the
ballast, or -Kb times the gap under a hanging sleeper.  Pads push rail and sleeper apart by -B^T h,
ballast pushes the sleeper by s.  A time step finds them by Newton's method with the exact
derivative of the bay's own forces; the weak coupling between bays and with the contacts is left
to the repetition, until every force fits the motion that it causes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.compiled import njit
from railtrack_ros.track.bay import Bay
from railtrack_ros.track.description import Support

Array = NDArray[np.float64]

MOST_ITERATIONS = 100
GAUSS = (0.5 - 0.5 / 3.0**0.5, 0.5 + 0.5 / 3.0**0.5)  # exact for cubics


class SupportForces(NamedTuple):
    """Non-linear supports of a row of bays, or of all kinds of bays; empty rows if there are none.

    row (k,), weight (k, lanes): pad compression e as a sum over degrees of freedom 0 .. nb + 1.
    sleeper (lanes,): the sleeper's.  pad (5, lanes): Kp, k1, k3, d0, preload.  ballast (3, lanes):
    Kb, Cb, B.  own (4, lanes): e and q by a unit pad force, then by a unit ballast force, of the
    bay itself within one time step.
    """

    row: NDArray[np.int64]
    weight: Array
    sleeper: NDArray[np.int64]
    pad: Array
    ballast: Array
    own: Array


def pad_compression(bay: Bay) -> Array:
    """Weights (nb + 2,) of the degrees of freedom in e, the pad's mean compression by nodes."""
    support = bay.track.support
    centre = -bay.start
    if support.kind == 'distributed':
        half = 0.5 * support.pad_length
        breaks = bay.table.breaks
        inside = (breaks[:-1] > centre - half - 1e-9) & (breaks[1:] < centre + half + 1e-9)
        low, length = breaks[:-1][inside], np.diff(breaks)[inside]
        mean = sum((0.5 * length / support.pad_length) @ bay.shape(low + at * length)
                   for at in GAUSS)
    else:
        # The rail's own displacements, where the pad's springs take hold of it.
        size = bay.dofs + 2
        mean = np.zeros(size)
        nodes = np.flatnonzero(np.abs(bay.nodes - centre) < (
            1e-9 if support.kind != 'multipoint' else 0.5 * support.pad_length + 1e-9))
        for node in nodes:
            edge = nodes.size > 1 and node in (nodes[0], nodes[-1])
            mean[bay.node_dofs[node]] = (0.5 if edge else 1.0) / max(1, nodes.size - 1)
    row = -np.asarray(mean)
    row[bay.sleeper_dof] += 1.0
    row[np.abs(row) < 1e-14] = 0.0
    return row


def pad_law(support: Support) -> Array:
    """Kp, k1, k3, d0 and preload (5,) of a progressive pad; zeros of a linear one.

    From P(d0) = preload and P'(d0) = Kp: d0 = 3 preload / (2 k1 + Kp), k3 = (Kp - k1) / (3 d0^2).
    """
    law = support.pad_nonlinearity
    if law is None:
        return np.zeros(5)
    stiffness, k1 = support.pad_stiffness, law.unloaded_stiffness
    d0 = 3.0 * law.preload / (2.0 * k1 + stiffness)
    return np.array([stiffness, k1, (stiffness - k1) / (3.0 * d0**2), d0, law.preload])


def ballast_law(support: Support) -> Array:
    """Kb, Cb and B (3,) of ballast that lets the sleeper lift off; zeros of any other."""
    law = support.ballast_lift_off
    if law is None:
        return np.zeros(3)
    stiffness = support.ballast_stiffness
    return np.array([stiffness, support.ballast_damping, law.preload - stiffness * law.gap])


def support_forces(kinds: Sequence[Bay]) -> SupportForces:
    """Laws of all kinds of bays, lane by kind; `own` is left zero for the caller to fill."""
    count = len(kinds)
    if all(bay.track.support.linear for bay in kinds):
        nothing = np.zeros((0, count))
        return SupportForces(np.zeros(0, np.int64), nothing, np.zeros(count, np.int64), nothing,
                             nothing, nothing)
    weights = np.array([pad_compression(bay) for bay in kinds])
    row = np.flatnonzero((weights != 0.0).any(axis=0))
    return SupportForces(
        row=row.astype(np.int64), weight=np.ascontiguousarray(weights[:, row].T),
        sleeper=np.array([bay.sleeper_dof for bay in kinds], dtype=np.int64),
        pad=np.array([pad_law(bay.track.support) for bay in kinds]).T.copy(),
        ballast=np.array([ballast_law(bay.track.support) for bay in kinds]).T.copy(),
        own=np.zeros((4, count)))


def spread(forces: SupportForces, kind: NDArray[np.int64], lanes: int) -> SupportForces:
    """Laws by kind laid out over the bays of a window (bays,); linear in the lanes beyond."""
    if forces.row.size == 0:
        return forces
    bays = kind.size

    def over(values: Array) -> Array:
        out = np.zeros((len(values), lanes))
        out[:, :bays] = values[:, kind]
        return out

    sleeper = np.zeros(lanes, dtype=np.int64)
    sleeper[:bays] = forces.sleeper[kind]
    return SupportForces(forces.row, over(forces.weight), sleeper, over(forces.pad),
                         over(forces.ballast), over(forces.own))


@njit(cache=True, nogil=True, inline='always')
def pad_deviation(pad, b, e):
    """h(e) and its derivative."""
    d = pad[3, b] + e
    if d > 0.0:
        return ((pad[1, b] + pad[2, b] * d * d) * d - pad[4, b] - pad[0, b] * e,
                pad[1, b] + 3.0 * pad[2, b] * d * d - pad[0, b])
    return -pad[4, b] - pad[0, b] * e, -pad[0, b]


@njit(cache=True, nogil=True, inline='always')
def ballast_deviation(ballast, b, q):
    """s(q) and its derivative."""
    rest = ballast[2, b]
    if q > rest:
        return q - max(0.0, rest), 1.0
    return rest - max(0.0, rest), 0.0


@njit(cache=True, nogil=True)
def static_deviation(forces, b, e, w):
    """h(e), h'(e), s and its derivative by the sleeper's displacement w, of bay b at rest."""
    h, slope = pad_deviation(forces.pad, b, e)
    s, lifted = ballast_deviation(forces.ballast, b, forces.ballast[0, b] * w)
    return h, slope, s, lifted * forces.ballast[0, b]


@njit(cache=True, nogil=True)
def add_forces(forces, r, x):
    """Add pad forces r[0] and ballast forces r[1] (lanes,) to nodal forces x (nb + 2, lanes)."""
    lanes = x.shape[1]
    for k in range(forces.row.size):
        i = forces.row[k]
        for b in range(lanes):
            x[i, b] -= forces.weight[k, b] * r[0, b]
    for b in range(lanes):
        x[forces.sleeper[b], b] += r[1, b]


@njit(cache=True, nogil=True)
def predict_supports(forces, u, v, scratch):
    """Compression e and ballast term q by the predicted u, v, into scratch rows 0 and 1."""
    lanes = u.shape[1]
    scratch[0] = 0.0
    for k in range(forces.row.size):
        i = forces.row[k]
        for b in range(lanes):
            scratch[0, b] += forces.weight[k, b] * u[i, b]
    for b in range(lanes):
        i = forces.sleeper[b]
        scratch[1, b] = forces.ballast[0, b] * u[i, b] + forces.ballast[1, b] * v[i, b]


@njit(cache=True, nogil=True)
def update_forces(forces, bays, a, first, column, now, dt, beta, gamma, enough, r, scratch):
    """One Newton step of all supports: r (2, lanes) += scratch[4:6].

    a: accelerations without the contact forces `now` of this step, whose columns are taken off
    here.  Returns the largest force [N] that does not fit yet; r stays if that is `enough`.
    """
    nb, lanes = a.shape[0] - 2, a.shape[1]
    reach = column.shape[1] // nb
    e, q = scratch[2], scratch[3]
    e[:] = 0.0
    for k in range(forces.row.size):
        i = forces.row[k]
        for b in range(lanes):
            e[b] += forces.weight[k, b] * a[i, b]
    for b in range(lanes):
        q[b] = a[forces.sleeper[b], b]
    for w in range(now.size):
        if now[w] != 0.0:
            for m in range(reach):
                b = first[w] + m
                for k in range(forces.row.size):
                    i, after = forces.row[k], m
                    if i >= nb:
                        i, after = i - nb, m + 1
                    if after < reach:
                        e[b] -= now[w] * forces.weight[k, b] * column[w, i * reach + after]
                q[b] -= now[w] * column[w, forces.sleeper[b] * reach + m]
    largest = 0.0
    for b in range(bays):
        e[b] = scratch[0, b] + beta * dt * dt * e[b]
        q[b] = scratch[1, b] + (beta * dt * dt * forces.ballast[0, b]
                                + gamma * dt * forces.ballast[1, b]) * q[b]
        h, h_slope = pad_deviation(forces.pad, b, e[b])
        s, s_slope = ballast_deviation(forces.ballast, b, q[b])
        x, y = h - r[0, b], s - r[1, b]
        if not (abs(x) <= largest and abs(y) <= largest):
            largest = max(largest, abs(x), abs(y))
            if not largest < np.inf:
                return np.inf
        m00, m01 = 1.0 - h_slope * forces.own[0, b], -h_slope * forces.own[2, b]
        m10, m11 = -s_slope * forces.own[1, b], 1.0 - s_slope * forces.own[3, b]
        determinant = m00 * m11 - m01 * m10
        scratch[4, b] = (m11 * x - m01 * y) / determinant
        scratch[5, b] = (m00 * y - m10 * x) / determinant
    if largest > enough:
        for b in range(bays):
            r[0, b] += scratch[4, b]
            r[1, b] += scratch[5, b]
    return largest
