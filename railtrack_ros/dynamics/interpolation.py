"""Where a wheel stands in the mesh: compiled lookup in a bay's piecewise-cubic interpolation.

Shared by the compiled loops of all forward solvers, so that they see the very same N(x), F(x).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.compiled import njit
from railtrack_ros.track.bay import Bay

Array = NDArray[np.float64]


class ShapeTable(NamedTuple):
    """Plain arrays of a bay's interpolation, as compiled loops take them.

    start, spacing: bay k covers k * spacing + start + [0, spacing) [m].
    breaks (m + 1,), guess: an interval at or before each of equal cells of the bay.
    element (m,): number of the element of each interval; dofs (elements, k): its degrees of
    freedom.  coefficients (m, k, 4), flexibility (m, 4): cubics in s, see `track.bay`.
    """

    start: float
    spacing: float
    breaks: Array
    guess: NDArray[np.int64]
    element: NDArray[np.int64]
    dofs: NDArray[np.int64]
    coefficients: Array
    flexibility: Array


def shape_table(bay: Bay) -> ShapeTable:
    """Pack a bay's interpolation."""
    table = bay.table
    change = np.any(np.diff(table.dofs, axis=0) != 0, axis=1)
    element = np.concatenate([[0], np.cumsum(change)]).astype(np.int64)
    first = np.concatenate([[0], np.flatnonzero(change) + 1])
    return ShapeTable(
        start=bay.start, spacing=bay.spacing, breaks=table.breaks,
        guess=first_guess(table.breaks, bay.spacing), element=element,
        dofs=np.ascontiguousarray(table.dofs[first]),
        coefficients=np.ascontiguousarray(table.coefficients),
        flexibility=np.ascontiguousarray(table.flexibility),
    )


def first_guess(breaks: Array, spacing: float) -> NDArray[np.int64]:
    """Interval at or before the beginning of each of many equal cells of a bay."""
    cells = np.linspace(0.0, spacing, 8 * len(breaks), endpoint=False)
    guess = np.clip(np.searchsorted(breaks, cells, side='right') - 1, 0, len(breaks) - 2)
    return guess.astype(np.int64)


def shape_tables(bays: Sequence[Bay]) -> ShapeTable:
    """Pack the interpolations of several kinds of bays, every array with a first axis of kinds.

    Beyond its own end an interpolation goes on as a constant, without end.
    """
    tables = [shape_table(bay) for bay in bays]
    intervals = max(table.element.size for table in tables)
    tables = [_lengthened(table, intervals - table.element.size) for table in tables]
    cells = max(table.guess.size for table in tables)
    guess = [table.guess[np.arange(cells) * table.guess.size // cells] for table in tables]

    def stack(name: str) -> Array:
        arrays = [getattr(table, name) for table in tables]
        shape = np.max([array.shape for array in arrays], axis=0)
        out = np.zeros((len(arrays), *shape), dtype=arrays[0].dtype)
        for place, array in zip(out, arrays, strict=True):
            place[tuple(slice(n) for n in array.shape)] = array
        return out

    return ShapeTable(
        start=tables[0].start, spacing=tables[0].spacing, breaks=stack('breaks'),
        guess=np.array(guess), element=stack('element').astype(np.int64),
        dofs=stack('dofs').astype(np.int64), coefficients=stack('coefficients'),
        flexibility=stack('flexibility'))


def _lengthened(table: ShapeTable, by: int) -> ShapeTable:
    """Add `by` intervals without end that hold the value at the end of the bay."""
    constant = np.array([1.0, 0.0, 0.0, 0.0])
    end = table.coefficients[-1].sum(axis=-1)[:, None] * constant
    return table._replace(
        breaks=np.append(table.breaks, np.full(by, np.inf)),
        element=np.append(table.element, np.full(by, table.element[-1])),
        coefficients=np.concatenate([table.coefficients, np.tile(end, (by, 1, 1))]),
        flexibility=np.concatenate(
            [table.flexibility, np.tile(table.flexibility[-1].sum() * constant, (by, 1))]))


@njit(cache=True, nogil=True, inline='always')
def interval_at(breaks, guess, spacing, inside):
    """Interval and local coordinate s of a place `inside` a bay [m]."""
    cells = guess.size
    interval = guess[min(int(inside / spacing * cells), cells - 1)]
    last = breaks.size - 2
    while interval < last and inside >= breaks[interval + 1]:
        interval += 1
    low = breaks[interval]
    return interval, (inside - low) / (breaks[interval + 1] - low)


@njit(cache=True, nogil=True, inline='always')
def locate(table, x):
    """Bay number, interval and local coordinate s of track position x [m]."""
    bay = math.floor((x - table.start) / table.spacing)
    inside = min(max(x - table.start - bay * table.spacing, 0.0), table.spacing)
    interval, s = interval_at(table.breaks, table.guess, table.spacing, inside)
    return int(bay), interval, s


@njit(cache=True, nogil=True, inline='always')
def cubic(c, s):
    """Value of c[0] + c[1] s + c[2] s^2 + c[3] s^3."""
    return ((c[3] * s + c[2]) * s + c[1]) * s + c[0]
