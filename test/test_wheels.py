"""Wheel against rail: polygons found by order, the rail left as it is."""

import math

import numpy as np
import pytest

from railtrack_ros.estimation import wheels
from railtrack_ros.irregularity.profile import iso3095
from railtrack_ros.irregularity.spectra import third_octave_levels

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
