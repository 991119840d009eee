"""Virtual runs: physics of the truth, its filter, its messages, and the command."""

import dataclasses
import math

import numpy as np
import pytest

from railtrack_ros.bags.bag import open_bag
from railtrack_ros.bags.codec import decode_speed, decode_waveform
from railtrack_ros.bags.reader import read_waveforms
from railtrack_ros.cli.main import main
from railtrack_ros.errors import InputError
from railtrack_ros.irregularity.surface import Surface, read_part
from railtrack_ros.paths import share_directory
from railtrack_ros.runs.synthesize import ACCELERATION_TOPIC, SPEED_TOPIC, synthesize
from railtrack_ros.runs.virtual_run import (
    FADE_IN,
    Corrugation,
    Decimator,
    RailSurface,
    RunSettings,
    simulate_run,
)
from railtrack_ros.vehicle.description import load_vehicle

BAGS = share_directory() / 'bags'
WAVES = Corrugation(0.06, 10e-6, 1.5, 10.0)
SHORT = RunSettings(
    duration=0.12, speed=30.0, noise=0.0, sample_rate=12800.0, corrugations=(WAVES,), seed=3)


@pytest.fixture(scope='module')
def wheelset():
    return load_vehicle(BAGS / 'one_wheelset.yaml')


@pytest.fixture(scope='module')
def two_wheels():
    return load_vehicle(BAGS / 'two_wheels.yaml')


def whole(track, vehicle, settings, quantity):
    blocks = list(simulate_run(track, vehicle, settings))
    return {name: np.concatenate([getattr(block, quantity)[name] for block in blocks])
            for name in blocks[0].acceleration}


# The anti-aliasing filter


def test_decimation_shifts_no_phase_and_keeps_the_pass_band():
    factor, n = 2, 4000
    fine = np.arange(n * factor) / factor
    wave = np.sin(2 * np.pi * 0.39 * fine)[:, None]  # 0.39 of the sample rate after decimation
    decimator = Decimator(factor)
    out = decimator.process(wave)[:, 0]
    middle = slice(200, len(out) - 200)
    np.testing.assert_allclose(out[middle], wave[::factor, 0][: len(out)][middle], atol=2e-5)


def test_decimation_stops_what_would_fold_into_the_pass_band():
    fine = np.arange(8000) / 2
    wave = np.sin(2 * np.pi * 0.61 * fine)[:, None]
    out = Decimator(2).process(wave)[200:-200]
    assert np.abs(out).max() < 2e-5  # 94 dB


@pytest.mark.parametrize('factor', [2, 3, 7])
def test_decimation_does_not_depend_on_how_the_stream_is_cut(factor):
    values = np.random.default_rng(0).standard_normal((3000, 2))
    at_once = Decimator(factor).process(values)
    piecewise = Decimator(factor)
    cuts = [0, 1, 10, 500, 501, 1800, 3000]
    parts = [piecewise.process(values[a:b]) for a, b in zip(cuts, cuts[1:], strict=False)]
    np.testing.assert_allclose(np.concatenate(parts), at_once, atol=1e-12)
    assert len(at_once) == (3000 - 1 - Decimator(factor).reach) // factor + 1


@pytest.mark.parametrize('rate', [1000.0, 5000.0, 12800.0, 25600.0, 51200.0, 102400.0])
def test_truth_steps_at_least_twice_a_sample_and_finer_than_20_microseconds(rate):
    settings = dataclasses.replace(SHORT, sample_rate=rate)
    step = 1.0 / (rate * settings.oversampling)
    assert step <= 0.5 / rate
    assert step <= 20e-6


# Physics


def test_every_wheel_obeys_newton(table_3_1, wheelset):
    blocks = list(simulate_run(table_3_1, wheelset, SHORT))
    wheel = wheelset.wheel
    for block in blocks:
        for name, force in block.contact_force.items():
            expected = wheel.static_load + wheel.mass * block.acceleration[name]
            np.testing.assert_allclose(force, expected, rtol=2e-5)


def test_wheels_start_in_static_equilibrium(table_3_1, wheelset):
    settings = dataclasses.replace(SHORT, corrugations=())
    block = next(simulate_run(table_3_1, wheelset, settings))
    for name in block.acceleration:
        assert block.contact_force[name][0] == pytest.approx(wheelset.wheel.static_load, rel=1e-3)
        assert -1e-3 < block.rail_deflection[name][0] < -1e-4


def test_a_standing_vehicle_feels_nothing(table_3_1, wheelset):
    settings = dataclasses.replace(SHORT, speed=0.0)
    force = whole(table_3_1, wheelset, settings, 'contact_force')['axle1_left']
    np.testing.assert_allclose(force, wheelset.wheel.static_load, rtol=1e-6)


def test_the_rails_do_not_feel_each_other(table_3_1, wheelset):
    one_sided = dataclasses.replace(
        SHORT, corrugations=(dataclasses.replace(WAVES, rail='right'),))
    smooth = dataclasses.replace(SHORT, corrugations=())
    force = whole(table_3_1, wheelset, one_sided, 'contact_force')
    untouched = whole(table_3_1, wheelset, smooth, 'contact_force')
    np.testing.assert_array_equal(force['axle1_left'], untouched['axle1_left'])
    assert np.std(force['axle1_right'] - untouched['axle1_right']) > 1e3


def test_each_wheel_has_the_irregularity_of_its_own_place(wheelset, two_wheels):
    surface = RailSurface(two_wheels, SHORT)
    position = np.linspace(FADE_IN, 4.0, 500)
    np.testing.assert_allclose(
        surface.at('left', position, -2.5)[position > 3.5],
        surface.at('left', position - 2.5, 0.0)[position > 3.5]
        / (0.5 - 0.5 * np.cos(np.pi * np.clip(position - 2.5, 0, 1)))[position > 3.5])
    assert np.abs(surface.at('left', position, 0.0)[position < 1.5]).max() == 0.0


def test_the_irregularity_fades_in(two_wheels):
    settings = dataclasses.replace(SHORT, roughness='iso3095')
    surface = RailSurface(two_wheels, settings)
    position = np.array([0.0, 0.01, 1.0])
    first, soon, later = np.abs(surface.at('left', position, 0.0))
    assert first == 0.0
    assert soon < 1e-3 * max(later, 1e-6)


def test_level_of_the_roughness_is_a_gain_in_decibels(two_wheels):
    place = np.linspace(1.0, 2.0, 50)
    settings = dataclasses.replace(SHORT, roughness='iso3095', corrugations=())
    full = RailSurface(two_wheels, settings).at('left', place, 0.0)
    half = RailSurface(two_wheels, dataclasses.replace(
        settings, roughness_level=-20.0 * np.log10(2.0))).at('left', place, 0.0)
    np.testing.assert_allclose(half, 0.5 * full, rtol=1e-12)


def test_random_roughness_differs_between_the_rails_and_the_seeds(two_wheels):
    settings = dataclasses.replace(SHORT, roughness='iso3095', corrugations=())
    position = np.linspace(1.0, 4.0, 3000)
    left = RailSurface(two_wheels, settings).at('left', position, 0.0)
    right = RailSurface(two_wheels, settings).at('right', position, 0.0)
    other = RailSurface(two_wheels, dataclasses.replace(settings, seed=4)).at('left', position, 0.0)
    assert abs(np.corrcoef(left, right)[0, 1]) < 0.5
    assert abs(np.corrcoef(left, other)[0, 1]) < 0.5


def test_position_is_the_integral_of_speed_and_braking_ends_in_a_stop():
    settings = dataclasses.replace(SHORT, duration=10.0, speed=10.0, acceleration=-2.0,
                                   start_position=100.0)
    time = np.linspace(0.0, 10.0, 10001)
    increments = np.diff(settings.position_at(time))
    speed = settings.speed_at(time)
    np.testing.assert_allclose(increments, 1e-3 * 0.5 * (speed[1:] + speed[:-1]), atol=1e-12)
    assert speed[-1] == 0.0
    assert settings.position_at(10.0) == pytest.approx(125.0)


# Messages


@pytest.fixture(scope='module')
def recording(tmp_path_factory, table_3_1, wheelset):
    path = tmp_path_factory.mktemp('synthesized') / 'run.mcap'
    synthesize(table_3_1, wheelset, dataclasses.replace(SHORT, start_position=50.0), path)
    return path


def test_the_recording_keeps_the_contract(recording):
    with open_bag(recording) as bag:
        acceleration = [decode_waveform(bag.decode(m)) for m in bag.messages({ACCELERATION_TOPIC})]
        speeds = [decode_speed(bag.decode(m)) for m in bag.messages({SPEED_TOPIC})]
        log_times = [m.log_time for m in bag.messages()]
        force = next(iter(bag.messages({'/truth/contact_force'})))
        truth = decode_waveform(bag.decode(force))
        assert float(bag.facts['start_position']) == 50.0
    assert log_times == sorted(log_times)
    assert [block.samples for block in acceleration] == [128] * 12
    assert [block.t[0] for block in acceleration] == [0.0] * 12
    starts = np.diff([block.stamp_ns for block in acceleration])
    assert (starts == 10_000_000).all()
    assert set(acceleration[0].channels) == {'axle1_left', 'axle1_right'}
    assert {x.dtype for x in acceleration[0].channels.values()} == {np.dtype('f4')}
    assert truth.position[0] == 50.0
    # The speed is known before the first sample, and sent when it is measured.
    assert speeds[0][0] < acceleration[0].stamp_ns
    assert [speed for _, speed in speeds] == [30.0] * len(speeds)
    assert set(np.diff([stamp for stamp, _ in speeds])) == {10_000_000}


def test_truth_of_the_irregularity_is_unfiltered(recording):
    with open_bag(recording) as bag:
        truth = read_waveforms(bag, ['/truth/irregularity'])['/truth/irregularity']
    place = truth.position
    run = np.clip((place - 50.0) / FADE_IN, 0.0, 1.0)
    assert np.all(truth.channels['axle1_left'] == 0.0)  # the waves end at 10 m
    assert place[-1] == pytest.approx(50.0 + 30.0 * (0.12 - 1 / 12800), abs=1e-9)
    assert run[-1] == 1.0


def test_the_same_seed_gives_the_same_recording(tmp_path, table_3_1, wheelset, recording):
    settings = dataclasses.replace(SHORT, noise=0.3, roughness='iso3095', duration=0.05)
    files = [tmp_path / name for name in ('a.mcap', 'b.mcap', 'c.mcap')]
    for path, seed in zip(files, (1, 1, 2), strict=True):
        synthesize(table_3_1, wheelset, dataclasses.replace(settings, seed=seed), path)
    messages = []
    for path in files:
        with open_bag(path) as bag:
            messages.append([m.data for m in bag.messages({ACCELERATION_TOPIC})])
    assert messages[0] == messages[1]
    assert messages[0] != messages[2]


def test_noise_has_the_given_deviation_and_no_correlation(table_3_1, wheelset):
    quiet = whole(table_3_1, wheelset, SHORT, 'acceleration')
    noisy = whole(table_3_1, wheelset, dataclasses.replace(SHORT, noise=2.0), 'acceleration')
    left, right = (noisy[name] - quiet[name] for name in ('axle1_left', 'axle1_right'))
    n = left.size
    assert np.std(left) == pytest.approx(2.0, rel=4 / math.sqrt(n))
    assert abs(np.corrcoef(left, right)[0, 1]) < 4 / math.sqrt(n)


def test_a_sample_recording_is_made_by_the_script_beside_it(tmp_path):
    script = (BAGS / 'synthesize.sh').read_text().replace('\\\n', ' ')
    line = next(line for line in script.splitlines() if 'corrugated_two_wheels.mcap' in line)
    words = line.split()[1:-1]
    vehicle = words.index('--vehicle') + 1
    words[vehicle] = str(BAGS / words[vehicle])
    assert main([*words, str(tmp_path / 'again.mcap')]) == 0
    topics = ['/axle_box_acceleration', '/truth/contact_force', '/truth/irregularity']
    shipped, again = tmp_path / 'again.mcap', BAGS / 'corrugated_two_wheels.mcap'
    with open_bag(shipped) as a, open_bag(again) as b:
        first, second = read_waveforms(a, topics), read_waveforms(b, topics)
    for topic in topics:
        for box, values in first[topic].channels.items():
            np.testing.assert_allclose(
                second[topic].channels[box], values, atol=1e-3 * np.std(values))


# The command


@pytest.mark.parametrize(('arguments', 'words'), [
    (['--corrugation', '0.05:1e-5:10'], 'WAVELENGTH:AMPLITUDE:FROM:TO'),
    (['--corrugation', '0.05:1e-5:20:10'], 'FROM before TO'),
    (['--corrugation', '0.05:1e-5:10:20:middle'], ':left or :right'),
    (['--corrugation', '0:1e-5:10:20'], 'above 0'),
    (['--corrugation', 'x:1e-5:10:20'], 'for example'),
    (['--roughness', 'nowhere.csv'], 'nowhere.csv'),
    (['--sample-rate', '1'], 'sample_rate'),
    (['--block', '20'], 'block'),
    (['--track', 'nowhere'], 'nowhere'),
])
def test_a_run_that_cannot_be_is_refused_in_one_line(arguments, words, tmp_path, capsys):
    out = tmp_path / 'run.mcap'
    status = main(['synthesize', '--track', 'blanco_table_3_1', '--vehicle', 'blanco_table_3_1',
                   '--duration', '1', '--speed', '20', '--seed', '1', *arguments, str(out)])
    error = capsys.readouterr().err
    assert status == 2
    assert error.count('\n') == 1
    assert words in error
    assert not out.exists()


def test_a_roughness_file_that_is_too_short_is_refused(tmp_path, two_wheels):
    path = tmp_path / 'short.csv'
    path.write_text('position_m,irregularity_m\n0,0\n1,1e-6\n2,0\n')
    with pytest.raises(InputError, match='covers 0 to 2 m'):
        RailSurface(two_wheels, dataclasses.replace(SHORT, roughness=str(path)))


@pytest.mark.parametrize('change', [
    {'duration': math.nan}, {'speed': -1.0}, {'speed': math.inf}, {'sample_rate': 0.0},
    {'noise': -0.1}, {'block': 0.0}, {'duration': 0.001}, {'seed': -1},
])
def test_settings_out_of_range_are_refused_by_name(change):
    with pytest.raises(InputError, match=next(iter(change))):
        dataclasses.replace(SHORT, **change)


def test_joints_and_wheel_flats_are_parts_of_the_truth(table_3_1, two_wheels):
    front, rear = two_wheels.axle_boxes
    parts = tuple(map(read_part, ('joint:1.2:1e-4:0.5', f'flat:0.05:2e-4:{front.name}')))
    settings = RunSettings(duration=0.2, speed=10.0, irregularity=parts, noise=0.0)
    blocks = list(simulate_run(table_3_1, two_wheels, settings))
    position = np.concatenate([block.position for block in blocks])
    found = {box.name: np.concatenate([block.irregularity[box.name] for block in blocks])
             for box in two_wheels.axle_boxes}
    expected = Surface(parts, two_wheels, 0.0, 0.0, 3.0)
    for box in two_wheels.axle_boxes:
        np.testing.assert_allclose(found[box.name], expected.at(box, position), atol=1e-9)
    assert found[front.name].min() < -0.9e-4
    assert set(position[found[rear.name] < -1e-6] + rear.offset > 0.9) <= {True}


def test_a_track_may_change_under_a_virtual_run(table_3_1, wheelset):
    """A hanging sleeper shows in the deflection where it is, and nowhere else."""
    hanging = dataclasses.replace(table_3_1.support, ballast_stiffness=1e6)
    uneven = dataclasses.replace(table_3_1, sleepers=((8, hanging),))
    settings = RunSettings(duration=0.5, speed=20.0, noise=0.0)
    name = wheelset.axle_boxes[0].name
    runs = []
    for track in (table_3_1, uneven):
        blocks = list(simulate_run(track, wheelset, settings))
        runs.append(np.concatenate([block.rail_deflection[name] for block in blocks]))
        position = np.concatenate([block.position for block in blocks])
    extra = runs[1] - runs[0]
    assert position[extra.argmin()] == pytest.approx(8 * 0.6, abs=0.3)
    assert extra.min() < 0.1 * runs[0].min()
    assert np.abs(extra[position < 1.5]).max() < 1e-2 * abs(extra.min())
