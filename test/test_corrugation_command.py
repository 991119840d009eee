"""The command indicators with its analysis: tables, grind list, report, and what is refused."""

import csv
import json
import math

import numpy as np
import pytest

from railtrack_ros.bags.bag import open_bag
from railtrack_ros.bags.codec import SECOND, decode_diagnostics
from railtrack_ros.bags.message_types import OFFLINE
from railtrack_ros.bags.writer import Recording
from railtrack_ros.cli.main import main
from railtrack_ros.estimation.estimator import EstimateBlock
from railtrack_ros.estimation.settings import EstimatorSettings, IndicatorSettings
from railtrack_ros.irregularity.profile import corrugation, iso3095
from railtrack_ros.runs import configuration
from railtrack_ros.runs.results import ResultMessages
from railtrack_ros.track.description import load_track
from railtrack_ros.vehicle.description import load_vehicle

START = 1_700_000_000 * SECOND
RATE, SPEED, BLOCK = 12800.0, 25.0, 640
METRES = 150.0
NODE = '/track_estimator'
VEHICLE = 'blanco_table_3_1'


ROUGH = iso3095(400.0, 1e-3, 3, -50.0)


def profile(x):
    return 0.3 * ROUGH.at(x) + corrugation(x, 0.05, 15e-6, 50.0, 80.0)


def write_estimate(path, fixes=False):
    """A recording as the estimator makes it, with the irregularity put in by hand."""
    vehicle, track = load_vehicle(VEHICLE), load_track(VEHICLE)
    settings = IndicatorSettings()
    results = ResultMessages(vehicle, OFFLINE, settings, EstimatorSettings())
    t = np.arange(round(METRES / SPEED * RATE)) / RATE
    with Recording(path) as recording:
        text = configuration.write_configuration(track, vehicle, EstimatorSettings(), settings)
        message = OFFLINE.get(configuration.TYPE)(data=text)
        recording.write(f'{NODE}/configuration', message, START)
        for k in range(0, t.size, BLOCK):
            part = slice(k, k + BLOCK)
            stamp = START + round(t[k] * SECOND)
            position = SPEED * t[part]
            z = {box.name: profile(position + box.offset) for box in vehicle.axle_boxes}
            zero = {name: np.zeros(y.size) for name, y in z.items()}
            block = EstimateBlock(
                stamp_ns=stamp, t=t[part] - t[k], position=position,
                speed=np.full(position.size, SPEED), contact_force=zero, rail_deflection=zero,
                irregularity=z)
            for topic, item in results.block(block, 'base_link'):
                recording.write(f'{NODE}/{topic}', item, stamp)
            if fixes:
                recording.write('/fix', fix(stamp, position[0]), stamp)
        for topic, item in results.finish():
            recording.write(f'{NODE}/{topic}', item, stamp)
    return path


def fix(stamp, position):
    header = OFFLINE.get('std_msgs/msg/Header')(
        stamp=OFFLINE.get('builtin_interfaces/msg/Time')(
            sec=stamp // SECOND, nanosec=stamp % SECOND), frame_id='antenna')
    status = OFFLINE.get('sensor_msgs/msg/NavSatStatus')(status=0, service=1)
    kind = OFFLINE.get('sensor_msgs/msg/NavSatFix')
    return kind(header=header, status=status, latitude=47.0 + 9e-6 * position,
                longitude=8.5, altitude=400.0, position_covariance=np.zeros(9),
                position_covariance_type=0)


@pytest.fixture(scope='module')
def estimate(tmp_path_factory):
    return write_estimate(tmp_path_factory.mktemp('corrugation') / 'estimate.mcap')


@pytest.fixture(scope='module')
def with_fixes(tmp_path_factory):
    return write_estimate(tmp_path_factory.mktemp('corrugation') / 'fixes.mcap', True)


def read(path):
    with open(path, newline='') as file:
        return list(csv.DictReader(file))


def run(estimate, tmp_path, *options):
    table = tmp_path / 'sections.csv'
    assert main(['indicators', str(estimate), '--output', str(table), *map(str, options)]) == 0
    return read(table)


def test_live_messages_carry_the_level_by_the_limits_and_the_numbers_of_the_table(
        estimate, tmp_path):
    rows = {(row['axle_box'], row['from_m']): row for row in run(estimate, tmp_path)}
    with open_bag(estimate) as bag:
        statuses = [status for m in bag.messages({f'{NODE}/corrugation'})
                    for status in decode_diagnostics(bag.decode(m))[1]]
    assert len(statuses) == len(rows)
    for status in statuses:
        row = rows[status.values['axle_box'], status.values['from_m']]
        assert status.values == row  # the same to the last digit
        assert status.level == ['OK', 'WARN', 'ERROR'].index(row['level'])
        inside = 50.0 <= float(row['from_m']) < 80.0
        assert (status.level == 2) == inside
        assert ('times the limit of Grassie' in status.message) == inside


def test_zero_phase_table_is_close_to_the_live_one(estimate, tmp_path):
    causal = run(estimate, tmp_path)
    smooth = run(estimate, tmp_path, '--filters', 'zero-phase')
    keys = {(row['axle_box'], row['from_m']): row for row in smooth}
    for row in causal:
        other = keys[row['axle_box'], row['from_m']]
        if not (row['rms_300_1000_um'] and other['rms_300_1000_um']):
            continue
        for name in ('rms_10_30_um', 'rms_30_100_um', 'rms_100_300_um'):
            assert 20.0 * abs(math.log10(float(row[name]) / float(other[name]))) < 0.5


def test_grind_list_names_the_stretch_its_wave_and_its_mechanism(estimate, tmp_path):
    grind, rails = tmp_path / 'grind.csv', tmp_path / 'rails.csv'
    run(estimate, tmp_path, '--grind-list', grind, '--rails', rails, '--line-speed', '17:18')
    (row,) = read(grind)
    assert (row['rank'], row['from_m'], row['to_m']) == ('1', '50.0', '80.0')
    assert row['level'] == 'ERROR'
    assert row['band_mm'] == '30-100'
    assert float(row['dominant_wavelength_m']) == pytest.approx(0.05, rel=0.03)
    assert float(row['dominant_depth_um']) == pytest.approx(30.0, rel=0.1)
    assert row['mechanism_certainty'] == 'clear'  # 340 to 360 Hz
    assert 'rutting' in row['mechanism']
    assert row['longitude_deg'] == ''
    table = read(rails)
    assert {row['block_m'] for row in table} == {'10.0', '50.0', '100.0', '200.0'}
    loud = next(row for row in table if row['block_m'] == '50.0' and row['from_m'] == '50.0')
    assert loud['noise_rule'] == 'grind'
    assert float(loud['noise_index_db']) > 2.0
    quiet = next(row for row in table if row['block_m'] == '50.0' and row['from_m'] == '100.0')
    assert quiet['noise_rule'] == 'clear'


def test_spectra_say_nothing_absolute_below_twenty_millimetres(estimate, tmp_path):
    path = tmp_path / 'spectra.csv'
    run(estimate, tmp_path, '--spectra', path, '--contact-filter', 'none')
    rows = read(path)
    short = [row for row in rows if float(row['wavelength_m']) < 0.019]
    assert short
    assert {row['rail_level_db'] for row in short} == {''}
    assert all(row['combined_level_db'] for row in short)
    level = [float(row['combined_level_db']) for row in rows
             if abs(float(row['wavelength_m']) - 0.05) < 0.001 and 55 < float(row['from_m']) < 75]
    assert level == pytest.approx([20.0 * math.log10(15.0 / math.sqrt(2.0))] * len(level), abs=0.3)


def test_places_on_earth_come_from_the_satellite_fixes_of_the_recording(with_fixes, tmp_path):
    path = tmp_path / 'grind.geojson'
    run(with_fixes, tmp_path, '--grind-list', path)
    (feature,) = json.loads(path.read_text())['features']
    line = feature['geometry']['coordinates']
    assert feature['geometry']['type'] == 'LineString'
    assert line[0] == pytest.approx([8.5, 47.0 + 9e-6 * 50.0], abs=1e-7)
    assert line[-1] == pytest.approx([8.5, 47.0 + 9e-6 * 80.0], abs=1e-7)
    assert feature['properties']['latitude_deg'] == pytest.approx(47.0 + 9e-6 * 65.0, abs=1e-7)


def test_places_on_earth_come_from_a_table(estimate, tmp_path):
    geography, path = tmp_path / 'places.csv', tmp_path / 'grind.geojson'
    geography.write_text('position_m,longitude_deg,latitude_deg\n0,8.0,47.0\n100,8.1,47.2\n')
    run(estimate, tmp_path, '--grind-list', path, '--geography', geography)
    (feature,) = json.loads(path.read_text())['features']
    assert feature['geometry']['coordinates'][0] == pytest.approx([8.05, 47.1])


def test_parquet_holds_the_table_of_the_csv(estimate, tmp_path):
    parquet = pytest.importorskip('pyarrow.parquet')
    path, table = tmp_path / 'rails.parquet', tmp_path / 'rails.csv'
    run(estimate, tmp_path, '--rails', path)
    run(estimate, tmp_path, '--rails', table)
    found, rows = parquet.read_table(path).to_pylist(), read(table)
    assert len(found) == len(rows)
    for one, other in zip(found, rows, strict=True):
        assert {key: '' if value is None else str(value) for key, value in one.items()} == other


def test_waveforms_are_written_along_the_track(estimate, tmp_path):
    path = tmp_path / 'waves.csv'
    run(estimate, tmp_path, '--waveforms', path)
    names = path.read_text().splitlines()[0].split(',')
    assert names == ['position_m', 'left_10_30_um', 'left_30_100_um', 'left_100_300_um',
                     'left_300_1000_um']
    table = np.genfromtxt(path, delimiter=',', skip_header=1)
    inside = (table[:, 0] > 55.0) & (table[:, 0] < 75.0)
    assert np.std(table[inside, 2]) * math.sqrt(2.0) == pytest.approx(15.0, rel=0.05)
    assert np.isnan(table[0, 1:]).all()
    assert len(set(table[:, 0])) == len(table)


def test_waveforms_of_parquet_are_those_of_the_csv(estimate, tmp_path):
    parquet = pytest.importorskip('pyarrow.parquet')
    path, table = tmp_path / 'waves.parquet', tmp_path / 'waves.csv'
    run(estimate, tmp_path, '--waveforms', path)
    run(estimate, tmp_path, '--waveforms', table)
    found = parquet.read_table(path)
    rows = np.genfromtxt(table, delimiter=',', names=True)
    assert found.column_names == list(rows.dtype.names)
    for name in found.column_names:
        column = np.array(found[name].to_pylist(), dtype=float)
        np.testing.assert_allclose(column, rows[name], rtol=1e-3, atol=1e-9)
        assert np.isnan(column).sum() == found[name].null_count


def test_parquet_without_its_package_is_refused_before_the_work(
        estimate, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(__import__('sys').modules, 'pyarrow', None)
    assert main(['indicators', str(estimate), '--output', str(tmp_path / 'a.csv'),
                 '--rails', str(tmp_path / 'rails.parquet')]) == 2
    assert 'pip install pyarrow' in capsys.readouterr().err
    assert not (tmp_path / 'a.csv').exists()


def test_report_holds_every_plot_and_the_grind_list(estimate, tmp_path):
    page, plot = tmp_path / 'report.html', tmp_path / 'sheet.png'
    run(estimate, tmp_path, '--report', page, '--plot', plot)
    text = page.read_text()
    for words in ('Along the track', 'Wavelength and place', 'Spectrum against ISO 3095',
                  'Exceedance', 'Stretches to grind', 'indirect', 'Grassie, Saxon and Smith 1999',
                  'not in the abstract'):
        assert words in text
    assert text.count('class="figure"') == 4
    assert plot.read_bytes().startswith(b'\x89PNG')


@pytest.mark.parametrize(('options', 'said'), [
    (['--limits', 'mine'], "unknown set of limits 'mine'"),
    (['--bands', '30'], 'bands: expected SHORTEST-LONGEST'),
    (['--line-speed', 'fast'], 'line speed fast: neither V nor LO:HI in m/s, nor a file'),
    (['--line-speed', '-3'], 'line speed: expected V or LO:HI in m/s above 0'),
    (['--grind-list', 'a.geojson'], 'a.geojson: GeoJSON needs places on Earth'),
    (['--grind-list', 'a.xlsx'], 'a.xlsx: a table is written as .csv'),
    (['--waveforms', 'a.geojson'], 'a.geojson: a waveform is written as .csv or .parquet'),
    (['--geography', 'nowhere.csv'], 'geography nowhere.csv: cannot be read'),
    (['--plot', 'a.bmp'], 'a.bmp: a plot is written as'),
    (['--contact-filter', 'gauss'], 'gauss'),
    (['--track', 'nowhere'], "unknown track 'nowhere'"),
])
def test_garbage_is_refused_in_one_line(estimate, tmp_path, monkeypatch, capsys, options, said):
    monkeypatch.chdir(tmp_path)
    assert main(['indicators', str(estimate), '--output', 'a.csv', *options]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count('\n') == 1


def test_speeds_of_the_line_are_read_by_place(tmp_path):
    from railtrack_ros.runs.rail_rows import read_line_speed

    path = tmp_path / 'speeds.csv'
    path.write_text('from_m,to_m,speed_m_s\n0,100,20\n50,200,30\n')
    speeds = read_line_speed(str(path))
    assert speeds.over(0.0, 10.0) == (20.0, 20.0)
    assert speeds.over(60.0, 70.0) == (20.0, 30.0)
    assert speeds.over(300.0, 310.0) is None


def test_waves_of_the_sleeper_spacing_are_told_apart():
    from railtrack_ros.cli.indicators import _is_spacing

    content = {'track': {'support': {'spacing': 0.6}}}
    assert _is_spacing(0.597, None, content)
    assert not _is_spacing(0.5, None, content)
    assert not _is_spacing(0.597, None, {})
    assert _is_spacing(0.597, load_track(VEHICLE), {})
