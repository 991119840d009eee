"""Limits of irregularity: the tables, and what is refused."""

import json

import pytest

from railtrack_ros.errors import InputError
from railtrack_ros.estimation.limits import load_limits, shipped_limits
from railtrack_ros.estimation.settings import IndicatorSettings
from railtrack_ros.irregularity.spectra import iso3095_limit

BANDS = ((0.01, 0.03), (0.03, 0.1), (0.1, 0.3), (0.3, 1.0))


def test_limits_of_grassie_are_exact():
    found = load_limits('grassie_1999')
    assert found.statistic == 'moving_rms'
    assert [found.of(band).limit for band in (*BANDS, (1.0, 3.0))] == [
        3e-6, 7e-6, 7e-6, 45e-6, 100e-6]
    assert {item.allowed_share for item in found.bands} == {0.05}
    assert 'window' in found.of(BANDS[0]).uncertain
    assert 'limit' not in found.of(BANDS[0]).uncertain


@pytest.mark.parametrize(('edition', 'statistic'), [
    ('2006', 'moving_peak_to_peak'), ('2012', 'peak_to_peak')])
def test_limits_of_en_13231_3_are_exact_and_the_doubtful_ones_marked(edition, statistic):
    found = load_limits(f'en_13231_3_{edition}')
    assert found.statistic == statistic
    assert [found.of(band).limit for band in BANDS] == [20e-6, 20e-6, 30e-6, 150e-6]
    doubtful = ['limit' in found.of(band).uncertain for band in BANDS]
    assert doubtful == [True, False, True, True]  # +-10 um at 30-100 mm has a source


def test_every_set_that_is_shipped_names_its_source():
    assert 'grassie_1999' in shipped_limits()
    for name in shipped_limits():
        found = load_limits(name)
        assert len(found.source) > 40
        assert {item.band for item in found.bands} >= set(BANDS)


def test_limit_of_iso_3095_is_exact(reference_data):
    path = reference_data / 'cnossos_roughness_tables.json'
    if not path.exists():
        pytest.skip(f'no {path.name}')
    table = json.loads(path.read_text())
    levels = table['rail_roughness_dB_re_1um']['EN ISO 3095 2013']
    for k, level in enumerate(levels, -3):
        assert iso3095_limit(10.0 ** (-k / 10.0)) == pytest.approx(level, abs=1e-9)


@pytest.mark.parametrize(('text', 'said'), [
    ('title: a\nsource: b\nstatistic: median\nbands: []', "statistic: unknown value 'median'"),
    ('title: a\nsource: b\nstatistic: peak_to_peak\nbands:\n- {shortest: 0.3, longest: 0.1, '
     'limit: 1.0e-6, allowed_share: 0.05}', 'bands[0].longest: expected more than shortest'),
    ('title: a\nsource: b\nstatistic: moving_rms\nbands:\n- {shortest: 0.1, longest: 0.3, '
     'limit: 1.0e-6, allowed_share: 0.05}', 'bands[0].window: missing key'),
    ('title: a\nsource: b\nstatistic: peak_to_peak\nbands:\n- {shortest: 0.1, longest: 0.3, '
     'limit: .nan, allowed_share: 0.05}', 'bands[0].limit: expected a number above 0'),
])
def test_bad_limits_are_refused_by_file_and_key(tmp_path, text, said):
    path = tmp_path / 'mine.yaml'
    path.write_text(text)
    with pytest.raises(InputError) as refusal:
        load_limits(path)
    assert str(refusal.value).startswith(str(path))
    assert said in str(refusal.value)


def test_unknown_limits_are_refused_with_those_that_are_shipped():
    with pytest.raises(InputError, match='unknown set of limits.*grassie_1999'):
        load_limits('grassi_1999')


def test_bands_are_a_setting():
    assert IndicatorSettings().wavelengths == BANDS
    assert IndicatorSettings(bands='20-80, 80-500').wavelengths == ((0.02, 0.08), (0.08, 0.5))


@pytest.mark.parametrize('bands', ['', '30', '100-30', '30-40', '1-30', 'a-b', '30-100,30-100'])
def test_impossible_bands_are_refused(bands):
    with pytest.raises(InputError, match='^bands: expected'):
        IndicatorSettings(bands=bands)
