import dataclasses
import math
import pickle

import numpy as np
import pytest
from scipy import signal

from railtrack_ros.dynamics.recursive import RecursiveForward
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.estimator import Estimator
from railtrack_ros.estimation.section import SAMPLES_A_WAVE
from railtrack_ros.estimation.settings import (
    EstimatorSettings,
    IndicatorSettings,
    declared,
)
from railtrack_ros.track.bay import Mesh, make_bay
from railtrack_ros.vehicle.description import AxleBox, Contact, Vehicle, Wheel

S = 1_000_000_000
START = 1_700_000_000 * S
RATE = 25600.0
BLOCK = 256


def bogie(**contact):
    return Vehicle(
        'bogie', Wheel(550.0, 100e3, 0.46), Contact(**{'stiffness': 100e9, 'exponent': 1.5}
                                                    | contact),
        (AxleBox('lead', 'left', 0.0), AxleBox('trail', 'left', -2.5),
         AxleBox('right', 'right', 0.0)))


NAMES = ('lead', 'trail', 'right')
QUANTITIES = ('contact_force', 'rail_deflection', 'irregularity')


@pytest.fixture(scope='module')
def fresh(table_3_1):
    """Return new estimators of one model, which is computed only once."""
    blanks = {}

    def make(vehicle=None, **settings):
        key = (vehicle or bogie(), tuple(sorted(settings.items())))
        if key not in blanks:
            blanks[key] = pickle.dumps(Estimator(table_3_1, key[0], EstimatorSettings(**settings)))
        return pickle.loads(blanks[key])

    return make


class Feed:
    """A steady run of noise, or of given accelerations, block by block."""

    def __init__(self, seconds=1.0, speed=25.0, acceleration=None, names=NAMES):
        self.n = round(seconds * RATE)
        self.speed = speed
        rng = np.random.default_rng(3)
        self.channels = acceleration or {n: 20.0 * rng.standard_normal(self.n) for n in names}

    def run(self, estimator, size=BLOCK, first=0, last=None, speeds=True):
        if speeds and first == 0:
            for k in range(-10, math.ceil(self.n / BLOCK) + 1):
                estimator.add_speed(START + k * S // 100, self.speed)
        found = []
        for a in range(first, last or self.n, size):
            part = slice(a, min(a + size, last or self.n))
            t = (np.arange(part.start, part.stop) - a) / RATE
            found.append(estimator.process(
                START + round(a / RATE * S), t, {n: x[part] for n, x in self.channels.items()}))
        return found


def join(blocks):
    """Join blocks: quantity -> name -> (n,)."""
    found = {q: {n: np.concatenate([getattr(b, q)[n] for b in blocks])
                 for n in blocks[0].contact_force} for q in QUANTITIES}
    return found | {'position': np.concatenate([b.position for b in blocks])}


def same(a, b):
    return all(np.array_equal(a[q][n], b[q][n], equal_nan=True) for q in QUANTITIES for n in a[q])


# Physics


def test_force_is_static_load_plus_inertia(fresh):
    feed = Feed(0.5)
    found = join(feed.run(fresh()))
    for name in NAMES:
        force = found['contact_force'][name]
        good = np.isfinite(force)
        assert good[8000:].all()
        assert force[good] == pytest.approx(100e3 + 550.0 * feed.channels[name][good])


def test_quiet_wheels_ride_on_the_moving_static_deflection(fresh):
    quiet = {name: np.zeros(20000) for name in NAMES}
    found = join(Feed(20000 / RATE, acceleration=quiet).run(fresh()))
    single, leading = (found['rail_deflection'][n][8000:] for n in ('right', 'lead'))
    # Moving load of 100 kN on table 3.1: 0.749 to 0.789 mm between sleepers and above them.
    assert -0.80e-3 < single.min() < -0.78e-3
    assert -0.76e-3 < single.max() < -0.74e-3
    # The other wheel of the bogie, 2.5 m away, lifts or lowers it by little, but does.
    assert 1e-7 < np.abs(leading - single).max() < 5e-5


def test_rails_do_not_feel_each_other(fresh):
    feed = Feed(0.4)
    alone = {**feed.channels, 'lead': 3.0 * feed.channels['lead']}
    a, b = join(feed.run(fresh())), join(Feed(0.4, acceleration=alone).run(fresh()))
    assert np.array_equal(a['rail_deflection']['right'], b['rail_deflection']['right'],
                          equal_nan=True)
    assert not np.array_equal(a['rail_deflection']['trail'], b['rail_deflection']['trail'],
                              equal_nan=True)


@pytest.mark.parametrize(('speed', 'dvdt'), [(25.0, 0.0), (20.0, 4.0)])
def test_known_irregularity_comes_back(table_3_1, fresh, speed, dvdt):
    # Two wheels driven over waves of 20 to 400 mm at twice the sample rate, another mesh.
    t = np.arange(round(1.6 * 2 * RATE)) / (2 * RATE)
    x = speed * t + 0.5 * dvdt * t * t
    rng = np.random.default_rng(5)
    wavelengths = np.geomspace(0.02, 0.4, 40)
    phases = rng.uniform(0.0, 2.0 * math.pi, 40)

    def profile(at):
        return sum(1e-6 * math.sqrt(w / 0.1) * np.sin(2.0 * math.pi * at / w + p)
                   for w, p in zip(wavelengths, phases, strict=True))

    offsets = np.array([0.0, -2.5])
    truth = np.column_stack([profile(x + offset) for offset in offsets])
    mesh = Mesh(elements_per_bay=10)
    forward = RecursiveForward(make_bay(table_3_1, mesh), bogie(), offsets, 0.5 / RATE, 0.0,
                               hold='linear', maximum_frequency=5000.0)
    ran = forward.run(x, truth)

    estimator = fresh()
    for k in range(-10, 160):
        estimator.add_speed(START + k * S // 100, speed + dvdt * k / 100)
    blocks = []
    for k in range(0, t.size // 2, BLOCK):
        part = slice(2 * k, 2 * (k + BLOCK), 2)
        a = ran.axle_box_acceleration[part]
        blocks.append(estimator.process(
            START + round(k / RATE * S), t[part] - t[2 * k],
            {'lead': a[:, 0], 'trail': a[:, 1], 'right': np.zeros(len(a))}))
    found = join(blocks)
    x, truth = x[::2][:found['position'].size], truth[::2][:found['position'].size]
    assert found['position'] == pytest.approx(x, abs=1e-6)
    # Past the transient of the start; both on a grid in space, zero-phase one-third octaves.
    grid = np.arange(14.0, x[-1] - 0.1, 0.001)
    for i, name in enumerate(('lead', 'trail')):
        deflection = found['rail_deflection'][name][10000:]
        true = ran.rail_deflection[::2, i][10000:found['position'].size]
        assert np.std(deflection - true) < 0.02 * np.std(true)
        back = np.interp(grid, x, found['irregularity'][name])
        given = np.interp(grid, x, truth[:, i])
        for centre in (0.0251, 0.0501, 0.1, 0.2, 0.316):
            edges = [10**-0.05 / centre, 10**0.05 / centre]
            band = signal.butter(3, edges, 'bandpass', fs=1000.0, output='sos')
            levels = [signal.sosfiltfilt(band, y)[2000:-2000].std() for y in (back, given)]
            assert abs(20.0 * math.log10(levels[0] / levels[1])) < 0.15


def test_gravity_is_subtracted_on_demand(fresh):
    feed = Feed(0.4)
    heavy = {name: a + 9.80665 for name, a in feed.channels.items()}
    a = join(feed.run(fresh()))
    b = join(Feed(0.4, acceleration=heavy).run(fresh(input_includes_gravity=True)))
    for q in QUANTITIES:
        assert b[q]['lead'] == pytest.approx(a[q]['lead'], rel=1e-9, abs=1e-12, nan_ok=True)


def test_lifted_wheel_has_no_indentation(fresh):
    falling = {name: np.full(12800, -200.0) for name in NAMES}  # -10 kN
    found = join(Feed(0.5, acceleration=falling).run(fresh()))
    assert np.nanmax(found['contact_force']['lead']) == pytest.approx(-10e3)
    assert np.isfinite(found['irregularity']['lead'][8000:]).all()


# Streams


@pytest.mark.parametrize('size', [64, 1000, 25600])
def test_result_does_not_depend_on_the_blocks(fresh, size):
    feed = Feed(1.0)
    feed.channels['trail'][5000:5100] = np.nan
    assert same(join(feed.run(fresh())), join(feed.run(fresh(), size)))


def test_stream_goes_on_after_being_saved_and_restored(fresh):
    feed = Feed(1.0)
    whole = join(feed.run(fresh()))
    estimator = fresh()
    begin = feed.run(estimator, last=51 * BLOCK)
    estimator = pickle.loads(pickle.dumps(estimator))
    assert same(whole, join(begin + feed.run(estimator, first=51 * BLOCK)))


def test_state_alone_is_small_and_continues_to_the_last_bit(fresh):
    feed = Feed(1.0)
    whole = join(feed.run(fresh()))
    estimator, other = fresh(), fresh()
    begin = feed.run(estimator, last=51 * BLOCK)
    state = estimator.state()
    assert len(state) < 50_000
    other.restore(state)
    assert same(whole, join(begin + feed.run(other, first=51 * BLOCK)))
    assert other.health.blocks == estimator.health.blocks + 49


def test_start_is_nan_for_a_tenth_of_a_second_and_two_wavelengths(fresh):
    found = join(Feed(0.5).run(fresh()))
    for q in QUANTITIES:
        for name in NAMES:
            good = np.isfinite(found[q][name])
            first = int(np.argmax(good))
            assert first / RATE == pytest.approx(0.24, abs=2 / RATE)
            assert good[first:].all()


def test_gap_is_a_start_and_the_position_goes_on(fresh):
    feed, estimator = Feed(2.0), fresh()
    before = feed.run(estimator, last=100 * BLOCK)
    after = feed.run(estimator, first=110 * BLOCK)
    assert before[-1].position[-1] + 25.0 * (10 * BLOCK + 1) / RATE == pytest.approx(
        after[0].position[0], abs=1e-6)
    good = np.isfinite(join(after)['rail_deflection']['lead'])
    assert int(np.argmax(good)) / RATE == pytest.approx(0.24, abs=2 / RATE)
    assert estimator.health.gaps == 1
    assert estimator.take_notes() == ['gap of 0.1 s (2560 samples): start anew']
    assert estimator.take_notes() == []


def test_repeated_block_changes_nothing(fresh):
    feed, estimator = Feed(0.6), fresh()
    first = feed.run(estimator, last=30 * BLOCK)
    again = feed.run(estimator, first=29 * BLOCK, last=30 * BLOCK)
    rest = feed.run(estimator, first=30 * BLOCK)
    assert again == [None]
    assert estimator.health.dropped_blocks == 1
    assert same(join(first + rest), join(feed.run(fresh())))


def test_without_a_speed_there_is_nothing_and_no_position(fresh):
    feed, estimator = Feed(0.2), fresh(start_position=77.0)
    found = join(feed.run(estimator, speeds=False))
    assert np.isnan(found['position']).all()
    assert all(np.isnan(found[q][n]).all() for q in QUANTITIES for n in NAMES)
    assert estimator.health.speed_state == 'none'
    assert math.isnan(estimator.health.position)


def test_speed_that_falls_silent_stops_the_estimate(fresh):
    feed, estimator = Feed(1.0), fresh(speed_timeout=0.3)
    estimator.add_speed(START - S // 10, 25.0)
    found = join(feed.run(estimator, speeds=False))
    # Blocks end 10 ms apart; the message is 0.1 s older than the first sample.
    last = int(np.flatnonzero(np.isfinite(found['position']))[-1])
    assert last / RATE == pytest.approx(0.2, abs=0.0101)
    assert estimator.health.speed_state == 'silent'
    assert any('no speed' in note for note in estimator.take_notes())


def test_clock_set_back_starts_at_the_start_position(fresh):
    feed, estimator = Feed(0.5), fresh(start_position=10.0)
    feed.run(estimator)
    early = START - 1000 * S
    for k in range(-10, 10):
        estimator.add_speed(early + k * S // 100, 25.0)
    quiet = np.arange(256) / RATE, {n: np.zeros(256) for n in NAMES}
    # One block of another time may be a slip of a stamp; the next one tells.
    assert estimator.process(early, *quiet) is None
    block = estimator.process(early + S // 100, *quiet)
    assert block.position[0] == pytest.approx(10.25, abs=1e-9)
    assert estimator.health.clock_resets == 1


@pytest.mark.parametrize('slip', [86400 * S, -86400 * S])
def test_a_single_block_with_a_wild_stamp_is_no_reset(fresh, slip):
    feed, estimator = Feed(0.6), fresh()
    first = feed.run(estimator, last=30 * BLOCK)
    quiet = np.arange(256) / RATE, {n: np.zeros(256) for n in NAMES}
    assert estimator.process(START + slip, *quiet) is None
    rest = feed.run(estimator, first=30 * BLOCK)
    assert estimator.health.clock_resets == estimator.health.gaps == 0
    assert 'believed when the next one goes on' in estimator.take_notes()[0]
    assert same(join(first + rest), join(feed.run(fresh())))


@pytest.mark.parametrize('change', [834 * 0.6, 0.2])
def test_position_reference_leaves_the_irregularity_alone(fresh, change):
    feed = Feed(2.0, acceleration={name: np.zeros(51200) for name in NAMES})
    corrected = fresh()
    corrected.set_position(START + S, 25.0 + change)
    plain, b = join(feed.run(fresh())), join(feed.run(corrected))
    assert b['position'][-1] == pytest.approx(plain['position'][-1] + change, abs=1e-6)
    # A load that jumps along the rail would find it 100 micrometres higher.
    difference = b['irregularity']['lead'] - plain['irregularity']['lead']
    assert np.nanmax(np.abs(np.diff(difference))) < 1e-6
    # In the end the sleepers are where they are in a run that started right.
    right = join(feed.run(fresh(start_position=change)))
    error = (b['irregularity']['lead'] - right['irregularity']['lead'])[-5000:]
    assert np.abs(error).max() < 1e-8


# Faults


@pytest.mark.parametrize('fault', ['missing', 'nan', 'short'])
def test_dead_axle_box_is_nan_and_loads_the_rail_statically(fresh, fault):
    feed = Feed(0.5)
    quiet = join(Feed(0.5, acceleration={**feed.channels, 'trail': np.zeros(feed.n)})
                 .run(fresh()))
    if fault == 'missing':
        del feed.channels['trail']
    elif fault == 'nan':
        feed.channels['trail'] = np.full(feed.n, np.nan)
    estimator = fresh()
    if fault == 'short':
        channels = dict(feed.channels)
        feed.channels = {**channels, 'trail': channels['trail'][:0]}
    found = join(feed.run(estimator))
    for q in QUANTITIES:
        assert np.isnan(found[q]['trail']).all()
        assert np.array_equal(found[q]['lead'], quiet[q]['lead'], equal_nan=True)
    assert estimator.health.dead == ('trail',)
    notes = estimator.take_notes()
    assert len(notes) == 1
    assert notes[0].startswith('trail: ')


@pytest.mark.parametrize('value', [math.nan, math.inf, -math.inf, 1e30])
def test_bad_sample_starts_its_channel_anew_and_no_other(fresh, value):
    feed, estimator = Feed(1.0), fresh()
    plain = join(feed.run(fresh()))
    feed.channels['lead'][12800] = value
    found = join(feed.run(estimator))
    good = np.isfinite(found['contact_force']['lead'])
    assert good[7000:12800].all()
    assert not good[12800:12800 + 6100].any()
    assert good[12800 + 6200:].all()
    assert np.isfinite(found['irregularity']['trail'][7000:]).all()
    assert np.array_equal(found['irregularity']['right'], plain['irregularity']['right'],
                          equal_nan=True)
    # The estimate is not spoilt: it is back to that of the plain run after a while.
    error = found['rail_deflection']['lead'][-2000:] - plain['rail_deflection']['lead'][-2000:]
    assert np.abs(error).max() < 1e-8
    assert estimator.health.bad_samples['lead'] == 1
    assert estimator.take_notes() == [
        'lead: 1 of 256 samples are no number: taken to carry its static load, not estimated',
        'lead: good samples again']


def test_other_channels_are_ignored_and_told(fresh):
    feed, estimator = Feed(0.4), fresh()
    feed.channels['temperature'] = np.full(feed.n, 20.0)
    found = join(feed.run(estimator))
    assert set(found['contact_force']) == set(NAMES)
    assert estimator.health.extra_channels == ('temperature',)


def test_slow_vehicle_has_force_but_no_irregularity(fresh):
    feed = Feed(8.0, speed=0.9)
    feed.channels = {n: np.zeros(feed.n) for n in NAMES}
    found = join(feed.run(fresh(speed_timeout=10.0, cut_on_wavelength=1.0), size=25600))
    good = np.isfinite(found['contact_force']['lead'])
    assert good[round(2.3 * RATE):].all()
    assert not np.isfinite(found['irregularity']['lead']).any()


# Settings


@pytest.mark.parametrize(('setting', 'value'), [
    ('cut_on_wavelength', 0.0), ('cut_on_wavelength', math.nan), ('cut_on_wavelength', '3'),
    ('minimum_speed', -1.0), ('speed_delay', math.inf), ('bays_in_ring', 61.5),
    ('local_system', 'exact'), ('input_includes_gravity', 1), ('start_position', None),
])
def test_setting_out_of_range_is_refused_by_name(setting, value):
    with pytest.raises(InputError, match=f'^{setting}: expected .*, got '):
        EstimatorSettings(**{setting: value})


def test_ring_shorter_than_the_vehicle_is_refused(table_3_1):
    long = dataclasses.replace(bogie(), axle_boxes=(
        AxleBox('a', 'left', 0.0), AxleBox('b', 'left', -30.0)))
    with pytest.raises(InputError, match='bays_in_ring: expected at least 70 '):
        Estimator(table_3_1, long, EstimatorSettings(bays_in_ring=61))


@pytest.mark.parametrize('settings', [EstimatorSettings, IndicatorSettings])
def test_every_setting_is_declared_with_words_and_a_default_in_its_range(settings):
    for setting in declared(settings):
        assert len(setting.description) > 20
        assert setting.check(setting.default) == setting.default
        assert setting.kind is type(setting.default)


@pytest.mark.parametrize('samples', [SAMPLES_A_WAVE, 10.0])
def test_waves_of_so_many_samples_are_right_within_so_many_decibels(table_3_1, samples):
    vehicle = dataclasses.replace(bogie(), axle_boxes=bogie().axle_boxes[:1])
    name = 'lead'
    speed, rate, often = 20.0, 2000.0, 16
    wavelength = samples * speed / rate
    t = np.arange(round(1.2 * rate * often)) / (rate * often)
    truth = 1e-6 * np.sin(2.0 * np.pi * speed * t / wavelength) * np.clip(speed * t, 0.0, 1.0)
    bay = make_bay(table_3_1)
    driven = RecursiveForward(bay, vehicle, [0.0], t[1], 0.0).run(speed * t, truth[:, None])
    estimator = Estimator(table_3_1, vehicle)
    estimator.add_speed(START, speed)
    acceleration = driven.axle_box_acceleration[::often, 0]
    block = estimator.process(START, t[::often], {name: acceleration})
    found = block.irregularity[name]
    inside = np.isfinite(found)
    wave = np.exp(2j * np.pi * speed * t[::often] / wavelength)[inside]
    assert inside.sum() > 1000
    level = 20.0 * np.log10(abs(np.mean(found[inside] * wave)) / 0.5e-6)
    assert abs(level) < (0.6 if samples < 10.0 else 0.2)


def test_a_stream_of_single_samples_is_estimated_as_blocks_are(fresh):
    vehicle = dataclasses.replace(bogie(), axle_boxes=bogie().axle_boxes[:1])
    n, rate = 2000, 2560.0
    a = np.random.default_rng(3).standard_normal(n)
    found = []
    for size in (1, 20):
        estimator = fresh(vehicle)
        for k in range(-2, 10):
            estimator.add_speed(START + k * S // 10, 25.0)
        stamps = [START + round(k / rate * S) for k in range(0, n, size)]
        blocks = [estimator.process(stamp, np.arange(size) / rate, {'lead': a[k * size:][:size]})
                  for k, stamp in enumerate(stamps)]
        parts = [block for block in blocks if block is not None]
        assert estimator.health.dropped_blocks == 0
        assert estimator.take_notes() == []
        assert len(parts) == (n - 32 if size == 1 else n // size)
        found.append([np.concatenate([part.position for part in parts])[-1000:],
                      np.concatenate([part.rail_deflection['lead'] for part in parts])[-1000:]])
    assert np.abs(found[0][0] - found[1][0]).max() < 1e-5
    assert np.abs(found[0][1] - found[1][1]).max() < 1e-3 * np.std(found[1][1])
