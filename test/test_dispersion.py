"""Bloch waves of the periodic track."""

import numpy as np
import pytest
from frequency_domain import KINDS, variant
from track_twins import characteristic_roots

from railtrack_ros.dynamics.closed_forms import smeared_foundation
from railtrack_ros.dynamics.dispersion import bloch_wavenumbers
from railtrack_ros.dynamics.receptance import receptances
from railtrack_ros.errors import InputError


@pytest.mark.parametrize('kind', KINDS)
def test_far_from_a_force_the_track_moves_in_the_first_wave(kind, table_3_1):
    track = variant(table_3_1, kind=kind)
    frequencies = np.array([150.0, 700.0, 1068.0, 1150.0, 2500.0, 4500.0])
    spacing = track.support.spacing
    near, far = receptances(track, frequencies, [0.11 + 20 * spacing, 0.11 + 21 * spacing], 0.2)
    kappa = bloch_wavenumbers(track, frequencies)[:, 0]
    np.testing.assert_allclose(far / near, np.exp(-1j * kappa * spacing), rtol=1e-7)


def test_waves_of_closely_spaced_supports_are_those_of_a_continuous_foundation(table_3_1):
    # Supports every 50 mm of a twelfth of the stiffness, at 20 Hz where their mass is nothing.
    frequency, n = 20.0, 12
    support = table_3_1.support
    track = variant(
        table_3_1, 0.0, kind='concentrated', spacing=support.spacing / n, pad_length=0.01,
        pad_stiffness=support.pad_stiffness / n, ballast_stiffness=support.ballast_stiffness / n,
        sleeper_mass=1e-6, pad_damping=0.0, ballast_damping=0.0)
    kappa = bloch_wavenumbers(track, [frequency])[0]
    expected = characteristic_roots(track.rail, 2.0 * np.pi * frequency,
                                    smeared_foundation(support))
    for k in expected:
        assert np.abs(kappa - k).min() < 1e-3 * abs(k)


def test_first_wave_follows_the_free_rail_through_the_stop_band(table_3_1):
    # On very soft pads the rail is free; its wavenumber passes pi / l without a fold.
    track = variant(table_3_1, 1e-3, kind='concentrated', pad_stiffness=1e6, pad_damping=1e3)
    frequencies = np.array([300.0, 900.0, 1300.0, 2500.0, 4500.0])
    kappa = bloch_wavenumbers(track, frequencies)
    free = [max(characteristic_roots(track.rail, 2.0 * np.pi * f), key=lambda k: k.real)
            for f in frequencies]
    np.testing.assert_allclose(kappa[:, 0].real, np.real(free), rtol=5e-3)
    assert kappa[-1, 0].real > 2.0 * np.pi / track.support.spacing


def test_waves_decay_away_from_their_source(table_3_1, table_2_1):
    for track in (table_3_1, table_2_1):
        assert (bloch_wavenumbers(track, np.linspace(1.0, 6000.0, 800)).imag < 0.0).all()


def test_undamped_track_stops_waves_around_the_pinned_pinned_frequency(table_3_1):
    track = variant(table_3_1, 0.0, kind='concentrated', pad_damping=0.0, ballast_damping=0.0)
    kappa = bloch_wavenumbers(track, [900.0, 1100.0, 1300.0])[:, 0]
    assert abs(kappa[0].imag) < 1e-9
    assert kappa[1].imag < -0.1
    assert kappa[1].real == pytest.approx(np.pi / track.support.spacing, rel=1e-9)
    assert abs(kappa[2].imag) < 1e-9


def test_the_answer_does_not_depend_on_what_else_is_asked(table_3_1):
    alone = bloch_wavenumbers(table_3_1, [1800.0])
    among = bloch_wavenumbers(table_3_1, [7000.0, 1800.0, 3.0])
    np.testing.assert_allclose(alone[0], among[1], rtol=1e-9)


def test_impossible_frequencies_are_refused(table_3_1):
    with pytest.raises(InputError, match='frequencies'):
        bloch_wavenumbers(table_3_1, [0.0])
