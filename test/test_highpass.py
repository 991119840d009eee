import math

import numpy as np
import pytest
from scipy import signal

from railtrack_ros.estimation.highpass import ChannelState, filter_block

CUT_ON = 3.0
RATE = 25600.0


def run(acceleration, direct, speed, rate=RATE, alive=None, minimum_speed=1.0, blocks=(None,)):
    """Filter one channel; returns (valid, irregularity, (n,) filter output where it runs)."""
    n = len(speed)
    column = [np.broadcast_to(np.asarray(x, dtype=float), n)[:, None] for x in
              (acceleration, direct)]
    alive = np.ones((n, 1), dtype=bool) if alive is None else alive[:, None]
    state = ChannelState.stopped(1)
    edges = [0, *[b for b in blocks if b], n]
    parts = [
        filter_block(state, np.ascontiguousarray(column[0][a:b]),
                     np.ascontiguousarray(column[1][a:b]), alive[a:b],
                     np.ascontiguousarray(speed[a:b]), 1.0 / rate, CUT_ON, minimum_speed)
        for a, b in zip(edges, edges[1:], strict=False)
    ]
    return tuple(np.concatenate([part[i][:, 0] for part in parts]) for i in (0, 1))


def motion(speed, acceleration, seconds, rate=RATE):
    t = np.arange(round(seconds * rate)) / rate
    return speed + acceleration * t, speed * t + 0.5 * acceleration * t * t


def wheel_acceleration(wavelength, v, x, dvdt):
    """Second time derivative of sin(k x) along a run."""
    k = 2.0 * math.pi / wavelength
    return -(k * v) ** 2 * np.sin(k * x) + k * dvdt * np.cos(k * x)


def butterworth(wavelength):
    b, a = signal.butter(4, 1.0 / CUT_ON, 'highpass', analog=True)
    return complex(signal.freqs(b, a, [1.0 / wavelength])[1][0])


def response(wavelength, y, x):
    """Complex amplitude of y relative to sin(k x)."""
    k = 2.0 * math.pi / wavelength
    good = np.isfinite(y)
    basis = np.column_stack([np.sin(k * x[good]), np.cos(k * x[good])])
    a, b = np.linalg.lstsq(basis, y[good], rcond=None)[0]
    return complex(a, b)


@pytest.mark.parametrize('wavelength', [0.008, 0.0125, 0.02, 0.1, 0.5, 1.0, 2.0, 3.0, 6.0])
@pytest.mark.parametrize('share', [0.0, 1.0])
def test_response_is_that_of_the_butterworth_filter(wavelength, share):
    # The wave comes in as acceleration, as a direct part, or half each.
    v, x = motion(25.0, 0.0, 2.0)
    k = 2.0 * math.pi / wavelength
    a = (1.0 - share) * wheel_acceleration(wavelength, v, x, 0.0)
    y = run(a, share * np.sin(k * x), v)[1]
    ratio = response(wavelength, y, x) / butterworth(wavelength)
    assert abs(20.0 * math.log10(abs(ratio))) < 0.05
    assert abs(np.angle(ratio)) < 0.003


def test_two_waves_that_cancel_leave_nothing():
    # A wheel that follows a sinking rail: the double integral and the direct part are equal.
    v, x = motion(20.0, 1.5, 3.0)
    a = 1e-3 * wheel_acceleration(2.0, v, x, 1.5)
    y = run(a, -1e-3 * np.sin(math.pi * x), v)[1]
    # Past the transient of a start in the middle of the motion.
    assert np.abs(y[x > 30.0]).max() < 1e-9


@pytest.mark.parametrize(('wavelength', 'limit'), [(0.1, 1e-4), (0.3, 1e-4), (1.0, 5e-4),
                                                   (3.0, 1.2e-2)])
def test_filter_is_one_in_wavelength_while_the_speed_changes(wavelength, limit):
    v, x = motion(10.0, 1.0, 12.0)
    y = run(wheel_acceleration(wavelength, v, x, 1.0), 0.0, v)[1]
    gain = butterworth(wavelength)
    expected = abs(gain) * np.sin(2.0 * math.pi * x / wavelength + np.angle(gain))
    later = np.isfinite(y) & (x > 20.0)
    assert np.std((y - expected)[later]) < limit * np.std(expected[later])


def test_bias_leaves_nothing_over_an_hour_of_uneven_speed():
    # Integrating first and filtering in distance afterwards gives millimetres here.
    rate = 500.0
    rng = np.random.default_rng(1)
    t = np.arange(round(3600 * rate)) / rate
    v = 25.0 + 10.0 * np.sin(2.0 * math.pi * t / 120.0)
    v += np.repeat(0.05 * rng.standard_normal(t.size // 5), 5)
    y = run(np.full(t.size, 0.05), 0.0, v, rate)[1]
    assert np.nanmax(np.abs(y[t > 30.0])) < 1e-12


def test_long_waves_of_the_track_stay_out_at_uneven_speed():
    rate = 2000.0
    rng = np.random.default_rng(2)
    v = 25.0 + np.repeat(0.05 * rng.standard_normal(6000), 20)
    t = np.arange(v.size) / rate
    a = -5e-3 * (2.0 * math.pi * 25.0 / 20.0) ** 2 * np.sin(2.0 * math.pi * 25.0 * t / 20.0)
    y = run(a, 0.0, v, rate)[1]
    # 5 mm of 20 m waves through the filter's own attenuation, (3/20)^4.
    assert np.nanmax(np.abs(y[t > 5.0])) < 1.1 * 5e-3 * abs(butterworth(20.0))


def test_constant_direct_part_is_no_irregularity():
    v, _ = motion(25.0, 0.0, 1.0)
    y = run(0.0, 7.3e-4, v)[1]
    assert np.all(y[np.isfinite(y)] == 0.0)


@pytest.mark.parametrize('blocks', [(1,), (7, 8, 5000), tuple(range(256, 25600, 256))])
def test_result_does_not_depend_on_the_blocks(blocks):
    rng = np.random.default_rng(0)
    v, _ = motion(25.0, 2.0, 1.0)
    a, u = rng.standard_normal((2, v.size))
    alive = np.ones(v.size, dtype=bool)
    alive[3000] = False
    whole = run(a, u, v, alive=alive)
    parts = run(a, u, v, alive=alive, blocks=blocks)
    assert all(np.array_equal(x, y, equal_nan=True) for x, y in zip(whole, parts, strict=True))


@pytest.mark.parametrize(('speed', 'seconds'), [(25.0, 0.24), (80.0, 0.1)])
def test_start_lasts_a_tenth_of_a_second_and_two_wavelengths(speed, seconds):
    v, _ = motion(speed, 0.0, 0.5)
    for series in run(0.0, 0.0, v):
        good = series == 1 if series.dtype == bool else np.isfinite(series)
        first = int(np.argmax(good))
        assert first / RATE == pytest.approx(seconds, abs=1.5 / RATE)
        assert good[first:].all()
        assert not good[:first].any()


def test_lost_sample_starts_the_channel_anew_and_the_other_goes_on():
    v, _ = motion(25.0, 0.0, 1.0)
    rng = np.random.default_rng(0)
    a = rng.standard_normal((v.size, 2))
    alive = np.ones((v.size, 2), dtype=bool)
    alive[12800, 0] = False
    valid, y = filter_block(ChannelState.stopped(2), a, np.zeros_like(a), alive, v, 1 / RATE,
                            CUT_ON, 1.0)
    for good in (valid, np.isfinite(y)):
        assert good[6200:, 1].all()
        assert good[6200:12800, 0].all()
        assert not good[12800:12800 + 6100, 0].any()
        assert good[12800 + 6200:, 0].all()


def test_standstill_is_a_start_for_the_irregularity_alone():
    t = np.arange(round(6 * 5000)) / 5000.0
    v = np.clip(np.abs(20.0 * (t - 3.0)), 0.0, 20.0) - 0.5
    valid, y = run(np.random.default_rng(0).standard_normal(t.size), 0.0, v, 5000.0)
    slow = np.abs(v) < 1.0
    assert valid[t > 0.5].all()
    assert not np.isfinite(y[slow]).any()
    again = np.flatnonzero(slow)[-1] + 1
    run_since = np.cumsum(np.abs(v[again:])) / 5000.0
    assert not np.isfinite(y[again:][run_since < 5.99]).any()
    assert np.isfinite(y[again:][run_since > 6.01]).all()


def test_direction_of_running_does_not_matter():
    v, x = motion(20.0, 0.0, 1.0)
    a = wheel_acceleration(0.5, v, x, 0.0)
    assert np.array_equal(run(a, 0.0, v)[1], run(a, 0.0, -v)[1], equal_nan=True)


def test_samples_too_sparse_for_the_cut_on_give_nothing():
    v = np.full(2000, 80.0)
    valid, y = run(1.0, 0.0, v, rate=100.0)
    assert valid[100:].all()
    assert not np.isfinite(y).any()
