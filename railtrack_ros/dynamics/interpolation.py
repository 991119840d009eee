"""Where a wheel stands in the mesh: compiled lookup in a bay's piecewise-cubic interpolation.

Shared by the compiled loops of all forward solvers, so that they see the very same N(x), F(x).
"""

from __future__ import annotations

import math
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
    cells = np.linspace(0.0, bay.spacing, 8 * len(table.breaks), endpoint=False)
    guess = np.clip(np.searchsorted(table.breaks, cells, side='right') - 1,
                    0, len(table.breaks) - 2)
    return ShapeTable(
        start=bay.start, spacing=bay.spacing, breaks=table.breaks,
        guess=guess.astype(np.int64), element=element,
        dofs=np.ascontiguousarray(table.dofs[first]),
        coefficients=np.ascontiguousarray(table.coefficients),
        flexibility=np.ascontiguousarray(table.flexibility),
    )


@njit(cache=True, nogil=True, inline='always')
def locate(table, x):
    """Bay number, interval and local coordinate s of track position x [m]."""
    bay = math.floor((x - table.start) / table.spacing)
    inside = min(max(x - table.start - bay * table.spacing, 0.0), table.spacing)
    cells = table.guess.size
    interval = table.guess[min(int(inside / table.spacing * cells), cells - 1)]
    last = table.breaks.size - 2
    while interval < last and inside >= table.breaks[interval + 1]:
        interval += 1
    low = table.breaks[interval]
    s = (inside - low) / (table.breaks[interval + 1] - low)
    return int(bay), interval, s


@njit(cache=True, nogil=True, inline='always')
def cubic(c, s):
    """Value of c[0] + c[1] s + c[2] s^2 + c[3] s^3."""
    return ((c[3] * s + c[2]) * s + c[1]) * s + c[0]
