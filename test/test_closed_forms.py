"""Closed forms of the rail on a continuous foundation."""

import dataclasses

import numpy as np
import pytest
from frequency_domain import variant

from railtrack_ros.dynamics.closed_forms import (
    critical_speed,
    euler_winkler,
    smeared_foundation,
    timoshenko_winkler,
)
from railtrack_ros.dynamics.receptance import receptance
from railtrack_ros.errors import InputError
from railtrack_ros.track.rail import pinned_pinned_frequency

FORCE = 100e3


@pytest.fixture
def foundation(table_3_1):
    return smeared_foundation(table_3_1.support)


def test_smeared_foundation_and_critical_speed(table_3_1, foundation):
    assert foundation == pytest.approx(97.222e6, rel=1e-5)
    assert critical_speed(table_3_1.rail, foundation) == pytest.approx(909.63, abs=0.005)


@pytest.mark.parametrize(('speed', 'millimetres'), [
    (0.0, 0.717502), (24.0, 0.717752), (100.0, 0.721878), (300.0, 0.760026)])
def test_euler_beam_under_a_moving_force(speed, millimetres, table_3_1, foundation):
    w = euler_winkler(table_3_1.rail, foundation, FORCE, 0.0, speed)
    assert 1e3 * w == pytest.approx(millimetres, abs=6e-7)


def test_euler_beam_beside_the_force(table_3_1, foundation):
    w = euler_winkler(table_3_1.rail, foundation, FORCE, [0.6, -0.6, 1.5])
    np.testing.assert_allclose(1e3 * w, [0.438749, 0.438749, 0.0325983], rtol=2e-6)


@pytest.mark.parametrize(('speed', 'millimetres', 'digits'), [
    (0.0, 0.770502, 6e-7), (24.0, 0.77079, 6e-6), (100.0, 0.77558, 6e-6), (300.0, 0.82010, 6e-6)])
def test_timoshenko_beam_under_a_moving_force(speed, millimetres, digits, table_3_1, foundation):
    w = timoshenko_winkler(table_3_1.rail, foundation, FORCE, 0.0, speed)
    assert 1e3 * w == pytest.approx(millimetres, abs=digits)


def test_timoshenko_without_shear_and_rotary_inertia_is_euler(table_3_1, foundation):
    rail = dataclasses.replace(table_3_1.rail, shear_coefficient=1e7)
    x = np.linspace(-4.0, 4.0, 41)
    # Rotary inertia remains: no difference at rest.
    np.testing.assert_allclose(timoshenko_winkler(rail, foundation, FORCE, x),
                               euler_winkler(rail, foundation, FORCE, x),
                               rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize('speed', [0.0, 24.0, 300.0])
def test_the_foundation_carries_the_force(speed, table_3_1, foundation):
    x = np.linspace(-40.0, 40.0, 80001)
    for beam in (euler_winkler, timoshenko_winkler):
        w = beam(table_3_1.rail, foundation, FORCE, x, speed)
        assert foundation * np.trapezoid(w, x) == pytest.approx(FORCE, rel=1e-6)


def test_speeds_beyond_the_critical_one_are_refused(table_3_1, foundation):
    for beam in (euler_winkler, timoshenko_winkler):
        with pytest.raises(InputError, match='speed'):
            beam(table_3_1.rail, foundation, FORCE, 0.0, 910.0)


def test_closely_spaced_supports_are_a_continuous_foundation(table_3_1, foundation):
    support = table_3_1.support
    errors = []
    for n in (6, 12):
        track = variant(
            table_3_1, 0.0, kind='concentrated', spacing=support.spacing / n, pad_length=0.01,
            pad_stiffness=support.pad_stiffness / n,
            ballast_stiffness=support.ballast_stiffness / n)
        w = FORCE * receptance(track, 1e-3, 0.0)[0].real
        expected = timoshenko_winkler(track.rail, foundation, FORCE)
        errors.append(abs(w / expected - 1.0))
    assert errors[1] < 2e-4
    assert errors[0] > 2.0 * errors[1]


@pytest.mark.parametrize(('shear_coefficient', 'frequency'), [
    (0.34, 1033.61), (0.38, 1057.51), (0.393, 1064.52), (0.40, 1068.16), (0.41, 1073.19)])
def test_pinned_pinned_frequency_of_uic60(shear_coefficient, frequency, table_3_1):
    rail = dataclasses.replace(table_3_1.rail, shear_coefficient=shear_coefficient)
    assert pinned_pinned_frequency(rail, 0.6) == pytest.approx(frequency, abs=0.006)


def test_second_pinned_pinned_frequency(table_3_1, table_2_1):
    assert pinned_pinned_frequency(table_3_1.rail, 0.3) == pytest.approx(2860.83, abs=0.006)
    assert pinned_pinned_frequency(table_2_1.rail, 0.395) == pytest.approx(1816.04, abs=0.01)
