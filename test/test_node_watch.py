"""What the node sees in stamps, samples, speeds, fixes: plain functions of plain data."""

import math

import numpy as np
import pytest

from railtrack_ros.estimation.samples import SampleCollector
from railtrack_ros.node.gnss import Locations, distance
from railtrack_ros.node.polarity import Polarity
from railtrack_ros.node.watch import BlockWatch, SpeedWatch
from railtrack_ros.vehicle.description import load_vehicle

SECOND = 1_000_000_000
T = np.arange(100) / 10e3  # 10 ms
BLOCK = SECOND // 100


def watch_blocks(blocks, **options):
    """Feed (start, sent) in units of 10 ms; return the stamps that were seen."""
    watch = BlockWatch(['a'], **options)
    for start, sent in blocks:
        watch.block(round(start * BLOCK), T, round(sent * BLOCK), {'a': np.sin(T)})
    return watch.take()[0]


# Stamps


def test_duplicates_and_blocks_out_of_order_are_told_apart():
    seen = watch_blocks([(0, 1), (1, 2), (1, 3), (2, 4), (1, 5), (3, 6)])
    assert (seen.blocks, seen.duplicates, seen.out_of_order) == (6, 1, 1)
    assert seen.jumps == 0


@pytest.mark.parametrize('jump', [-200, 200])
def test_a_clock_that_was_set_is_a_jump_of_the_stamps(jump):
    seen = watch_blocks([(i + (jump if i >= 5 else 0), i + 1) for i in range(10)])
    assert seen.jumps == 1
    assert seen.jump == pytest.approx(jump / 100)


def test_a_sensor_that_paused_or_sent_late_is_no_clock_jump():
    paused = [(i + (200 if i >= 5 else 0), i + 1 + (200 if i >= 5 else 0)) for i in range(10)]
    late = [(i, i + 1 if i < 5 else 206) for i in range(10)]
    assert watch_blocks(paused).jumps == 0
    assert watch_blocks(late).jumps == 0


def test_the_offset_of_the_clock_is_told():
    assert watch_blocks([(0, 701)]).offset == pytest.approx(7.0, abs=0.02)


# Samples


def seen_signal(blocks, **options):
    watch = BlockWatch(['a'], **options)
    for index, values in enumerate(blocks):
        watch.block(index * BLOCK, T, index * BLOCK, {'a': np.asarray(values, np.float32)})
    return watch.take()[1]['a']


RNG = np.random.default_rng(3)
NOISE = RNG.normal(0.0, 40.0, (50, 100)).astype(np.float32)


def test_noise_is_neither_stuck_nor_saturated():
    found = seen_signal(NOISE)
    assert (found.samples, found.saturated, found.stuck) == (5000, 0, 0.0)
    assert found.mean == pytest.approx(NOISE.mean(), abs=1e-3)


@pytest.mark.parametrize('value', [0.0, -37.5])
def test_a_stuck_channel_is_told_with_its_time(value):
    assert seen_signal([*NOISE[:5], *[np.full(100, value)] * 20]).stuck == pytest.approx(0.2)
    assert seen_signal([*[np.full(100, value)] * 20, NOISE[0]]).stuck == 0.0


def test_clipped_samples_are_counted_with_and_without_a_known_full_scale():
    clipped = np.clip(10.0 * NOISE, -500.0, 500.0)
    count = np.count_nonzero(np.abs(clipped) >= 499.5)
    assert seen_signal(clipped, full_scale=500.0).saturated == count
    told = seen_signal(clipped).saturated
    runs_of_three = sum(
        len(run) for block in clipped
        for run in np.split(block, np.flatnonzero(np.diff(block)) + 1)
        if len(run) >= 3 and abs(run[0]) == 500.0)
    assert told == runs_of_three > 10


def test_a_coarse_converter_at_rest_is_not_saturated():
    assert seen_signal(np.round(RNG.normal(0.0, 0.4, (20, 100)))).saturated == 0


def test_nan_and_missing_channels_are_no_samples():
    watch = BlockWatch(['a', 'b'])
    watch.block(0, T, 0, {'a': np.full(100, np.nan), 'c': T})
    for signal in watch.take()[1].values():
        assert (signal.samples, signal.saturated, signal.stuck) == (0, 0, 0.0)
        assert math.isnan(signal.mean)


# Polarity


@pytest.mark.parametrize('direction', [1.0, -1.0])
def test_a_reversed_sensor_contradicts_the_others_on_its_rail(direction):
    coach = load_vehicle('measurement_coach')
    polarity = Polarity(coach)
    x = np.arange(-400.0, 400.0, 0.05)
    rng = np.random.default_rng(5)
    rails = {rail: np.convolve(rng.normal(size=x.size), np.hanning(30), 'same')
             for rail in coach.rails}
    for index in range(300):
        position = direction * (0.3 * index + np.linspace(0.0, 0.3, 64, endpoint=False))
        polarity.block(position, {
            box.name: np.interp(position + box.offset, x, rails[box.rail])
            * (-1.0 if box.name == 'axle3_right' else 1.0) for box in coach.axle_boxes})
    assert list(polarity.reversed(0.5)) == ['axle3_right']
    assert polarity.correlations()['axle1_left'] > 0.9


def test_little_track_standstill_and_no_position_tell_nothing_about_polarity():
    coach = load_vehicle('measurement_coach')
    polarity = Polarity(coach)
    nothing = {box.name: np.ones(10) for box in coach.axle_boxes}
    for position in (np.zeros(10), np.full(10, np.nan), np.linspace(0.0, 5.0, 10)):
        polarity.block(position, nothing)
    assert polarity.reversed(0.1) == {}


# Speed and fixes


def test_a_slipping_wheel_is_told_by_a_change_that_no_train_reaches():
    watch = SpeedWatch()
    for index in range(100):
        watch.add(index * SECOND // 50, 20.0 + 0.02 * index)
    assert watch.take() == pytest.approx(1.0)
    for index in range(100, 150):
        watch.add(index * SECOND // 50, 22.0 - 0.2 * (index - 100))
    assert watch.take() == pytest.approx(10.0, rel=0.05)


def test_resolution_and_pauses_of_an_odometer_are_no_slip():
    watch = SpeedWatch()
    for index in range(200):
        watch.add(index * SECOND // 100, round(20.0 + 0.005 * index, 1))
    watch.add(60 * SECOND, 0.0)
    assert watch.take() < 1.0


def test_a_watch_tells_how_far_apart_speeds_are_and_for_how_long_none_came():
    moment = [10.0]
    watch = SpeedWatch(lambda: moment[0])
    moment[0] = 11.5
    assert watch.silence == 1.5
    assert math.isnan(watch.interval)
    watch.add(100 * SECOND, 20.0)
    watch.add(102 * SECOND, 20.0)
    assert (watch.silence, watch.interval) == (0.0, 2.0)
    watch.add(50 * SECOND, 20.0)  # a clock that was set back tells no interval
    moment[0] = 12.0
    assert (watch.silence, watch.interval) == (0.5, 2.0)


def test_distances_on_the_sphere():
    assert distance(0.0, 0.0, 0.0, 1.0) == pytest.approx(111_195, rel=1e-4)
    assert distance(60.0, 10.0, 60.0, 11.0) == pytest.approx(111_195 / 2, rel=1e-3)
    assert distance(48.0, 11.0, 48.0, 11.0) == 0.0


def test_a_wrong_wheel_diameter_shows_against_the_fixes():
    locations = Locations()
    for index in range(600):
        stamp = index * SECOND // 20
        locations.add_positions(stamp, np.zeros(1), np.array([25.0 * 1.2 * index / 20]))
        if index % 20 == 10:
            locations.add_fix(stamp, 48.0 + 25.0 * index / 20 / 111_195.0, 11.0, math.nan)
    assert locations.paired > 25
    assert locations.speed == pytest.approx(25.0, rel=0.01)
    assert locations.difference == pytest.approx(1.0 - 1.0 / 1.2, abs=0.01)


# Single samples


def collected(streams, duration=0.05):
    """Feed {name: [(stamp [s], value)]} in the order of time; return the blocks."""
    collector = SampleCollector(list(streams), duration)
    samples = sorted((stamp, name, value) for name, stream in streams.items()
                     for stamp, value in stream)
    blocks = []
    for stamp, name, value in samples:
        blocks += collector.add(name, round(stamp * SECOND), value)
    return blocks


def stream(rate, count, shift=0.0, skip=()):
    return [(shift + i / rate, math.sin(5.0 * (shift + i / rate))) for i in range(count)
            if i not in skip]


def test_samples_of_one_sensor_are_neither_lost_nor_changed():
    given = stream(1000.0, 1000)
    blocks = collected({'a': given})
    values = np.concatenate([block.channels['a'] for block in blocks])
    assert len(values) == 1000
    np.testing.assert_array_equal(values, [value for _, value in given])
    assert all(block.t.size == 50 for block in blocks)
    assert [block.stamp_ns for block in blocks] == [i * SECOND // 20 for i in range(20)]


def test_samples_of_unlike_clocks_are_brought_to_the_same_times():
    blocks = collected({'a': stream(1000.0, 4000), 'b': stream(999.3, 4000, 0.0003)})
    for block in blocks[1:]:
        times = block.stamp_ns / SECOND + block.t
        np.testing.assert_allclose(block.channels['b'], np.sin(5.0 * times), atol=1e-5)


def test_a_lost_sample_ends_its_block_and_the_next_begins_after_it():
    blocks = collected({'a': stream(500.0, 500, skip={260})})
    ends = [block.stamp_ns + round(block.t[-1] * SECOND) for block in blocks]
    starts = [block.stamp_ns for block in blocks]
    gaps = [round((b - a) * 500 / SECOND) for a, b in zip(ends, starts[1:], strict=False)]
    assert sorted(gaps)[-2:] == [1, 2]
    assert sum(block.t.size for block in blocks) >= 475


def test_a_sensor_that_falls_silent_does_not_hold_up_the_others():
    for dead in ('a', 'b'):
        streams = {'a': stream(1000.0, 2000), 'b': stream(1000.0, 2000)}
        streams[dead] = streams[dead][:700]
        blocks = collected(streams)
        alive = 'b' if dead == 'a' else 'a'
        assert blocks[-1].stamp_ns > 1.8 * SECOND
        assert np.isnan(blocks[-1].channels[dead]).all()
        assert np.isfinite(blocks[-1].channels[alive]).all()


def test_samples_from_the_past_are_dropped_and_a_clock_set_back_begins_anew():
    collector = SampleCollector(['a'], 0.05)
    for index in range(200):
        collector.add('a', 10 * SECOND + index * SECOND // 1000, 1.0)
    assert collector.add('a', 10 * SECOND, 1.0) == []
    assert collector.dropped == 1
    blocks = []
    for index in range(200):
        blocks += collector.add('a', index * SECOND // 1000, 1.0)
    assert collector.dropped == 1
    assert blocks[0].stamp_ns == 0
