"""Figures 2.2 to 2.6: the local system of the Timoshenko element."""

from __future__ import annotations

import dataclasses

import numpy as np
import scipy.sparse.linalg

from railtrack_ros.dynamics.window import assemble
from railtrack_ros.figures.cases import SPEED_2_1, drive, sleepers, table_2_1, table_3_1, thinned
from railtrack_ros.figures.content import (
    AGREES,
    DIFFERS,
    MISPRINT,
    UNKNOWN,
    Array,
    Curve,
    Figure,
    Finding,
    Panel,
)
from railtrack_ros.track import rail as tim4
from railtrack_ros.track.bay import Bay, Mesh, make_bay
from railtrack_ros.track.description import Rail
from railtrack_ros.vehicle.description import load_vehicle

LENGTH = 0.15  # m, of the clamped beam of figures 2.3 and 2.4
PRINTED = np.array([6196.0, 12284.0, 18160.0, 18645.0])  # Hz, figure 2.3
STATIC_FORCE = 55e3  # N, figure 2.2: puts the deflection where the thesis has it
JUMP_REACH = 5e-3  # m: half a contact patch
FORCE_FACTOR = (0.8, 1.2)


def rail_of_figure_2_3() -> Rail:
    """Return the rail that has the printed frequencies: table 2.1's with E = 210 GPa."""
    return dataclasses.replace(table_2_1().rail, youngs_modulus=210e9)


def local_deflection(rail: Rail, length: float, load: float, x: Array) -> Array:
    """Deflection (n,) [m/N] at x [m] of the clamped beam under a unit force at `load` [m].

    Two elements meet at the load; thesis (2.7) and (2.8), whose sign is that of a force upwards
    on a deflection counted downwards.
    """
    left = tim4.stiffness_matrix(rail, load)[2:, 2:]
    right = tim4.stiffness_matrix(rail, length - load)[:2, :2]
    joint = np.linalg.solve(left + right, [1.0, 0.0])
    before = tim4.shape_functions(rail, load, np.minimum(x, load))[0][:, 2:] @ joint
    after = tim4.shape_functions(rail, length - load, np.maximum(x - load, 0.0))[0][:, :2] @ joint
    return np.where(x <= load, before, after)


def static_shape(elements: int, load: float, x: Array, local: bool) -> Array:
    """Deflection (n,) [m/N] of 61 bays of table 3.1's track at x under a unit force upwards."""
    bay = make_bay(table_3_1('CVS'), Mesh(elements, local_system='none'))
    bays, nb = 61, bay.dofs
    number, inside = bay.locate(load)
    first = int(number[0]) - bays // 2
    force = np.zeros((bays + 1) * nb)
    at = (int(number[0]) - first) * nb
    force[at:at + nb + 2] = bay.shape(inside)[0]
    free = slice(2, bays * nb)
    stiffness = assemble(bay.stiffness, bays)
    u = np.zeros_like(force)
    u[free] = scipy.sparse.linalg.spsolve(stiffness[free, free], force[free])
    bay_of_x, inside_x = bay.locate(x)
    places = ((bay_of_x - first) * nb)[:, None] + np.arange(nb + 2)
    result: Array = (bay.shape(inside_x) * u[places]).sum(axis=1)
    if local:
        element = int(np.searchsorted(bay.nodes, inside[0], side='right')) - 1
        ends = number[0] * bay.spacing + bay.start + bay.nodes[element:element + 2]
        within = (x >= ends[0]) & (x <= ends[1])
        result[within] += local_deflection(
            bay.track.rail, float(ends[1] - ends[0]), load - float(ends[0]), x[within] - ends[0])
    return result


def figure_2_2() -> Figure:
    """Static deflection of a rail under a force at a quarter of the span, three models."""
    spacing = 0.6
    load = 15.25 * spacing
    x = np.unique(np.append(np.linspace(7.0, 13.0, 1201), load))
    coarse, repaired, fine = (-STATIC_FORCE * static_shape(n, load, x, local)
                              for n, local in ((2, False), (2, True), (4, False)))
    at = int(np.searchsorted(x, load))
    lack = 1.0 - coarse[at] / fine[at]
    rest = np.abs(repaired - fine).max() / np.abs(fine).max()
    return Figure(
        f'Table 3.1, concentrated supports, 61 bays, {STATIC_FORCE / 1e3:.0f} kN at x_a = 0.25 l '
        'beyond the sleeper at 9 m.',
        (Panel('position_m', 'Position (m)', 'Vertical displacement (m)', x,
               (Curve('two_elements_m', '2 elements per bay', coarse, ':'),
                Curve('two_elements_local_m', '2 elements per bay + local sys.', repaired, '--'),
                Curve('four_elements_m', '4 elements per bay', fine)),
               x_limits=(7.0, 13.0), y_limits=(-5.5e-4, 0.5e-4),
               supports=sleepers(spacing, 7.0, 13.0),
               inset=((9.0, 9.6), (1.03 * float(fine.min()), 0.75 * float(fine.min())))),),
        (Finding('without local system two elements a bay underestimate the deflection under the '
                 'load', f'by {100.0 * lack:.1f} %', AGREES),
         Finding('with it they agree with four elements a bay',
                 f'largest difference {rest:.1e} of the deflection: the same up to rounding',
                 AGREES),
         Finding('track and force', "its axes' 9.0 to 9.6 m is a bay of table 3.1; the force is "
                 f'chosen to fit its scale, {STATIC_FORCE / 1e3:.0f} kN', UNKNOWN)))


def _told(values: Array) -> str:
    return ', '.join(f'{value:,.1f}' for value in values)


def figure_2_3() -> Figure:
    """First four modes of a beam of 0.15 m clamped at both ends."""
    found = {'as printed': tim4.clamped_modes(table_2_1().rail, LENGTH, 4),
             'E = 210 GPa': tim4.clamped_modes(rail_of_figure_2_3(), LENGTH, 4),
             'UIC60': tim4.clamped_modes(table_3_1().rail, LENGTH, 4)}
    hertz = {name: modes.angular_frequency / (2.0 * np.pi) for name, modes in found.items()}
    modes = found['E = 210 GPa']
    x = np.linspace(0.0, LENGTH, 301)
    w, theta = modes.shapes(x)
    turned = np.sign(theta[5])  # all rotate the same way at the left end
    w, theta = w * turned, theta * turned
    lines = ('-', ':', '-.', '--')
    labels = [f'{f:,.0f} Hz' for f in hertz['E = 210 GPa']]
    worst = np.abs(hertz['E = 210 GPa'] / PRINTED - 1.0).max()

    return Figure(
        "Beam of 0.15 m, table 2.1's rail with E = 210 GPa, mass-normalised by (2.13).",
        (Panel('position_m', 'Position (m)', 'Normalised displacement (-)', x,
               tuple(Curve(f'mode_{i + 1}', labels[i], w[:, i], lines[i]) for i in range(4)),
               title='(a) vertical vibration mode shapes', name='a', x_limits=(0.0, LENGTH)),
         Panel('position_m', 'Position (m)', 'Normalised bending rotation (-)', x,
               tuple(Curve(f'mode_{i + 1}', labels[i], theta[:, i], lines[i]) for i in range(4)),
               title='(b) bending vibration mode shapes', name='b', x_limits=(0.0, LENGTH))),
        (Finding('6196, 12284, 18160, 18645 Hz, rail said to be UIC60',
                 f'UIC60 (table 3.1) has {_told(hertz["UIC60"])} Hz; table 2.1 as printed '
                 f'(E = 207 GPa) {_told(hertz["as printed"])} Hz; with E = 210 GPa '
                 f'{_told(hertz["E = 210 GPa"])} Hz, within {100.0 * worst:.3f} % of the figure',
                 MISPRINT),
         Finding('displacements within ±0.5, rotations from about -2 to 10',
                 f'displacements up to {np.abs(w).max():.2f}, rotations {theta.min():.1f} to '
                 f'{theta.max():.1f}; the sign of a mode is free', AGREES)),
        columns=2)


def figure_2_4() -> Figure:
    """Flexibility of the clamped beam by 1, 3, 6 and 20 modes against the static one."""
    rail = table_3_1().rail
    x = np.linspace(0.0, LENGTH, 301)
    static = tim4.clamped_flexibility(rail, LENGTH, x)
    modes = tim4.clamped_modes(rail, LENGTH, 20, terms=48)
    w, _ = modes.shapes(x)
    shares = w**2 / modes.angular_frequency**2
    curves = tuple(Curve(f'modes_{n}_m_per_n', f'{n} vibration mode{"s" if n > 1 else ""}',
                         shares[:, :n].sum(axis=1), line)
                   for n, line in ((1, ':'), (3, '-.'), (6, '--'), (20, '-')))
    middle = x.size // 2
    share = {n: shares[middle, :n].sum() / static[middle] for n in (1, 3, 6, 20)}
    other = tim4.clamped_flexibility(table_2_1().rail, LENGTH, 0.5 * LENGTH)[0]
    below = bool((shares.sum(axis=1) <= static * (1.0 + 1e-9) + 1e-30).all())
    return Figure(
        'UIC60 rail of table 3.1, beam of 0.15 m.',
        (Panel('position_m', 'Position (m)', 'Flexibility (m/N)', x,
               (*curves, Curve('static_m_per_n', 'Static', static)), x_limits=(0.0, LENGTH),
               y_limits=(0.0, 16e-11)),),
        (Finding('the static flexibility takes many modes; six leave a gap, which the residual '
                 'flexibility fills',
                 'at the middle 1, 3, 6, 20 modes give '
                 + ', '.join(f'{100.0 * value:.1f}' for value in share.values())
                 + ' % of the static one; never more than it anywhere'
                 + ('' if below else ' (violated)'), AGREES if below else DIFFERS),
         Finding('axis up to about 15e-11 m/N',
                 f'{static[middle]:.3e} m/N at the middle; the rail of table 2.1 would reach '
                 f'{other:.3e}', AGREES),
         Finding('L = 0.15 cm', '0.15 m', MISPRINT)))


def _bay(elements: int, local_system: str) -> Bay:
    return make_bay(table_2_1(), Mesh(elements, local_system=local_system))


def _force_factor(elements: int, local_system: str) -> tuple[Array, Array]:
    """Positions from 10 to 11.4 m and contact force over the static load, in steps of 82 um."""
    vehicle = load_vehicle('blanco_table_2_1')
    bay = _bay(elements, local_system)
    x, result = drive(bay, vehicle, SPEED_2_1, 10.0, 11.4, time_step=2e-6, run_up=12)
    return x, result.contact_force[:, 0] / vehicle.wheel.static_load


def largest_jump(x: Array, force: Array, bay: Bay) -> float:
    """Largest jump of a force's slope [1/m] at the nodes of a mesh, (n,) over positions x (n,).

    One-sided cubics over half the length of a contact patch.  Above a support at a point the jump
    is that of the track, and left out.
    """
    last = int(x[-1] / bay.spacing) + 2
    nodes = np.concatenate([k * bay.spacing + bay.start + bay.nodes[:-1] for k in range(last)])
    wanted = (nodes > x[0] + JUMP_REACH) & (nodes < x[-1] - JUMP_REACH)
    if bay.track.support.kind != 'distributed':
        wanted &= np.abs(nodes / bay.spacing - np.rint(nodes / bay.spacing)) > 1e-6
    jumps = []
    for node in nodes[wanted]:
        slopes = []
        for side in (-1.0, 1.0):
            way = side * (x - node)
            near = (way > 0.0) & (way < JUMP_REACH)
            slopes.append(np.polyfit(x[near] - node, force[near], 3)[-2])
        jumps.append(abs(slopes[1] - slopes[0]))
    return max(jumps)


def _temporal(conditions: str, models: dict[tuple[int, str], tuple[str, str, str]],
              findings: tuple[Finding, ...], found: dict[tuple[int, str], tuple[Array, Array]],
              ) -> Figure:
    """Contact force factor from 10.2 to 11.2 m of several models."""
    x, *values = thinned(found[next(iter(models))][0], *(found[key][1] for key in models))
    curves = tuple(Curve(name, label, value, line) for (name, label, line), value in
                   zip(models.values(), values, strict=True))
    return Figure(
        conditions,
        (Panel('distance_m', 'Distance (m)', 'Contact force factor', x, curves,
               x_limits=(10.1, 11.3), y_limits=FORCE_FACTOR,
               supports=sleepers(table_2_1().support.spacing, 10.1, 11.3)),), findings)


TABLE_2_1_RUN = ('Table 2.1, concentrated supports, rail without loss, 148 km/h, steps of 2 us, '
                 '12 bays of run-up.')


def figure_2_5a() -> Figure:
    """Contact force with the static local system and without any, 8 elements a bay."""
    keys = {(8, 'static'): ('static_local_system', 'Static approach', '-'),
            (8, 'none'): ('no_local_system', 'Conventional Timoshenko element', '--')}
    found = {key: _force_factor(*key) for key in keys}
    _, true = _force_factor(8, 'dynamic')
    apart = {key: np.abs(factor - true).max() for key, (_, factor) in found.items()}
    jump = largest_jump(*found[8, 'static'], _bay(8, 'static'))
    return _temporal(
        TABLE_2_1_RUN, keys,
        (Finding('the static local system is a significant enhancement',
                 'largest difference of the force factor from the converged one (dynamic local '
                 f'system, 8 elements) {apart[8, "static"]:.4f} instead of '
                 f'{apart[8, "none"]:.4f}',
                 AGREES if apart[8, 'static'] < 0.5 * apart[8, 'none'] else DIFFERS),
         Finding('discontinuities remain each time the load overtakes a node',
                 f'jumps of slope up to {jump:.1f} 1/m at the nodes between the sleepers',
                 AGREES if jump > 1.0 else DIFFERS)), found)


def figure_2_5b() -> Figure:
    """Contact force with the dynamic and the static local system."""
    keys = {(8, 'static'): ('static_local_system', 'Static approach', '-'),
            (4, 'dynamic'): ('dynamic_local_system', 'Dynamic approach', '--')}
    found = {key: _force_factor(*key) for key in keys}
    jumps = {key: largest_jump(*found[key], _bay(*key)) for key in keys}
    low, high = found[4, 'dynamic'][1].min(), found[4, 'dynamic'][1].max()
    return _temporal(
        TABLE_2_1_RUN + ' Dynamic: 4 elements a bay, 6 modes in every element (the thesis: in the '
        '5 around the load). Static: 8 elements a bay.', keys,
        (Finding('with the dynamic local system the discontinuities become insignificant',
                 f'largest jump of slope between the sleepers {jumps[4, "dynamic"]:.2f} against '
                 f'{jumps[8, "static"]:.1f} 1/m of the static one, '
                 f'{100.0 * jumps[4, "dynamic"] / jumps[8, "static"]:.1f} %',
                 AGREES if jumps[4, 'dynamic'] < 0.1 * jumps[8, 'static'] else DIFFERS),
         Finding('force factor within 0.8 to 1.2 (axis)', f'{low:.3f} to {high:.3f}', AGREES)),
        found)


def figure_2_6() -> Figure:
    """Convergence of the dynamic local system: 2 against 8 elements a bay."""
    keys = {(2, 'dynamic'): ('two_elements', '2 elements per bay', '-'),
            (8, 'dynamic'): ('eight_elements', '8 elements per bay', '--')}
    found = {key: _force_factor(*key) for key in keys}
    (_, two), (_, eight) = (found[key] for key in keys)
    apart = np.std(two - eight) / np.std(eight)
    jump = largest_jump(*found[2, 'dynamic'], _bay(2, 'dynamic'))
    return _temporal(
        TABLE_2_1_RUN + ' 6 modes in every element.', keys,
        (Finding('two elements a bay agree with eight',
                 f'RMS of the difference {100.0 * apart:.2f} % of the dynamic force; extremes '
                 f'{two.min():.4f}, {two.max():.4f} and {eight.min():.4f}, {eight.max():.4f}',
                 AGREES if apart < 0.02 else DIFFERS),
         Finding('the discontinuity stays at a low level with two elements',
                 f'largest jump of slope between the sleepers {jump:.2f} 1/m', AGREES)), found)
