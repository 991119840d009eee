"""Placing blocks in time (SampleClock) and speed and position at the samples (Odometer)."""

import math

import numpy as np
import pytest

from railtrack_ros.estimation.odometer import GLIDE, Odometer
from railtrack_ros.estimation.timeline import SINGLES, Place, SampleClock

MS = 1_000_000
S = 1_000_000_000
RATE = 1000.0
STEP = 1.0 / RATE
START = 1_700_000_000 * S
T10 = np.arange(10) / RATE  # a block of 10 ms


def clock():
    return SampleClock(tolerance=0.002)


def odometer(start=0.0, delay=0.02, timeout=2.5, bay=0.6):
    return Odometer(start, delay, timeout, bay)


# Blocks in time


def test_blocks_with_jittering_stamps_are_one_stretch():
    c = clock()
    jitter = [0, 1.5, -0.4, 1.9, 0.1]
    places = [c.place(START + round((10 * k + j) * MS), T10)[0] for k, j in enumerate(jitter)]
    assert places == [Place.STARTED] + 4 * [Place.CONTINUED]


def test_slow_drift_between_sensor_and_stamps_is_no_gap():
    c = clock()
    for k in range(1000):  # stamps 1 % fast: 100 ms in all
        place, _ = c.place(START + round(k * 10.1 * MS), T10)
    assert place is Place.CONTINUED


def test_gap_and_overlap_begin_a_new_stretch_and_are_told():
    c = clock()
    c.place(START, T10)
    place, remark = c.place(START + 15 * MS, T10)
    assert place is Place.STARTED
    assert remark == 'gap of 0.005 s (5 samples): start anew'
    place, remark = c.place(START + 20 * MS, T10)
    assert place is Place.STARTED
    assert 'overlap by 5 ms' in remark


def test_repeated_blocks_and_blocks_from_the_past_are_dropped_without_a_trace():
    c = clock()
    c.place(START, T10)
    c.place(START + 10 * MS, T10)
    for stamp, words in ((START + 10 * MS, 'stamp of the last'), (START - 2 * S, 'before')):
        place, remark = c.place(stamp, T10)
        assert place is Place.DROPPED
        assert words in remark
    assert c.place(START + 20 * MS, T10)[0] is Place.CONTINUED


def test_clock_set_back_begins_the_stream_anew():
    c = clock()
    c.place(START, T10)
    assert c.place(START - 3600 * S, T10)[0] is Place.DROPPED  # it may be a slip of one stamp
    assert c.place(START - 3600 * S + 10 * MS, T10)[0] is Place.REWOUND
    assert c.begun_ns == START - 3600 * S
    assert c.place(START - 3600 * S + 20 * MS, T10)[0] is Place.CONTINUED


@pytest.mark.parametrize('slip', [-3600 * S, 3600 * S])
def test_one_wild_stamp_is_dropped_and_the_stream_goes_on(slip):
    c = clock()
    c.place(START, T10)
    assert c.place(START + slip, T10)[0] is Place.DROPPED
    assert c.place(START + 10 * MS, T10)[0] is Place.CONTINUED


def test_a_long_gap_is_believed_from_the_second_block_on():
    c = clock()
    c.place(START, T10)
    assert c.place(START + 60 * S, T10)[0] is Place.DROPPED
    assert c.place(START + 60 * S + 10 * MS, T10)[0] is Place.STARTED


@pytest.mark.parametrize('samples', [2, 10, 256, 25600])
@pytest.mark.parametrize('rate', [25600.0, 2091.28, 999.5])
def test_sample_period_does_not_depend_on_the_length_of_the_block(samples, rate):
    c = clock()
    c.place(START, np.arange(samples) / rate)
    assert c.step == 1.0 / rate


def test_time_field_in_single_precision_is_of_the_same_rate():
    c = clock()
    for k in range(3):
        t = (np.arange(256) / 25600).astype(np.float32).astype(float)
        c.place(START + k * 10 * MS, t)
    assert c.step == 1.0 / 25600


def test_other_sample_rate_begins_a_new_stretch():
    c = clock()
    c.place(START, T10)
    place, remark = c.place(START + 10 * MS, np.arange(20) / 2000.0)
    assert place is Place.STARTED
    assert remark == 'sample rate changed from 1000 to 2000 Hz'
    assert c.step == 1 / 2000


@pytest.mark.parametrize('t', [
    [], [0.0, np.nan], [0.0, 0.0], [0.001, 0.0], [0.0, 0.001, 0.002, 0.013],
])
def test_block_without_usable_times_is_dropped(t):
    c = clock()
    place, remark = c.place(START, np.array(t))
    assert place is Place.DROPPED
    assert remark.startswith('block dropped: ')
    assert c.place(START, T10) == (Place.STARTED, '')


def test_single_samples_go_on_at_a_known_rate():
    c = clock()
    c.place(START, T10)
    assert c.place(START + 10 * MS, np.zeros(1))[0] is Place.CONTINUED


@pytest.mark.parametrize('rate', [25600.0, 2000.0, 100.0])
def test_single_samples_tell_their_rate_and_go_on(rate):
    c = clock()
    found = [c.place(START + round(k / rate * S), np.zeros(1)) for k in range(200)]
    assert c.step == pytest.approx(1.0 / rate, rel=1e-6)
    assert {place for place, _ in found[:SINGLES]} == {Place.HELD}
    assert found[SINGLES:] == [(Place.STARTED, '')] + (199 - SINGLES) * [(Place.CONTINUED, '')]


def test_a_gap_among_the_first_single_samples_does_not_count_for_the_rate():
    c = clock()
    for k in range(3 * SINGLES):
        c.place(START + k * MS + (50 * MS if k > 10 else 0), np.zeros(1))
    assert c.step == pytest.approx(STEP)


# Speed


def test_block_uses_the_messages_up_to_its_end_minus_the_delay():
    # Messages every 5 ms on a broken line; the block of 100..109 ms may use those up to 89 ms.
    o = odometer()
    speeds = {k: 10.0 + (0.1 * k if k <= 75 else 7.5 - 0.3 * (k - 75)) for k in range(0, 200, 5)}
    for k, v in speeds.items():
        o.add_speed(START + k * MS, v)
    run = o.run(START + 100 * MS, T10, STEP, False)
    slope = (speeds[85] - speeds[80]) / 5.0
    assert run.speed == pytest.approx(speeds[85] + slope * (np.arange(100, 110) - 85), abs=1e-12)


def test_long_block_is_interpolated_and_only_its_end_extrapolated():
    o = odometer()
    rng = np.random.default_rng(0)
    times = np.arange(-50, 1100, 7)
    speeds = 20.0 + rng.standard_normal(times.size)
    for k, v in zip(times, speeds, strict=True):
        o.add_speed(START + int(k) * MS, float(v))
    ms = np.arange(1000)
    run = o.run(START, ms / RATE, STEP, False)
    last = int(np.flatnonzero(times <= 999 - 20)[-1])
    expected = np.interp(ms, times, speeds)
    late = ms > times[last]
    slope = (speeds[last] - speeds[last - 1]) / 7.0
    expected[late] = speeds[last] + slope * (ms[late] - times[last])
    assert run.speed == pytest.approx(expected, abs=1e-9)


def test_message_at_the_limit_is_used_and_one_behind_it_is_not():
    end = START + 9 * MS
    for stamp, used in ((end - 20 * MS, True), (end - 20 * MS + 1, False)):
        o = odometer()
        o.add_speed(START - 60 * MS, 10.0)
        o.add_speed(stamp, 20.0)
        assert bool(o.run(START, T10, STEP, False).speed[0] > 10.0) == used


def test_order_of_arrival_does_not_matter():
    stamps = [START + k * MS for k in (-90, -60, -30, -25, -21, -15)]
    runs = []
    for order in ([0, 1, 2, 3, 4, 5], [5, 3, 0, 1, 4, 2]):
        o = odometer()
        for i in order:
            o.add_speed(stamps[i], 10.0 + i**2)
        runs.append([o.run(START + 10 * k * MS, T10, STEP, k > 0).speed for k in range(2)])
    assert np.array_equal(runs[0], runs[1])


def test_late_message_is_counted_and_changes_nothing():
    plain, disturbed = odometer(), odometer()
    for o in (plain, disturbed):
        o.add_speed(START - 100 * MS, 10.0)
    for k in range(20):
        for o in (plain, disturbed):
            o.add_speed(START + (10 * k - 15) * MS, 10.0 + 0.1 * k)
        a, b = (o.run(START + 10 * k * MS, T10, STEP, k > 0) for o in (plain, disturbed))
        assert np.array_equal(a.speed, b.speed)
        assert np.array_equal(a.position, b.position)
        disturbed.add_speed(START + (10 * k + 9 - 20) * MS, 99.0)  # the last that it could use
    assert (plain.late, disturbed.late) == (0, 20)
    assert 'larger speed_delay' in disturbed.notes[0]
    assert len(disturbed.notes) < 8


def test_message_of_the_future_waits_for_its_block():
    o = odometer()
    o.add_speed(START - 50 * MS, 10.0)
    o.add_speed(START + 20 * MS, 17.0)
    assert np.all(o.run(START, T10, STEP, False).speed == 10.0)
    assert o.run(START + 40 * MS, T10, STEP, True).speed[0] == pytest.approx(17.0 + 2.0)


@pytest.mark.parametrize('speed', [math.nan, math.inf, -math.inf, 1e9])
def test_impossible_speed_is_refused(speed):
    o = odometer()
    o.add_speed(START - 50 * MS, 10.0)
    o.add_speed(START - 40 * MS, speed)
    assert np.all(o.run(START, T10, STEP, False).speed == 10.0)
    assert o.refused == 1
    assert 'no plausible speed' in o.notes[0]


def test_silence_ends_the_estimate_and_the_way_through_it_is_not_lost():
    o = odometer(timeout=0.5)
    o.add_speed(START - 30 * MS, 10.0)
    runs = [o.run(START + k * 10 * MS, T10, STEP, k > 0) for k in range(100)]
    known = sum(run is not None for run in runs)
    assert known == 47  # 469 ms after START the message is 499 ms old
    assert o.state == 'silent'
    o.add_speed(START + 980 * MS, 20.0)
    back = o.run(START + 1000 * MS, T10, STEP, True)
    assert o.state == 'ok'
    # 10 m/s up to 469 ms as put out, then along the line from the old message to the new one.
    slope = 10.0 / 1.01
    line = [10.0 + slope * 0.499, 20.0, 20.0 + slope * 0.02]
    way = 0.5 * (line[0] + line[1]) * 0.511 + 0.5 * (line[1] + line[2]) * 0.02
    assert back.position[0] == pytest.approx(runs[46].position[-1] + way, abs=1e-9)


# Position


def test_position_is_the_start_and_the_distance_run():
    o = odometer(start=123.0)
    for k in range(-5, 105):
        o.add_speed(START + k * 10 * MS, 20.0 + 0.01 * k)  # 1 m/s2
    runs = [o.run(START + k * 10 * MS, T10, STEP, k > 0) for k in range(100)]
    position = np.concatenate([run.position for run in runs])
    t = np.arange(1000) / RATE
    assert position == pytest.approx(123.0 + 20.0 * t + 0.5 * t * t, abs=1e-9)


def test_first_sample_is_at_the_start_though_the_speed_comes_later():
    o = odometer(start=50.0)
    assert o.run(START, T10, STEP, False) is None
    assert o.state == 'none'
    o.add_speed(START, 20.0)
    o.add_speed(START + 100 * MS, 22.0)
    for k in range(1, 40):
        run = o.run(START + k * 10 * MS, T10, STEP, True)
        if run is None:
            assert k == 1  # its end minus the delay is before the first message
        elif k == 2:  # one message only
            assert run.position[0] == pytest.approx(50.0 + 20.0 * 0.02, abs=1e-12)
    # The second message serves the blocks from 120 ms on.
    assert run.position[-1] == pytest.approx(
        50.0 + 20.0 * 0.399 + 10.0 * (0.399**2 - 0.12**2), abs=0.002)


def test_start_is_where_the_speed_is_first_known_if_it_comes_much_later():
    o = odometer(start=50.0, timeout=1.0)
    assert o.run(START, T10, STEP, False) is None
    o.add_speed(START + 3900 * MS, 20.0)
    run = o.run(START + 4 * S, T10, STEP, True)
    assert run.position[0] == 50.0
    assert 'start position' in o.notes[0]


@pytest.mark.parametrize('gap', [0.5, 40.0])
def test_gap_of_the_acceleration_is_driven_through(gap):
    o = odometer()
    for k in range(-5, round((gap + 1) * 100)):
        o.add_speed(START + k * 10 * MS, 10.0 + 0.001 * k)
    o.run(START, T10, STEP, False)
    run = o.run(START + round(gap * S), T10, STEP, False)
    t = gap + np.arange(10) / RATE
    assert run.position == pytest.approx(10.0 * t + 0.05 * t * t, rel=1e-9)


def test_memory_is_bounded_while_no_acceleration_comes():
    o = odometer()
    o.add_speed(START - S, 10.0)
    o.run(START, T10, STEP, False)
    for k in range(60_000):
        o.add_speed(START + k * 10 * MS, 10.0)
    assert len(o._stamps) <= 20_001
    assert o.run(START + 599 * S, T10, STEP, False).position[0] == pytest.approx(5990.0)


def in_blocks(size, reference=None):
    o = odometer(start=7.0)
    o.add_speed(START - 100 * MS, 23.456)
    if reference:
        o.set_position(*reference)
    runs = [o.run(START + k * MS, np.arange(min(size, 1000 - k)) / RATE, STEP, k > 0)
            for k in range(0, 1000, size)]
    return [np.concatenate([getattr(run, name) for run in runs])
            for name in ('speed', 'position', 'place')]


@pytest.mark.parametrize('size', [1, 10, 137])
def test_result_does_not_depend_on_the_blocks(size):
    for whole, parts in zip(in_blocks(1000), in_blocks(size), strict=True):
        assert np.array_equal(whole, parts)
    # A reference takes effect with the first block that may know of it.
    reference = (START + 200 * MS, 31.7)
    for whole, parts in zip(in_blocks(1000, reference), in_blocks(size, reference), strict=True):
        assert np.array_equal(whole[:200], parts[:200])
        assert parts[940:] == pytest.approx(whole[940:], abs=1e-9)


def test_reversal_runs_back_along_the_track():
    o = odometer(start=10.0)
    for k in range(-50, 450):
        o.add_speed(START + k * 10 * MS, 1.0 - 0.01 * k)
    position = np.concatenate(
        [o.run(START + k * 10 * MS, T10, STEP, k > 0).position for k in range(400)])
    assert position.max() == pytest.approx(10.5, abs=1e-6)
    assert position[-1] == pytest.approx(10.0 + 3.999 - 0.5 * 3.999**2, abs=1e-6)


# Position references


def moving(speed=20.0, start=100.0):
    o = odometer(start=start)
    for k in range(-1, 30):
        o.add_speed(START + k * 100 * MS, speed)
    return o


def test_reference_counts_from_its_stamp():
    o = moving()
    t = np.arange(1000) / RATE
    o.set_position(START + 500 * MS, 200.0)
    run = o.run(START, t, STEP, False)
    assert run.position[499] == pytest.approx(100.0 + 20.0 * 0.499)
    assert run.position[500] == pytest.approx(200.0)
    assert run.position[-1] == pytest.approx(200.0 + 20.0 * 0.499)
    assert np.all(run.speed == 20.0)
    assert o.corrections == 1


def test_reference_that_comes_later_counts_back_to_its_stamp():
    o = moving()
    for k in range(50):
        o.run(START + 10 * k * MS, T10, STEP, k > 0)
    o.set_position(START + 300 * MS, 200.0)
    run = o.run(START + 500 * MS, T10, STEP, True)
    assert run.position[0] == pytest.approx(200.0 + 20.0 * 0.2)


def test_reference_before_the_first_sample_sets_the_start():
    o = moving()
    o.set_position(START - 50 * MS, 1000.0)
    assert o.run(START, T10, STEP, False).position[0] == pytest.approx(1001.0)


def test_useless_references_are_told():
    o = moving()
    o.set_position(START, math.nan)
    o.set_position(START - 10 * S, 5.0)
    run = o.run(START, np.arange(100) / RATE, STEP, False)
    o.set_position(START + 60 * MS, 300.0)
    o.run(START + 100 * MS, T10, STEP, True)
    o.set_position(START + 20 * MS, 400.0)
    last = o.run(START + 110 * MS, T10, STEP, True)
    assert run.position[0] == 100.0
    assert last.position[0] == pytest.approx(301.0)
    assert [any(word in note for note in o.notes)
            for word in ('not plausible', 'without known distance', 'older than')] == 3 * [True]


@pytest.mark.parametrize('change', [0.25, -0.25, 0.6 * 40 + 0.1, -0.4])
def test_sleepers_glide_under_the_wheels_to_their_corrected_phase(change):
    o = moving()
    o.set_position(START + 100 * MS, 102.0 + change)
    run = o.run(START, np.arange(3000) / RATE, STEP, False)
    steps = np.diff(run.place)
    assert np.abs(steps - 0.02).max() <= GLIDE * 0.02 + 1e-9
    phase = (run.position - run.place) / 0.6
    assert phase[-1] == pytest.approx(round(phase[-1]), abs=1e-9)


def test_clock_set_back_begins_at_the_start_with_the_speeds_of_the_new_time():
    o = moving(start=5.0)
    o.run(START, T10, STEP, False)
    new = START - 3600 * S
    o.add_speed(new - 30 * MS, 11.0)
    o.rewind(new)
    run = o.run(new, T10, STEP, False)
    assert run.position[0] == 5.0
    assert np.all(run.speed == 11.0)
