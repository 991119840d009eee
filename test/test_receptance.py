"""Finite-element receptances, and the borders of the receptance functions."""

import dataclasses

import numpy as np
import pytest
from frequency_domain import KINDS, variant

from railtrack_ros.dynamics.receptance import (
    HIGHEST,
    MOST_BAYS,
    finite_track,
    receptance,
    receptances,
)
from railtrack_ros.errors import InputError
from railtrack_ros.track.bay import Mesh, make_bay
from railtrack_ros.track.description import Stretch
from railtrack_ros.track.infinite import Sleeper

FREQUENCIES = np.array([10.0, 90.0, 236.0, 514.0, 1068.0, 2500.0])


def mesh(kind, local_system='static'):
    return Mesh(elements_per_bay=4 if kind.startswith('concentrated') else 6,
                local_system=local_system)


def one_big_matrix(track, frequency):
    """Dynamic stiffness of all bays, assembled, and each bay's first degree of freedom."""
    omega = 2.0 * np.pi * frequency
    starts = np.concatenate([[0], np.cumsum([bay.dofs for bay in track.bays])])
    whole = np.zeros((starts[-1] + 2,) * 2, dtype=complex)
    for bay, start in zip(track.bays, starts[:-1], strict=True):
        part = slice(start, start + bay.dofs + 2)
        whole[part, part] += (
            bay.stiffness + 1j * bay.track.rail.loss_factor * bay.rail_stiffness
            + 1j * omega * bay.support_damping - omega**2 * bay.mass)
    return whole, starts


def assert_equals_one_big_matrix(track, force, places, sleepers):
    h = receptances(track, FREQUENCIES, [force, *places, *map(Sleeper, sleepers)], force)
    for i, f in enumerate(FREQUENCIES):
        matrix, starts = one_big_matrix(track, f)

        def weights(x, starts=starts):
            number, inside = track.bays[0].locate(x)
            k = int(number[0]) - track.first
            full = np.zeros(starts[-1] + 2)
            full[starts[k]:starts[k] + track.bays[k].dofs + 2] = track.bays[k].shape(inside)[0]
            return full

        u = np.linalg.solve(matrix, weights(force))
        rail = np.array([weights(x) @ u for x in (force, *places)])
        loaded = track.bays[int(track.bays[0].locate(force)[0][0]) - track.first]
        loss = 1.0 + 1j * loaded.track.rail.loss_factor
        rail[0] += loaded.flexibility(loaded.locate(force)[1])[0] / loss
        moved = [u[starts[k - track.first] + track.bays[k - track.first].sleeper_dof]
                 for k in sleepers]
        np.testing.assert_allclose(h[:, i], [*rail, *moved], rtol=1e-7)


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('local_system', ['none', 'static', 'dynamic'])
def test_row_of_bays_equals_one_big_matrix(kind, local_system, table_3_1):
    track = finite_track(variant(table_3_1, kind=kind), mesh(kind, local_system), 7)
    assert_equals_one_big_matrix(track, 0.217, [0.3, -1.6, 2.0], [2, -3])


@pytest.mark.parametrize('force', [0.217, -0.6, 1.9])
def test_row_of_unequal_bays_equals_one_big_matrix(force, table_3_1):
    # Another rail on other pads from 1.5 m on, and a hanging sleeper at -0.6 m.
    other = variant(table_3_1, 0.05, kind='concentrated_rotational', pad_stiffness=100e6)
    other_rail = dataclasses.replace(other.rail, second_moment=2e-5)
    hanging = dataclasses.replace(table_3_1.support, ballast_stiffness=0.0, ballast_damping=0.0)
    track = dataclasses.replace(
        table_3_1, stretches=(Stretch(1.5, 9.0, other_rail, other.support),),
        sleepers=((-1, hanging),))
    row = finite_track(track, Mesh(elements_per_bay=6), 9)
    assert len(set(map(id, row.bays))) == 3
    assert_equals_one_big_matrix(row, force, [0.3, -1.6, 2.3], [-1, 2, 4, -4])


def test_a_hanging_sleeper_softens_the_track_above_it(table_3_1):
    hanging = dataclasses.replace(table_3_1.support, ballast_stiffness=0.0, ballast_damping=0.0)
    track = dataclasses.replace(table_3_1, sleepers=((0, hanging),))
    one, all_alike = (finite_track(t, Mesh(), 61) for t in (track, table_3_1))
    above = np.abs(receptance(one, 5.0, 0.0) / receptance(all_alike, 5.0, 0.0))
    beside = np.abs(receptance(one, 5.0, 6.0) / receptance(all_alike, 5.0, 6.0))
    assert above > 1.3
    assert beside == pytest.approx(1.0, abs=0.01)


def test_infinite_track_with_a_stretch_is_refused(table_3_1):
    track = dataclasses.replace(
        table_3_1, stretches=(Stretch(0.0, 9.0, table_3_1.rail, variant(
            table_3_1, pad_stiffness=1e8).support),))
    with pytest.raises(InputError, match='stretches'):
        receptance(track, 100.0, 0.3)


@pytest.mark.parametrize('kind', KINDS)
def test_reciprocity_of_finite_elements(kind, table_3_1):
    track = variant(table_3_1, kind=kind)
    own = mesh(kind, 'dynamic')
    for model in (make_bay(track, own), finite_track(track, own, 9)):
        for here, there in ((0.217, -1.34), (0.1, Sleeper(2)), (Sleeper(0), Sleeper(-2))):
            np.testing.assert_allclose(receptance(model, FREQUENCIES, there, here),
                                       receptance(model, FREQUENCIES, here, there), rtol=1e-8)


def test_long_finite_track_tends_to_the_infinite_one(table_3_1):
    endless = receptance(make_bay(table_3_1, Mesh()), FREQUENCIES, 0.3)
    errors = [np.abs(receptance(finite_track(table_3_1, Mesh(), n), FREQUENCIES, 0.3) / endless
                     - 1.0).max() for n in (21, 61, 121)]
    assert errors[0] > 3.0 * errors[1]
    assert errors[2] < 1e-6


def test_ends_of_a_finite_track_reflect(table_3_1):
    # Lossless rail on point supports: the pinned-pinned peak still grows from 61 to 121 bays.
    track = variant(table_3_1, 0.0, kind='concentrated')
    frequencies = np.linspace(1066.0, 1070.0, 400)
    peaks = [np.abs(receptance(finite_track(track, Mesh(local_system='dynamic'), n), frequencies,
                               0.3)).max() for n in (61, 121)]
    assert peaks[1] > 1.3 * peaks[0]


def test_many_frequencies_come_in_batches_and_count_progress(table_3_1):
    frequencies = np.linspace(1.0, 2500.0, 1200)
    done = []
    h = receptances(table_3_1, frequencies, [0.3], 0.3, progress=done.append)[0]
    assert sum(done) == frequencies.size
    assert len(done) > 1
    np.testing.assert_allclose(h[::100], receptance(table_3_1, frequencies[::100], 0.3), rtol=1e-9)


@pytest.mark.parametrize('wrong', [0.0, -5.0, float('nan'), float('inf'), 1.01 * HIGHEST])
def test_impossible_frequencies_are_refused(wrong, table_3_1):
    with pytest.raises(InputError, match='frequencies'):
        receptance(table_3_1, [100.0, wrong], 0.3)


def test_no_frequency_is_refused(table_3_1):
    with pytest.raises(InputError, match='none given'):
        receptance(table_3_1, [], 0.3)


@pytest.mark.parametrize('place', [9.9, -9.9, Sleeper(4)])
def test_places_beyond_the_ends_are_refused(place, table_3_1):
    track = finite_track(table_3_1, Mesh(), 5)
    for response, force in ((place, 0.0), (0.0, place)):
        with pytest.raises(InputError, match='outside the track of 5 bays'):
            receptance(track, 100.0, response, force)


def test_the_right_end_belongs_to_the_track(table_3_1):
    track = finite_track(table_3_1, Mesh(), 5)
    spacing = table_3_1.support.spacing
    low = -2 * spacing + track.bays[0].start
    high = low + 5 * spacing
    h = receptances(track, FREQUENCIES, [high, high - 1e-7], 0.0)
    np.testing.assert_allclose(h[0], h[1], rtol=1e-5)
    assert np.isfinite(receptance(track, FREQUENCIES, low)).all()


def test_position_that_is_no_number_is_refused(table_3_1):
    with pytest.raises(InputError, match='position'):
        receptance(table_3_1, 100.0, float('nan'))


@pytest.mark.parametrize('bays', [0, -3, MOST_BAYS + 1])
def test_impossible_numbers_of_bays_are_refused(bays, table_3_1):
    with pytest.raises(InputError, match='bays'):
        finite_track(table_3_1, Mesh(), bays)
