"""Figures of the thesis, computed again, and the page that holds them against it."""

import csv
import json

import numpy as np
import pytest

from railtrack_ros.cli.main import main
from railtrack_ros.figures import (
    catalogue,
    chapter2,
    chapter4,
    content,
    evidence,
    evidence_time,
    page,
)
from railtrack_ros.figures.evidence import Section
from railtrack_ros.track import rail as tim4

NUMBERS = ['1.3', '2.2', '2.3', '2.4', '2.5a', '2.5b', '2.6', '3.2', '3.3', '3.4a', '3.4b',
           '3.5a', '3.5b', '3.6', '3.7', '4.1a', '4.1b', '4.3']
QUICK = '2.2,2.3,2.4,3.2,3.3'


def printed_deflection(rail, length, xa, x):
    """Thesis (2.7) and (2.8) as printed, unit force."""
    phi = tim4.shear_ratio(rail, length)
    s, a = x / length, xa / length
    both = a * (1.0 - a) / (2.0 * (1.0 + phi)) * (
        (2.0 * (1.0 - a) + phi) * (s**3 - 3.0 * s**2 + 2.0 * s) + (2.0 * a + phi) * (s - s**3))
    left = s * ((1.0 - a) * (s**2 - phi / 2.0) + 3.0 * a**2 - a**3 - 2.0 * a)
    right = a * (phi / 2.0 * (s - 1.0) * 2.0 / 2.0 + 3.0 * s**2 - s**3 - s * a**2 - 2.0 * s
                 + a**2)
    factor = length**3 / (6.0 * rail.bending_stiffness)
    return factor * (np.where(x <= xa, left, right) + both)


@pytest.mark.parametrize('load', [0.03, 0.075, 0.11])
def test_local_deflection_is_the_printed_one_with_its_sign_turned(table_3_1, load):
    x = np.linspace(0.0, 0.15, 61)
    here = chapter2.local_deflection(table_3_1.rail, 0.15, load, x)
    np.testing.assert_allclose(here, -printed_deflection(table_3_1.rail, 0.15, load, x),
                               atol=1e-9 * here.max())
    under = chapter2.local_deflection(table_3_1.rail, 0.15, load, np.array([load]))
    assert under == pytest.approx(tim4.clamped_flexibility(table_3_1.rail, 0.15, load))


def test_impulse_response_of_the_poles_is_the_transform_of_the_receptance():
    from railtrack_ros.dynamics.modes import make_track_modes
    from railtrack_ros.figures.cases import table_3_1
    from railtrack_ros.track.bay import Mesh, make_bay

    modes = make_track_modes(make_bay(table_3_1('CVS', 0.02), Mesh(4, local_system='dynamic')))
    t = np.linspace(5e-3, 0.03, 101)
    poles = modes.impulse_response(t, 0.3, 0.3)
    transformed = chapter4.transformed(0.3, t)
    assert np.std(poles - transformed) < 0.02 * np.std(poles)


def test_every_figure_of_the_list_is_there_once():
    assert [entry.number for entry in catalogue.CATALOGUE] == NUMBERS


def test_a_number_without_letter_stands_for_its_parts():
    assert [entry.number for entry in catalogue.chosen(['3.4', '1.3'])] == ['1.3', '3.4a', '3.4b']


def test_the_four_frequencies_of_figure_2_3_are_those_of_table_2_1_with_210_gpa():
    modes = tim4.clamped_modes(chapter2.rail_of_figure_2_3(), chapter2.LENGTH, 4)
    np.testing.assert_allclose(modes.angular_frequency / (2.0 * np.pi), chapter2.PRINTED,
                               rtol=1.5e-4)


def test_coarse_mesh_with_local_system_has_the_deflection_of_the_fine_one():
    x = np.linspace(8.0, 10.0, 201)
    load = 15.25 * 0.6
    coarse, repaired, fine = (chapter2.static_shape(n, load, x, local) for n, local in
                              ((2, False), (2, True), (4, False)))
    np.testing.assert_allclose(repaired, fine, atol=1e-12 * fine.max())
    assert np.abs(coarse - fine).max() > 0.02 * fine.max()


def test_chosen_figures_come_as_picture_and_data(tmp_path, capsys):
    assert main(['figures', '--only', QUICK, '--output', str(tmp_path), '--json']) == 0
    told = json.loads(capsys.readouterr().out)
    assert told['figures'] == QUICK.split(',')
    assert {path.name for path in tmp_path.iterdir()} == {
        *(f'figure_{n.replace(".", "_")}.png' for n in QUICK.split(',')),
        'figure_2_2.csv', 'figure_2_3_a.csv', 'figure_2_3_b.csv', 'figure_2_4.csv',
        'figure_3_2_a.csv', 'figure_3_2_b.csv', 'figure_3_3.csv'}
    assert all(path.read_bytes().startswith(b'\x89PNG') for path in tmp_path.glob('*.png'))
    with open(tmp_path / 'figure_2_4.csv', encoding='utf-8') as file:
        rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
    middle = min(rows, key=lambda row: abs(row['position_m'] - 0.075))
    assert middle['static_m_per_n'] == pytest.approx(1.5368e-10, rel=1e-4)
    assert middle['modes_6_m_per_n'] < middle['modes_20_m_per_n'] < middle['static_m_per_n']


def test_receptances_of_figure_3_4_peak_where_an_independent_method_has_them():
    # Transfer matrices, infinite track without loss: 3.324e-9 (DS), 5.435e-9 (CVRS), CVS unbounded.
    [entry] = catalogue.chosen(['3.4a'])
    columns = entry.compute().panels[0].columns()
    near = (columns['frequency_hz'] > 1040.0) & (columns['frequency_hz'] < 1110.0)
    ds, cvrs, cvs = (columns[f'rail_{name}_m_per_n'][near].max() for name in ('ds', 'cvrs', 'cvs'))
    assert ds == pytest.approx(3.324e-9, rel=0.01)
    assert cvrs == pytest.approx(5.435e-9, rel=0.03)
    assert cvs > 4.0 * ds


def test_steady_forces_of_figure_3_5_are_the_published_ones():
    [entry] = catalogue.chosen(['3.5b'])
    columns = entry.compute().panels[0].columns()
    for name, low, high in (('cvs_n', 97.73, 101.23), ('cvrs_n', 97.80, 101.20),
                            ('ds_n', 98.90, 100.92)):
        assert columns[name].min() / 1e3 == pytest.approx(low, abs=0.15)
        assert columns[name].max() / 1e3 == pytest.approx(high, abs=0.15)


def test_what_was_finished_stays_when_the_rest_is_interrupted(tmp_path, monkeypatch):
    def interrupted():
        raise KeyboardInterrupt

    first = catalogue.chosen(['2.4'])[0]
    second = content.Entry('9.9', 'never made', interrupted)
    monkeypatch.setattr(catalogue, 'CATALOGUE', (first, second))
    assert main(['figures', '--only', '2.4,9.9', '--output', str(tmp_path)]) == 130
    assert {path.name for path in tmp_path.iterdir()} == {'figure_2_4.png', 'figure_2_4.csv'}


@pytest.mark.parametrize(('arguments', 'said'), [
    (['--only', '5.1'], "figure '5.1'"), (['--only', '3.4,'], "figure ''"),
    (['--only', '2.4', '--page', 'x.md'], '--page')])
def test_what_is_no_figure_is_refused_by_name(arguments, said, tmp_path, capsys):
    assert main(['figures', *arguments, '--output', str(tmp_path / 'out')]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert len(error.splitlines()) == 1
    assert not (tmp_path / 'out').exists()


def test_a_folder_that_is_a_file_is_refused(tmp_path, capsys):
    (tmp_path / 'file').write_text('')
    assert main(['figures', '--only', '2.4', '--output', str(tmp_path / 'file')]) == 2
    assert 'cannot be written' in capsys.readouterr().err


def test_the_page_finds_its_pictures_from_where_it_lies(tmp_path):
    entry = content.Entry('2.4', 'Flexibility', chapter2.figure_2_4)
    figure = entry.compute()
    target = tmp_path / 'docs' / 'validation.md'
    page.write_page(target, tmp_path / 'docs' / 'figures', [(entry, figure)],
                    [Section('More', 'text')])
    text = target.read_text(encoding='utf-8')
    assert '](figures/figure_2_4.png)' in text
    assert all(finding.computed in text for finding in figure.findings)
    assert '## More\n\ntext' in text


def test_a_wheel_on_many_light_supports_deflects_them_as_the_closed_form_says():
    import dataclasses

    from railtrack_ros.dynamics.closed_forms import smeared_foundation, timoshenko_winkler
    from railtrack_ros.figures.cases import table_3_1
    from railtrack_ros.track.bay import Mesh, make_bay
    from railtrack_ros.vehicle.description import load_vehicle

    track, vehicle = table_3_1('CVS'), load_vehicle('blanco_table_3_1')
    fine = evidence.spread(track, 6)
    fine = dataclasses.replace(fine, support=dataclasses.replace(
        fine.support, pad_damping=0.0, ballast_damping=0.0, sleeper_mass=1e-3))
    found = evidence_time.moving_deflection(make_bay(fine, Mesh(2)), vehicle, 300.0)
    closed = timoshenko_winkler(track.rail, smeared_foundation(track.support), 100e3, 0.0, 300.0)
    assert found == pytest.approx(float(closed), rel=5e-4)


def test_sections_without_reference_data_say_so(monkeypatch):
    monkeypatch.setattr(evidence_time.paths, 'reference_data', lambda: None)
    assert 'RAILTRACK_DATA' in evidence_time.measured_vibration().text
    assert 'RAILTRACK_DATA' in page.decay_section().text


def test_measured_vibration_holds_the_waves_that_were_found_on_that_track(reference_data):
    with np.load(reference_data / 'measured_corrugated_a.npz') as data:
        speed = float(np.mean(data['speed_km_h'])) / 3.6
        step = 1e3 * float(np.median(np.abs(np.diff(data['position_km']))))
        vibration = np.asarray(data['left'][:20000], dtype=float)
    found = evidence_time.irregularity_of(vibration, step / speed, speed)
    wave = evidence_time.strongest_wavelength(found[np.isfinite(found)], step)
    assert 0.228 < wave < 0.246  # published: 231 to 243 mm


def test_five_local_elements_are_worse_than_modes_everywhere_on_the_page():
    text = evidence.exact_track().text
    everywhere, five = (next(line for line in text.splitlines() if line.startswith(f'| {name}'))
                        for name in ('every element', 'five around the load'))
    at_2500 = [float(line.split('|')[-2].strip(' %')) for line in (everywhere, five)]
    assert at_2500[0] < 0.1
    assert at_2500[1] > 3.0
