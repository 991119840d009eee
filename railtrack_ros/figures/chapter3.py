"""Figures 3.2 to 3.7: the distributed support."""

from __future__ import annotations

import dataclasses

import numpy as np

from railtrack_ros.dynamics.receptance import finite_track, receptance
from railtrack_ros.figures.cases import (
    CORRUGATION,
    SPEED_CORRUGATED,
    drive,
    sleepers,
    steady_3_1,
    table_3_1,
    thinned,
)
from railtrack_ros.figures.chapter2 import largest_jump
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
    Surface,
)
from railtrack_ros.track import rail as tim4
from railtrack_ros.track import teef
from railtrack_ros.track.bay import Mesh, make_bay
from railtrack_ros.track.infinite import Sleeper
from railtrack_ros.vehicle.description import load_vehicle

LENGTH = 0.5  # m, of the elements of figures 3.2 and 3.3
STIFFNESSES = (100, 200, 300, 400, 600, 1000)  # MN/m^2, figure 3.2
BAYS = 91  # of the finite track of figure 3.4
RATIO_CVS, RATIO_CVRS = 6.25, 1.92  # to the distributed support's pinned-pinned peak


def figure_3_2() -> Figure:
    """Difference between the shape functions of TEEF and TIM4."""
    rail = table_3_1().rail
    xi = np.linspace(0.0, 1.0, 201)
    plain = tim4.shape_functions(rail, LENGTH, xi * LENGTH)[0]
    panels, tops = [], []
    for index, letter, label in ((0, 'a', '(N1 - NEF1) x 100'),
                                 (1, 'b', '(N2 - NEF2)/Nmax2 x 100')):
        scale = 100.0 / (1.0 if index == 0 else np.abs(plain[:, index]).max())
        curves = []
        for stiffness in STIFFNESSES:
            field = teef.static_field(rail, LENGTH, 1e6 * stiffness, xi * LENGTH).deflection
            curves.append(Curve(f'kd_{stiffness}_mn_per_m2', f'{stiffness} MN/m²',
                                scale * (plain[:, index] - field[:, index])))
        tops.append(float(max(curve.values.max() for curve in curves)))
        panels.append(Panel('xi', 'x/L', label, xi, tuple(curves), name=letter,
                            x_limits=(0.0, 1.0), title=f'({letter})'))
    other = dataclasses.replace(rail, shear_coefficient=0.6)
    difference = (tim4.shape_functions(other, LENGTH, xi * LENGTH)[0]
                  - teef.static_field(other, LENGTH, 1e9, xi * LENGTH).deflection[:, :4])
    stiffer = [100.0 * difference[:, i].max() / np.abs(plain[:, i]).max() for i in (0, 1)]
    weakest = teef.static_field(rail, LENGTH, 1.0, xi * LENGTH).deflection[:, :4]
    return Figure(
        'UIC60 rail of table 3.1, element of 0.5 m.', tuple(panels),
        (Finding('the disagreement grows with the stiffness; highest ticks of the axes 5 and 8',
                 f'largest at 1000 MN/m²: {tops[0]:.2f} and {tops[1]:.2f} %',
                 AGREES if 4.0 < tops[0] < 5.2 and 6.0 < tops[1] < 8.2 else DIFFERS),
         Finding('the beam is the UIC60 rail',
                 f'with a shear coefficient of 0.6 instead of 0.4 it would be {stiffer[0]:.2f} and '
                 f'{stiffer[1]:.2f} %, which fits the axes: a stiffer shear may have been used',
                 UNKNOWN),
         Finding('TIM4 is the limit of a vanishing foundation',
                 f'difference {np.abs(weakest - plain).max():.0e} at 1 N/m²', AGREES)),
        columns=2)


def figure_3_3() -> Figure:
    """Shape function of the sleeper over position and stiffness."""
    rail = table_3_1().rail
    xi = np.linspace(0.0, 1.0, 41)
    stiffness = np.linspace(0.0, 500.0, 26)
    z = np.array([teef.static_field(rail, LENGTH, 1e6 * kd, xi * LENGTH).deflection[:, 4]
                  for kd in stiffness])
    other = teef.static_field(rail, LENGTH, 500e6 / LENGTH, [0.5 * LENGTH]).deflection[0, 4]
    return Figure(
        'UIC60 rail of table 3.1, element of 0.5 m.',
        (Surface(('xi', 'stiffness_mn_per_m2', 'ns'), ('ξ (-)', 'Stiffness (MN/m²)', 'Ns'),
                 xi, stiffness, z),),
        (Finding('Ns up to less than 0.1 at 500 "MN/m"',
                 f'{z.max():.4f} with kd = 500 MN/m²; were 500 MN/m the stiffness of the whole '
                 f'pad, it would be {other:.3f}: the axis means stiffness per length, MN/m²',
                 MISPRINT),
         Finding('zero at the ends and without foundation',
                 f'{np.abs(z[:, [0, -1]]).max():.0e} and {np.abs(z[0]).max():.0e}', AGREES)))


def peak(track: object, low: float, high: float, x: float) -> tuple[float, float]:
    """Frequency [Hz] and magnitude [m/N] of the largest point receptance between two frequencies.

    track: as for dynamics.receptance.receptance.  The maximum is searched on finer and finer grids.
    """
    for _ in range(6):
        f = np.linspace(low, high, 101)
        magnitude = np.abs(receptance(track, f, x))  # type: ignore[arg-type]
        top = int(np.argmax(magnitude))
        low, high = f[max(top - 1, 0)], f[min(top + 1, 100)]
    return float(f[top]), float(magnitude[top])


def _receptances(x: float, low: float) -> Figure:
    """Rail and sleeper for a force at x; sleeper 0 answers, the first one beside mid-span."""
    f = np.unique(np.append(np.geomspace(low, 2500.0, 500), np.linspace(1000.0, 1180.0, 361)))
    curves, models = [], {}
    for support, line in (('CVS', '-'), ('CVRS', '--'), ('DS', '-.')):
        mesh = Mesh(8) if support == 'DS' else Mesh(8, local_system='dynamic')
        models[support] = finite_track(table_3_1(support), mesh, BAYS)
        curves.append(Curve(f'rail_{support.lower()}_m_per_n', f'Rail {support}',
                            np.abs(receptance(models[support], f, x)), line))
    for support, line in (('CVS', ':'), ('DS', ':')):
        curves.append(Curve(f'sleeper_{support.lower()}_m_per_n', f'Sleeper {support}',
                            np.abs(receptance(models[support], f, Sleeper(0), x)), line))
    place = 'at mid-span' if x else 'above a sleeper'
    conditions = (f'Table 3.1, rail without loss, {BAYS} bays with free ends, 8 elements a bay '
                  f'(point supports with dynamic local system); force and rail {place}, the '
                  'nearest sleeper.')
    panel = Panel('frequency_hz', 'Frequency (Hz)', 'Amplitude (m/N)', f, tuple(curves),
                  x_limits=(low, 2500.0), y_limits=(1e-9, 2e-8) if x else (1e-10, 2e-8),
                  logarithmic=True)
    return Figure(conditions, (panel,),
                  _at_midspan(x) if x else _above_sleeper())


def _at_midspan(x: float) -> tuple[Finding, ...]:
    """Peaks of figure 3.4a."""
    exact = {s: peak(table_3_1(s), 1040.0, 1110.0, x) for s in ('CVRS', 'DS')}
    lossy = {s: peak(table_3_1(s, 0.02), 1040.0, 1110.0, x) for s in ('CVS', 'CVRS', 'DS')}
    base = exact['DS'][1]
    by_length = {n: peak(finite_track(table_3_1('CVS'), Mesh(4, local_system='dynamic'), n),
                         1060.0, 1075.0, x)[1] / base for n in (21, 61, 81, 91, 121)}
    ratio = exact['CVRS'][1] / base
    enough = float(np.interp(RATIO_CVS, list(by_length.values()), list(by_length)))
    f = np.array([50.0, 100.0, 150.0, 200.0, 300.0, 517.0, 700.0, 900.0])
    apart = np.abs(np.abs(receptance(table_3_1('CVS'), f, x)
                          / receptance(table_3_1('DS'), f, x)) - 1.0)
    return (
        Finding('the support model matters from 200 Hz to the pinned-pinned frequency, there most',
                'CVS against DS: ' + ', '.join(f'{100.0 * a:.1f} % at {hz:g} Hz' for a, hz in
                                               zip(apart, f, strict=True))
                + f', {100.0 * (by_length[BAYS] - 1.0):.0f} % at the peak of {BAYS} bays',
                AGREES if apart[:3].max() < apart[3:].max() else DIFFERS),
        Finding('concentrated supports overestimate the pinned-pinned peak: '
                f'CVRS by {RATIO_CVRS}, CVS by {RATIO_CVS}, relative to DS',
                f'DS peaks at {exact["DS"][0]:.1f} Hz with {base:.3e} m/N (exact infinite track). '
                f'CVRS: {ratio:.3f}. CVS has no value of its own: without loss it is unbounded on '
                'the infinite track and grows with the length of a finite one, '
                + ', '.join(f'{value:.2f} ({n} bays)' for n, value in by_length.items())
                + f'; {RATIO_CVS} are about {enough:.0f} bays with free ends. With loss factor '
                f'0.02: {lossy["CVS"][1] / lossy["DS"][1]:.2f} and '
                f'{lossy["CVRS"][1] / lossy["DS"][1]:.2f}',
                'qualitatively; the numbers depend on the length of the track'),)


def _above_sleeper() -> tuple[Finding, ...]:
    """Antiresonances of figure 3.4b."""
    f = np.linspace(1050.0, 1200.0, 1501)
    dips = {}
    for support in ('CVS', 'CVRS', 'DS'):
        magnitude = np.abs(receptance(table_3_1(support), f, 0.0))
        dips[support] = f[int(np.argmin(magnitude))], float(magnitude.min())
    return (
        Finding('concentrated supports underestimate the antiresonance, less significantly than '
                'the peak; CVRS does not correct it',
                '; '.join(f'{s} {h:.3e} m/N at {hz:.0f} Hz' for s, (hz, h) in dips.items()),
                AGREES if max(dips['CVS'][1], dips['CVRS'][1]) < dips['DS'][1] else DIFFERS),)


def figure_3_4a() -> Figure:
    """Receptance at mid-span."""
    return _receptances(0.3, 1e2)


def figure_3_4b() -> Figure:
    """Receptance above a sleeper."""
    return _receptances(0.0, 1e1)


STEADY = ('Table 3.1, 24 m/s, smooth rail without loss, 8 elements a bay, static local system, '
          'steps of 5 us, 20 bays of run-up.')


def _steady() -> tuple[Array, dict[str, tuple[Array, Array]]]:
    """Positions, and deflection and force of the three supports."""
    found = {}
    for support in ('DS', 'CVRS', 'CVS'):
        x, result = steady_3_1(support)
        x, w, force = thinned(x, result.rail_deflection[:, 0], result.contact_force[:, 0])
        found[support] = w, force
    return x, found


def figure_3_5a() -> Figure:
    """Rail displacement under a wheel on a smooth rail."""
    x, found = _steady()
    spans = {s: np.ptp(w) for s, (w, _) in found.items()}
    curves = tuple(Curve(f'{s.lower()}_m', s, w, line) for (s, (w, _)), line in
                   zip(found.items(), ('-', '--', '-.'), strict=True))
    less = 1.0 - spans['DS'] / spans['CVS']
    return Figure(
        STEADY,
        (Panel('distance_m', 'Distance (m)', 'Vertical displacement (m)', x, curves,
               x_limits=(6.0, 9.0), y_limits=(-9e-4, -7.2e-4),
               supports=sleepers(0.6, 6.0, 9.0)),),
        (Finding('a certain stiffening by supports of finite length, CVRS and DS alike',
                 'mean deflection ' + ', '.join(f'{s} {1e3 * w.mean():.4f}' for s, (w, _) in
                                                found.items()) + ' mm',
                 AGREES if found['CVS'][0].mean() < min(found[s][0].mean() for s in ('DS', 'CVRS'))
                 else DIFFERS),
         Finding('the amplitude is only reduced by DS',
                 'peak to peak ' + ', '.join(f'{s} {1e6 * v:.1f}' for s, v in spans.items())
                 + f' um: DS {100.0 * less:.0f} % below CVS, CVRS '
                 f'{100.0 * (1.0 - spans["CVRS"] / spans["CVS"]):.0f} %',
                 AGREES if less > 2.0 * (1.0 - spans['CVRS'] / spans['CVS']) else DIFFERS),
         Finding('all within -9 to -7.2e-4 m (axis)',
                 f'{1e3 * min(w.min() for w, _ in found.values()):.4f} to '
                 f'{1e3 * max(w.max() for w, _ in found.values()):.4f} mm', AGREES)))


def figure_3_5b() -> Figure:
    """Contact force on a smooth rail."""
    x, found = _steady()
    curves = tuple(Curve(f'{s.lower()}_n', s, found[s][1], line) for s, line in
                   (('CVS', '-.'), ('CVRS', '--'), ('DS', '-')))
    # Steepest fall of the force on the way, per metre.
    steep = {s: -float(np.gradient(f, x).min()) / 1e3 for s, (_, f) in found.items()}
    jumps = []
    for local_system in ('static', 'dynamic'):
        mesh = Mesh(8, local_system=local_system)
        way, result = steady_3_1('DS', mesh)
        bay = make_bay(table_3_1('DS'), mesh)
        jumps.append(largest_jump(way, result.contact_force[:, 0], bay) / 1e3)
    ranges = ', '.join(f'{s} {f.min() / 1e3:.2f} to {f.max() / 1e3:.2f} kN'
                       for s, (_, f) in found.items())
    return Figure(
        STEADY,
        (Panel('distance_m', 'Distance (m)', 'Contact force (N)', x, curves,
               x_limits=(6.0, 9.0), y_limits=(0.95e5, 1.15e5),
               supports=sleepers(0.6, 6.0, 9.0)),),
        (Finding('concentrated supports disrupt the force abruptly at each support, with DS the '
                 'transition is much softer; the rotational spring is insignificant',
                 'steepest fall ' + ', '.join(f'{s} {v:.0f}' for s, v in steep.items()) + ' kN/m',
                 AGREES if steep['DS'] < 0.5 * min(steep['CVS'], steep['CVRS']) else DIFFERS),
         Finding('with DS only shear incompatibilities between elements are left, which a dynamic '
                 'local system of the TEEF would remove (future work of the thesis)',
                 f'made here: largest jump of slope at a node {jumps[1]:.1f} instead of '
                 f'{jumps[0]:.0f} kN/m', AGREES if jumps[1] < 0.1 * jumps[0] else DIFFERS),
         Finding('range of the force', ranges, UNKNOWN)))


def _corrugated(support: str) -> Figure:
    """Contact force from 6 to 8 m on a corrugated rail, amplitudes 0, 2 and 4 um."""
    bay = make_bay(table_3_1(support), Mesh(8))
    vehicle = load_vehicle('blanco_table_3_1')
    forces = []
    for amplitude in (0.0, 2e-6, 4e-6):
        x, result = drive(bay, vehicle, SPEED_CORRUGATED, 6.0, 8.0, amplitude=amplitude)
        x, force = thinned(x, result.contact_force[:, 0])
        forces.append(force)
    smooth, two, four = forces
    linear = np.std(four - smooth) / np.std(two - smooth)
    curves = (Curve('smooth_n', 'Smooth surfaces', smooth),
              Curve('amplitude_2_um_n', '2 µm roughness amplitude', two, '--'),
              Curve('amplitude_4_um_n', '4 µm roughness amplitude', four, '-.'))
    step = float(np.abs(np.diff(smooth)).max()) / 1e3
    findings = [
        Finding(f'4.1 cm at 44.4 m/s excite the pinned-pinned resonance '
                f'({SPEED_CORRUGATED / CORRUGATION:.0f} Hz)',
                f'the corrugation adds {np.std(two - smooth) / 1e3:.2f} and '
                f'{np.std(four - smooth) / 1e3:.2f} kN RMS, ratio {linear:.3f}', AGREES)]
    if support == 'DS':
        findings.append(Finding(
            'a wavy force without the disruption at the supports',
            f'smooth rail: {smooth.min() / 1e3:.2f} to {smooth.max() / 1e3:.2f} kN, largest '
            f'change within 1.3 mm {step:.3f} kN', AGREES))
    else:
        findings.append(Finding(
            'a discontinuity at each concentrated support',
            f'smooth rail: {smooth.min() / 1e3:.2f} to {smooth.max() / 1e3:.2f} kN, largest '
            f'change within 1.3 mm {step:.3f} kN', AGREES))
    findings.append(Finding(
        'axis from 0.95 to 1.15e5 N',
        f'2 um: {two.min() / 1e3:.1f} to {two.max() / 1e3:.1f} kN; 4 um: {four.min() / 1e3:.1f} to '
        f'{four.max() / 1e3:.1f} kN, lower than the axis goes unless "amplitude" means peak to '
        'peak', UNKNOWN))
    return Figure(
        f'Table 3.1, {support}, 44.4 m/s, rail without loss, 8 elements a bay, static local '
        'system, steps of 5 us; a crest at 0 m (the thesis does not tell its phase).',
        (Panel('distance_m', 'Distance (m)', 'Contact force (N)', x, curves,
               x_limits=(6.0, 8.0), y_limits=(0.88e5, 1.15e5),
               supports=sleepers(0.6, 6.0, 8.0)),), tuple(findings))


def figure_3_6() -> Figure:
    """Corrugated rail, distributed supports."""
    return _corrugated('DS')


def figure_3_7() -> Figure:
    """Corrugated rail, concentrated supports with rotational spring."""
    return _corrugated('CVRS')
