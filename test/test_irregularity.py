"""Profiles and roughness levels against closed forms and the published limit curve."""

import json

import numpy as np
import pytest

from railtrack_ros.errors import InputError
from railtrack_ros.irregularity import profile, spectra


def test_sine_of_3_um_at_10_mm_reads_6_53_db():
    x = np.arange(0.0, 5.0, 1e-3)
    wavelength, level = spectra.third_octave_levels(profile.sine(x, 0.01, 3e-6), 1e-3)
    loudest = np.argmax(level)
    assert wavelength[loudest] == pytest.approx(0.01)
    assert level[loudest] == pytest.approx(10.0 * np.log10(4.5), abs=0.01)
    assert np.delete(level, loudest).max() < -40.0


def test_mean_square_of_the_levels_is_that_of_the_profile():
    made = profile.iso3095(40.0, 1e-3, seed=4, longest=0.4, shortest=0.005)
    _, level = spectra.third_octave_levels(made.irregularity, 1e-3)
    total = np.sum(10.0 ** (level / 10.0)) * spectra.REFERENCE**2
    assert total == pytest.approx(np.mean(made.irregularity**2), rel=0.05)


@pytest.mark.parametrize('seed', [1, 2])
def test_iso_3095_roughness_lies_on_the_limit_in_every_band(seed):
    made = profile.iso3095(120.0, 1e-3, seed=seed)
    wavelength, level = spectra.third_octave_levels(made.irregularity, 1e-3)
    inside = wavelength > 2.5e-3 * spectra.HALF_BAND
    deviation = (level - spectra.iso3095_limit(wavelength))[inside]
    short = wavelength[inside] < 0.2  # enough waves in the record for a sharp average
    assert np.abs(deviation[short]).max() < 0.3
    assert np.abs(deviation).max() < 1.0
    assert abs(deviation.mean()) < 0.15


def test_iso_3095_limit_has_the_published_values():
    published = {0.4: 17.1, 0.315: 15.0, 0.1: 4.9, 0.05: -1.1, 0.0315: -5.0, 0.01: -8.0,
                 0.00315: -11.0}
    exact = [10.0 ** (-round(-10.0 * np.log10(nominal)) / 10.0) for nominal in published]
    assert spectra.iso3095_limit(exact) == pytest.approx(list(published.values()))


def test_iso_3095_limit_is_that_of_the_directive(reference_data):
    tables = json.loads((reference_data / 'cnossos_roughness_tables.json').read_text())
    nominal = np.array(tables['wavelength_mm'], dtype=float) * 1e-3
    exact = 10.0 ** (-np.round(-10.0 * np.log10(nominal)) / 10.0)
    limit = tables['rail_roughness_dB_re_1um']['EN ISO 3095 2013']
    assert spectra.iso3095_limit(exact) == pytest.approx(limit)


def test_roughness_is_the_same_for_the_same_seed_only():
    one, again, other = (profile.iso3095(5.0, seed=s).irregularity for s in (7, 7, (7, 1)))
    assert np.array_equal(one, again)
    assert abs(np.corrcoef(one, other)[0, 1]) < 0.3


def test_roughness_repeats_after_its_length():
    made = profile.iso3095(5.0, 1e-3, seed=1, start=12.0)
    assert made.position[0] == 12.0
    assert made.position[-1] == pytest.approx(17.0)
    assert made.irregularity[0] == made.irregularity[-1]


def test_profile_passes_through_its_samples_and_is_smooth_between():
    x = np.linspace(-1.0, 1.0, 201)
    made = profile.Profile(x, profile.sine(x, 0.2, 1e-5))
    assert made.at(x) == pytest.approx(made.irregularity, abs=1e-20)
    between = np.linspace(-0.9, 0.9, 777).reshape(3, -1)
    assert made.at(between) == pytest.approx(profile.sine(between, 0.2, 1e-5), abs=2e-8)


def test_profile_has_no_value_where_it_was_not_measured():
    made = profile.Profile(np.array([0.0, 1.0, 2.0]), np.zeros(3), name='file.csv')
    with pytest.raises(InputError, match=r'file\.csv covers 0 to 2 m.*1 to 2\.5 m'):
        made.at([1.0, 2.5])


@pytest.mark.parametrize(('position', 'irregularity', 'message'), [
    ([0.0, 1.0, 1.0], [0.0, 0.0, 0.0], '1 m follows 1 m'),
    ([0.0, 1.0], [0.0, np.nan], 'finite'),
    ([0.0], [0.0], 'two positions'),
    ([0.0, 1.0], [0.0, 0.0, 0.0], 'shapes'),
])
def test_profile_refuses_what_it_cannot_interpolate(position, irregularity, message):
    with pytest.raises(InputError, match=message):
        profile.Profile(np.array(position), np.array(irregularity))


def test_corrugation_fades_to_nothing_at_its_ends():
    x = np.linspace(0.0, 10.0, 100001)
    made = profile.corrugation(x, 0.045, 10e-6, 3.0, 7.0)
    assert not made[(x <= 3.0) | (x >= 7.0)].any()
    middle = made[(x > 3.1) & (x < 6.9)]
    assert np.std(middle) == pytest.approx(10e-6 / np.sqrt(2.0), rel=1e-3)
    slope = np.abs(np.gradient(made, x))
    assert slope[(x < 3.005) | (x > 6.995)].max() < 0.05 * slope.max()


def test_dipped_joint_has_its_depth_and_its_angle():
    x = np.linspace(-1.0, 1.0, 2001)
    made = profile.dipped_joint(x, 0.0, 2e-3, 1.0)
    assert made.min() == -2e-3
    assert made[1000] == -2e-3
    assert not made[np.abs(x) >= 0.5].any()
    angle = (made[1001] - made[1000]) / 1e-3 + (made[999] - made[1000]) / 1e-3
    assert angle == pytest.approx(8.0 * 2e-3 / 1.0, rel=2e-3)


def test_csv_of_one_column_serves_both_rails(tmp_path):
    path = tmp_path / 'one.csv'
    path.write_text('\ufeffirregularity_m,note,position_m\n1e-6,3,0\n2e-6,4,0.5\n')
    rails = profile.read_csv(path)
    assert rails['left'].at(0.5) == pytest.approx(2e-6)
    assert rails['right'].at(0.0) == pytest.approx(1e-6)


def test_csv_of_two_columns_keeps_the_rails_apart(tmp_path):
    path = tmp_path / 'two.csv'
    path.write_text('position_m, irregularity_left_m, irregularity_right_m\n0,1,2\n1,3,4\n')
    rails = profile.read_csv(path)
    assert rails['left'].irregularity.tolist() == [1.0, 3.0]
    assert rails['right'].irregularity.tolist() == [2.0, 4.0]


@pytest.mark.parametrize(('text', 'message'), [
    ('position_m,irregularity_m\n0,1\n1,x\n', r"line 3: column irregularity_m: .* got 'x'"),
    ('position_m,irregularity_m\n0,1\n1,nan\n2,0\n', r"line 3: column irregularity_m: .*'nan'"),
    ('position_m,irregularity_m\n0,1\n1\n', r"line 3: column irregularity_m: .* got ''"),
    ('position_m,irregularity_m\n0,1\n', 'at least two lines'),
    ('position_m,height\n0,1\n', 'column irregularity_m is missing.*found position_m, height'),
    ('position_m,irregularity_left_m\n0,1\n', 'column irregularity_right_m is missing'),
    ('', 'column position_m is missing.*found nothing'),
    ('position_m,irregularity_m\n1,0\n0,0\n', '0 m follows 1 m'),
])
def test_csv_that_cannot_be_used_is_named_with_line_and_column(tmp_path, text, message):
    path = tmp_path / 'rough.csv'
    path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        profile.read_csv(path)
    assert 'rough.csv' in str(caught.value)


def test_missing_csv_is_named(tmp_path):
    with pytest.raises(InputError, match=r'none\.csv: cannot be read: No such file'):
        profile.read_csv(tmp_path / 'none.csv')


@pytest.mark.parametrize('arguments', [
    {'length': 0.0}, {'length': 1.0, 'step': -1.0}, {'length': 1.0, 'shortest': 1e-3},
    {'length': 1.0, 'longest': 1e-3},
])
def test_impossible_roughness_is_refused(arguments):
    with pytest.raises(InputError, match='roughness'):
        profile.iso3095(**arguments)


def test_record_too_short_for_any_band_is_refused():
    with pytest.raises(InputError, match='resolve no one-third octave'):
        spectra.third_octave_levels(np.zeros(6), 1e-3)
