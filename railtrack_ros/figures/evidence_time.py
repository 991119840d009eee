"""Evidence in the time domain: steps, energy, three solvers, there and back, a real record."""

from __future__ import annotations

import dataclasses

import numpy as np

from railtrack_ros import paths
from railtrack_ros.dynamics.closed_forms import smeared_foundation, timoshenko_winkler
from railtrack_ros.dynamics.newmark import FullModel, assemble
from railtrack_ros.dynamics.receptance import receptance
from railtrack_ros.dynamics.recursive import RecursiveForward
from railtrack_ros.estimation.estimator import Estimator
from railtrack_ros.estimation.settings import EstimatorSettings
from railtrack_ros.figures.cases import SOLVERS, table_3_1
from railtrack_ros.figures.content import Array
from railtrack_ros.figures.evidence import Section, percent, spread, table
from railtrack_ros.irregularity.profile import iso3095
from railtrack_ros.irregularity.spectra import third_octave_levels
from railtrack_ros.runs.virtual_run import RailSurface, RunSettings, simulate_run
from railtrack_ros.track.bay import Bay, Mesh, make_bay
from railtrack_ros.track.description import load_track
from railtrack_ros.vehicle.description import AxleBox, Vehicle, load_vehicle

SPEED = 40.0  # m/s
ROUGH_STEP = 1.6e-4  # m between the samples of the roughness
DURATION = 0.6  # s


def _rough(position: Array, wheels: int = 1) -> Array:
    """Roughness after ISO 3095 at positions (n,), faded in over a metre; (n, wheels)."""
    profile = iso3095(SPEED * DURATION + 30.0, 1e-3, seed=3, start=-14.0)
    places = position[:, None] - np.array([0.0, 2.5])[:wheels]
    return np.asarray(profile.at(places) * np.clip(position, 0.0, 1.0)[:, None])


def moving_load() -> Section:
    """Full model on many light supports against the closed form of a moving load."""
    track, vehicle = table_3_1('CVS', 0.0), load_vehicle('blanco_table_3_1')
    foundation = smeared_foundation(track.support)
    fine = spread(track, 6)
    fine = dataclasses.replace(fine, support=dataclasses.replace(
        fine.support, pad_damping=0.0, ballast_damping=0.0, sleeper_mass=1e-3))
    bay = make_bay(fine, Mesh(2))
    at_rest = np.mean([abs(receptance(fine, [0.01], x)[0]) for x in np.linspace(0.0, 0.1, 50)])
    discrete = float(at_rest / timoshenko_winkler(track.rail, foundation, 1.0)[()]) - 1.0
    rows, worst = [], 0.0
    for speed in (24.0, 100.0, 300.0):
        found = moving_deflection(bay, vehicle, speed)
        closed = float(timoshenko_winkler(
            track.rail, foundation, vehicle.wheel.static_load, 0.0, speed)[()])
        worst = max(worst, abs(found / closed - 1.0))
        rows.append([f'{speed:g} m/s', f'{1e3 * closed:.5f}', f'{1e3 * found:.5f}',
                     f'{found / closed - 1.0:+.1e}'])
    return Section('A moving load in the time domain', '\n\n'.join((
        'Closed form: Timoshenko beam on a continuous foundation without mass or damping, load '
        'moving steadily. Full model: the same foundation as supports every 0.1 m, a wheel of '
        '100 kN that speeds up smoothly in 0.6 s; mean deflection under it over the next 0.1 s:',
        table(('speed', 'closed form [mm]', 'full model [mm]', 'difference'), rows),
        f'The supports being 0.1 m apart explains {discrete:+.1e}, the mean over all places of the '
        'static deflection against the closed form.')),
        f'the full model agrees with the closed form within {worst:.0e} at 24 to 300 m/s')


def moving_deflection(bay: Bay, vehicle: Vehicle, speed: float) -> float:
    """Mean downward deflection [m] under a wheel at `speed` [m/s], reached smoothly in 0.6 s."""
    step, ramp, hold = 2.5e-5, 0.6, 0.1
    t = step * np.arange(round((ramp + hold) / step))
    way = np.where(t < ramp, 0.5 * (t - ramp / np.pi * np.sin(np.pi * t / ramp)), t - 0.5 * ramp)
    model = FullModel(bay, vehicle, (0.0,), step, 0.0, margin=150)
    result = model.run(speed * way, np.zeros((t.size, 1)))
    return -float(result.rail_deflection[t >= ramp, 0].mean())


def mesh_in_time() -> Section:
    """Convergence of the mesh in the contact force over roughness."""
    vehicle, step = load_vehicle('blanco_table_3_1'), 25e-6
    position = SPEED * step * np.arange(round(DURATION / step))
    irregularity = _rough(position)

    def force(support: str, mesh: Mesh) -> Array:
        bay = make_bay(table_3_1(support, 0.02), mesh)
        return FullModel(bay, vehicle, (0.0,), step, 0.0).run(
            position, irregularity).contact_force[:, 0]

    rows, errors = [], {}
    for kind, support, finest, meshes in (
            ('concentrated', 'CVS', Mesh(8, local_system='dynamic'), (
                Mesh(2, local_system='dynamic'), Mesh(4, local_system='dynamic'),
                Mesh(8, local_system='none'), Mesh(8), Mesh(16))),
            ('distributed', 'DS', Mesh(8, local_system='dynamic'), (
                Mesh(4, elements_per_pad=1, local_system='dynamic'),
                Mesh(5, elements_per_pad=1), Mesh(6), Mesh(8), Mesh(16, elements_per_pad=4)))):
        true = force(support, finest)
        for mesh in meshes:
            error = float(np.std(force(support, mesh) - true) / np.std(true))
            errors[support, mesh] = error
            pads = f', {mesh.elements_per_pad or 2} over the pad' if support == 'DS' else ''
            rows.append([kind, f'{mesh.elements_per_bay}{pads}', mesh.local_system,
                         percent(error)])
    return Section('Convergence of the mesh in time', '\n\n'.join((
        'Contact force of the full model, table 3.1, 40 m/s over ISO 3095 roughness, steps of 25 '
        'us; RMS of the difference from 8 elements a bay with dynamic local system over the RMS of '
        'the dynamic part:',
        table(('supports', 'elements a bay', 'local system', 'error'), rows))),
        'contact force over roughness: '
        f'{percent(errors["DS", Mesh(8)])} from the converged one with the default mesh, '
        f'{percent(errors["CVS", Mesh(8, local_system="none")])} without any local system')


def time_step() -> Section:
    """Convergence in the time step."""
    bay = make_bay(table_3_1('DS', 0.02), Mesh(8))
    vehicle = load_vehicle('blanco_table_3_1')
    steps = 1e-4 / 2.0 ** np.arange(6)
    forces = []
    for step in steps:
        position = SPEED * step * np.arange(round(DURATION / step))
        model = FullModel(bay, vehicle, (0.0,), step, 0.0)
        forces.append(model.run(position, _rough(position)).contact_force[:, 0])
    # The next finer pair extrapolates the limit of a second-order scheme.
    limit = [forces[-1][:: 2**(5 - i)] for i in range(5)]
    errors = [float(np.std(f - best[:f.size]) / np.std(f))
              for f, best in zip(forces[:-1], limit, strict=True)]
    rows = [[f'{1e6 * step:g} us', percent(error),
             '' if i == 0 else f'{np.log2(errors[i - 1] / error):.2f}']
            for i, (step, error) in enumerate(zip(steps[:4], errors[:4], strict=True))]
    return Section('Convergence in the time step', '\n\n'.join((
        'Full model, table 3.1, 40 m/s over ISO 3095 roughness; RMS of the difference of the '
        f'contact force from that at {1e6 * steps[-1]:.3g} us, over the RMS of its dynamic part, '
        'and the order from one row to the next (two is what Newmark promises):',
        table(('step', 'error', 'order'), rows),
        'A reference has to run at 25 us or less.')),
        f'the error falls with the power {np.log2(errors[0] / errors[3]) / 3.0:.2f} of the step')


def energy() -> Section:
    """Balance of energy of a wheel that is driven over a wavy rail."""
    rows = []
    for step in 4e-5 / 2.0 ** np.arange(4):
        defect, exchanged = energy_defect(float(step))
        rows.append([f'{1e6 * step:g} us', f'{1e6 * defect:.2f} uJ', f'{defect / exchanged:.1e}'])
    return Section('Balance of energy', '\n\n'.join((
        'A wheel is driven through part of an element of table 3.1 over waves of 30 um. Energy of '
        'track, local deflection, contact spring and wheel, less what propulsion has put in and '
        'damping has taken, must not change; what is lacking in the end, and its share of the '
        'energy that was exchanged:', table(('step', 'defect', 'share'), rows),
        'It vanishes with the square of the step.')),
        f'closed to {defect / exchanged:.0e} of the energy exchanged at {1e6 * step:.0f} us')


def energy_defect(step: float) -> tuple[float, float]:
    """Return what the energy balance lacks in the end and what was exchanged [J]."""
    vehicle = load_vehicle('blanco_table_3_1')
    bay = make_bay(load_track('blanco_table_3_1'), Mesh(6))
    duration, way, begin = 4e-3, 0.09, 0.09
    t = step * np.arange(round(duration / step) + 1)
    position = begin + 0.5 * way * (1.0 - np.cos(np.pi * t / duration))
    speed = 0.5 * way * np.pi / duration * np.sin(np.pi * t / duration)
    turn = 2.0 * np.pi / 0.12
    irregularity = 30e-6 * np.sin(turn * (position - begin))
    incline = 30e-6 * turn * np.cos(turn * (position - begin))
    model = FullModel(bay, vehicle, (0.0,), step, begin, margin=20)
    mass, damping, stiffness = (assemble(x, model.bays)
                                for x in (bay.mass, bay.damping, bay.stiffness))
    contact, wheel = vehicle.contact, vehicle.wheel
    stored, power = np.zeros(t.size), np.zeros(t.size)
    wheel_speed = before = 0.0
    for i in range(t.size):
        result = model.run(position[i:i + 1], irregularity[i:i + 1, None])
        force, w = result.contact_force[0, 0], result.wheel_displacement[0, 0]
        acceleration = float(result.axle_box_acceleration[0, 0])
        wheel_speed += 0.5 * step * (acceleration + before) if i else 0.0
        before = acceleration
        u, v, _ = model.track_state()
        number, inside = bay.locate(position[i])
        places = (number[0] - model.first_bay) * bay.dofs + np.arange(bay.dofs + 2)
        h = 1e-6
        slope = ((bay.shape(inside + h) - bay.shape(inside - h))[0] / (2.0 * h)) @ u[places]
        local = bay.flexibility(inside)[0]
        local_slope = (bay.flexibility(inside + h) - bay.flexibility(inside - h))[0] / (2.0 * h)
        indentation = (force / contact.stiffness) ** (1.0 / contact.exponent)
        stored[i] = (0.5 * (v @ (mass @ v) + u @ (stiffness @ u)) + 0.5 * wheel.mass
                     * wheel_speed**2 + wheel.static_load * w
                     + force * indentation / (1.0 + contact.exponent) + 0.5 * local * force**2)
        power[i] = (speed[i] * (force * (slope + incline[i]) - 0.5 * local_slope * force**2)
                    - v @ (damping @ v))
    work = step * (power.sum() - 0.5 * (power[0] + power[-1]))
    return float(stored[-1] - stored[0] - work), float(np.abs(np.diff(stored)).sum())


def solvers() -> Section:
    """Full model, convolution and recursion over the same roughness."""
    vehicle, step = load_vehicle('blanco_table_3_1'), 25e-6
    position = SPEED * step * np.arange(round(DURATION / step))
    irregularity = _rough(position, 2)
    rows, apart = [], {'irf': 0.0, 'recursive': 0.0, 'all poles': 0.0}
    for support in ('CVS', 'CVRS', 'DS'):
        bay = make_bay(table_3_1(support, 0.02), Mesh(8))
        found = {name: make(bay, vehicle, (0.0, -2.5), step, 0.0).run(position, irregularity)
                 for name, make in SOLVERS.items()}
        exact = RecursiveForward(bay, vehicle, (0.0, -2.5), step, 0.0, maximum_frequency=20e3)
        found['all poles'] = exact.run(position, irregularity)
        full = found['newmark']
        for name, label in (('irf', 'convolution'), ('recursive', 'recursion'),
                            ('all poles', 'recursion, poles to 20 kHz')):
            apart[name] = max(apart[name], float(np.std(
                found[name].contact_force - full.contact_force) / np.std(full.contact_force)))
            rows.append([support, label, *(
                percent(float(np.std(getattr(found[name], field) - getattr(full, field))
                              / np.std(getattr(full, field))))
                for field in ('contact_force', 'rail_deflection'))])
    return Section('Full model, convolution, recursion', '\n\n'.join((
        'Three solvers on the same mesh (8 elements a bay, static local system) and steps of 25 '
        'us, two wheels 2.5 m apart at 40 m/s over ISO 3095 roughness, table 3.1, loss factor '
        '0.02. RMS of the difference from the full model over the RMS of the dynamic part:',
        table(('supports', 'solver', 'contact force', 'rail deflection'), rows),
        'What is left of the convolution is its memory of 0.1 s; of the recursion, that poles '
        'above its cut-off are not followed one by one.')),
        f'contact forces within {percent(apart["irf"])} (convolution) and '
        f'{percent(apart["recursive"])} (recursion) of the full model')


def there_and_back() -> Section:
    """Accelerations from a finer full model, turned back into force, deflection, irregularity."""
    track = load_track('blanco_table_3_1')
    vehicle = dataclasses.replace(load_vehicle('blanco_table_3_1'), axle_boxes=(
        AxleBox('lead', 'left', 0.0), AxleBox('trail', 'left', -2.5)))
    settings = RunSettings(duration=3.0, speed=24.0, acceleration=2.0, roughness='iso3095', seed=4)
    estimator = Estimator(track, vehicle, EstimatorSettings())
    kept: dict[str, list[Array]] = {key: [] for key in (
        'position', *(f'{kind} {box.name} {side}' for box in vehicle.axle_boxes
                      for kind in ('force', 'deflection', 'irregularity')
                      for side in ('true', 'found')))}
    for block in simulate_run(track, vehicle, settings):
        n = block.position.size
        begin = block.first / settings.sample_rate
        stamp = 1_000_000_000 + round(1e9 * begin)
        estimator.add_speed(stamp, float(settings.speed_at(begin)))
        estimated = estimator.process(stamp, np.arange(n) / settings.sample_rate,
                                      block.acceleration)
        assert estimated is not None
        kept['position'].append(block.position)
        for box in vehicle.axle_boxes:
            for kind, true, found in (
                    ('force', block.contact_force, estimated.contact_force),
                    ('deflection', block.rail_deflection, estimated.rail_deflection),
                    ('irregularity', block.irregularity, estimated.irregularity)):
                kept[f'{kind} {box.name} true'].append(true[box.name].astype(float))
                kept[f'{kind} {box.name} found'].append(found[box.name])
    whole = {key: np.concatenate(parts) for key, parts in kept.items()}
    rows = []
    surface = RailSurface(vehicle, settings)
    for box in vehicle.axle_boxes:
        valid = np.isfinite(whole[f'irregularity {box.name} found'])
        valid &= whole['position'] > 30.0
        cells = [box.name]
        for kind in ('force', 'deflection'):
            true, found = (whole[f'{kind} {box.name} {side}'][valid] for side in ('true', 'found'))
            cells.append(percent(float(np.std(found - true) / np.std(true))))
        last = float(whole['position'][valid].max()) - 0.5
        x = np.asarray(31.0 + 1e-3 * np.arange(round(1e3 * (last - 31.0))), dtype=np.float64)
        back = np.interp(x, whole['position'][valid],
                         whole[f'irregularity {box.name} found'][valid])
        wavelength, level = third_octave_levels(back, 1e-3)
        _, truth = third_octave_levels(surface.at('left', x, box.offset), 1e-3)
        off = level - truth
        for low, high in ((0.0099, 0.0201), (0.0199, 0.32), (0.31, 1.01)):
            inside = (wavelength > low) & (wavelength < high)
            cells.append(f'{np.abs(off[inside]).max():.2f} dB')
        rows.append(cells)
    return Section('There and back', '\n\n'.join((
        'Accelerations of two wheels come from the full model on a finer mesh with shorter steps '
        '(24 to 30 m/s, ISO 3095 roughness, noise of 0.3 m/s² RMS, 25.6 kHz); the estimator turns '
        'them back. Errors of force and deflection as RMS over the RMS of the dynamic part, those '
        'of the irregularity as the worst one-third octave:',
        table(('axle box', 'force', 'deflection', '10 to 20 mm', '20 to 315 mm', '0.3 to 1 m'),
              rows),
        'The noise alone is '
        f'{vehicle.wheel.mass * settings.noise:.0f} N RMS in the force.')),
        f'force within {max(row[1] for row in rows)}, deflection within '
        f'{max(row[2] for row in rows)}, irregularity within '
        f'{max(row[4] for row in rows)} in every one-third octave from 20 to 315 mm')


def measured_vibration() -> Section:
    """Indirect irregularity of a corrugated and a normal track from measured vibration."""
    title = 'Measured vibration'
    folder = paths.reference_data()
    if folder is None or not (folder / 'measured_corrugated_a.npz').is_file():
        return Section(title, 'Not computed: the environment variable RAILTRACK_DATA does not '
                       'name a folder with the recordings.')
    rows = []
    for label, name in (('normal', 'measured_normal_a'), ('corrugated', 'measured_corrugated_a')):
        with np.load(folder / f'{name}.npz') as data:
            speed = float(np.mean(data['speed_km_h'])) / 3.6
            step = 1e3 * float(np.median(np.abs(np.diff(data['position_km']))))
            vibration = {rail: np.asarray(data[rail], dtype=float) for rail in ('left', 'right')}
        for rail, acceleration in vibration.items():
            found = irregularity_of(acceleration, step / speed, speed)
            found = found[np.isfinite(found)]
            wavelength, level = third_octave_levels(found, step)
            band = (wavelength > 0.1) & (wavelength < 0.3)
            rms = float(np.sqrt(np.sum(10.0 ** (level[band] / 10.0))))
            rows.append([label, rail, f'{3.6 * speed:.0f} km/h', f'{rms:.1f}',
                         f'{1e3 * strongest_wavelength(found, step):.0f} mm'])
    return Section(title, '\n\n'.join((
        'Vibration recorded on a running vehicle on 0.5 km of normal and of corrugated track '
        '(repository TiraMisuLab01/AVMD_for_Rail_Corrugation_Detection; not part of this source, '
        'about 2 kHz). The place of the sensor is not told; it is taken for an axle box of table '
        "3.1's wheel on `mainline_soft_pads`, so the level is indicative, the wavelength is not. "
        'Known: strong waves of 231 to 243 mm on the corrugated part.',
        table(('track', 'rail', 'speed', 'RMS 100 to 300 mm [um]', 'strongest wavelength'),
              rows))),
        f'corrugated track: {rows[2][4]} (known: 231 to 243 mm) at {rows[2][3]} um RMS, normal '
        f'track {rows[0][3]} um')


def strongest_wavelength(irregularity: Array, step: float) -> float:
    """Return the wavelength [m] between 0.1 and 0.3 m at which the level is highest.

    Highest is the spectrum times the wavenumber, as one-third octaves weigh it, averaged over 15
    lines.
    """
    spectrum = np.abs(np.fft.rfft(irregularity * np.hanning(irregularity.size))) ** 2
    number = np.fft.rfftfreq(irregularity.size, step)
    window = (number > 1.0 / 0.3) & (number < 1.0 / 0.1)
    smooth = np.convolve(spectrum, np.ones(15) / 15.0, 'same')
    return float(1.0 / number[window][np.argmax(smooth[window] * number[window])])


def irregularity_of(acceleration: Array, time_step: float, speed: float) -> Array:
    """Estimate the irregularity (n,) [m] from one channel (n,) [m/s2] at constant speed."""
    vehicle = dataclasses.replace(load_vehicle('blanco_table_3_1'),
                                  axle_boxes=(AxleBox('box', 'left', 0.0),))
    estimator = Estimator(load_track('mainline_soft_pads'), vehicle, EstimatorSettings())
    parts = []
    for begin in range(0, acceleration.size, 256):
        block = acceleration[begin:begin + 256] - acceleration.mean()
        stamp = 1_000_000_000 + round(1e9 * begin * time_step)
        estimator.add_speed(stamp, speed)
        found = estimator.process(stamp, time_step * np.arange(block.size), {'box': block})
        if found is not None:
            parts.append(found.irregularity['box'])
    return np.concatenate(parts)
