"""TEEF: the rail over a pad that rides on the sleeper."""

import numpy as np
import pytest

from railtrack_ros.track import rail as tim4
from railtrack_ros.track import teef
from railtrack_ros.track.description import load_track

RAIL = load_track('blanco_table_3_1').rail
PADS = [(0.16, 350e6), (0.5, 350e6), (0.08, 80e6), (0.16, 3000e6)]


@pytest.mark.parametrize(('length', 'pad'), PADS)
def test_rigid_body_motion_of_rail_and_sleeper_strains_nothing(length, pad):
    k = teef.teef_matrices(RAIL, length, pad / length).stiffness
    assert np.abs(k @ [1.0, 0.0, 1.0, 0.0, 1.0]).max() < 1e-12 * np.abs(k).max()


@pytest.mark.parametrize(('length', 'pad'), PADS)
def test_sleeper_row_is_the_pad_force(length, pad):
    kd = pad / length
    k = teef.teef_matrices(RAIL, length, kd).stiffness
    x, weight = tim4.gauss(length)
    n = teef.static_field(RAIL, length, kd, x).deflection
    expected = -kd * weight @ n
    expected[4] += kd * length
    np.testing.assert_allclose(k[4], expected, rtol=1e-10, atol=1e-12 * np.abs(k).max())


def test_sleeper_stiffness_has_the_known_value():
    k = teef.teef_matrices(RAIL, 0.16, 350e6 / 0.16).stiffness
    assert k[4, 4] == pytest.approx(343.47e6, rel=2e-5)


def test_tends_to_tim4_as_the_foundation_vanishes():
    m = teef.teef_matrices(RAIL, 0.16, 1e-3)
    k4, m4 = tim4.stiffness_matrix(RAIL, 0.16), tim4.mass_matrix(RAIL, 0.16)
    np.testing.assert_allclose(m.stiffness[:4, :4], k4, atol=1e-10 * np.abs(k4).max())
    np.testing.assert_allclose(m.mass[:4, :4], m4, atol=1e-10 * np.abs(m4).max())
    x = [0.03, 0.1]
    np.testing.assert_allclose(teef.clamped_flexibility(RAIL, 0.16, 1e-3, x),
                               tim4.clamped_flexibility(RAIL, 0.16, x), rtol=1e-9)


def test_field_satisfies_the_differential_equation():
    length, kd = 0.3, 350e6 / 0.3
    h = 1e-4
    x = np.linspace(0.01, 0.29, 15)
    at, after, before = (teef.static_field(RAIL, length, kd, x + d) for d in (0.0, h, -h))

    def slope(name):
        return (getattr(after, name) - getattr(before, name)) / (2.0 * h)

    sleeper = np.array([0.0, 0.0, 0.0, 0.0, 1.0])
    for left, right in (
            (slope('deflection'), at.rotation + at.shear / RAIL.shear_stiffness),
            (slope('rotation'), at.moment / RAIL.bending_stiffness),
            (slope('shear'), kd * (at.deflection - sleeper)),
            (slope('moment'), -at.shear)):
        np.testing.assert_allclose(left, right, atol=2e-6 * np.abs(right).max())


def test_clamped_flexibility_is_that_of_two_joined_elements():
    length, kd = 0.16, 350e6 / 0.16
    for x in (0.03, 0.08, 0.15):
        left = teef.teef_matrices(RAIL, x, kd).stiffness[2:4, 2:4]
        right = teef.teef_matrices(RAIL, length - x, kd).stiffness[:2, :2]
        assert teef.clamped_flexibility(RAIL, length, kd, x)[0] == pytest.approx(
            np.linalg.inv(left + right)[0, 0], rel=1e-9)
    ends = teef.clamped_flexibility(RAIL, length, kd, [0.0, length])
    assert np.all(ends == 0.0)


def test_foundation_raises_the_clamped_frequencies_by_its_stiffness():
    kd = 350e6 / 0.16
    free = tim4.clamped_modes(RAIL, 0.16, 1).angular_frequency[0]
    held = tim4.clamped_modes(RAIL, 0.16, 1, foundation=kd).angular_frequency[0]
    # The first mode is nearly all deflection: its square rises by almost kd / (rho A).
    assert 0.8 < (held**2 - free**2) / (kd / RAIL.mass_per_length) < 1.0
