"""The command `simulate`: its table, its speeds, its two rails, and what it refuses."""

import csv
import json

import numpy as np
import pytest

from railtrack_ros.cli.main import main
from railtrack_ros.cli.simulate import COLUMNS
from railtrack_ros.dynamics.modes import make_track_modes
from railtrack_ros.errors import InputError
from railtrack_ros.irregularity import profile
from railtrack_ros.runs import forward_run
from railtrack_ros.runs.forward_run import SpeedHistory
from railtrack_ros.track.bay import make_bay
from railtrack_ros.track.description import load_track

STEP = 1e-4
SOLVERS = ('newmark', 'irf', 'recursive')
TWO_RAILS = """
wheel: {mass: 550.0, static_load: 100.0e3, radius: 0.46}
contact: {stiffness: 100.0e9, exponent: 1.5}
axle_boxes:
  - {name: lead_right, rail: right, offset: 0.0}
  - {name: lead_left, rail: left, offset: 0.0}
  - {name: trail_right, rail: right, offset: -2.5}
"""


def simulate(output, *options, vehicle='blanco_table_3_1', status=0):
    arguments = ['simulate', '--track', 'blanco_table_3_1', '--vehicle', str(vehicle),
                 '--time-step', STEP, '--output', output, *options]
    assert main([str(argument) for argument in arguments]) == status
    if not output.exists():
        return None
    with output.open() as file:
        rows = list(csv.DictReader(file))
    return {name: (np.array([row[name] for row in rows]) if name == 'axle_box' else
                   np.array([float(row[name]) for row in rows])) for name in COLUMNS}


def table(path, columns):
    with path.open('w', newline='') as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))
    return path


@pytest.fixture
def vehicle(tmp_path):
    path = tmp_path / 'two_rails.yaml'
    path.write_text(TWO_RAILS)
    return path


@pytest.fixture
def rough_file(tmp_path):
    x = np.arange(-10.0, 20.0, 1e-3)
    left, right = (profile.iso3095(30.0, 1e-3, s, -10.0, shortest=0.02).at(x) for s in (1, 2))
    return table(tmp_path / 'rough.csv', {'position_m': x, 'irregularity_left_m': left,
                                          'irregularity_right_m': right})


@pytest.mark.parametrize('solver', SOLVERS)
def test_table_has_every_axle_box_at_every_time_step(tmp_path, vehicle, solver):
    got = simulate(tmp_path / 'run.csv', '--solver', solver, '--speed', 30, '--start', 4,
                   '--distance', 1.5, vehicle=vehicle)
    steps = round(1.5 / 30 / STEP) + 1
    assert got['time_s'] == pytest.approx(np.repeat(STEP * np.arange(steps), 3))
    assert got['axle_box'].tolist() == ['lead_right', 'lead_left', 'trail_right'] * steps
    offsets = np.tile([0.0, 0.0, -2.5], steps)
    assert got['position_m'] == pytest.approx(4.0 + 30.0 * got['time_s'] + offsets)
    assert got['contact_force_n'][:3] == pytest.approx(100e3, rel=1e-12)
    assert got['rail_deflection_m'].max() < 0.0
    mass, load = 550.0, 100e3
    assert got['axle_box_acceleration_m_s2'] == pytest.approx(
        (got['contact_force_n'] - load) / mass, abs=1e-6)


def test_solvers_agree_on_a_rough_rail(tmp_path, vehicle, rough_file):
    runs = [simulate(tmp_path / f'{solver}.csv', '--solver', solver, '--speed', 30,
                     '--distance', 4, '--irregularity', rough_file, vehicle=vehicle)
            for solver in SOLVERS]
    dynamic = np.std(runs[0]['contact_force_n'])
    assert dynamic > 1e3
    # The convolution repeats the full model; the recursion leaves out poles above 8 kHz.
    for other, limit in zip(runs[1:], (1e-3, 1e-2), strict=True):
        difference = other['contact_force_n'] - runs[0]['contact_force_n']
        assert np.std(difference) < limit * dynamic


def test_each_rail_has_its_own_irregularity(tmp_path, vehicle, rough_file):
    smooth = simulate(tmp_path / 'smooth.csv', '--speed', 30, '--distance', 1, vehicle=vehicle)
    values = np.genfromtxt(rough_file, delimiter=',', names=True)
    only_left = table(tmp_path / 'left.csv', {
        'position_m': values['position_m'], 'irregularity_left_m': values['irregularity_left_m'],
        'irregularity_right_m': np.zeros(len(values))})
    got = simulate(tmp_path / 'run.csv', '--speed', 30, '--distance', 1, '--irregularity',
                   only_left, vehicle=vehicle)
    right = got['axle_box'] != 'lead_left'
    assert np.array_equal(got['contact_force_n'][right], smooth['contact_force_n'][right])
    difference = (got['contact_force_n'] - smooth['contact_force_n'])[~right]
    assert np.std(difference) > 500.0


def test_chunks_leave_no_trace(tmp_path, rough_file, monkeypatch):
    options = ('--speed', 30, '--distance', 1, '--irregularity', rough_file)
    whole = simulate(tmp_path / 'whole.csv', *options)
    monkeypatch.setattr(forward_run, 'CHUNK', 37)
    assert simulate(tmp_path / 'parts.csv', *options) is not None
    assert (tmp_path / 'parts.csv').read_text() == (tmp_path / 'whole.csv').read_text()
    some = simulate(tmp_path / 'some.csv', *options, '--every', 10)
    assert np.array_equal(some['contact_force_n'], whole['contact_force_n'][::10])


def test_speed_file_of_constant_speed_is_constant_speed(tmp_path):
    speeds = table(tmp_path / 'speed.csv', {'time_s': [5.0, 6.0], 'speed_m_s': [30.0, 30.0]})
    by_file = simulate(tmp_path / 'file.csv', '--speed-file', speeds, '--distance', 1.2)
    by_value = simulate(tmp_path / 'value.csv', '--speed', 30, '--distance', 1.2)
    assert by_file['time_s'][-1] == pytest.approx(0.04)
    assert by_file['contact_force_n'] == pytest.approx(by_value['contact_force_n'], rel=1e-6)


def test_speed_file_brakes_stops_and_reverses(tmp_path):
    speeds = table(tmp_path / 'speed.csv', {
        'time_s': [0.0, 0.1, 0.2, 0.3], 'speed_m_s': [20.0, 0.0, 0.0, -20.0]})
    got = simulate(tmp_path / 'run.csv', '--speed-file', speeds, '--start', 7)
    assert got['time_s'][-1] == pytest.approx(0.3)
    assert got['position_m'].max() == pytest.approx(8.0)
    standing = (got['time_s'] >= 0.1) & (got['time_s'] <= 0.2)
    assert got['position_m'][standing] == pytest.approx(8.0)
    assert got['position_m'][-1] == pytest.approx(7.0)
    assert np.abs(got['contact_force_n'] - 100e3).max() < 5e3


def test_summary_tells_extremes_and_loss_of_contact(tmp_path, capsys):
    x = np.arange(-1.0, 3.0, 1e-3)
    dip = np.where(np.abs(x - 1.15) < 0.15, -1e-3 * (1 - np.cos(2 * np.pi * (x - 1) / 0.3)), 0.0)
    dips = table(tmp_path / 'dip.csv', {'position_m': x, 'irregularity_m': dip})
    got = simulate(tmp_path / 'run.csv', '--speed', 40, '--distance', 2, '--irregularity', dips,
                   '--json')
    summary = json.loads(capsys.readouterr().out)
    box = summary['axle_boxes']['axle1_left']
    force = got['contact_force_n']
    assert box['contact_force_n']['max'] == force.max() > 200e3
    assert box['contact_force_n']['min'] == 0.0
    assert box['time_without_contact_s'] == pytest.approx(STEP * (force == 0.0).sum())
    assert box['rail_deflection_m']['min'] == got['rail_deflection_m'].min()
    assert summary['steps'] == len(force)
    assert summary['end_m'] == pytest.approx(2.0)
    assert 1.0 < summary['iterations_per_step'] < 10.0
    assert summary['microseconds_per_step'] > 0.0


def test_model_options_change_the_model(tmp_path, capsys):
    forces = []
    for options in ((), ('--support', 'concentrated'), ('--local-system', 'none'),
                    ('--elements-per-bay', 4), ('--loss-factor', 0.2), ('--margin', 3)):
        got = simulate(tmp_path / 'run.csv', '--speed', 40, '--distance', 1, *options)
        forces.append(got['contact_force_n'])
        assert all(np.abs(forces[-1] - other).max() > 0.01 for other in forces[:-1]), options
    assert 'Newton iterations' in capsys.readouterr().out


def test_places_far_out_are_named_to_the_centimetre(tmp_path, capsys):
    simulate(tmp_path / 'far.csv', '--speed', '24', '--start', '350000.4', '--distance', '0.12')
    assert 'time steps, 350000.4 to 350000.52 m' in capsys.readouterr().out


def test_failure_keeps_the_results_before_it(tmp_path, capsys):
    wall = table(tmp_path / 'wall.csv', {
        'position_m': [-1.0, 0.5, 0.502, 2.0], 'irregularity_m': [0.0, 0.0, 1e300, 0.0]})
    got = simulate(tmp_path / 'run.csv', '--speed', 40, '--distance', 1, '--irregularity', wall,
                   status=2)
    said = capsys.readouterr().err
    assert f'the {got["time_s"].size} time steps before' in said
    assert str(tmp_path / 'run.csv') in said
    assert said.count('\n') == 1


@pytest.mark.parametrize(('options', 'message'), [
    (('--speed', 0, '--distance', 1), '--speed'),
    (('--speed', -3, '--distance', 1), '--speed'),
    (('--speed', 30), '--distance is required'),
    (('--speed', 30, '--distance', 0), '--distance'),
    (('--speed', 30, '--distance', 1, '--time-step', 0), '--time-step'),
    (('--speed', 30, '--distance', 1, '--time-step', 1e-2), 'too long for the contact'),
    (('--speed', 30, '--distance', 1, '--time-step', 1e-13), 'time step'),
    (('--speed', 30, '--distance', 1e-3), 'longer than the whole run'),
    (('--speed', 3e4, '--distance', 10), 'too long for the speed'),
    (('--speed', 30, '--distance', 1, '--solver', 'irf', '--margin', 9), 'margin'),
    (('--speed', 30, '--speed-file', 'x.csv', '--distance', 1), 'not allowed with'),
    (('--speed-file', 'nowhere.csv'), 'nowhere.csv'),
    (('--speed', 30, '--distance', 1, '--irregularity', 'nowhere.csv'), 'nowhere.csv'),
    (('--speed', 30, '--distance', 1, '--solver', 'magic'), '--solver'),
])
def test_bad_options_are_refused_in_one_line(tmp_path, capsys, options, message):
    assert simulate(tmp_path / 'run.csv', *options, status=2) is None
    said = capsys.readouterr().err
    assert message in said
    assert said.count('\n') == 1


def test_profile_that_does_not_cover_the_run_is_refused(tmp_path, capsys):
    short = table(tmp_path / 'short.csv', {'position_m': [0.0, 1.0], 'irregularity_m': [0.0, 0.0]})
    assert simulate(tmp_path / 'run.csv', '--speed', 30, '--distance', 1.5, '--irregularity',
                    short, status=2) is None
    assert 'short.csv covers 0 to 1 m, but the wheels run from 0 to 1.5 m' in (
        capsys.readouterr().err)


@pytest.mark.parametrize(('times', 'speeds', 'message'), [
    ([0.0, 1.0, 1.0], [1.0, 1.0, 1.0], '1 s follows 1 s'),
    ([0.0, 1.0, 0.5], [1.0, 1.0, 1.0], '0.5 s follows 1 s'),
    ([0.0, 1.0], [1.0, 'fast'], 'line 3: column speed_m_s'),
    ([0.0, 0.1], [1.0, 1.0], 'ends after 0.1 m, before the distance of 5 m'),
])
def test_speed_files_that_cannot_be_driven_are_refused(tmp_path, capsys, times, speeds, message):
    path = table(tmp_path / 'speed.csv', {'time_s': times, 'speed_m_s': speeds})
    assert simulate(tmp_path / 'run.csv', '--speed-file', path, '--distance', 5,
                    status=2) is None
    said = capsys.readouterr().err
    assert 'speed.csv' in said
    assert message in said


def test_speed_history_is_integrated_exactly():
    history = SpeedHistory(np.array([1.0, 3.0, 4.0]), np.array([2.0, -2.0, 0.0]))
    assert history.duration == 3.0
    t = np.array([0.0, 1.0, 2.0, 3.0])
    assert history.distance_at(t) == pytest.approx([0.0, 1.0, 0.0, -1.0])
    assert history.extent(2.0) == pytest.approx((0.0, 1.0))
    assert history.extent(3.0) == pytest.approx((-1.0, 1.0))
    for distance, time in ((0.0, 0.0), (0.75, 0.5), (1.0, 1.0), (1.25, 1.5), (3.0, 3.0)):
        assert history.time_of_distance(distance) == pytest.approx(time)
    with pytest.raises(InputError, match='ends after 3 m'):
        history.time_of_distance(3.1)


@pytest.mark.parametrize(('options', 'words'), [
    (['--solver', 'newmark', '--hold', 'linear'], 'hold: the solver newmark does not have it'),
    (['--solver', 'irf', '--cut-off', '4000'], 'cut_off: the solver irf does not have it'),
    (['--solver', 'recursive', '--memory', '0.1'], 'memory: the solver recursive does not'),
    (['--solver', 'recursive', '--cut-off', '10'], 'cut-off of the poles: 10 Hz is too low'),
    (['--solver', 'irf', '--memory', '1e-5'], 'memory: 1e-05 s is too short'),
])
def test_options_of_another_solver_are_refused(capsys, tmp_path, options, words):
    status = main(['simulate', '--track', 'blanco_table_3_1', '--vehicle', 'blanco_table_3_1',
                   '--speed', '30', '--distance', '0.2', '--output', str(tmp_path / 'x.csv'),
                   *options])
    assert status == 2
    assert words in capsys.readouterr().err


def test_a_memory_that_is_too_short_is_told(capsys, tmp_path):
    for memory, told in (('0.02', 1), ('0.1', 0)):
        assert main(['simulate', '--track', 'blanco_table_3_1', '--vehicle', 'blanco_table_3_1',
                     '--solver', 'irf', '--speed', '30', '--distance', '0.3', '--time-step', '1e-4',
                     '--memory', memory, '--output', str(tmp_path / 'x.csv')]) == 0
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == told
        assert all('memory of 0.02 s' in line and '% of a deflection' in line for line in lines)


@pytest.mark.parametrize('solver', ['irf', 'recursive'])
def test_hold_is_used_and_told(capsys, tmp_path, solver):
    forces = {}
    for hold in ('trapezoidal', 'linear'):
        path = tmp_path / f'{hold}.csv'
        assert main(['simulate', '--track', 'blanco_table_3_1', '--vehicle', 'blanco_table_3_1',
                     '--solver', solver, '--speed', '30', '--distance', '0.6', '--elements-per-bay',
                     '6', '--time-step', '1e-4', '--irregularity', 'sine:0.04:5e-6', '--hold', hold,
                     '--output', str(path), '--json']) == 0
        assert json.loads(capsys.readouterr().out)['hold'] == hold
        forces[hold] = np.genfromtxt(path, delimiter=',', names=True)['contact_force_n']
    difference = np.std(forces['linear'] - forces['trapezoidal'])
    assert 1e-3 < difference / np.std(forces['linear']) < 0.3


def test_cache_is_listed_with_its_size_and_cleared(capsys, monkeypatch, tmp_path):
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path))
    make_track_modes(make_bay(load_track('blanco_table_3_1')), 21)
    assert main(['cache', '--json']) == 0
    told = json.loads(capsys.readouterr().out)
    (entry,) = told['entries']
    assert told['bytes'] == entry['bytes'] > 10_000
    assert main(['cache', '--clear']) == 0
    assert 'removed' in capsys.readouterr().out
    assert main(['cache']) == 0
    assert capsys.readouterr().out.startswith('0 tables, 0.0 of at most')
