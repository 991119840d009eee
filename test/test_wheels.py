"""Wheel against rail: polygons found by order, the rail left as it is."""

import math

import numpy as np
import pytest

from railtrack_ros.estimation import wheels
from railtrack_ros.irregularity.profile import iso3095
from railtrack_ros.irregularity.spectra import density, third_octave_levels

STEP = 2e-3
LENGTH = 400.0
RADIUS = 0.46


def run(radii, seed, low=5e-6, high=20e-6, corrugation=0.0, length=LENGTH):
    """Irregularity (n, wheels) over a rough rail, its rail's part, and the amplitudes by order."""
    rng = np.random.default_rng(seed)
    offsets = np.array([0.0, -2.5, -19.0])[: len(radii)]
    rough = iso3095(LENGTH + 40.0, 1e-3, seed, -30.0)
    s = np.arange(round(length / STEP)) * STEP
    values, rails, amplitudes = [], [], []
    for radius, offset in zip(radii, offsets, strict=True):
        x = s + offset
        rail = rough.at(x) + corrugation * np.sin(2 * math.pi * x / 0.24) * (x > 100) * (x < 160)
        turn = s / radius
        amplitude, phase = rng.uniform(low, high, 20), rng.uniform(0.0, 2.0 * math.pi, 20)
        wheel = sum(a * np.cos(n * turn + p)
                    for n, (a, p) in enumerate(zip(amplitude, phase, strict=True), 1))
        values.append(rail + wheel + 1e-7 * rng.standard_normal(s.size))
        rails.append(rail)
        amplitudes.append(amplitude)
    return np.array(values).T, np.array(rails).T, np.array(amplitudes), offsets


@pytest.mark.parametrize(('radii', 'corrugation', 'bound'), [
    ([0.458, 0.4593], 0.0, 1.0),
    ([0.451, 0.462], 20e-6, 1.0),
    ([0.458, 0.4592, 0.461], 0.0, 1.0),
])
def test_polygon_is_found_within_a_decibel_and_the_rail_keeps_its_levels(
        radii, corrugation, bound):
    values, rails, amplitudes, offsets = run(radii, 1, corrugation=corrugation)
    cleaned, found = wheels.separate(values, STEP, offsets, RADIUS)
    for w, radius in enumerate(radii):
        assert found[w].circumference / (2.0 * math.pi) == pytest.approx(radius, abs=2e-5)
        error = 20.0 * np.log10(np.abs(found[w].amplitude) / amplitudes[w])
        assert np.abs(error).max() < bound
        wavelength, before = third_octave_levels(rails[:, w], STEP, 0.8)
        _, after = third_octave_levels(cleaned[:, w], STEP, 0.8)
        whole = wavelength > 0.02  # below, it is the noise of the sensor
        assert np.abs(after - before)[whole].max() < 1.0


def test_wheel_alone_keeps_what_the_rail_has_in_its_lines():
    """Its uncertainty says so: -10 lg(revolutions) of the rail's level."""
    values, _, amplitudes, offsets = run([0.4585], 2)
    _, found = wheels.separate(values, STEP, offsets, RADIUS)
    deviation = np.abs(found[0].amplitude) - amplitudes[0]
    assert np.abs(deviation).max() < 3.5 * np.sqrt(found[0].variance.max())
    assert math.sqrt(float(np.mean((20.0 * np.log10(
        np.abs(found[0].amplitude) / amplitudes[0])) ** 2))) < 1.0


@pytest.mark.parametrize('wheels_of_rail', [1, 2])
def test_wheels_of_one_radius_reach_the_least_variance_that_the_rail_allows(wheels_of_rail):
    """The bound S / L of what rail and wheel share, within the scatter of 12 runs."""
    errors = []
    for seed in range(40, 52):
        values, _, amplitudes, offsets = run([0.4585] * wheels_of_rail, seed)
        _, found = wheels.separate(values, STEP, offsets, RADIUS)
        shown = wheels.roundness(found[0], 'a', 'left', 0.0, LENGTH, RADIUS, 1e3)
        errors.append(shown.amplitude - amplitudes[0])
    orders = np.arange(3, 21)
    bound = np.sqrt(density(orders / (2.0 * math.pi * 0.4585)) / LENGTH)
    error = np.array(errors)[:, 2:]
    assert math.sqrt(float(np.mean((error / bound) ** 2))) < 1.15
    assert abs(float(np.mean(error / bound))) < 0.15
    assert shown.uncertainty[2:] == pytest.approx(bound, rel=0.5)


def test_reaches_of_a_wheel_are_pooled_and_their_uncertainty_falls():
    periodic = wheels._Periodic(2.88, np.full(20, 10e-6 + 0j), np.full(20, 4e-12))
    worse = wheels._Periodic(2.88, np.full(20, 11e-6 + 0j), np.full(20, 4e-12))
    reaches = [wheels.roundness(item, 'a', 'left', start, start + 400.0, RADIUS, 1e3)
               for item, start in ((periodic, 0.0), (worse, 400.0), (None, 800.0))]
    (one,) = wheels.pooled(reaches)
    assert (one.start, one.end, one.reaches) == (0.0, 800.0, 2)
    assert one.amplitude == pytest.approx(
        np.full(20, math.sqrt((100.0 + 121.0) / 2.0 - 4.0) * 1e-6), rel=1e-6)
    assert one.uncertainty == pytest.approx(np.full(20, 1e-6), rel=1e-6)
    (none,) = wheels.pooled(reaches[2:])
    assert math.isnan(none.radius)


@pytest.mark.parametrize('radii', [[0.4585, 0.4585], [0.458, 0.4593]])
def test_gaps_take_nothing_off_the_amplitudes(radii):
    """Of either wheel 8 % are missing, at other places."""
    values, _, amplitudes, offsets = run(radii, 6)
    _, before = wheels.separate(values, STEP, offsets, RADIUS)
    values[:3000, 0] = values[80_000:93_000, 0] = np.nan
    values[150_000:166_000, 1] = np.nan
    _, after = wheels.separate(values, STEP, offsets, RADIUS)
    for w in range(2):
        strong = amplitudes[w] > 12e-6
        ratio = 20.0 * np.log10(np.abs(after[w].amplitude / before[w].amplitude))
        assert np.abs(np.mean(ratio[strong])) < 0.1
        assert np.abs(ratio[strong]).max() < 0.5


def test_round_wheels_are_round_and_corrugation_is_left_on_the_rail():
    values, _, _, offsets = run([0.46, 0.459], 3, 1e-9, 2e-9, corrugation=30e-6)
    cleaned, found = wheels.separate(values, STEP, offsets, RADIUS)
    assert found == [None, None]
    assert np.array_equal(cleaned, values)


def test_waves_of_the_sleeper_spacing_are_no_wheel():
    x = np.arange(round(LENGTH / STEP)) * STEP
    sag = sum(30e-6 / n * np.cos(2.0 * math.pi * n * x / 0.585) for n in (1, 2, 3, 4))
    rough = iso3095(LENGTH, 1e-3, 5)
    _, found = wheels.separate((rough.at(x) + sag)[:, None], STEP, np.zeros(1), RADIUS)
    assert found == [None]


def test_short_stretch_says_nothing_of_wheels():
    values, _, _, offsets = run([0.458], 4, length=40.0)
    _, found = wheels.separate(values, STEP, offsets, RADIUS)
    assert found == [None]


def test_first_order_is_corrected_for_the_high_pass_of_the_estimate():
    circumference = 2.0 * math.pi * RADIUS
    periodic = wheels._Periodic(circumference, np.full(20, 10e-6 + 0j), np.zeros(20))
    found = wheels.roundness(periodic, 'a', 'left', 0.0, 400.0, RADIUS, 3.0)
    assert found.radius == pytest.approx(RADIUS)
    assert found.amplitude[0] == pytest.approx(
        10e-6 * math.sqrt(1.0 + (circumference / 3.0) ** 8), rel=1e-9)
    assert found.amplitude[5] == pytest.approx(10e-6, rel=1e-5)
