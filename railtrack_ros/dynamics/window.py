"""The travelling window of the full model: its factorised matrix, laid out for the compiled steps.

Bays of one kind are condensed to their two ends once.  What depends on the order of the kinds in
the window is the elimination of the left nodes and the columns of A^-1 under the wheels; on a
track that is not periodic both are renewed where the window has come to another sequence of kinds,
the columns only of those wheels around which it has changed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import zip_longest

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from railtrack_ros.dynamics import newmark_kernel as kernel
from railtrack_ros.dynamics.interpolation import shape_tables
from railtrack_ros.dynamics.support_forces import SupportForces, spread, support_forces
from railtrack_ros.track.bay import Bay
from railtrack_ros.track.row import BayRow

Array = NDArray[np.float64]

VECTOR = 8  # doubles in a vector register; lanes are a multiple of it
NEGLIGIBLE = 1e-18  # where columns of A^-1 are cut off, relative to their peak


class TravellingWindow:
    """A number of bays of a row around the reference point, which stands in lane `home`.

    Parameters
    ----------
    behind
        Lanes of the wheels relative to the reference point's, (wheels,): each may stand in that
        lane or the next.
    first_bay
        Bay of the row in lane 0.
    """

    def __init__(self, row: BayRow, bays: int, home: int, behind: NDArray[np.int64],
                 first_bay: int, time_step: float, beta: float, gamma: float) -> None:
        self.row, self.bays, self._home = row, bays, home
        self._kinds = _FactorisedKinds(row.kinds, time_step, beta, gamma)
        self._laws = support_forces(row.kinds)
        self._lanes = VECTOR * math.ceil((bays + 1) / VECTOR)
        nb = row.bay.dofs

        # How far columns reach, the slowest kind tells; what a support feels of its own force.
        distance = 0
        for kind in range(len(row.kinds)):
            alike = self._kinds.operator(np.full(bays, kind), self._lanes)
            distance = max(distance, _decay_distance(alike, nb, home + behind))
            if self._laws.row.size:
                self._laws.own[:, kind] = _own_response(alike, self._laws, kind, bays // 2,
                                                        time_step, beta, gamma)
        self._distance = distance
        reach = min(self._lanes, VECTOR * math.ceil((2 * distance + 3) / VECTOR))
        lane = home + behind
        self._columns = kernel.Columns(
            home=lane.astype(np.int64),
            first=np.clip(lane - distance, 0, self._lanes - reach).astype(np.int64),
            value=np.zeros((lane.size, 2 * nb + 2, nb, reach)))
        self._table = shape_tables(row.kinds)
        self._made_for: list[bytes] = [b''] * lane.size
        self.place(first_bay)

    def place(self, first_bay: int) -> None:
        """Make the window ready for lane 0 in that bay."""
        kind = self.row.kind(first_bay, self.bays)
        self.stay = np.array(self.row.alike(first_bay, self.bays), dtype=np.int64) + self._home
        operator = self._kinds.operator(kind, self._lanes)
        columns = self._columns
        for w, lane in enumerate(columns.home):
            around = kind[max(0, lane - self._distance):lane + self._distance + 3].tobytes()
            if self._made_for[w] == around:
                continue
            same = [v for v in range(w) if columns.home[v] == lane]
            if same:
                columns.value[w] = columns.value[same[0]]
            else:
                kernel.inverse_columns(operator, lane, columns.first[w], columns.value[w])
            self._made_for[w] = around
        kinds = np.zeros(self._lanes, dtype=np.int64)
        kinds[:self.bays] = kind
        self.compiled = kernel.Window(operator, columns, self._table, kinds,
                                      spread(self._laws, kind, self._lanes))
        self.first_bay = first_bay


class _FactorisedKinds:
    """Matrices and factors of all kinds of bays for time steps [s], on their common pattern."""

    def __init__(self, kinds: Sequence[Bay], time_step: float, beta: float, gamma: float) -> None:
        nb = self._dofs = kinds[0].dofs
        self._lag = _common_ratio(kinds[0].damping, kinds[0].stiffness)
        rest, a = [], []
        for bay in kinds:
            left_over = bay.damping - self._lag * bay.stiffness
            left_over[np.abs(left_over) < 1e-12 * np.abs(bay.damping)] = 0.0
            rest.append(left_over)
            a.append(bay.mass + gamma * time_step * bay.damping
                     + beta * time_step**2 * bay.stiffness)

        # Partial L D L^T of a bay: the interior goes, the left node and the next one's stay.
        remaining = np.array(a)
        order = _elimination_order((remaining != 0.0).any(axis=0), nb)
        lower = np.zeros_like(remaining)
        self._pivot = np.zeros((len(kinds), nb + 2))
        kept = list(range(nb + 2))
        for j in order:
            kept.remove(j)
            self._pivot[:, j] = 1.0 / remaining[:, j, j]
            lower[:, kept, j] = remaining[:, kept, j] * self._pivot[:, j, None]
            for matrix, factor in zip(remaining, lower, strict=True):
                matrix[np.ix_(kept, kept)] -= np.outer(factor[kept, j], matrix[j, kept])
        ends = [0, 1, nb, nb + 1]
        self._ends = np.ascontiguousarray(remaining[:, ends][:, :, ends])
        self._entries = {
            'stiffness': _entries([-bay.stiffness for bay in kinds], range(nb + 2)),
            'damping': _entries([-matrix for matrix in rest], range(nb + 2)),
            'forward': _entries(-lower, [*order, *ends]),
            'backward': _entries(-lower.transpose(0, 2, 1), order[::-1]),
        }

    def operator(self, kind: NDArray[np.int64], lanes: int) -> kernel.Operator:
        """The window's operator for bays of kinds (bays,)."""
        bays = kind.size
        uniform = bool((kind == kind[0]).all())
        entries = {}
        for name, (row, column, value) in self._entries.items():
            if uniform:
                laid_out = value[:, :, kind[:1]]
            else:
                laid_out = np.zeros((*value.shape[:2], lanes))
                laid_out[:, :, :bays] = value[:, :, kind]
            entries[name] = kernel.Entries(row, column, np.ascontiguousarray(laid_out))
        pivot = np.zeros((self._dofs + 2, lanes))
        pivot[:, :bays] = self._pivot[kind].T
        below, diagonal, above = (np.zeros((bays + 1, 2, 2)) for _ in range(3))
        kernel.eliminate(self._ends[kind], bays, below, diagonal, above)
        return kernel.Operator(bays=bays, lag=self._lag, pivot=pivot, below=below,
                               diagonal=diagonal, above=above, **entries)


def make_operator(bay: Bay, bays: int, time_step: float, beta: float = 0.25, gamma: float = 0.5
                  ) -> kernel.Operator:
    """Matrices and factors of a window of `bays` equal bays for time steps [s]."""
    lanes = VECTOR * math.ceil((bays + 1) / VECTOR)
    return _FactorisedKinds([bay], time_step, beta, gamma).operator(
        np.zeros(bays, dtype=np.int64), lanes)


def assemble(matrix: Array | Sequence[Array], bays: int) -> scipy.sparse.csc_matrix:
    """Matrix (nb + 2, nb + 2) of one bay or of each, for a row of bays: ((bays + 1) nb,) squared.

    Degree of freedom d of bay b is row b nb + d.  Of the last nb rows only the first two, the
    right end's node, belong to the track; the others are empty.
    """
    stack = np.asarray(matrix)
    stack = np.broadcast_to(stack, (bays, *stack.shape[-2:]))
    nb = stack.shape[1] - 2
    row, column = np.nonzero((stack != 0.0).any(axis=0))
    first = nb * np.arange(bays)[:, None]
    size = (bays + 1) * nb
    return scipy.sparse.coo_matrix(
        (stack[:, row, column].ravel(), ((first + row).ravel(), (first + column).ravel())),
        shape=(size, size)).tocsc()


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


def _entries(matrices: Sequence[Array] | Array, rows: Sequence[int]
             ) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Non-zero entries of matrices (nb + 2, nb + 2) in pairs, rows in the given order.

    Row (n,), column (n, 2) and value (n, 2, matrices), see kernel.Entries.
    """
    stack = np.asarray(matrices)
    row, column, value = [], [], []
    for i in rows:
        occupied = np.flatnonzero((stack[:, i] != 0.0).any(axis=0))
        for j, k in zip_longest(occupied[::2], occupied[1::2]):
            row.append(i)
            column.append((j, j if k is None else k))
            second = np.zeros(len(stack)) if k is None else stack[:, i, k]
            value.append((stack[:, i, j], second))
    size = len(row)
    return (np.array(row, dtype=np.int64), np.array(column, dtype=np.int64).reshape(size, 2),
            np.array(value, dtype=float).reshape(size, 2, len(stack)))


def _decay_distance(operator: kernel.Operator, nb: int, lanes: NDArray[np.int64]) -> int:
    """Lanes from a wheel's first one at which its columns of A^-1 have died away."""
    distance = 0
    whole = np.zeros((2 * nb + 2, nb, operator.pivot.shape[1]))
    for lane in np.unique(lanes):
        kernel.inverse_columns(operator, int(lane), 0, whole)
        strong = np.abs(whole) > NEGLIGIBLE * np.abs(whole).max(axis=2, keepdims=True)
        for k, rows in enumerate(strong):
            occupied = np.flatnonzero(rows.any(axis=0))
            distance = max(distance, int(np.abs(occupied - lane - k // nb).max()))
    return distance


def _own_response(operator: kernel.Operator, laws: SupportForces, kind: int, lane: int,
                  time_step: float, beta: float, gamma: float) -> Array:
    """What e and q of a bay feel of unit forces of its own pad and ballast, as in `own`."""
    nb = operator.pivot.shape[0] - 2
    sleeper = laws.sleeper[kind]
    spring, damper = laws.ballast[:2, kind]
    out = []
    for force in range(2):
        x = np.zeros_like(operator.pivot)
        if force == 0:
            x[laws.row, lane] = -laws.weight[:, kind]
        else:
            x[sleeper, lane] = 1.0
        kernel.solve(operator, x)
        felt = np.append(x[:nb, lane], x[:2, lane + 1])
        out += [beta * time_step**2 * laws.weight[:, kind] @ felt[laws.row],
                (beta * time_step**2 * spring + gamma * time_step * damper) * felt[sleeper]]
    return np.array(out)
