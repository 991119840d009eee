"""TIM4 element, clamped modes and clamped flexibility against physics and exact numbers."""

import dataclasses

import numpy as np
import pytest

from railtrack_ros.track import rail as tim4
from railtrack_ros.track.description import load_track

RAIL = load_track('blanco_table_3_1').rail
OTHER = load_track('blanco_table_2_1').rail


@pytest.mark.parametrize('length', [0.05, 0.15, 0.6])
def test_rigid_body_motion_strains_nothing(length):
    k = tim4.stiffness_matrix(RAIL, length)
    rotation_about_left_end = np.array([0.0, 1.0, length, 1.0])
    for motion in ([1.0, 0.0, 1.0, 0.0], rotation_about_left_end):
        assert np.abs(k @ motion).max() < 1e-12 * np.abs(k).max()


def test_rigid_translation_has_the_mass_of_the_rail():
    m = tim4.mass_matrix(RAIL, 0.3)
    ones = np.array([1.0, 0.0, 1.0, 0.0])
    assert ones @ m @ ones == pytest.approx(RAIL.density * RAIL.area * 0.3, rel=1e-12)


def test_shape_functions_have_unit_values_at_the_ends():
    w, theta = tim4.shape_functions(RAIL, 0.2, [0.0, 0.2])
    np.testing.assert_allclose(
        np.stack([w[0], theta[0], w[1], theta[1]]), np.eye(4), atol=1e-13)


def test_cantilever_deflects_by_bending_and_shear():
    length, force = 0.7, 1000.0
    free = np.linalg.solve(tim4.stiffness_matrix(RAIL, length)[2:, 2:], [force, 0.0])
    expected = (force * length**3 / (3.0 * RAIL.bending_stiffness)
                + force * length / RAIL.shear_stiffness)
    assert free[0] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize('x', [0.01, 0.05, 0.075, 0.12])
def test_clamped_flexibility_is_that_of_two_joined_elements(x):
    length = 0.15
    left = tim4.stiffness_matrix(RAIL, x)[2:, 2:]
    right = tim4.stiffness_matrix(RAIL, length - x)[:2, :2]
    joined = np.linalg.inv(left + right)[0, 0]
    assert tim4.clamped_flexibility(RAIL, length, x)[0] == pytest.approx(joined, rel=1e-10)


def test_clamped_flexibility_at_the_middle_has_the_closed_form_and_known_values():
    phi = tim4.shear_ratio(RAIL, 0.15)
    closed = 0.15**3 * (1.0 + 4.0 * phi) / (192.0 * RAIL.bending_stiffness)
    assert tim4.clamped_flexibility(RAIL, 0.15, 0.075)[0] == pytest.approx(closed, rel=1e-12)
    assert closed == pytest.approx(1.5368e-10, rel=1e-4)
    at_other = tim4.clamped_flexibility(OTHER, 0.15, 0.075)[0]
    assert at_other == pytest.approx(1.9683e-10, rel=1e-4)


@pytest.mark.parametrize(('rail', 'length', 'hertz'), [
    (RAIL, 0.15, [6704.38, 13261.42, 18136.19, 20166.32, 26973.13, 33670.95]),
    (OTHER, 0.15, [6151.11, 12194.47, 18030.13, 18508.79]),
    (dataclasses.replace(OTHER, youngs_modulus=210e9), 0.15,
     [6195.52, 12282.52, 18160.32, 18642.43, 24934.36, 31168.44]),
    (RAIL, 0.3, [3269.57, 6399.18, 9920.02, 10179.22]),
])
def test_clamped_frequencies_below_and_above_the_cut_off(rail, length, hertz):
    found = tim4.clamped_modes(rail, length, len(hertz)).angular_frequency / (2.0 * np.pi)
    np.testing.assert_allclose(found, hertz, rtol=2e-6)


def test_clamped_modes_are_orthonormal_in_mass_and_held_at_the_ends():
    modes = tim4.clamped_modes(RAIL, 0.15, 6)
    x, weight = np.polynomial.legendre.leggauss(60)
    x, weight = 0.075 * (x + 1.0), 0.075 * weight
    w, theta = modes.shapes(x)
    gram = (RAIL.mass_per_length * w.T @ (weight[:, None] * w)
            + RAIL.rotary_inertia * theta.T @ (weight[:, None] * theta))
    np.testing.assert_allclose(gram, np.eye(6), atol=1e-9)
    w, theta = modes.shapes([0.0, 0.15])
    assert np.abs(w).max() < 1e-9
    assert np.abs(theta).max() < 1e-7


def test_modal_sum_tends_to_the_static_flexibility():
    x = np.array([0.04, 0.075])
    modes = tim4.clamped_modes(RAIL, 0.15, 40, terms=60)
    partial = np.cumsum(modes.shapes(x)[0] ** 2 / modes.angular_frequency**2, axis=1)
    exact = tim4.clamped_flexibility(RAIL, 0.15, x)
    assert np.all(partial <= exact[:, None] * (1.0 + 1e-9))
    np.testing.assert_allclose(partial[:, -1], exact, rtol=0.03)


def test_pinned_pinned_frequencies_of_the_two_reference_rails():
    assert tim4.pinned_pinned_frequency(RAIL, 0.6) == pytest.approx(1068.16, abs=0.006)
    assert tim4.pinned_pinned_frequency(RAIL, 0.3) == pytest.approx(2860.83, abs=0.006)
    assert tim4.pinned_pinned_frequency(OTHER, 0.79) == pytest.approx(619.49, abs=0.006)
