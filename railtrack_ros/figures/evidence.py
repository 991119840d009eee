"""Evidence in the frequency domain and at rest: misprints, the exact track, closed forms."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from railtrack_ros.dynamics.closed_forms import smeared_foundation, timoshenko_winkler
from railtrack_ros.dynamics.receptance import (
    finite_track,
    local_modes_around,
    receptance,
)
from railtrack_ros.dynamics.resonances import contact_stiffness, track_resonances
from railtrack_ros.figures.cases import steady_3_1, table_3_1
from railtrack_ros.figures.chapter3 import peak
from railtrack_ros.track import teef
from railtrack_ros.track.bay import Mesh, make_bay
from railtrack_ros.track.description import Track
from railtrack_ros.track.rail import pinned_pinned_frequency
from railtrack_ros.vehicle.description import load_vehicle

PLACES = (0.0, 0.3, 0.2625)  # m: sleeper, mid-span, inside an element
FREQUENCIES = (100.0, 514.0, 900.0, 1080.0, 2500.0)  # Hz
MESHES = (
    ('concentrated', 'CVS', Mesh(2, local_system='dynamic')),
    ('concentrated', 'CVS', Mesh(4, local_system='dynamic')),
    ('concentrated', 'CVS', Mesh(4)),
    ('concentrated', 'CVS', Mesh(8)),
    ('concentrated', 'CVS', Mesh(16)),
    ('concentrated', 'CVS', Mesh(8, local_system='none')),
    ('distributed', 'DS', Mesh(4, elements_per_pad=1, local_system='dynamic')),
    ('distributed', 'DS', Mesh(5, elements_per_pad=1)),
    ('distributed', 'DS', Mesh(8)),
    ('distributed', 'DS', Mesh(16, elements_per_pad=4)),
)


@dataclass(frozen=True)
class Section:
    """A part of the page in Markdown; `digest` is its result in a line."""

    title: str
    text: str
    digest: str = ''


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = ['| ' + ' | '.join(row) + ' |' for row in (head, ['---'] * len(head), *rows)]
    return '\n'.join(lines)


def percent(value: float) -> str:
    """Return a ratio in per cent with two significant digits."""
    return f'{100.0 * value:.2g} %' if value < 0.1 else f'{100.0 * value:.0f} %'


def misprints() -> Section:
    """Values and formulas of the thesis that cannot be as printed."""
    return Section('What is misprinted, and how that shows', '\n\n'.join((
        'Figures 2.3, 3.3 and 4.1 above hold further cases; the ratios 6.25 and 1.92 are in '
        'figure 3.4a.', _pad_damping(), _rotational(), _contact(), _teef_stiffness())),
        'pad damping, the rail of figure 2.3, the stiffness of the TEEF and the normalisation of '
        '(4.2) cannot be as printed, the contact stiffness of table 3.1 is a linear one; 6.25 and '
        '1.92 are no constants of a model')


def _pad_damping() -> str:
    found = {}
    for damping in (48.0, 48e3):
        track = table_3_1('CVS')
        support = dataclasses.replace(track.support, pad_damping=damping)
        model = dataclasses.replace(track, support=support)
        found[damping] = peak(model, 400.0, 650.0, 0.3)
    return (
        '**Pad damping, table 3.1: "48 Ns/m".** The second resonance at mid-span would be '
        f'{found[48.0][1]:.2e} m/N, far off the axis of figure 3.4 (1e-9 to 1e-8). With 48 kNs/m '
        f'it is {found[48e3][1]:.2e} m/N at {found[48e3][0]:.0f} Hz. Table 2.1 has kNs/m too.')


def _rotational() -> str:
    track = table_3_1('CVRS')
    base = peak(table_3_1('DS'), 1040.0, 1110.0, 0.3)[1]
    lengths = np.linspace(0.7, 1.0, 13) ** 0.5  # of the pad: stiffness goes with its square
    ratios = [peak(dataclasses.replace(track, support=dataclasses.replace(
        track.support, pad_length=factor * track.support.pad_length)), 1040.0, 1110.0, 0.3)[1]
        / base for factor in lengths]
    share = float(np.interp(-1.92, -np.array(ratios), lengths**2))
    return (
        '**Rotational support, "1.92".** The spring of a pad of length Ls is Kp Ls²/12, and the '
        f'peak then {ratios[-1]:.3f} times that of the distributed support. 1.92 is reached with '
        f'{share:.2f} of that spring; what the thesis used it does not say.')


def _contact() -> str:
    hertz = load_vehicle('blanco_table_3_1')
    linear = dataclasses.replace(hertz, contact=dataclasses.replace(
        hertz.contact, stiffness=1.028e9, exponent=1.0))
    rows = []
    for support in ('CVS', 'DS'):
        _, first = steady_3_1(support, vehicle=hertz, time_step=25e-6)
        _, second = steady_3_1(support, vehicle=linear, time_step=25e-6)
        apart = np.abs(first.contact_force - second.contact_force).max() / 1e3
        rows.append([support, *(f'{r.contact_force.min() / 1e3:.2f} to '
                                f'{r.contact_force.max() / 1e3:.2f}' for r in (first, second)),
                     f'{apart:.3f}'])
    return (
        '**Contact stiffness, table 3.1: 1.028 GN/m.** The unit is that of a linear contact (n = '
        '0). The Hertzian one of the same literature is 100 GN/m^1.5, as in table 2.1; its '
        f'tangent under 100 kN is {contact_stiffness(hertz) / 1e9:.3f} GN/m. On a smooth rail the '
        'difference is small, 24 m/s, kN:\n\n'
        + table(('supports', '100 GN/m^1.5', '1.028 GN/m, linear', 'largest difference'), rows))


def _teef_stiffness() -> str:
    rows = []
    track = table_3_1('DS')
    foundation = track.support.pad_stiffness / track.support.pad_length
    rigid = np.array([1.0, 0.0, 1.0, 0.0, 1.0])
    for length in (0.16, 0.5):
        made = teef.teef_matrices(track.rail, length, foundation)
        printed = made.stiffness.copy()
        printed[4] -= made.rail_stiffness[4]
        printed[:4, 4] -= made.rail_stiffness[:4, 4]
        scale = foundation * length
        rows.append([f'{length:g} m', *(f'{np.abs(matrix @ rigid).max() / scale:.1e}'
                                        for matrix in (printed, made.stiffness))])
    return (
        '**Stiffness of the TEEF, (3.17) with (3.20) and (3.21).** As printed it leaves the strain '
        'energy of Ns out. A rigid-body motion of rail and sleeper together must not strain '
        'anything; the largest force that it causes, over kd L:\n\n'
        + table(('length', 'as printed', 'all five functions'), rows))


def _error(model: object, exact: np.ndarray, x: float) -> np.ndarray:
    found = receptance(model, FREQUENCIES, x)  # type: ignore[arg-type]
    error: np.ndarray = np.abs(found / exact - 1.0)
    return error


def exact_track() -> Section:
    """Meshes against the exact infinite track, and local modes in five elements only."""
    rows, accurate = [], 0.0
    for kind, support, mesh in MESHES:
        track = table_3_1(support, 0.02)
        worst = np.max([_error(make_bay(track, mesh), receptance(track, FREQUENCIES, x), x)
                        for x in PLACES], axis=0)
        if mesh.local_system == 'dynamic':
            accurate = max(accurate, float(worst.max()))
        pads = f', {mesh.elements_per_pad or 2} over the pad' if support == 'DS' else ''
        rows.append([kind, f'{mesh.elements_per_bay}{pads}', mesh.local_system,
                     *map(percent, worst)])
    hertz = [f'{f:g} Hz' for f in FREQUENCIES]
    track, x = table_3_1('CVS', 0.02), 0.225
    whole = finite_track(track, Mesh(4, local_system='dynamic'), 121)
    exact = receptance(track, FREQUENCIES, x)
    five = [[name, *map(percent, _error(model, exact, x))] for name, model in (
        ('every element', whole), ('five around the load', local_modes_around(whole, x, 5)))]
    return Section('The exact infinite track, and convergence of the mesh', '\n\n'.join((
        'The infinite periodic track is solved without a mesh: dynamic stiffness of the rail, '
        'condensed to one bay, closed by the two waves that decay away from the load. It shares '
        'nothing with the finite elements but the input. Its values agree with a table found by '
        'another method (transfer matrices, and a Green function with 241 support reactions) to '
        'the digits of that table (`test/test_infinite_track.py`). Error of finite-element bays, '
        'infinitely many, table 3.1, loss factor 0.02, the largest at sleeper, mid-span and a '
        'place inside an element:',
        table(('supports', 'elements a bay', 'local system', *hertz), rows),
        'Near 1080 Hz an error is mostly a shift of the pinned-pinned frequency.',
        '**Five local elements against modes everywhere.** The thesis gives modes to five elements '
        'around the load, which then has to be followed by the matrices. Modes in every element '
        'leave the matrices constant, and are more accurate by orders of magnitude. Concentrated '
        'supports, 4 elements a bay, load between nodes at 0.225 m, 121 bays:',
        table(('local modes in', *hertz), five))),
        'two to four elements a bay with dynamic local system stay within '
        f'{percent(accurate)} of the exact infinite track up to 2500 Hz')


def closed_forms() -> Section:
    """Limits with a known solution."""
    track = table_3_1('CVS', 0.0)
    foundation = smeared_foundation(track.support)
    continuous = float(timoshenko_winkler(track.rail, foundation, 100e3)[()])
    rows = []
    for n in (3, 6, 12, 24):
        fine = spread(track, n)
        static = 100e3 * abs(receptance(fine, [0.01], 0.0)[0])
        rows.append([f'{fine.support.spacing * 1e3:.0f} mm', f'{1e3 * static:.6f}',
                     f'{static / continuous - 1.0:+.1e}'])
    pinned = pinned_pinned_frequency(track.rail, track.support.spacing)
    found = peak(table_3_1('CVS', 1e-5), 1060.0, 1075.0, 0.3)[0]
    resonances = {(r.name, r.place): r for r in track_resonances(table_3_1('DS'))}
    known = (('in-phase', 'midspan', 89.66, 1.3992e-8), ('dip', 'midspan', 236.0, 1.2012e-9),
             ('out-of-phase', 'midspan', 517.3, 3.3435e-9),
             ('pinned-pinned', 'midspan', 1080.69, 3.3240e-9),
             ('pinned-pinned antiresonance', 'sleeper', 1123.5, 1.6648e-10))
    apart = max(abs(found_there / value - 1.0) for name, place, f, m in known
                for found_there, value in ((resonances[name, place].frequency, f),
                                           (resonances[name, place].magnitude, m)))
    named = [[f'{name}, {place}', f'{f:g} Hz, {m:.4e}',
              f'{resonances[name, place].frequency:.2f} Hz, '
              f'{resonances[name, place].magnitude:.4e}'] for name, place, f, m in known]
    return Section('Closed forms and known values', '\n\n'.join((
        'Supports spread out over more and more sleepers tend to a continuous foundation; '
        'deflection under a standing force of 100 kN, Timoshenko beam on a Winkler foundation '
        f'{1e3 * continuous:.6f} mm:',
        table(('support every', 'deflection [mm]', 'against the closed form'), rows),
        f'A rail pinned at every sleeper resonates at {pinned:.2f} Hz (quadratic equation); the '
        f'peak of the track on concentrated supports lies at {found:.2f} Hz.',
        'Resonances of table 3.1, distributed supports, rail without loss, against values computed '
        'independently by transfer matrices (m/N):',
        table(('resonance', 'independent', 'here'), named))),
        f'closely spaced supports come within {abs(static / continuous - 1.0):.0e} of the closed '
        f'form, five resonances within {apart:.0e} of independent values')


def spread(track: Track, n: int) -> Track:
    """Return the same foundation in n times as many supports."""
    support = track.support
    return dataclasses.replace(track, support=dataclasses.replace(
        support, spacing=support.spacing / n, pad_length=0.01,
        **{name: getattr(support, name) / n for name in (
            'pad_stiffness', 'pad_damping', 'sleeper_mass', 'ballast_stiffness',
            'ballast_damping')}))
