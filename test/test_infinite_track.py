"""The exact infinite track against reference numbers, physics and other derivations."""

from pathlib import Path

import numpy as np
import pytest
from frequency_domain import KINDS, undamped, variant
from track_twins import receptance_by_greens_function, receptance_by_wave_amplitudes

from railtrack_ros.dynamics.receptance import receptance, receptances
from railtrack_ros.errors import InputError
from railtrack_ros.track import exact
from railtrack_ros.track.description import load_track
from railtrack_ros.track.exact import ExactBay
from railtrack_ros.track.infinite import InfiniteRow, Sleeper

WIDE = np.array([0.05, 1.0, 20.0, 90.0, 236.0, 514.0, 1068.0, 1127.0, 2500.0, 4000.0, 6000.0])


def reference_table():
    """Rows (frequency, |H|, phase, ...) of either track."""
    tables = {}
    file = Path(__file__).parent / 'data' / 'receptance_reference.txt'
    for line in file.read_text(encoding='utf-8').splitlines():
        if line.startswith('T'):
            rows = tables[line.split()[0]] = []
        else:
            rows.append([float(value) for value in line.split()])
    return {name: np.array(rows) for name, rows in tables.items()}


@pytest.mark.parametrize(('table', 'name'), [('T3.1', 'blanco_table_3_1'),
                                             ('T2.1', 'blanco_table_2_1')])
@pytest.mark.parametrize('column', range(4))
def test_reference_receptances_to_the_last_printed_digit(table, name, column):
    rows = reference_table()[table]
    kind = ('concentrated', 'distributed')[column // 2]
    track = variant(load_track(name), kind=kind)
    x = 0.0 if column % 2 else 0.5 * track.support.spacing
    h = receptance(track, rows[:, 0], x)
    magnitude, phase = rows[:, 1 + 2 * column], rows[:, 2 + 2 * column]
    half_digit = 0.5 * 10.0 ** (np.floor(np.log10(magnitude)) - 5.0)
    assert (np.abs(np.abs(h) - magnitude) <= half_digit + 2e-6 * magnitude).all()
    assert np.abs(np.degrees(np.angle(h)) - phase).max() <= 0.006


@pytest.mark.parametrize(('kind', 'name', 'midspan', 'sleeper'), [
    ('concentrated', 'blanco_table_3_1', 7.9329e-9, 7.5497e-9),
    ('distributed', 'blanco_table_3_1', 7.7937e-9, 7.5148e-9),
    ('concentrated', 'blanco_table_2_1', 1.8047e-8, 1.7200e-8),
    ('distributed', 'blanco_table_2_1', 1.7794e-8, 1.7111e-8),
])
def test_static_limit(kind, name, midspan, sleeper):
    track = variant(load_track(name), 0.0, kind=kind)
    half = 0.5 * track.support.spacing
    for f in (1e-6, 1e-3):
        assert receptance(track, f, half)[0].real == pytest.approx(midspan, rel=7e-5)
        assert receptance(track, f, 0.0)[0].real == pytest.approx(sleeper, rel=7e-5)


PLACES = [0.217, 0.3, 0.0, 0.05, -0.1, 1.7, -3.33]


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize(('name', 'frequencies'), [
    ('blanco_table_3_1', [20.0, 90.0, 514.0, 900.0, 1150.0, 2500.0]),
    ('blanco_table_2_1', [20.0, 150.0, 514.0, 619.0, 6000.0]),
])
def test_second_derivation_with_very_many_sleepers_agrees(kind, name, frequencies):
    # More loss than usual, so that nothing comes back from the ends of the finite twin.
    track = variant(load_track(name), 0.06, kind=kind)
    twin = (receptance_by_wave_amplitudes if kind == 'distributed'
            else receptance_by_greens_function)
    h = receptances(track, frequencies, [*PLACES, Sleeper(0)], PLACES[0])
    for i, f in enumerate(frequencies):
        rail, sleeper = twin(track, f, PLACES[0], PLACES, 121)
        expected = np.append(rail, sleeper)
        np.testing.assert_allclose(h[:, i], expected, rtol=1e-8, atol=0.0)


@pytest.mark.parametrize('kind', KINDS)
def test_reciprocity(kind, table_3_1):
    track = variant(table_3_1, kind=kind)
    for here, there in ((0.217, 0.131), (0.0801, -1.34), (0.3, 25.2), (0.1, Sleeper(0)),
                        (-0.25, Sleeper(-3)), (Sleeper(1), Sleeper(4))):
        forth = receptance(track, WIDE, there, here)
        back = receptance(track, WIDE, here, there)
        np.testing.assert_allclose(forth, back, rtol=1e-8, atol=0.0)


@pytest.mark.parametrize('kind', KINDS)
def test_translation_by_a_bay_and_reflection_change_nothing(kind, table_3_1):
    track = variant(table_3_1, kind=kind)
    h = receptance(track, WIDE, 0.9, 0.11)
    np.testing.assert_allclose(receptance(track, WIDE, 3.9, 3.11), h, rtol=1e-9)
    np.testing.assert_allclose(receptance(track, WIDE, -0.9, -0.11), h, rtol=1e-9)


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('loss_factor', [0.0, 0.02])
def test_a_force_never_gains_energy(kind, loss_factor, table_3_1):
    track = variant(table_3_1, loss_factor, kind=kind)
    frequencies = np.linspace(1.0, 6000.0, 700)
    for point in (0.0, 0.08, 0.3, Sleeper(0)):
        h = receptance(track, frequencies, point)
        assert np.isfinite(h).all()
        assert (h.imag < 0.0).all()


def test_sleepers_carry_the_whole_static_force(table_3_1):
    numbers = range(-60, 61)
    w = receptances(table_3_1, 1e-4, [Sleeper(k) for k in numbers], 0.21)[:, 0]
    carried = table_3_1.support.ballast_stiffness * w.sum()
    assert carried.real == pytest.approx(1.0, abs=1e-8)


@pytest.mark.parametrize('kind', KINDS)
def test_one_bay_more_leaves_half_the_track_as_it_is(kind, table_3_1):
    row = InfiniteRow(ExactBay(variant(table_3_1, kind=kind), WIDE))
    k, waves = row.bay(0).stiffness, row.waves
    a, b, e = k[:, :2, :2], k[:, :2, 2:], k[:, 2:, 2:]
    longer = a - b @ np.linalg.solve(e + waves.right_stiffness, b.transpose(0, 2, 1))
    scale = np.abs(waves.right_stiffness)
    assert (np.abs(longer - waves.right_stiffness) < 1e-10 * scale.max(axis=(1, 2))[:, None, None]
            ).all()
    # The track looks the same in both directions: shear and moment change sign with x.
    mirror = np.diag([1.0, -1.0])
    np.testing.assert_allclose(mirror @ waves.left_stiffness @ mirror, waves.right_stiffness,
                               rtol=1e-8)


@pytest.mark.parametrize('change', [
    {}, {'pad_stiffness': 1e7}, {'pad_stiffness': 1e10}, {'ballast_stiffness': 1e6},
    {'pad_length': 0.59}, {'pad_length': 0.002}, {'spacing': 1.5}, {'spacing': 0.3},
])
def test_shorter_pieces_of_rail_change_nothing(change, table_3_1, monkeypatch):
    track = variant(table_3_1, **change)
    places = [0.0, 0.0801, 0.14, 0.3]
    h = [receptance(track, WIDE, x) for x in places]
    monkeypatch.setattr(exact, 'LONGEST_PIECE', 0.7)
    for x, before in zip(places, h, strict=True):
        np.testing.assert_allclose(receptance(track, WIDE, x), before, rtol=1e-9)


@pytest.mark.parametrize('kind', ['concentrated', 'distributed'])
def test_without_damping_waves_still_leave_the_load(kind, table_3_1):
    # The limit of vanishing loss: energy flows outwards wherever a wave propagates.
    lossless = undamped(table_3_1, kind)
    frequencies = np.array([50.0, 400.0, 800.0, 1000.0, 1300.0, 1900.0, 3000.0])
    h = receptance(lossless, frequencies, 0.2)
    almost = receptance(variant(lossless, 1e-8), frequencies, 0.2)
    np.testing.assert_allclose(h, almost, rtol=1e-5)
    assert (h[frequencies > 600.0].imag < 0.0).all()


@pytest.mark.parametrize('x', [-0.3, -0.08, 0.0, 0.08, 0.3, 0.045])
def test_deflection_is_continuous_where_pieces_and_bays_meet(x, table_3_1):
    left, here, right = receptances(table_3_1, WIDE, [x - 1e-9, x, x + 1e-9], 0.13)
    np.testing.assert_allclose(left, here, rtol=1e-6)
    np.testing.assert_allclose(right, here, rtol=1e-6)


@pytest.mark.parametrize('kind', ['concentrated_rotational', 'multipoint', 'distributed'])
def test_short_pads_tend_to_a_point(kind, table_3_1):
    point = receptance(variant(table_3_1, kind='concentrated'), WIDE, 0.2)
    errors = []
    for length in (0.02, 0.01):
        h = receptance(variant(table_3_1, kind=kind, pad_length=length), WIDE, 0.2)
        errors.append(np.abs(h / point - 1.0).max())
    assert errors[0] < 0.02
    assert errors[0] > 1.8 * errors[1]


def test_pad_longer_than_the_bay_is_refused(table_3_1):
    with pytest.raises(InputError, match='pad_length'):
        receptance(variant(table_3_1, pad_length=0.6), 100.0, 0.0)
