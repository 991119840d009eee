"""Contact filters, A-weighting, the noise index and the rule of +2 dB."""

import json
import math

import numpy as np
import pytest

from railtrack_ros.errors import InputError
from railtrack_ros.estimation import roughness
from railtrack_ros.estimation.mechanism import (
    P2,
    PINNED,
    RUTTING,
    SLEEPER,
    SPACING,
    TrackFrequencies,
    classify,
)
from railtrack_ros.irregularity.spectra import iso3095_limit

TABLE_3_1 = TrackFrequencies((63.0,), (89.8, 518.0), (1080.0,), 0.6)


def test_contact_filter_is_the_table_of_the_directive(reference_data):
    path = reference_data / 'cnossos_roughness_tables.json'
    if not path.exists():
        pytest.skip(f'no {path.name}')
    table = json.loads(path.read_text())['contact_filter_dB']
    for load in (25, 50, 100):
        levels = table[f'Wheel load {load}kN wheel diameter 920mm']
        found = roughness.contact_filter(
            'cnossos', roughness.TABLE_WAVELENGTH, 1e3 * load, 0.46)
        assert found == pytest.approx(np.array(levels), abs=1e-12)


def test_contact_filter_lies_between_the_loads_of_the_table():
    at = [float(roughness.contact_filter('cnossos', 10.0**-1.7, load, 0.46))
          for load in (10e3, 25e3, 50e3, 70e3, 100e3, 200e3)]
    assert at[:3] == pytest.approx([-5.3, -5.3, -8.0])
    assert -12.2 < at[3] < -8.0
    assert at[4:] == pytest.approx([-12.2, -12.2])


def test_patch_and_filter_of_remington_are_those_of_hertz_and_close_to_the_table():
    assert roughness.contact_radius(50e3, 0.46) == pytest.approx(4.9e-3, rel=0.02)
    assert roughness.contact_radius(100e3, 0.46) == pytest.approx(6.2e-3, rel=0.02)
    assert roughness.remington(1e-3) == pytest.approx(0.0, abs=1e-3)
    long = 10.0 ** np.array([-1.0, -1.1, -1.2])
    difference = roughness.contact_filter('remington', long, 100e3, 0.46) - (
        roughness.contact_filter('cnossos', long, 100e3, 0.46))
    assert (difference > -0.1).all()  # weaker than the table, by 0.6 dB at most
    assert (difference < 0.6).all()


def test_no_contact_filter_takes_nothing_and_an_unknown_one_is_refused():
    assert not roughness.contact_filter('none', [0.1, 0.01], 50e3, 0.46).any()
    with pytest.raises(InputError, match='cnossos, remington, none'):
        roughness.contact_filter('gauss', [0.1], 50e3, 0.46)


@pytest.mark.parametrize(('frequency', 'level'), [
    (31.62, -39.4), (100.0, -19.1), (250.0, -8.6), (1000.0, 0.0), (4000.0, 1.0), (10000.0, -2.5)])
def test_a_weighting_is_that_of_the_standard(frequency, level):
    assert float(roughness.a_weighting(frequency)) == pytest.approx(level, abs=0.1)


@pytest.mark.parametrize('speed', [10.0, 25.0, 60.0])
def test_rail_at_the_limit_has_index_zero_and_one_above_it_by_so_much(speed):
    limit = iso3095_limit(roughness.CENTRES)
    assert roughness.noise_index(roughness.CENTRES, limit, speed) == pytest.approx(0.0, abs=1e-9)
    assert roughness.noise_index(roughness.CENTRES, limit + 3.3, speed) == pytest.approx(3.3)


def test_louder_waves_count_by_what_the_speed_makes_of_them():
    limit = iso3095_limit(roughness.CENTRES)
    long, short = limit.copy(), limit.copy()
    long[roughness.CENTRES > 0.2] += 10.0
    short[roughness.CENTRES < 0.05] += 10.0
    slow, fast = ((roughness.noise_index(roughness.CENTRES, long, v),
                   roughness.noise_index(roughness.CENTRES, short, v)) for v in (15.0, 60.0))
    assert slow[1] > slow[0]
    assert fast[0] > slow[0]
    assert fast[1] < slow[1]


def test_index_is_not_given_where_most_of_the_noise_is_not_resolved():
    level = iso3095_limit(roughness.CENTRES)
    level[roughness.CENTRES < 0.09] = np.nan
    assert math.isnan(roughness.noise_index(roughness.CENTRES, level, 20.0))
    assert math.isnan(roughness.noise_index(roughness.CENTRES, level * np.nan, 20.0))


def rule(index, length=50.0):
    start = length * np.arange(len(index))
    return roughness.grinding_due(start, start + length, np.array(index))


def test_rule_of_two_decibels():
    quiet = [0.0] * 5
    assert rule([*quiet, 2.0, 2.4, *quiet])[5:7] == ['grind', 'grind']
    assert rule([*quiet, 1.99, *quiet])[5] == 'watch'
    assert rule([*quiet, 0.99, *quiet])[5] == 'clear'
    assert rule([*quiet, float('nan'), *quiet])[5] == ''


def test_short_stretch_between_long_quiet_ones_is_not_due():
    quiet = [0.0] * 4
    assert rule([*quiet, 5.0, *quiet])[4] == 'short'
    assert rule([*quiet[1:], 5.0, *quiet])[3] == 'grind'  # 150 m on one side
    assert rule([2.0, 0.0, 0.0, 0.0, 5.0, *quiet])[4] == 'grind'  # the neighbourhood is loud
    assert rule([*quiet, 5.0, 5.0, *quiet])[4:6] == ['grind', 'grind']  # 100 m


# Mechanisms


@pytest.mark.parametrize(('wavelength', 'speeds', 'candidates', 'certainty'), [
    (0.3, (18.0, 18.9), (P2,), 'clear'),  # 60-63 Hz
    (0.03, (33.0, 34.0), (PINNED,), 'clear'),  # 1100-1133 Hz
    (0.05, (16.0, 19.0), (RUTTING,), 'clear'),  # 320-380 Hz
    (0.2, (18.5, 19.0), (SLEEPER,), 'clear'),  # 92-95 Hz
    (0.2, (15.4, 15.6), (SLEEPER, P2), 'ambiguous'),  # 77-78 Hz
    (0.05, (10.0, 22.5), (RUTTING, SLEEPER), 'ambiguous'),  # 200-450 Hz
    (0.03, (25.0, 29.0), (PINNED,), 'likely'),  # 833-967 Hz
    (0.1, (14.0, 20.0), (), 'none'),  # 140-200 Hz
])
def test_class_follows_from_wavelength_line_speed_and_the_tracks_own_frequencies(
        wavelength, speeds, candidates, certainty):
    found = classify(wavelength, speeds, TABLE_3_1)
    assert found.certainty == certainty
    assert found.candidates == candidates


def test_wavelength_of_the_sleeper_spacing_is_said_to_be_no_corrugation():
    found = classify(0.595, (25.0, 25.0), TABLE_3_1)
    assert (found.candidates, found.certainty) == ((SPACING,), 'clear')
    assert 'not corrugation' in str(found)
    assert classify(0.595, (40.0, 40.0), TABLE_3_1).certainty == 'ambiguous'  # 67 Hz: or P2


def test_other_track_other_class():
    soft = TrackFrequencies((45.0,), (70.0, 250.0), (620.0,), 0.6)
    assert classify(0.03, (18.0, 19.0), soft).candidates == (PINNED,)
    assert classify(0.03, (18.0, 19.0), TABLE_3_1).candidates == ()
