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

The loops take the modes CHUNK by CHUNK, through a whole batch of samples where the forces are
known beforehand, so that what a chunk needs stays in the processor's nearest cache.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.compiled import njit
from railtrack_ros.dynamics.interpolation import ShapeTable, first_guess, interval_at, locate
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

    Modes are arranged in rows (..., chunks, modes), all g1 before all g2, filled up with zeros.
    breaks, guess: pieces of a bay, as in `interpolation.ShapeTable`.  first, second re and im
    (pieces, 4, ...): c in bay 0, cubics in s, and what the turn to another bay adds, cos(q m)
    first + sin(q m) second; cos, sin (bays, ...).  e re and im (...).
    Oscillators for the poles that are not kept, two at each of the k degrees of freedom of an
    element and filled up to l: oe (l,); out (m, 4, l), cubics of interval m of the bay, is their
    share in the deflection.  nodes: degrees of freedom of a bay.
    """

    breaks: Array
    guess: Indices
    first_re: Array
    first_im: Array
    second_re: Array
    second_im: Array
    cos: Array
    sin: Array
    e_re: Array
    e_im: Array
    oe_re: Array
    oe_im: Array
    out_re: Array
    out_im: Array
    nodes: int
    corrected: bool


class State(NamedTuple):
    """What a run carries from step to step, for `wheels` wheels on each of `lines` rails.

    r (lines, chunks, modes); oscillators o (lines, wheels, l); place of the reference point (1,)
    [m] and force (lines, wheels, 2) at the last samples, newest first.  All else follows from
    them: home (wheels, 3), bay, element and piece; source (wheels, 4, chunks, modes), the
    cubics there; c (wheels, chunks, modes); weight (wheels, k) N(x).
    The rest is scratch, for BATCH samples: the loops do not allocate.  fresh (BATCH, wheels, 2):
    bay and piece that a wheel comes to in a sample, or NOWHERE; local (BATCH, wheels): s;
    last (BATCH, lines, wheels): forces of the last sample as the hold takes them; free (BATCH,
    lines, wheels).
    """

    r_re: Array
    r_im: Array
    o_re: Array
    o_im: Array
    place: Array
    force: Array
    home: Indices
    source_re: Array
    source_im: Array
    c_re: Array
    c_im: Array
    spare_re: Array
    spare_im: Array
    weight: Array
    fresh: Indices
    local: Array
    last: Array
    free: Array


SAVED = ('r_re', 'r_im', 'o_re', 'o_im', 'place', 'force')

LINE = 64  # bytes in a cache line
CHUNK = 256  # modes worked off at a time, at most
BATCH = 128  # samples worked off at a time
NOWHERE = -2**40  # number of a bay far from any other
PIECES = 48  # of a bay, at least, in which the shape of a mode is a cubic
NODES = np.array([0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0])  # where these pass through it


def make_model(modes: TrackModes, time_step: float, hold: str) -> Model:
    """Tables of the loops for a time step [s]; raises InputError for an unknown hold."""
    step = step_of(modes.poles, time_step, hold)
    count = 2 * modes.poles.size
    chunks = -(-count // CHUNK)
    row = chunks, -(-count // (16 * chunks)) * 16

    def arranged(values: NDArray[Any]) -> Array:
        room = _zeros(*values.shape[:-1], *row)
        room.reshape(*values.shape[:-1], -1)[..., :count] = values
        return room

    def parts(values: ComplexArray) -> tuple[Array, Array]:
        return arranged(values.real), arranged(values.imag)

    root = np.sqrt(step.gain)
    angle = np.tile(np.outer(np.arange(modes.bays), modes.wave_number), 2)
    o = step_of(modes.oscillators, time_step, hold)
    dofs, cubics = modes.table.dofs, modes.table.coefficients
    elements, k = dofs.shape
    breaks = pieces(modes.table, PIECES)
    x = breaks[:-1, None] + NODES * np.diff(breaks)[:, None]
    fit = np.linalg.inv(NODES[:, None] ** np.arange(4))
    shape = fit @ modes.bay.shape(x.ravel()).reshape(*x.shape, -1)
    first, second = shape @ (modes.first * root), shape @ (modes.second * root)
    out = np.zeros((2, elements, k, -(-2 * k // 8) * 8))
    pairs = o.gain[:, None, None, None] * modes.amplitude[:, dofs[:, :, None], dofs[:, None, :]]
    oe = np.zeros((2, out.shape[-1]))
    for i in range(2):
        own = slice(i * k, (i + 1) * k)
        out[0, :, :, own], out[1, :, :, own] = pairs[i].real, pairs[i].imag
        oe[0, own], oe[1, own] = o.e[i].real, o.e[i].imag
    shares = np.ascontiguousarray(
        np.einsum('mjc,rmji->rmci', cubics, out[:, modes.table.element]))
    return Model(
        breaks, first_guess(breaks, modes.table.spacing), *parts(np.dstack([first, second])),
        *parts(np.dstack([second, -first])),
        arranged(np.cos(angle)), arranged(np.sin(angle)), *parts(np.tile(step.e, 2)),
        oe[0], oe[1], shares[0], shares[1], modes.bay.dofs,
        hold == 'corrected')


def pieces(table: ShapeTable, least: int) -> Array:
    """Breaks [m] of at least so many pieces of a bay: elements and equal parts of them."""
    ends = table.breaks[np.flatnonzero(np.diff(table.element, prepend=-1, append=-1))]
    parts = np.ceil(np.diff(ends) / table.spacing * least - 1e-6).astype(int)
    return np.concatenate([np.linspace(a, b, n, endpoint=False) for a, b, n in zip(
        ends[:-1], ends[1:], parts, strict=True)] + [ends[-1:]])


def _zeros(*shape: int, dtype: Any = np.float64) -> NDArray[Any]:
    """Zeros at the beginning of a cache line: vectors that straddle lines cost twice."""
    room = np.zeros(math.prod(shape) + LINE, dtype)
    first = -room.ctypes.data % LINE // room.itemsize
    return room[first:first + math.prod(shape)].reshape(shape)


def make_state(model: Model, table: ShapeTable, wheels: int, lines: int = 1) -> State:
    """The rail at rest and unloaded."""
    row, k, oscillators = model.e_re.shape, table.dofs.shape[1], model.oe_re.size
    return State(
        r_re=_zeros(lines, *row), r_im=_zeros(lines, *row),
        o_re=_zeros(lines, wheels, oscillators), o_im=_zeros(lines, wheels, oscillators),
        place=np.zeros(1), force=np.zeros((lines, wheels, 2)),
        home=np.full((wheels, 3), NOWHERE),
        source_re=_zeros(wheels, 4, *row), source_im=_zeros(wheels, 4, *row),
        c_re=_zeros(wheels, *row), c_im=_zeros(wheels, *row),
        spare_re=np.zeros(oscillators), spare_im=np.zeros(oscillators),
        weight=np.zeros((wheels, k)), fresh=np.full((BATCH, wheels, 2), NOWHERE),
        local=np.zeros((BATCH, wheels)), last=np.zeros((BATCH, lines, wheels)),
        free=np.zeros((BATCH, lines, wheels)))


def settle(model: Model, state: State, force: Array) -> None:
    """Let constant upward forces (lines, wheels) [N] have acted for ever where the wheels are."""
    state.force[:] = force[:, :, None]
    drive = np.tensordot(force, state.c_re + 1j * state.c_im, 1)
    still = drive / (1.0 - (model.e_re + 1j * model.e_im))
    state.r_re[:], state.r_im[:] = still.real, still.imag
    k = state.weight.shape[1]
    still = np.zeros(state.o_re.shape, dtype=complex)
    for i in range(2):
        still[:, :, i * k:(i + 1) * k] = force[:, :, None] * state.weight
    still /= 1.0 - (model.oe_re + 1j * model.oe_im)
    state.o_re[:], state.o_im[:] = still.real, still.imag


@njit(cache=True, nogil=True, _nrt=False)
def used(table, element, k):
    """Whether entry k is a degree of freedom; rows of fewer are filled up with zeros."""
    return k == 0 or table.dofs[element, k] != 0


@njit(cache=True, nogil=True, _nrt=False)
def enter(table, state, wheel, bay, element, nodes):
    """Come to another element: its oscillators go on at the nodes that it shares with the last.

    The others are at rest.  nodes: degrees of freedom of a bay.
    """
    before, width = state.home[wheel, 1], table.dofs.shape[1]
    ahead = nodes * (bay - state.home[wheel, 0])
    known = abs(bay - state.home[wheel, 0]) <= 1
    for line in range(state.o_re.shape[0]):
        state.spare_re[:] = 0.0
        state.spare_im[:] = 0.0
        for k in range(width):
            for j in range(width):
                if (known and table.dofs[element, k] + ahead == table.dofs[before, j]
                        and used(table, element, k) and used(table, before, j)):
                    for n in (0, width):
                        state.spare_re[n + k] = state.o_re[line, wheel, n + j]
                        state.spare_im[n + k] = state.o_im[line, wheel, n + j]
        for n in range(2 * width):
            state.o_re[line, wheel, n] = state.spare_re[n]
            state.o_im[line, wheel, n] = state.spare_im[n]
    state.home[wheel, 0] = bay
    state.home[wheel, 1] = element


@njit(cache=True, nogil=True, inline='always')
def stand(model, table, state, k, wheel, place):
    """Put a wheel at its place in sample k and let its oscillators do the step to there."""
    lines, width, weight = state.o_re.shape[0], state.weight.shape[1], state.weight
    o_re, o_im, oe_re, oe_im = state.o_re, state.o_im, model.oe_re, model.oe_im
    out_re, out_im = model.out_re, model.out_im
    for n in range(lines):
        force = state.last[k, n, wheel]
        for i in range(oe_re.size):
            re, im = o_re[n, wheel, i], o_im[n, wheel, i]
            o_re[n, wheel, i] = oe_re[i] * re - oe_im[i] * im
            o_im[n, wheel, i] = oe_re[i] * im + oe_im[i] * re
        for i in range(width):
            o_re[n, wheel, i] += force * weight[wheel, i]
            o_re[n, wheel, i + width] += force * weight[wheel, i]
    bay, interval, s = locate(table, place)
    element = table.element[interval]
    inside = min(max(place - table.start - bay * table.spacing, 0.0), table.spacing)
    piece, state.local[k, wheel] = interval_at(model.breaks, model.guess, table.spacing, inside)
    state.fresh[k, wheel, 0] = NOWHERE
    if state.home[wheel, 0] != bay or state.home[wheel, 2] != piece:
        state.fresh[k, wheel, 0] = bay % model.cos.shape[0]
        state.fresh[k, wheel, 1] = piece
        if state.home[wheel, 0] != bay or state.home[wheel, 1] != element:
            enter(table, state, wheel, bay, element, model.nodes)
        state.home[wheel, 2] = piece
    c = table.coefficients
    for i in range(width):
        weight[wheel, i] = (
            (c[interval, i, 3] * s + c[interval, i, 2]) * s + c[interval, i, 1]
        ) * s + c[interval, i, 0]
    for n in range(lines):
        total = 0.0
        for i in range(o_re.shape[2]):
            re = ((out_re[interval, 3, i] * s + out_re[interval, 2, i]) * s
                  + out_re[interval, 1, i]) * s + out_re[interval, 0, i]
            im = ((out_im[interval, 3, i] * s + out_im[interval, 2, i]) * s
                  + out_im[interval, 1, i]) * s + out_im[interval, 0, i]
            total += re * o_re[n, wheel, i] - im * o_im[n, wheel, i]
        state.free[k, n, wheel] = total


# The loops over a chunk of modes: functions of plain arrays and indices, written into their
# callers before these are compiled, so that the compiler sees arrays that stand still.


@njit(cache=True, nogil=True, inline='always')
def fetch(first_re, first_im, second_re, second_im, cos, sin, bay, piece, wheel, chunk, source_re,
          source_im):
    """source[wheel] = cubics of c in a piece of a bay."""
    for i in range(4):
        for p in range(cos.shape[2]):
            x, y = cos[bay, chunk, p], sin[bay, chunk, p]
            source_re[wheel, i, chunk, p] = (x * first_re[piece, i, chunk, p]
                                             + y * second_re[piece, i, chunk, p])
            source_im[wheel, i, chunk, p] = (x * first_im[piece, i, chunk, p]
                                             + y * second_im[piece, i, chunk, p])


@njit(cache=True, nogil=True, inline='always')
def combine(s, source_re, source_im, wheel, chunk, r_re, r_im, c_re, c_im):
    """c[wheel] = sum_i s^i source[wheel, i]; returns c r[0]."""
    total = 0.0
    for p in range(c_re.shape[2]):
        re = ((source_re[wheel, 3, chunk, p] * s + source_re[wheel, 2, chunk, p]) * s
              + source_re[wheel, 1, chunk, p]) * s + source_re[wheel, 0, chunk, p]
        im = ((source_im[wheel, 3, chunk, p] * s + source_im[wheel, 2, chunk, p]) * s
              + source_im[wheel, 1, chunk, p]) * s + source_im[wheel, 0, chunk, p]
        c_re[wheel, chunk, p], c_im[wheel, chunk, p] = re, im
        total += re * r_re[0, chunk, p] - im * r_im[0, chunk, p]
    return total


@njit(cache=True, nogil=True, inline='always')
def turn(e_re, e_im, one, c_re, c_im, chunk, line, r_re, r_im):
    """r[line] <- e r[line] + one c[0], complex."""
    for p in range(c_re.shape[2]):
        re, im = r_re[line, chunk, p], r_im[line, chunk, p]
        r_re[line, chunk, p] = (e_re[chunk, p] * re - e_im[chunk, p] * im
                                + one * c_re[0, chunk, p])
        r_im[line, chunk, p] = (e_re[chunk, p] * im + e_im[chunk, p] * re
                                + one * c_im[0, chunk, p])


@njit(cache=True, nogil=True, inline='always')
def add(one, two, wheel, other, c_re, c_im, chunk, line, r_re, r_im):
    """r[line] += one c[wheel] + two c[other]."""
    for p in range(c_re.shape[2]):
        r_re[line, chunk, p] += one * c_re[wheel, chunk, p] + two * c_re[other, chunk, p]
        r_im[line, chunk, p] += one * c_im[wheel, chunk, p] + two * c_im[other, chunk, p]


@njit(cache=True, nogil=True, inline='always')
def dot(c_re, c_im, wheel, chunk, line, r_re, r_im):
    """Re sum c[wheel] r[line], complex."""
    total = 0.0
    for p in range(c_re.shape[2]):
        total += (c_re[wheel, chunk, p] * r_re[line, chunk, p]
                  - c_im[wheel, chunk, p] * r_im[line, chunk, p])
    return total


@njit(cache=True, nogil=True, inline='always')
def begin(model, table, offsets, state, position, force):
    """Put the wheels at positions (n,) [m] and tell what the past has left there, state.free.

    n is at most BATCH.  force (n, lines, wheels) [N, upward] are those at these places; the last
    of them has no effect yet but for the corrected hold.
    """
    count, lines, wheels = force.shape
    for k in range(count):
        for n in range(lines):
            for w in range(wheels):
                newest, earlier = state.force[n, w, 0], state.force[n, w, 1]
                state.last[k, n, w] = newest
                if model.corrected:
                    state.last[k, n, w] -= (force[k, n, w] - 2.0 * newest + earlier) / 12.0
                state.force[n, w, 1] = newest
                state.force[n, w, 0] = force[k, n, w]
        for w in range(wheels):
            stand(model, table, state, k, w, position[k] + offsets[w])
    state.place[0] = position[count - 1]
    for chunk in range(model.e_re.shape[0]):
        follow(model, state, count, chunk)


@njit(cache=True, nogil=True, inline='always')
def follow(model, state, count, chunk):
    """Add what a chunk of the kept modes has left at the wheels' places."""
    _, lines, wheels = state.free.shape
    r_re, r_im, c_re, c_im = state.r_re, state.r_im, state.c_re, state.c_im
    last, free, local, fresh = state.last, state.free, state.local, state.fresh
    source_re, source_im, e_re, e_im = state.source_re, state.source_im, model.e_re, model.e_im
    first_re, first_im, second_re = model.first_re, model.first_im, model.second_re
    second_im, cos, sin = model.second_im, model.cos, model.sin
    for k in range(count):
        for n in range(lines):
            turn(e_re, e_im, last[k, n, 0], c_re, c_im, chunk, n, r_re, r_im)
            for w in range(1, wheels, 2):
                other = min(w + 1, wheels - 1)
                two = last[k, n, other] if other > w else 0.0
                add(last[k, n, w], two, w, other, c_re, c_im, chunk, n, r_re, r_im)
        for w in range(wheels):
            if fresh[k, w, 0] != NOWHERE:
                fetch(first_re, first_im, second_re, second_im, cos, sin, fresh[k, w, 0],
                      fresh[k, w, 1], w, chunk, source_re, source_im)
            free[k, 0, w] += combine(local[k, w], source_re, source_im, w, chunk, r_re, r_im,
                                     c_re, c_im)
            for n in range(1, lines):
                free[k, n, w] += dot(c_re, c_im, w, chunk, n, r_re, r_im)
