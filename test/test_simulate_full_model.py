"""The command `simulate` where only the full model goes: any track, any wheel, its options."""

import json

import numpy as np
import pytest
import yaml

from railtrack_ros import paths
from railtrack_ros.cli.main import main
from railtrack_ros.errors import InputError
from railtrack_ros.irregularity.surface import Surface, read_part, wheel_flat
from railtrack_ros.vehicle.description import load_vehicle

VEHICLE = load_vehicle('blanco_table_3_1')


@pytest.fixture
def run(tmp_path, capsys):
    def run(*options, track=None, vehicle=None, status=0):
        files = {}
        for kind, changes in (('track', track), ('vehicle', vehicle)):
            shipped = paths.config_directory() / f'{kind}s' / 'blanco_table_3_1.yaml'
            content = yaml.safe_load(shipped.read_text())
            for section, values in (changes or {}).items():
                content[section] = ({**content[section], **values}
                                    if section in content else values)
            files[kind] = tmp_path / f'{kind}.yaml'
            files[kind].write_text(yaml.safe_dump(content))
        output = tmp_path / 'run.csv'
        arguments = ['simulate', '--track', files['track'], '--vehicle', files['vehicle'],
                     '--speed', 30, '--distance', 3, '--time-step', 1e-4, '--output', output,
                     '--json', *options]
        assert main([str(argument) for argument in arguments]) == status
        said = capsys.readouterr()
        if status:
            assert said.err.count('\n') == 1
            return said.err
        force = np.genfromtxt(output, delimiter=',', skip_header=1, usecols=3)
        return force, json.loads(said.out)

    return run


NONLINEAR = {'pad_nonlinearity': {'preload': 20e3, 'unloaded_stiffness': 120e6}}
UNEVEN = {'sleepers': [{'index': 3, 'ballast_stiffness': 10e6}]}
FLEXIBLE = {'wheel': {
    'suspension': {'stiffness': 1e6, 'damping': 2e4, 'sprung_mass': 5000.0},
    'modes': [{'frequency': 85, 'damping_ratio': 0.01, 'contact_shape': 0.03,
               'axle_box_shape': -0.035}]}, 'contact': {'damping': 1e4}}


def test_every_kind_of_track_and_wheel_changes_the_force(run):
    even, summary = run()
    assert 'support_iterations_per_step' not in summary
    for changes in ({'track': UNEVEN}, {'track': {'support': NONLINEAR}}, {'vehicle': FLEXIBLE},
                    {'track': {'support': {'ballast_lift_off': {'preload': 100.0}}}}):
        force, summary = run(**changes)
        assert np.abs(force - even).max() > 10.0, changes
        if 'support' in changes.get('track', {}):
            assert 1.0 <= summary['support_iterations_per_step'] < 10.0
            assert summary['most_support_iterations'] < 20


@pytest.mark.parametrize('solver', ['irf', 'recursive'])
def test_linear_solvers_refuse_such_tracks_by_name(run, solver):
    said = run('--solver', solver, track={'support': NONLINEAR}, status=2)
    assert 'support.pad_nonlinearity' in said
    assert 'sleepers' in run('--solver', solver, track=UNEVEN, status=2)
    assert 'iteration: the solver' in run('--solver', solver, '--iteration', 'fixed', status=2)
    assert 'beta: the solver' in run('--solver', solver, '--newmark-beta', 0.3, status=2)


def test_time_integration_is_chosen_and_told(run):
    force, summary = run('--irregularity', 'iso3095:1')
    assert summary['tolerance'] == 1e-10
    assert summary['iteration'] == 'newton'
    assert summary['iterations_per_step'] < summary['most_iterations'] < 20
    fixed, told = run('--irregularity', 'iso3095:1', '--iteration', 'fixed')
    assert fixed == pytest.approx(force, rel=1e-6)
    assert told['iterations_per_step'] > 2.0 * summary['iterations_per_step']
    assert told['iteration'] == 'fixed'
    _, loose = run('--irregularity', 'iso3095:1', '--tolerance', 1e-3)
    assert loose['iterations_per_step'] < summary['iterations_per_step']
    damped, told = run('--irregularity', 'iso3095:1', '--newmark-beta', 0.36, '--newmark-gamma',
                       0.7)
    assert (told['newmark_beta'], told['newmark_gamma']) == (0.36, 0.7)
    assert np.std(damped) < np.std(force)
    assert 'unconditionally stable' in run('--newmark-beta', 0.1, status=2)


def test_shapes_by_formula_add_up(run):
    smooth, _ = run()
    flat, _ = run('--irregularity', 'flat:0.05:0.0003')
    joint, _ = run('--irregularity', 'joint:1.2:0.002:0.8')
    position = 30.0 * 1e-4 * np.arange(smooth.size)
    # Half a circumference until the flat comes round.
    met = np.flatnonzero(np.abs(flat - smooth) > 100.0)[0]
    assert position[met] == pytest.approx(np.pi * 0.46 - 0.025, abs=0.01)
    met = np.flatnonzero(np.abs(joint - smooth) > 100.0)[0]
    assert position[met] == pytest.approx(0.8, abs=0.05)
    both, _ = run('--irregularity', 'flat:0.05:0.0003', '--irregularity', 'joint:1.2:0.002:0.8')
    assert np.abs(both - joint).max() > 1e3
    assert np.array_equal(both[position < 1.3], joint[position < 1.3])


@pytest.mark.parametrize('text', [
    'flat:0.05', 'flat:0.05:x', 'flat:5:0.001', 'flat:0.05:0.001:nobody', 'sine:0:1e-6',
    'iso3095:-1', 'iso3095:1.5', 'joint:1:-0.002:1', 'corrugation:0.04:1e-5:5:4', 'nowhere.csv'])
def test_irregularity_that_cannot_be_is_refused(text):
    with pytest.raises(InputError, match='irregularity'):
        Surface([read_part(text)], VEHICLE, 0.0, 0.0, 10.0)


def test_wheel_flat_comes_once_a_revolution_as_deep_and_long_as_told():
    radius, length, depth = 0.46, 0.06, 0.4e-3
    around = 2.0 * np.pi * radius
    rolled = np.linspace(0.0, 5.0 * around, 200_001)
    flat = wheel_flat(rolled, radius, length, depth)
    assert flat.min() == pytest.approx(-depth, rel=1e-4)
    assert flat.max() == 0.0
    assert np.mean(flat < 0.0) * around == pytest.approx(length, rel=0.01)
    assert -np.mean(flat) * around == pytest.approx(0.5 * depth * length, rel=0.01)
    assert flat[0] == 0.0
    assert np.argmin(flat) / 200_000 * 5.0 % 1.0 == pytest.approx(0.5, abs=1e-3)
    backwards = wheel_flat(-rolled, radius, length, depth)
    assert np.abs(flat - backwards).max() < 1e-9


def test_a_flat_may_be_on_one_wheel_alone():
    coach = load_vehicle('measurement_coach')
    surface = Surface([read_part('flat:0.05:0.0003:axle2_left')], coach, 5.0, 5.0, 10.0)
    position = np.linspace(5.0, 10.0, 5001)
    flat = {box.name for box in coach.axle_boxes if surface.at(box, position).any()}
    assert flat == {'axle2_left'}
