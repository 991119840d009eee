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
known beforehand, so that what a chunk needs stays in the processor's nearest cache.  Shapes are in
single precision, which moves a rail by less than a tenth of a nanometre; states are in double.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.compiled import njit
from railtrack_ros.dynamics.interpolation import ShapeTable, first_guess, interval_at
from railtrack_ros.dynamics.modes import OSCILLATORS, ComplexArray, TrackModes
from railtrack_ros.errors import InputError

Array = NDArray[np.float64]
Single = NDArray[np.float32]
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

    Modes are arranged in rows (..., chunks, modes): chunk by chunk all g1 before all g2, each
    filled up with zeros.
    breaks, guess: pieces of a bay, as in `interpolation.ShapeTable`.  first, second re and im
    (pieces, 4, chunks, modes / 2): c of g1 and of g2 in bay 0, cubics in s; in bay m they are
    turned, as in `modes.TrackModes`, by cos, sin (bays, chunks, modes / 2).  e re and im (...).
    oe (k,): the oscillators that stand for the poles that are not kept; out (finer pieces, 4, k),
    cubics: residues where the wheel is, times p0 + e p1.  fine_breaks, fine_guess: those pieces.
    """

    start: float
    spacing: float
    breaks: Array
    guess: Indices
    first_re: Single
    first_im: Single
    second_re: Single
    second_im: Single
    cos: Single
    sin: Single
    e_re: Array
    e_im: Array
    oe: ComplexArray
    out: ComplexArray
    fine_breaks: Array
    fine_guess: Indices
    corrected: bool


class State(NamedTuple):
    """What a run carries from step to step, for `wheels` wheels on each of `lines` rails.

    r (lines, chunks, modes); oscillators o (lines, wheels, 2, k), driven by the force and by force
    times residue; place of the reference point (1,) [m] and force (lines, wheels, 2)
    at the last samples, newest first.  All else follows from them: home (wheels, 2), bay and
    piece; source (wheels, 4, chunks, modes), the cubics there; c (wheels, chunks, modes); residue
    (wheels, k).
    The rest is scratch, for BATCH samples: the loops do not allocate.  fresh (BATCH, wheels, 2):
    bay and piece that a wheel comes to in a sample, or NOWHERE; local (BATCH, wheels): s;
    last (BATCH, lines, wheels): forces of the last sample as the hold takes them; free (BATCH,
    lines, wheels).
    """

    r_re: Array
    r_im: Array
    o: ComplexArray
    place: Array
    force: Array
    home: Indices
    source_re: Single
    source_im: Single
    c_re: Single
    c_im: Single
    residue: ComplexArray
    fresh: Indices
    local: Array
    last: Array
    free: Array


SAVED = ('r_re', 'r_im', 'o', 'place', 'force')

LINE = 64  # bytes in a cache line
CHUNK = 256  # modes worked off at a time, at most
LANES = 32  # modes that compiled loops take in one turn; what is left over goes one by one
BATCH = 128  # samples worked off at a time
NOWHERE = -2**40  # number of a bay far from any other
PIECES = 48  # of a bay, at least, in which the shape of a mode is a cubic
RESIDUE_PIECES = 360  # the same for the residues: squares, of the waves of local systems too
NODES = np.array([0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0])  # where these pass through it


def make_model(modes: TrackModes, time_step: float, hold: str) -> Model:
    """Tables of the loops for a time step [s]; raises InputError for an unknown hold."""
    step = step_of(modes.poles, time_step, hold)
    chunks = -(-2 * modes.poles.size // CHUNK)
    half = -(-2 * modes.poles.size // (LANES * chunks)) * LANES // 2

    def arranged(values: NDArray[Any], dtype: Any = np.float32) -> NDArray[Any]:
        room = _zeros(*values.shape[:-1], chunks, half, dtype=dtype)
        room.reshape(*values.shape[:-1], -1)[..., :values.shape[-1]] = values
        return room

    def parts(values: ComplexArray) -> tuple[Single, Single]:
        return arranged(values.real), arranged(values.imag)

    def twice(values: Array) -> Array:
        both = _zeros(chunks, 2 * half)
        both[:, :half] = both[:, half:] = arranged(values, np.float64)
        return both

    root = np.sqrt(step.gain)
    angle = np.outer(np.arange(modes.bays), modes.wave_number)
    oscillators = step_of(modes.oscillators, time_step, hold)
    fit = np.linalg.inv(NODES[:, None] ** np.arange(4))

    def shape_in(breaks: Array) -> Array:
        x = breaks[:-1, None] + NODES * np.diff(breaks)[:, None]
        return modes.bay.shape(x.ravel()).reshape(*x.shape, -1)

    breaks, fine = pieces(modes.table, PIECES), pieces(modes.table, RESIDUE_PIECES)
    shape = fit @ shape_in(breaks)
    first, second = shape @ (modes.first * root), shape @ (modes.second * root)
    shape = shape_in(fine)
    out = fit @ np.einsum('xni,mij,xnj->xnm', shape, modes.amplitude, shape, optimize=True)
    return Model(
        modes.table.start, modes.table.spacing, breaks, first_guess(breaks, modes.table.spacing),
        *parts(first), *parts(second), arranged(np.cos(angle)), arranged(np.sin(angle)),
        twice(step.e.real), twice(step.e.imag), oscillators.e, out * oscillators.gain,
        fine, first_guess(fine, modes.table.spacing), hold == 'corrected')


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


def make_state(model: Model, wheels: int, lines: int = 1) -> State:
    """The rail at rest and unloaded."""
    row, single = model.e_re.shape, np.float32
    return State(
        r_re=_zeros(lines, *row), r_im=_zeros(lines, *row),
        o=np.zeros((lines, wheels, 2, OSCILLATORS), complex),
        residue=np.zeros((wheels, OSCILLATORS), complex),
        place=np.zeros(1), force=np.zeros((lines, wheels, 2)),
        home=np.full((wheels, 2), NOWHERE),
        source_re=_zeros(wheels, 4, *row, dtype=single),
        source_im=_zeros(wheels, 4, *row, dtype=single),
        c_re=_zeros(wheels, *row, dtype=single), c_im=_zeros(wheels, *row, dtype=single),
        fresh=np.full((BATCH, wheels, 2), NOWHERE), local=np.zeros((BATCH, wheels)),
        last=np.zeros((BATCH, lines, wheels)), free=np.zeros((BATCH, lines, wheels)))


def settle(model: Model, state: State, force: Array) -> None:
    """Let constant upward forces (lines, wheels) [N] have acted for ever where the wheels are."""
    state.force[:] = force[:, :, None]
    drive = np.tensordot(force, state.c_re + 1j * state.c_im, 1)
    still = drive / (1.0 - (model.e_re + 1j * model.e_im))
    state.r_re[:], state.r_im[:] = still.real, still.imag
    state.o[:, :, 0] = force[:, :, None] / (1.0 - model.oe)
    state.o[:, :, 1] = state.residue * state.o[:, :, 0]


@njit(cache=True, nogil=True, inline='always')
def stand(model, state, k, wheel, place):
    """Put a wheel at its place in sample k; what its oscillators have left there."""
    bay = int(math.floor((place - model.start) / model.spacing))
    inside = min(max(place - model.start - bay * model.spacing, 0.0), model.spacing)
    piece, s = interval_at(model.breaks, model.guess, model.spacing, inside)
    state.local[k, wheel] = s
    state.fresh[k, wheel, 0] = NOWHERE
    if state.home[wheel, 0] != bay or state.home[wheel, 1] != piece:
        state.fresh[k, wheel, 0] = bay % model.cos.shape[0]
        state.fresh[k, wheel, 1] = piece
        state.home[wheel, 0], state.home[wheel, 1] = bay, piece
    # Residues a(x, x') of a wheel that was at x' are the mean of a(x, x) and a(x', x').
    piece, s = interval_at(model.fine_breaks, model.fine_guess, model.spacing, inside)
    out, o, e = model.out, state.o, model.oe
    for n in range(o.shape[0]):
        state.free[k, n, wheel] = 0.0
    for i in range(OSCILLATORS):
        before = state.residue[wheel, i]
        here = ((out[piece, 3, i] * s + out[piece, 2, i]) * s
                + out[piece, 1, i]) * s + out[piece, 0, i]
        state.residue[wheel, i] = here
        for n in range(o.shape[0]):
            force = state.last[k, n, wheel]
            o[n, wheel, 0, i] = e[i] * o[n, wheel, 0, i] + force
            o[n, wheel, 1, i] = e[i] * o[n, wheel, 1, i] + force * before
            state.free[k, n, wheel] += 0.5 * (here * o[n, wheel, 0, i] + o[n, wheel, 1, i]).real


# The loops over a chunk of modes: functions of plain arrays and indices, written into their
# callers before these are compiled, so that the compiler sees arrays that stand still.


@njit(cache=True, nogil=True, inline='always')
def fetch(first_re, first_im, second_re, second_im, cos, sin, bay, piece, wheel, chunk, source_re,
          source_im):
    """source[wheel] = cubics of c in a piece of a bay."""
    # Bounds that tell the compiler that half + p counts from the beginning, not from the end.
    half = min(max(cos.shape[2], 0), CHUNK)
    for i in range(4):
        for p in range(half):
            x, y = cos[bay, chunk, p], sin[bay, chunk, p]
            source_re[wheel, i, chunk, p] = (x * first_re[piece, i, chunk, p]
                                             + y * second_re[piece, i, chunk, p])
            source_im[wheel, i, chunk, p] = (x * first_im[piece, i, chunk, p]
                                             + y * second_im[piece, i, chunk, p])
        for p in range(half):
            x, y = cos[bay, chunk, p], sin[bay, chunk, p]
            source_re[wheel, i, chunk, half + p] = (x * second_re[piece, i, chunk, p]
                                                    - y * first_re[piece, i, chunk, p])
            source_im[wheel, i, chunk, half + p] = (x * second_im[piece, i, chunk, p]
                                                    - y * first_im[piece, i, chunk, p])


@njit(cache=True, nogil=True, inline='always')
def combine(s, source_re, source_im, wheel, chunk, c_re, c_im):
    """c[wheel] = sum_i s^i source[wheel, i]."""
    for p in range(c_re.shape[2]):
        c_re[wheel, chunk, p] = (
            (source_re[wheel, 3, chunk, p] * s + source_re[wheel, 2, chunk, p]) * s
            + source_re[wheel, 1, chunk, p]) * s + source_re[wheel, 0, chunk, p]
        c_im[wheel, chunk, p] = (
            (source_im[wheel, 3, chunk, p] * s + source_im[wheel, 2, chunk, p]) * s
            + source_im[wheel, 1, chunk, p]) * s + source_im[wheel, 0, chunk, p]


@njit(cache=True, nogil=True, inline='always')
def turn(e_re, e_im, one, two, other, c_re, c_im, chunk, line, r_re, r_im):
    """r[line] <- e r[line] + one c[0] + two c[other], complex."""
    for p in range(c_re.shape[2]):
        re, im = r_re[line, chunk, p], r_im[line, chunk, p]
        r_re[line, chunk, p] = (e_re[chunk, p] * re - e_im[chunk, p] * im
                                + one * c_re[0, chunk, p] + two * c_re[other, chunk, p])
        r_im[line, chunk, p] = (e_re[chunk, p] * im + e_im[chunk, p] * re
                                + one * c_im[0, chunk, p] + two * c_im[other, chunk, p])


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
def begin(model, offsets, state, position, force):
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
            stand(model, state, k, w, position[k] + offsets[w])
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
            other = min(1, wheels - 1)
            two = last[k, n, other] if other else 0.0
            turn(e_re, e_im, last[k, n, 0], two, other, c_re, c_im, chunk, n, r_re, r_im)
            for w in range(2, wheels, 2):
                other = min(w + 1, wheels - 1)
                two = last[k, n, other] if other > w else 0.0
                add(last[k, n, w], two, w, other, c_re, c_im, chunk, n, r_re, r_im)
        for w in range(wheels):
            if fresh[k, w, 0] != NOWHERE:
                fetch(first_re, first_im, second_re, second_im, cos, sin, fresh[k, w, 0],
                      fresh[k, w, 1], w, chunk, source_re, source_im)
            combine(np.float32(local[k, w]), source_re, source_im, w, chunk, c_re, c_im)
            for n in range(lines):
                free[k, n, w] += dot(c_re, c_im, w, chunk, n, r_re, r_im)
