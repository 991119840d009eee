"""The recursion over the modes of the ring: coefficients, tables and compiled loops.

With upward forces f_w at x_w the modes of `dynamics.modes` obey s' = lambda s + sum_w g(x_w) f_w,
and the rail moves by w(x) = Re sum g(x) s.  Over a time step

    s_1 = e s_0 + p0 u_0 + p1 u_1,    u = sum_w g(x_w) f_w.

What the past leaves behind, e s + p0 u, is all that need be remembered.  Divided by the square
root of p0 + e p1, and the shapes multiplied by it (written c below), it is r with

    r <- e r + sum_w f_w c(x_w),    w(x) = Re sum c(x) (r + k sum_w f_w c(x_w)),
    k = p1 / (p0 + e p1),

r without the present forces: one complex product per mode and one shape for all.

Holds, how the forces run within a time step:
trapezoidal: z = (1 + lambda dt / 2) / (1 - lambda dt / 2), repeats the Newmark scheme (1/4, 1/2);
linear: exact for forces that are linear within a step;
corrected: the same through points f - (second difference of f) / 12.  A line through samples of
a wave loses sinc^2(f dt) of it; this gives back all but the fourth power of (omega dt).  The force
of the present sample is taken as it is until its successor is known.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.compiled import njit
from railtrack_ros.dynamics.interpolation import ShapeTable, locate
from railtrack_ros.dynamics.modes import ComplexArray, TrackModes
from railtrack_ros.errors import InputError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

HOLDS = ('trapezoidal', 'linear', 'corrected')


class Step(NamedTuple):
    """Coefficients of a pole's recursion, (p,) each."""

    e: ComplexArray
    p0: ComplexArray
    p1: ComplexArray

    @property
    def gain(self) -> ComplexArray:
        """p0 + e p1, the share of a force in what it leaves behind."""
        return np.asarray(self.p0 + self.e * self.p1)

    @property
    def present(self) -> ComplexArray:
        """k, the share of the present force over `gain`."""
        return np.asarray(self.p1 / self.gain)


def step_of(poles: ComplexArray, time_step: float, hold: str) -> Step:
    """Coefficients for poles (p,) [1/s] and a time step [s]."""
    z: ComplexArray = poles * time_step
    if hold == 'trapezoidal':
        p: ComplexArray = 0.5 * time_step / (1.0 - 0.5 * z)
        return Step((1.0 + 0.5 * z) / (1.0 - 0.5 * z), p, p)
    if hold not in HOLDS:
        raise InputError(f'hold {hold!r}: expected one of ' + ', '.join(HOLDS))
    phi1 = np.expm1(z) / z
    # (phi1 - 1) / z loses digits for slow poles at short steps: series there.
    phi2: ComplexArray = np.where(
        np.abs(z) < 1e-2, 0.5 + z / 6 + z**2 / 24 + z**3 / 120 + z**4 / 720, (phi1 - 1.0) / z)
    return Step(np.exp(z), time_step * (phi1 - phi2), time_step * phi2)


class Model(NamedTuple):
    """What the loops know of the track at one time step; nothing of it changes.

    shape_re, shape_im (nb + 2, 2p): c at the degrees of freedom of bay 0, all g1 before all g2;
    cos, sin (bays, p): their turn in bay m.  e, k re and im (2p,).  Oscillators (2,) at every
    degree of freedom of an element for the poles that are not kept: oe (2,) and out
    (elements, 2, k, k).  present (m, 7): sum of present[i, n] s^n is what they and F(x) do at once
    in interval i.  remainder (bays, nb + 2, nb + 2): static, between wheels.
    corrected: whether the forces are.
    """

    shape_re: Array
    shape_im: Array
    cos: Array
    sin: Array
    e_re: Array
    e_im: Array
    k_re: Array
    k_im: Array
    oe_re: Array
    oe_im: Array
    out_re: Array
    out_im: Array
    present: Array
    remainder: Array
    corrected: bool


class State(NamedTuple):
    """What a run carries from step to step, for `wheels` wheels on each of `lines` rails.

    r (lines, 2p); oscillators o (lines, wheels, 2, k); the last samples: place (wheels,) [m] and
    force (lines, wheels, 2), newest first.  All else follows from them: source (wheels, k, 2p),
    shapes of the element at (bay, element) home (wheels, 2); weight (wheels, k) N(x);
    c (wheels, 2p).  The rest is scratch: the loops do not allocate.
    """

    r_re: Array
    r_im: Array
    o_re: Array
    o_im: Array
    place: Array
    force: Array
    source_re: Array
    source_im: Array
    home: Indices
    weight: Array
    c_re: Array
    c_im: Array
    spare_re: Array
    spare_im: Array
    d_re: Array
    d_im: Array
    last: Array
    free: Array
    present: Array


SAVED = ('r_re', 'r_im', 'o_re', 'o_im', 'place', 'force')


def make_model(modes: TrackModes, time_step: float, hold: str) -> Model:
    """Tables of the loops for a time step [s]; raises InputError for an unknown hold."""
    step = step_of(modes.poles, time_step, hold)
    width = -(-modes.poles.size // LINE) * LINE
    padding = width - modes.poles.size

    def pair(first: ComplexArray, second: ComplexArray) -> tuple[Array, Array]:
        fill = np.zeros((*first.shape[:-1], padding))
        return _padded(np.concatenate([first, fill, second], axis=-1), 2 * width)

    root = np.sqrt(step.gain)
    angle = np.outer(np.arange(modes.bays), np.append(modes.wave_number, np.zeros(padding)))
    table = modes.table
    o = step_of(modes.oscillators, time_step, hold)
    pairs = modes.amplitude[:, table.dofs[:, :, None], table.dofs[:, None, :]]
    out = np.moveaxis(o.gain[:, None, None, None] * pairs, 0, 1)
    at_once = np.tensordot(o.p1, pairs, 1).real[table.element]
    present = _products(table.coefficients, np.asarray(at_once, dtype=float))
    present[:, :4] += table.flexibility
    return Model(
        *pair(modes.first * root, modes.second * root), np.cos(angle), np.sin(angle),
        *pair(step.e, step.e), *pair(step.present, step.present), *_parts(o.e), *_parts(out),
        present, modes.remainder, hold == 'corrected')


def _products(cubics: Array, matrix: Array) -> Array:
    """Polynomials (m, 7) of N^T A N, cubics (m, k, 4) and A (m, k, k)."""
    square = np.einsum('mic,mij,mjd->mcd', cubics, matrix, cubics)
    result = np.zeros((len(square), 7))
    for c in range(4):
        result[..., c:c + 4] += square[..., c, :]
    return result


def _parts(x: ComplexArray) -> tuple[Array, Array]:
    return np.ascontiguousarray(x.real), np.ascontiguousarray(x.imag)


LINE = 8  # numbers in a cache line


def _zeros(*shape: int) -> Array:
    """Zeros at the beginning of a cache line: vectors that straddle lines cost twice."""
    room = np.zeros(math.prod(shape) + LINE)
    first = -(room.ctypes.data // room.itemsize) % LINE
    return room[first:first + math.prod(shape)].reshape(shape)


def _padded(x: ComplexArray, width: int) -> tuple[Array, Array]:
    """Real and imaginary part, their rows filled up with zeros and aligned."""
    parts = _zeros(*x.shape[:-1], width), _zeros(*x.shape[:-1], width)
    parts[0][..., :x.shape[-1]], parts[1][..., :x.shape[-1]] = x.real, x.imag
    return parts


def make_state(model: Model, table: ShapeTable, wheels: int, lines: int = 1) -> State:
    """The rail at rest and unloaded."""
    q, k = model.e_re.size, table.dofs.shape[1]
    return State(
        r_re=_zeros(lines, q), r_im=_zeros(lines, q),
        o_re=np.zeros((lines, wheels, 2, k)), o_im=np.zeros((lines, wheels, 2, k)),
        place=np.zeros(wheels), force=np.zeros((lines, wheels, 2)),
        source_re=_zeros(wheels, k, q), source_im=_zeros(wheels, k, q),
        home=np.full((wheels, 2), np.iinfo(np.int64).min), weight=np.zeros((wheels, k)),
        c_re=_zeros(wheels, q), c_im=_zeros(wheels, q),
        spare_re=np.zeros((2, k)), spare_im=np.zeros((2, k)),
        d_re=_zeros(lines, q), d_im=_zeros(lines, q), last=np.zeros((lines, wheels)),
        free=np.zeros((lines, wheels)), present=np.zeros(wheels))


def settle(model: Model, table: ShapeTable, state: State, position: Array, force: Array) -> None:
    """Let constant upward forces (lines, wheels) [N] at (wheels,) [m] have acted for ever."""
    state.place[:], state.force[:] = position, force[:, :, None]
    resume(model, table, state)
    drive = force @ (state.c_re + 1j * state.c_im)
    still = drive / (1.0 - (model.e_re + 1j * model.e_im))
    state.r_re[:], state.r_im[:] = still.real, still.imag
    still = ((force[:, :, None] * state.weight)[:, :, None, :]
             / (1.0 - (model.oe_re + 1j * model.oe_im))[:, None])
    state.o_re[:], state.o_im[:] = still.real, still.imag


@njit(cache=True, nogil=True)
def resume(model, table, state):
    """Find what follows from the wheels' last places."""
    for w in range(state.place.size):
        bay, interval, s = locate(table, state.place[w])
        enter(model, table, state, w, bay, table.element[interval])
        weigh(table.coefficients, interval, s, w, state.weight)
        combine(state.weight, state.source_re, w, state.c_re)
        combine(state.weight, state.source_im, w, state.c_im)


@njit(cache=True, nogil=True, _nrt=False)
def used(table, element, k):
    """Whether entry k is a degree of freedom; rows of fewer are filled up with zeros."""
    return k == 0 or table.dofs[element, k] != 0


@njit(cache=True, nogil=True, fastmath=True, _nrt=False)
def enter(model, table, state, wheel, bay, element):
    """Take over the shapes of the element which the wheel has come to, turned to its bay."""
    m, p = bay % model.cos.shape[0], model.cos.shape[1]
    before, width = state.home[wheel, 1], table.dofs.shape[1]
    ahead = (model.shape_re.shape[0] - 2) * (bay - state.home[wheel, 0])
    known = abs(bay - state.home[wheel, 0]) <= 1
    # Oscillators go on at the nodes that both elements share; the others are at rest there.
    for line in range(state.o_re.shape[0]):
        for n in range(2):
            for k in range(width):
                state.spare_re[n, k], state.spare_im[n, k] = 0.0, 0.0
                for j in range(width):
                    if (known and table.dofs[element, k] + ahead == table.dofs[before, j]
                            and used(table, element, k) and used(table, before, j)):
                        state.spare_re[n, k] = state.o_re[line, wheel, n, j]
                        state.spare_im[n, k] = state.o_im[line, wheel, n, j]
            for k in range(width):
                state.o_re[line, wheel, n, k] = state.spare_re[n, k]
                state.o_im[line, wheel, n, k] = state.spare_im[n, k]
    for k in range(width):
        dof = table.dofs[element, k]
        for n in range(p):
            cos, sin = model.cos[m, n], model.sin[m, n]
            first, second = model.shape_re[dof, n], model.shape_re[dof, n + p]
            state.source_re[wheel, k, n] = cos * first + sin * second
            state.source_re[wheel, k, n + p] = cos * second - sin * first
            first, second = model.shape_im[dof, n], model.shape_im[dof, n + p]
            state.source_im[wheel, k, n] = cos * first + sin * second
            state.source_im[wheel, k, n + p] = cos * second - sin * first
    state.home[wheel, 0] = bay
    state.home[wheel, 1] = element


# The loops over the modes: functions of plain arrays and an index, which the compiler turns into
# vector code and takes into its callers. (A tuple of arrays as an argument costs as much as the
# work itself.)


@njit(cache=True, nogil=True, fastmath=True, _nrt=False)
def combine(weight, source, wheel, out):
    """out[wheel, p] = sum_k weight[wheel, k] source[wheel, k, p]."""
    w0, w1, w2, w3 = weight[wheel, 0], weight[wheel, 1], weight[wheel, 2], weight[wheel, 3]
    for p in range(out.shape[1]):
        out[wheel, p] = (w0 * source[wheel, 0, p] + w1 * source[wheel, 1, p]
                         + w2 * source[wheel, 2, p] + w3 * source[wheel, 3, p])
    for k in range(4, weight.shape[1]):
        w = weight[wheel, k]
        if w != 0.0:
            for p in range(out.shape[1]):
                out[wheel, p] += w * source[wheel, k, p]


@njit(cache=True, nogil=True, fastmath=True, _nrt=False)
def add(factor, x, wheel, line, out):
    """out[line] += factor x[wheel]."""
    for p in range(out.shape[1]):
        out[line, p] += factor * x[wheel, p]


@njit(cache=True, nogil=True, fastmath=True, _nrt=False)
def turn(e_re, e_im, line, r_re, r_im):
    """r[line] <- e r[line], complex."""
    for p in range(e_re.size):
        re, im = r_re[line, p], r_im[line, p]
        r_re[line, p] = e_re[p] * re - e_im[p] * im
        r_im[line, p] = e_re[p] * im + e_im[p] * re


@njit(cache=True, nogil=True, fastmath=True, _nrt=False)
def dot(a_re, a_im, wheel, line, b_re, b_im):
    """Re sum a[wheel] b[line], complex."""
    total = 0.0
    for p in range(b_re.shape[1]):
        total += a_re[wheel, p] * b_re[line, p] - a_im[wheel, p] * b_im[line, p]
    return total


@njit(cache=True, nogil=True, fastmath=True, _nrt=False)
def oscillate(e_re, e_im, factor, weight, wheel, line, o_re, o_im):
    """One step of the oscillators under a wheel: o <- e o + factor weight."""
    for n in range(e_re.size):
        for k in range(weight.shape[1]):
            re, im = o_re[line, wheel, n, k], o_im[line, wheel, n, k]
            o_re[line, wheel, n, k] = e_re[n] * re - e_im[n] * im + factor * weight[wheel, k]
            o_im[line, wheel, n, k] = e_re[n] * im + e_im[n] * re


@njit(cache=True, nogil=True, fastmath=True, _nrt=False)
def read_oscillators(out_re, out_im, element, weight, wheel, line, o_re, o_im):
    """Deflection [m] of the oscillators under a wheel."""
    total = 0.0
    for n in range(out_re.shape[1]):
        for j in range(weight.shape[1]):
            row = 0.0
            for k in range(weight.shape[1]):
                row += (out_re[element, n, j, k] * o_re[line, wheel, n, k]
                        - out_im[element, n, j, k] * o_im[line, wheel, n, k])
            total += weight[wheel, j] * row
    return total


@njit(cache=True, nogil=True, fastmath=True, _nrt=False)
def weigh(coefficients, interval, s, wheel, weight):
    """N(x) of a wheel."""
    for k in range(weight.shape[1]):
        weight[wheel, k] = (
            (coefficients[interval, k, 3] * s + coefficients[interval, k, 2]) * s
            + coefficients[interval, k, 1]) * s + coefficients[interval, k, 0]


@njit(cache=True, nogil=True, fastmath=True, _nrt=False)
def polynomial(c, row, s):
    """Sum of c[row, n] s^n over seven terms."""
    return (((((c[row, 6] * s + c[row, 5]) * s + c[row, 4]) * s + c[row, 3]) * s
             + c[row, 2]) * s + c[row, 1]) * s + c[row, 0]


@njit(cache=True, nogil=True, fastmath=True, _nrt=False)
def begin_step(model, table, state, last, place, free, present):
    """Put the wheels at their places and tell what the past has left there.

    last (lines, wheels): upward forces of the last sample [N]; place (wheels,): present
    positions [m].  Found: free (lines, wheels) deflection [m] without the present forces; present
    (wheels,) [m/N] what each force does at once at its own wheel apart from the kept modes.
    """
    lines, wheels = last.shape
    r_re, r_im, o_re, o_im = state.r_re, state.r_im, state.o_re, state.o_im
    c_re, c_im, weight, home = state.c_re, state.c_im, state.weight, state.home
    for n in range(lines):
        turn(model.e_re, model.e_im, n, r_re, r_im)
        for w in range(wheels):
            add(last[n, w], c_re, w, n, r_re)
            add(last[n, w], c_im, w, n, r_im)
            oscillate(model.oe_re, model.oe_im, last[n, w], weight, w, n, o_re, o_im)
    for w in range(wheels):
        bay, interval, s = locate(table, place[w])
        element = table.element[interval]
        if home[w, 0] != bay or home[w, 1] != element:
            enter(model, table, state, w, bay, element)
        weigh(table.coefficients, interval, s, w, weight)
        combine(weight, state.source_re, w, c_re)
        combine(weight, state.source_im, w, c_im)
        present[w] = polynomial(model.present, interval, s)
        for n in range(lines):
            free[n, w] = (dot(c_re, c_im, w, n, r_re, r_im)
                          + read_oscillators(model.out_re, model.out_im, element, weight, w, n,
                                             o_re, o_im))


@njit(cache=True, nogil=True, fastmath=True, _nrt=False)
def remainder_between(model, table, state, response, force):
    """Static flexibility [m/N] of the poles that are not kept, between two wheels."""
    apart = (state.home[response, 0] - state.home[force, 0]) % model.cos.shape[0]
    there, here = state.home[response, 1], state.home[force, 1]
    total = 0.0
    for i in range(table.dofs.shape[1]):
        part = 0.0
        for j in range(table.dofs.shape[1]):
            part += (model.remainder[apart, table.dofs[there, i], table.dofs[here, j]]
                     * state.weight[force, j])
        total += state.weight[response, i] * part
    return total


@njit(cache=True, nogil=True, fastmath=True, _nrt=False)
def advance(model, table, state, position, force, deflection):
    """Deflection (n, lines, wheels) under known upward forces (n, lines, wheels).

    Lines are rails that do not feel each other with wheels side by side at (n, wheels).
    """
    steps, lines, wheels = force.shape
    last, free, present = state.last, state.free, state.present
    for k in range(steps):
        for n in range(lines):
            for w in range(wheels):
                newest, earlier = state.force[n, w, 0], state.force[n, w, 1]
                last[n, w] = newest
                if model.corrected:
                    last[n, w] -= (force[k, n, w] - 2.0 * newest + earlier) / 12.0
                state.force[n, w, 1] = newest
                state.force[n, w, 0] = force[k, n, w]
        for w in range(wheels):
            state.place[w] = position[k, w]
        begin_step(model, table, state, last, state.place, free, present)
        for n in range(lines):
            for p in range(state.d_re.shape[1]):
                state.d_re[n, p] = 0.0
                state.d_im[n, p] = 0.0
            for w in range(wheels):
                add(force[k, n, w], state.c_re, w, n, state.d_re)
                add(force[k, n, w], state.c_im, w, n, state.d_im)
            turn(model.k_re, model.k_im, n, state.d_re, state.d_im)
            for w in range(wheels):
                deflection[k, n, w] = (
                    free[n, w] + present[w] * force[k, n, w]
                    + dot(state.c_re, state.c_im, w, n, state.d_re, state.d_im))
        for w in range(wheels):
            for v in range(w):
                between = remainder_between(model, table, state, w, v)
                for n in range(lines):
                    deflection[k, n, w] += between * force[k, n, v]
                    deflection[k, n, v] += between * force[k, n, w]
