"""One bay of the track as a finite-element mesh: the cell from which every track is assembled.

A bay reaches from one mesh node to the node one sleeper spacing further on and holds one sleeper.
Its matrices act on its own degrees of freedom followed by the deflection and rotation of the next
bay's left node, so that a track is a row of bays overlapping by two degrees of freedom.  Dynamics
(full model, Bloch ring, receptance) sees nothing but a :class:`Bay`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railtrack_ros.errors import InputError
from railtrack_ros.track import rail as tim4
from railtrack_ros.track import teef
from railtrack_ros.track.description import Rail, Support, Track
from railtrack_ros.track.rail import Array

LOCAL_SYSTEMS = ('none', 'static', 'dynamic')


@dataclass(frozen=True)
class Mesh:
    """How a bay is cut into elements and what represents the rail inside them.

    elements_per_bay counts the elements over the pad too.  elements_per_pad is 2 for distributed
    and 4 for multipoint supports unless given; point supports have none.  local_system: 'none',
    'static' (flexibility of the clamped element, thesis 2.15) or 'dynamic' (clamped modes in
    every element and the residual flexibility, thesis 2.11-2.16).
    """

    elements_per_bay: int = 8
    elements_per_pad: int | None = None
    local_system: str = 'static'
    modes_per_element: int = 6
    local_damping_ratio: float = 0.01


@dataclass(frozen=True)
class Interpolation:
    """Piecewise-cubic form of the rail's deflection over one bay.

    In interval i, with s = (x - breaks[i]) / (breaks[i+1] - breaks[i]) in 0..1 and x in metres
    from the bay's left end, degree of freedom dofs[i, k] has the weight
    sum_c coefficients[i, k, c] s^c, and the local system the flexibility sum_c flexibility[i, c]
    s^c [m/N].  breaks (m + 1,), dofs (m, k), coefficients (m, k, 4), flexibility (m, 4).  Cubics
    are exact for TIM4; elsewhere the intervals are short enough for 1e-7 of a unit displacement.
    """

    breaks: Array
    dofs: NDArray[np.int64]
    coefficients: Array
    flexibility: Array

    def locate(self, x: ArrayLike) -> tuple[NDArray[np.int64], Array]:
        """Interval index and local coordinate s for x (n,) metres from the bay's left end."""
        x = np.atleast_1d(np.asarray(x, dtype=float))
        last = len(self.breaks) - 2
        index = np.clip(np.searchsorted(self.breaks, x, side='right') - 1, 0, last)
        s = (x - self.breaks[index]) / (self.breaks[index + 1] - self.breaks[index])
        return index, s


@dataclass(frozen=True)
class Bay:
    """One period of the track; bay k covers k * spacing + start + [0, spacing).

    dofs: nb, the bay's own degrees of freedom.  Matrices are (nb + 2, nb + 2), symmetric; the last
    two rows are the next bay's left node.  rail_stiffness is the share of `stiffness` that the
    hysteretic loss factor of the rail multiplies in the frequency domain: K + i eta K_rail.
    support_damping holds pads and ballast.  rail_damping is the time domain's equivalent of the
    rail's loss: proportional to stiffness, eta / omega_pp K_rail with omega_pp the pinned-pinned
    frequency (exact there, less below, more above), and 2 zeta omega for local modes.
    """

    track: Track
    mesh: Mesh
    start: float
    dofs: int
    nodes: Array
    node_dofs: NDArray[np.int64]
    sleeper_dof: int
    modal_dofs: NDArray[np.int64]
    stiffness: Array
    rail_stiffness: Array
    support_damping: Array
    rail_damping: Array
    mass: Array
    table: Interpolation

    @property
    def spacing(self) -> float:
        """Sleeper spacing [m]."""
        return self.track.support.spacing

    @property
    def damping(self) -> Array:
        """Damping (nb + 2, nb + 2) of the time domain [N s/m]."""
        return self.support_damping + self.rail_damping

    def locate(self, x: ArrayLike) -> tuple[NDArray[np.int64], Array]:
        """Bay number and distance [m] from that bay's left end of track positions x (n,) [m]."""
        x = np.atleast_1d(np.asarray(x, dtype=float))
        number = np.floor((x - self.start) / self.spacing)
        inside = np.clip(x - self.start - number * self.spacing, 0.0, self.spacing)
        return number.astype(np.int64), inside

    def shape(self, x: ArrayLike) -> Array:
        """Weights N(x) of the nb + 2 degrees of freedom for x (n,) [m] from the left end."""
        index, s = self.table.locate(x)
        powers = s[:, None] ** np.arange(4)
        weights = np.einsum('nkc,nc->nk', self.table.coefficients[index], powers)
        result = np.zeros((index.size, self.dofs + 2))
        rows = np.arange(index.size)
        for k in range(self.table.dofs.shape[1]):
            np.add.at(result, (rows, self.table.dofs[index, k]), weights[:, k])
        return result

    def flexibility(self, x: ArrayLike) -> Array:
        """Instantaneous flexibility [m/N] of the local system, x (n,) [m] from the left end."""
        index, s = self.table.locate(x)
        return np.einsum('nc,nc->n', self.table.flexibility[index], s[:, None] ** np.arange(4))


@dataclass(frozen=True)
class _Element:
    """Matrices and fields of one element; `slots` are its degrees of freedom in the bay."""

    left: float
    length: float
    slots: list[int]
    stiffness: Array
    rail_stiffness: Array
    support_damping: Array
    rail_damping: Array
    mass: Array
    weights: Callable[[Array], Array]
    flexibility: Callable[[Array], Array]
    intervals: int


def make_bay(track: Track, mesh: Mesh | None = None, tangent: bool = False) -> Bay:
    """Mesh and matrices of one bay.

    `tangent` takes the stiffness of a non-linear support at its static preload; without it such a
    support is refused, as linear theory would be wrong about it.

    Raises
    ------
    InputError
        A mesh that does not fit the support, a track that is not periodic, or not linear.
    """
    track.require_periodic('a mesh of one bay for the whole track')
    if not tangent:
        track.require_linear('a linear model')
    mesh = mesh or Mesh()
    support = track.support
    nodes, pad = _node_positions(support, mesh)
    start = float(nodes[0])
    count = len(nodes) - 1
    modes = mesh.modes_per_element if mesh.local_system == 'dynamic' else 0

    # Degrees of freedom in order along the track, the sleeper after the node above its centre
    # or before it: whichever comes first at or after x = 0.
    node_dofs, modal_dofs = [], []
    sleeper, number = -1, 0
    for i, x in enumerate(nodes[:-1]):
        node_dofs.append(number)
        number += 2
        if sleeper < 0 and (x > -1e-9 or i == count - 1):
            sleeper = number
            number += 1
        modal_dofs.append(list(range(number, number + modes)))
        number += modes
    node_dofs.append(number)
    total = number + 2

    # One description serves every element of the same kind and length.
    made: dict[tuple[bool, float], _ElementKind] = {}
    matrices: dict[str, Array] = {name: np.zeros((total, total)) for name in
                ('stiffness', 'rail_stiffness', 'support_damping', 'rail_damping', 'mass')}
    elements = []
    for i in range(count):
        length = float(nodes[i + 1] - nodes[i])
        over_pad = i in pad and support.kind == 'distributed'
        key = (over_pad, round(length, 9))
        if key not in made:
            made[key] = _ElementKind(track, mesh, length, over_pad)
        ends = [node_dofs[i], node_dofs[i] + 1, node_dofs[i + 1], node_dofs[i + 1] + 1]
        slots = ends + ([sleeper] if over_pad else []) + modal_dofs[i]
        element = made[key].at(float(nodes[i]) - start, slots)
        grid = np.ix_(slots, slots)
        for name, matrix in matrices.items():
            matrix[grid] += getattr(element, name)
        elements.append(element)

    _add_sleeper(matrices, track, nodes, node_dofs, pad, sleeper)
    return Bay(
        track=track, mesh=mesh, start=start, dofs=number,
        nodes=nodes - start, node_dofs=np.array(node_dofs, dtype=np.int64), sleeper_dof=sleeper,
        modal_dofs=np.array(modal_dofs, dtype=np.int64).reshape(-1),
        table=_interpolation(elements), **matrices,
    )


def keep_local_modes(bay: Bay, elements: Sequence[int]) -> Bay:
    """The bay with local modes in some of its elements only; the others' are uncoupled.

    elements: indices from the bay's left end.  The thesis gives modes to a few elements around the
    load; a load outside them is then not represented.
    """
    modes = bay.modal_dofs.reshape(len(bay.nodes) - 1, -1)
    lost = np.delete(modes, list(elements), axis=0).ravel()
    changed = {}
    for name in ('stiffness', 'rail_stiffness', 'support_damping', 'rail_damping', 'mass'):
        matrix = getattr(bay, name).copy()
        own = np.diag(matrix)[lost].copy()
        matrix[lost, :] = matrix[:, lost] = 0.0
        matrix[lost, lost] = own
        changed[name] = matrix
    return dataclasses.replace(bay, **changed)


def make_bays(track: Track, mesh: Mesh | None, first: int, count: int) -> list[Bay]:
    """Bays first .. first + count - 1 of a track that need not be periodic; equal ones are shared.

    Raises InputError where neighbouring bays do not meet at a node.
    """
    made: dict[tuple[Rail, Support], Bay] = {}
    bays = []
    for number in range(first, first + count):
        own = track.bay(number)
        key = (own.rail, own.support)
        if key not in made:
            made[key] = make_bay(own, mesh)
        bays.append(made[key])
        if abs(made[key].start - bays[0].start) > 1e-9:
            raise InputError(f'track {track.name}: the meshes of bays {first} and {number} do not '
                             'meet at a node; take an even number of elements between the pads')
    return bays


def _node_positions(support: Support, mesh: Mesh) -> tuple[Array, range]:
    """Node positions (relative to the sleeper) of the bay and the elements that are the pad's."""
    kind, spacing, total = support.kind, support.spacing, mesh.elements_per_bay
    if mesh.local_system not in LOCAL_SYSTEMS:
        raise InputError(f'local system {mesh.local_system!r}: expected one of '
                         + ', '.join(LOCAL_SYSTEMS))
    if kind in ('concentrated', 'concentrated_rotational'):
        if mesh.elements_per_pad is not None:
            raise InputError(f'elements per pad: a {kind} support has no element over the pad')
        if total < 1:
            raise InputError(f'elements per bay: {total} is too few, at least 1 is needed')
        after = spacing / total * np.arange(total + 1)
        cut = total // 2
        return np.concatenate([after[cut:] - spacing, after[1:cut + 1]]), range(0)
    per_pad = mesh.elements_per_pad or (4 if kind == 'multipoint' else 2)
    span = total - per_pad
    if per_pad < 1 or span < 1:
        raise InputError(f'elements per bay: {total} is too few with {per_pad} over the pad, '
                         f'at least {max(per_pad, 1) + 1} are needed')
    half = 0.5 * support.pad_length
    over = np.linspace(-half, half, per_pad + 1)
    after = np.linspace(half, spacing - half, span + 1)
    cut = span // 2
    nodes = np.concatenate([after[cut:-1] - spacing, over, after[1:cut + 1]])
    first = span - cut
    return nodes, range(first, first + per_pad)


class _ElementKind:
    """One kind of element (TIM4 or TEEF of one length) with its local system."""

    def __init__(self, track: Track, mesh: Mesh, length: float, over_pad: bool) -> None:
        rail, support = track.rail, track.support
        foundation = support.pad_stiffness / support.pad_length if over_pad else 0.0
        damping = support.pad_damping / support.pad_length if over_pad else 0.0
        self.rail, self.length, self.foundation = rail, length, foundation
        self.over_pad = over_pad
        self.modes = None
        if mesh.local_system == 'dynamic':
            self.modes = tim4.clamped_modes(rail, length, mesh.modes_per_element, foundation)
        self.static = mesh.local_system != 'none'
        count = 0 if self.modes is None else mesh.modes_per_element
        size = (5 if over_pad else 4) + count
        nodal = slice(0, size - count)

        self.stiffness, self.rail_stiffness, self.support_damping, self.mass = (
            np.zeros((size, size)) for _ in range(4))
        if over_pad:
            m = teef.teef_matrices(rail, length, foundation)
            self.stiffness[nodal, nodal] = m.stiffness
            self.rail_stiffness[nodal, nodal] = m.rail_stiffness
            self.support_damping[nodal, nodal] = damping * m.damping_shape
            self.mass[nodal, nodal] = m.mass
        else:
            self.stiffness[nodal, nodal] = tim4.stiffness_matrix(rail, length)
            self.rail_stiffness[nodal, nodal] = self.stiffness[nodal, nodal]
            self.mass[nodal, nodal] = tim4.mass_matrix(rail, length)
        # Time domain: equivalent viscous damping of the rail's hysteretic loss.
        pinned = 2.0 * math.pi * tim4.pinned_pinned_frequency(rail, support.spacing)
        self.rail_damping = rail.loss_factor / pinned * self.rail_stiffness
        if self.modes is not None:
            self._add_modes(rail, damping, mesh.local_damping_ratio)

    def _add_modes(self, rail: Rail, damping: float, ratio: float) -> None:
        """Modal rows: frequencies, mass cross terms m_ij (2.16) and the pad's damping."""
        assert self.modes is not None
        omega = self.modes.angular_frequency
        n = self.stiffness.shape[0] - omega.size
        x, weight = tim4.gauss(self.length)
        w, theta = self.modes.shapes(x)
        nodal_w, nodal_theta = self._nodal(x)
        cross = (rail.mass_per_length * w.T @ (weight[:, None] * nodal_w)
                 + rail.rotary_inertia * theta.T @ (weight[:, None] * nodal_theta))
        self.mass[n:, :n], self.mass[:n, n:] = cross, cross.T
        self.mass[n:, n:] = np.eye(omega.size)
        # Clamped modes are orthogonal to the static shape functions in strain energy.
        self.stiffness[n:, n:] = np.diag(omega**2)
        foundation_share = self.foundation * w.T @ (weight[:, None] * w)
        self.rail_stiffness[n:, n:] = np.diag(omega**2) - foundation_share
        self.rail_damping[n:, n:] = np.diag(2.0 * ratio * omega)
        if self.over_pad:
            stretch = nodal_w.copy()
            stretch[:, 4] -= 1.0
            coupling = w.T @ (weight[:, None] * stretch)
            self.rail_stiffness[n:, :n] = -self.foundation * coupling
            self.rail_stiffness[:n, n:] = -self.foundation * coupling.T
            self.support_damping[n:, :n] = damping * coupling
            self.support_damping[:n, n:] = damping * coupling.T
            self.support_damping[n:, n:] = damping * w.T @ (weight[:, None] * w)

    def _nodal(self, x: Array) -> tuple[Array, Array]:
        """Deflection and rotation of the rail for unit nodal (and sleeper) displacements."""
        if self.over_pad:
            field = teef.static_field(self.rail, self.length, self.foundation, x)
            return field.deflection, field.rotation
        return tim4.shape_functions(self.rail, self.length, x)

    def weights(self, x: Array) -> Array:
        """Weights (n, dofs) of the element's degrees of freedom in the deflection at x."""
        nodal = self._nodal(x)[0]
        return nodal if self.modes is None else np.hstack([nodal, self.modes.shapes(x)[0]])

    def flexibility(self, x: Array) -> Array:
        """F_sta, or the residual flexibility F_sta - sum W^2 / omega^2 (2.14) [m/N]."""
        if not self.static:
            return np.zeros_like(x)
        if self.over_pad:
            f = teef.clamped_flexibility(self.rail, self.length, self.foundation, x)
        else:
            f = tim4.clamped_flexibility(self.rail, self.length, x)
        if self.modes is not None:
            f = f - (self.modes.shapes(x)[0] ** 2 / self.modes.angular_frequency**2).sum(axis=1)
        return f

    def at(self, left: float, slots: list[int]) -> _Element:
        """This kind of element at `left` metres from the bay's left end."""
        if self.modes is not None:
            intervals = 6 * self.modes.angular_frequency.size
        else:
            intervals = 12 if self.static else (2 if self.over_pad else 1)
        return _Element(left, self.length, slots, self.stiffness, self.rail_stiffness,
                        self.support_damping, self.rail_damping, self.mass,
                        self.weights, self.flexibility, intervals)


def _add_sleeper(
    matrices: dict[str, Array], track: Track, nodes: Array, node_dofs: list[int],
    pad: range, sleeper: int,
) -> None:
    """Sleeper and ballast, and the springs and dampers of pads that act on single nodes."""
    support = track.support
    matrices['mass'][sleeper, sleeper] += support.sleeper_mass
    matrices['stiffness'][sleeper, sleeper] += support.ballast_stiffness
    matrices['support_damping'][sleeper, sleeper] += support.ballast_damping

    shares: dict[int, float] = {}
    if support.kind in ('concentrated', 'concentrated_rotational'):
        shares = {int(np.argmin(np.abs(nodes))): 1.0}
    elif support.kind == 'multipoint':
        for i in pad:
            for node in (i, i + 1):
                shares[node] = shares.get(node, 0.0) + 0.5 / len(pad)
    for node, share in shares.items():
        grid = np.ix_([node_dofs[node], sleeper], [node_dofs[node], sleeper])
        spring = share * np.array([[1.0, -1.0], [-1.0, 1.0]])
        matrices['stiffness'][grid] += support.pad_stiffness * spring
        matrices['support_damping'][grid] += support.pad_damping * spring
        if support.kind == 'concentrated_rotational':
            rotation = node_dofs[node] + 1
            arm = support.pad_length**2 / 12.0
            matrices['stiffness'][rotation, rotation] += support.pad_stiffness * arm
            matrices['support_damping'][rotation, rotation] += support.pad_damping * arm


def _interpolation(elements: list[_Element]) -> Interpolation:
    """Cubics through four points of each interval: continuous, and exact where N is cubic."""
    width = max(len(e.slots) for e in elements)
    s = np.array([0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0])
    fit = np.linalg.inv(s[:, None] ** np.arange(4))
    breaks, dofs, coefficients, flexibility = [0.0], [], [], []
    tables: dict[tuple[int, float], tuple[Array, Array]] = {}
    for e in elements:
        edges = np.linspace(0.0, e.length, e.intervals + 1)
        key = (len(e.slots), round(e.length, 9))
        if key not in tables:
            x = (edges[:-1, None] + np.diff(edges)[:, None] * s).reshape(-1)
            weights = e.weights(x).reshape(e.intervals, 4, -1)
            tables[key] = (np.einsum('cp,ipk->ikc', fit, weights),
                           e.flexibility(x).reshape(e.intervals, 4) @ fit.T)
        cubic, f = tables[key]
        breaks.extend((e.left + edges[1:]).tolist())
        padding = width - len(e.slots)
        dofs.extend([e.slots + [0] * padding] * e.intervals)
        coefficients.append(np.pad(cubic, ((0, 0), (0, padding), (0, 0))))
        flexibility.append(f)
    return Interpolation(
        breaks=np.array(breaks), dofs=np.array(dofs, dtype=np.int64),
        coefficients=np.concatenate(coefficients), flexibility=np.concatenate(flexibility),
    )
