"""From acceleration to indicators: runs of the full model, and measured recordings."""

import csv
import math

import numpy as np
import pytest
import yaml

from railtrack_ros.bags.bag import open_bag
from railtrack_ros.bags.reader import read_waveforms
from railtrack_ros.cli.main import main
from railtrack_ros.estimation.wavelengths import spectrum

TRACK = {
    'rail': {'youngs_modulus': 210e9, 'poisson_ratio': 0.3, 'area': 7.69e-3,
             'second_moment': 3.055e-5, 'density': 7850.0, 'shear_coefficient': 0.4,
             'loss_factor': 0.02},
    'support': {'kind': 'distributed', 'spacing': 0.58, 'pad_length': 0.16,
                'pad_stiffness': 700e6, 'pad_damping': 60e3, 'sleeper_mass': 150.0,
                'ballast_stiffness': 50e6, 'ballast_damping': 40e3},
}  # fmt: skip
WHEELS = {
    'wheel': {'mass': 550.0, 'static_load': 80e3, 'radius': 0.46},
    'contact': {'stiffness': 100e9, 'exponent': 1.5},
}
BOGIE = [{'name': 'lead', 'rail': 'left', 'offset': 0.0},
         {'name': 'trail', 'rail': 'left', 'offset': -2.5}]
WHEELSET = [{'name': side, 'rail': side, 'offset': 0.0} for side in ('left', 'right')]


def described(path, content):
    path.write_text(yaml.safe_dump(content))
    return str(path)


def sections(bag, path, *options):
    assert main(['indicators', str(bag), '--output', str(path), *options]) == 0
    with open(path, newline='') as file:
        return {(row['axle_box'], float(row['from_m'])): row for row in csv.DictReader(file)}


def test_indicators_of_a_run_that_accelerates_over_another_track_are_the_true_ones(tmp_path):
    track = described(tmp_path / 'track.yaml', TRACK)
    vehicle = described(tmp_path / 'bogie.yaml', {**WHEELS, 'axle_boxes': BOGIE})
    bag, out = str(tmp_path / 'run.mcap'), str(tmp_path / 'out.mcap')
    assert main(['synthesize', '--track', track, '--vehicle', vehicle, '--duration', '1.5',
                 '--speed', '28', '--acceleration', '1.5', '--roughness', 'iso3095',
                 '--corrugation', '0.045:10e-6:12:22', '--corrugation', '0.16:30e-6:27:37',
                 '--seed', '2', bag]) == 0
    assert main(['estimate', bag, '--track', track, '--vehicle', vehicle, '--output', out]) == 0
    found = sections(out, tmp_path / 'a.csv', '--section', '5')
    truth = sections(out, tmp_path / 'b.csv', '--section', '5', '--topic', '/truth/irregularity',
                     '--vehicle', vehicle)
    assert len(found) > 12
    for key, row in found.items():
        for name in ('rms_30_100_um', 'rms_100_300_um'):
            if row[name] and truth[key][name]:
                assert float(row[name]) == pytest.approx(float(truth[key][name]), rel=0.1)
        start = key[1]
        waves = {0.045: 15.0 <= start < 20.0, 0.16: 30.0 <= start < 35.0}
        for wavelength, inside in waves.items():
            if inside:
                assert float(row['dominant_wavelength_m']) == pytest.approx(wavelength, rel=0.03)
        if start + 5.0 <= 12.0 or start >= 37.0:
            assert row['dominant_wavelength_m'] == ''


def test_measured_corrugation_is_named_where_it_holds_half_of_the_energy(
        reference_data, tmp_path):
    measured = reference_data / 'measured_corrugated_a.npz'
    if not measured.exists():
        pytest.skip(f'no {measured.name}')
    vehicle = described(tmp_path / 'wheelset.yaml', {**WHEELS, 'axle_boxes': WHEELSET})
    bag, out = str(tmp_path / 'run.mcap'), str(tmp_path / 'out.mcap')
    assert main(['import', str(measured), '--channels', 'left,right', '--position-column',
                 'position_km', '--position-unit', 'km', '--speed-column', 'speed_km_h',
                 '--speed-unit', 'km/h', bag]) in (0, 3)
    assert main(['estimate', bag, '--track', 'blanco_table_3_1', '--vehicle', vehicle,
                 '--output', out]) in (0, 3)
    rows = sections(out, tmp_path / 'a.csv', '--grind-list', str(tmp_path / 'grind.csv'))
    assert {row['rms_10_30_um'] for row in rows.values()} == {''}
    assert all(row['rms_30_100_um'] for row in rows.values())
    with open_bag(out) as opened:
        topic = '/track_estimator/irregularity'
        wave = read_waveforms(opened, [topic])[topic]
    for side in ('left', 'right'):
        eligible, named = 0, 0
        for (box, start), row in rows.items():
            inside = (wave.position >= start) & (wave.position < start + 10.0)
            values = wave.channels[side][inside].astype(float)
            if box != side or not np.isfinite(values).all():
                continue
            power = spectrum(values, float(np.median(np.diff(wave.position))))
            share = power.mean_square(1.0 / 0.25, 1.0 / 0.225) / power.mean_square(1 / 0.3, 10.0)
            if share >= 0.5:
                eligible += 1
                named += 0.225 <= float(row['dominant_wavelength_m'] or 'nan') <= 0.25
        assert eligible >= 30
        assert named >= 0.8 * eligible
    with open(tmp_path / 'grind.csv', newline='') as file:
        grind = list(csv.DictReader(file))
    assert {row['rail'] for row in grind[:2]} == {'left', 'right'}
    for row in grind[:2]:
        assert float(row['length_m']) > 450.0
        assert 0.225 <= float(row['dominant_wavelength_m']) <= 0.25
        assert math.isclose(float(row['limit_um']), 7.0)
