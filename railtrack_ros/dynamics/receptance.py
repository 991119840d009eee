"""Receptance of the track, H = displacement / force at angular frequency omega (thesis 3.23).

Three tracks: the exact infinite one (no mesh, no reflections); one of finite elements with free
ends, which need not be periodic; and infinitely many bays of finite elements, so that the error
of a mesh shows without reflections.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from railtrack_ros.errors import InputError
from railtrack_ros.track.bay import Bay, Mesh, keep_local_modes, make_bays
from railtrack_ros.track.description import Track
from railtrack_ros.track.exact import ComplexArray, ExactBay
from railtrack_ros.track.infinite import CondensedBay, InfiniteRow, Row, Sleeper
from railtrack_ros.track.rail import Array

AT_A_TIME = 512  # frequencies in one batch: bounds the memory
MOST_BAYS = 2000
HIGHEST = 20e3  # [Hz]: far above what a beam can say of a rail


class FiniteElementBay:
    """A bay of finite elements at the frequencies (f,) [Hz].

    The rail's loss is hysteretic here, K + i eta K_rail; the time domain's equivalent viscous
    damping stays out.  The local system's flexibility acts at the loaded point alone.
    """

    def __init__(self, bay: Bay, frequencies: ArrayLike) -> None:
        omega = 2.0 * math.pi * np.atleast_1d(np.asarray(frequencies, dtype=float))
        self.bay = bay
        self.spacing, self.start = bay.spacing, bay.start
        self.sleeper = bay.sleeper_dof
        self.ends = np.array([0, 1, bay.dofs, bay.dofs + 1])
        self._loss = 1.0 + 1j * bay.track.rail.loss_factor
        w = omega[:, None, None]
        self.stiffness: ComplexArray = (
            bay.stiffness + 1j * bay.track.rail.loss_factor * bay.rail_stiffness
            + 1j * w * bay.support_damping - w**2 * bay.mass)

    def shape(self, x: float) -> ComplexArray:
        """Weights (f, n) of the degrees of freedom in the deflection at x [m from the left]."""
        weights = self.bay.shape(x)[0].astype(complex)
        return np.tile(weights, (len(self.stiffness), 1))

    def flexibility(self, x: float, load: float) -> ComplexArray | complex:
        """Flexibility of the local system [m/N], zero away from the load."""
        at_load = abs(x - load) < 1e-9 * self.spacing
        return complex(self.bay.flexibility(x)[0] / self._loss) if at_load else 0.0


@dataclass(frozen=True)
class FiniteTrack:
    """Bays of finite elements in a row with free ends; the first one has the number `first`."""

    bays: tuple[Bay, ...]
    first: int


def finite_track(track: Track, mesh: Mesh | None, bays: int) -> FiniteTrack:
    """Mesh a number of bays of a track, periodic or not, with sleeper 0 in the middle one."""
    if not 1 <= bays <= MOST_BAYS:
        raise InputError(f'bays: expected 1 to {MOST_BAYS}, got {bays}')
    first = -(bays // 2)
    return FiniteTrack(tuple(make_bays(track, mesh, first, bays)), first)


def local_modes_around(track: FiniteTrack, x: float, elements: int) -> FiniteTrack:
    """Keep the local modes of so many elements around the load at x [m] only, as the thesis does.

    elements: an odd number; the loaded element is the middle one.  Every element of the mesh must
    have local modes.  Raises InputError.
    """
    if elements < 1 or elements % 2 == 0:
        raise InputError(f'local elements: expected an odd number of at least 1, got {elements}')
    if not all(bay.modal_dofs.size for bay in track.bays):
        raise InputError('local elements: only the dynamic local system has modes to keep')
    number, inside = track.bays[0].locate(x)
    per_bay = len(track.bays[0].nodes) - 1
    bay = track.bays[min(max(int(number[0]) - track.first, 0), len(track.bays) - 1)]
    element = int(np.clip(np.searchsorted(bay.nodes, inside[0], side='right') - 1, 0, per_bay - 1))
    middle = (int(number[0]) - track.first) * per_bay + element
    chosen = range(middle - elements // 2, middle + elements // 2 + 1)
    made: dict[tuple[int, tuple[int, ...]], Bay] = {}
    bays = []
    for i, whole in enumerate(track.bays):
        kept = tuple(k - i * per_bay for k in chosen if 0 <= k - i * per_bay < per_bay)
        key = (id(whole), kept)
        if key not in made:
            made[key] = keep_local_modes(whole, kept)
        bays.append(made[key])
    return FiniteTrack(tuple(bays), track.first)


class FiniteRow(Row):
    """The bays of a finite track at the frequencies (f,) [Hz]."""

    def __init__(self, track: FiniteTrack, frequencies: ArrayLike) -> None:
        different = {id(bay): bay for bay in track.bays}
        made = {key: CondensedBay(FiniteElementBay(bay, frequencies))
                for key, bay in different.items()}
        self._bays = [made[id(bay)] for bay in track.bays]
        self.spacing, self.start = track.bays[0].spacing, track.bays[0].start
        self.first, self.last = track.first, track.first + len(track.bays) - 1
        # Stiffness of all bays on one side of a bay, and the matrix that carries displacements
        # from its end to the next bay's far end; free ends first.
        blocks = [(k[:, :2, :2], k[:, :2, 2:], k[:, 2:, 2:])
                  for k in (bay.stiffness for bay in self._bays)]
        none = np.zeros_like(blocks[0][0])
        self._left, self._right = [(none, none)], [(none, none)]
        for near, across, far in blocks[:-1]:
            self._left.append(_one_more(self._left[-1][0], far, across.transpose(0, 2, 1), near))
        for near, across, far in blocks[:0:-1]:
            self._right.append(_one_more(self._right[-1][0], near, across, far))
        self._right.reverse()

    def bay(self, number: int) -> CondensedBay:
        """Return the bay of that number; InputError beyond the ends of the track."""
        if not self.first <= number <= self.last:
            low = self.first * self.spacing + self.start
            high = (self.last + 1) * self.spacing + self.start
            raise InputError(
                f'bay {number} (around {number * self.spacing:g} m): outside the track of '
                f'{len(self._bays)} bays, {low:g} to {high:g} m, sleepers {self.first} to '
                f'{self.last}')
        return self._bays[number - self.first]

    def closures(self, number: int) -> tuple[ComplexArray, ComplexArray]:
        """Return what the bays on either side add to the ends of the loaded one."""
        return self._left[number - self.first][0], self._right[number - self.first][0]

    def carry(self, ends: ComplexArray, loaded: int, number: int) -> ComplexArray:
        """Carry end displacements from the loaded bay to another."""
        if number > loaded:
            near = far = ends[:, 2:, None]
            for k in range(loaded, number):
                near, far = far, self._right[k - self.first][1] @ far
            return np.concatenate((near, far), axis=1)[..., 0]
        near = far = ends[:, :2, None]
        for k in range(loaded, number, -1):
            near, far = far, self._left[k - self.first][1] @ far
        return np.concatenate((far, near), axis=1)[..., 0]

    def locate(self, x: float) -> tuple[int, float]:
        """Find the bay of the track position x [m]; the last one owns its right end."""
        number, inside = super().locate(x)
        at_the_end = number == self.last + 1 and inside < 1e-9 * self.spacing
        return (self.last, self.spacing) if at_the_end else (number, inside)


def _one_more(
    hold: ComplexArray, near: ComplexArray, across: ComplexArray, far: ComplexArray,
) -> tuple[ComplexArray, ComplexArray]:
    """Put a bay before a row that resists with `hold`: stiffness at its near end, and the step.

    Blocks (f, 2, 2) of the bay: near end, near-far, far end.
    """
    step = -np.linalg.solve(far + hold, across.transpose(0, 2, 1))
    return near + across @ step, step


def checked_frequencies(frequencies: ArrayLike) -> Array:
    """Return frequencies (f,) [Hz] as an array; InputError unless all are in 0 < f <= 20 kHz."""
    values = np.atleast_1d(np.asarray(frequencies, dtype=float))
    if values.size == 0:
        raise InputError('frequencies: none given')
    wrong = values[~(np.isfinite(values) & (values > 0.0))]
    if wrong.size:
        raise InputError(f'frequencies: {wrong[0]:g} Hz is not a frequency above zero')
    if values.max() > HIGHEST:
        raise InputError(f'frequencies: {values.max():g} Hz is above {HIGHEST:g} Hz, where the '
                         'rail is no beam any more')
    return values


def receptances(
    model: Track | Bay | FiniteTrack, frequencies: ArrayLike,
    responses: Sequence[float | Sleeper], force: float | Sleeper,
    progress: Callable[[int], object] | None = None,
) -> ComplexArray:
    """Find receptances (responses, f) [m/N] at places along the track for a force at one place.

    model: a :class:`Track` for the exact infinite track, a :class:`Bay` for infinitely many such
    bays of finite elements, or a :class:`FiniteTrack`; frequencies: (f,) Hz; places: metres along
    the rail (sleeper k at k * spacing) or a Sleeper; progress: called with the number of
    frequencies just done.

    Raises InputError for frequencies that are not above zero, places outside the track, and an
    infinite track that is not periodic.
    """
    values = checked_frequencies(frequencies)
    for place in (*responses, force):
        if not isinstance(place, Sleeper) and not math.isfinite(place):
            raise InputError(f'position {place!r}: expected metres along the track')
    result = np.empty((len(responses), values.size), dtype=complex)
    for start in range(0, values.size, AT_A_TIME):
        part = slice(start, start + AT_A_TIME)
        response = harmonic_row(model, values[part]).excite(force)
        for i, place in enumerate(responses):
            result[i, part] = response.at(place)
        if progress is not None:
            progress(len(values[part]))
    return result


def receptance(
    model: Track | Bay | FiniteTrack, frequencies: ArrayLike, response: float | Sleeper,
    force: float | Sleeper | None = None,
) -> ComplexArray:
    """Find one receptance (f,) [m/N]: the point receptance unless the force acts elsewhere."""
    return receptances(model, frequencies, [response], response if force is None else force)[0]


def harmonic_row(model: Track | Bay | FiniteTrack, frequencies: ArrayLike) -> Row:
    """Prepare a track to be excited at some frequencies (f,) [Hz]; see `receptances`."""
    if isinstance(model, Track):
        return InfiniteRow(ExactBay(model, frequencies))
    if isinstance(model, Bay):
        return InfiniteRow(FiniteElementBay(model, frequencies))
    return FiniteRow(model, frequencies)
