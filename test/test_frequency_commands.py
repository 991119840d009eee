"""The commands receptance, decay-rate, dispersion and resonances."""

import csv
import json

import numpy as np
import pytest

from railtrack_ros import paths
from railtrack_ros.cli import main
from railtrack_ros.dynamics.decay_rate import track_decay_rate
from railtrack_ros.dynamics.dispersion import bloch_wavenumbers
from railtrack_ros.dynamics.receptance import finite_track, receptance
from railtrack_ros.track.bay import Mesh
from railtrack_ros.track.infinite import Sleeper

TRACK = ['--track', 'blanco_table_3_1']


def read(path):
    with open(path, encoding='utf-8', newline='') as file:
        header, *rows = csv.reader(file)
    return header, rows


def complex_column(path):
    header, rows = read(path)
    assert header == ['frequency_hz', 'receptance_real_m_per_n', 'receptance_imag_m_per_n']
    values = np.array(rows, dtype=float)
    return values[:, 0], values[:, 1] + 1j * values[:, 2]


@pytest.fixture
def run(tmp_path):
    def run(command, *options):
        path = tmp_path / 'out.csv'
        assert main.main([command, *TRACK, '--output', str(path), *options]) == 0
        return path

    return run


@pytest.mark.parametrize(('at', 'x'), [('midspan', 0.3), ('sleeper', 0.0), ('0.1', 0.1),
                                       ('-1.25', -1.25)])
def test_receptance_writes_what_the_library_computes(at, x, run, table_3_1):
    frequencies, h = complex_column(run('receptance', '--at', at, '--frequencies', '10:100:30'))
    np.testing.assert_array_equal(frequencies, [10.0, 40.0, 70.0, 100.0])
    np.testing.assert_array_equal(h, receptance(table_3_1, frequencies, x))


def test_cross_receptances(run, table_3_1):
    options = ['--at', 'sleeper', '--frequencies', '50,1000.5']
    f, h = complex_column(run('receptance', *options, '--response-at', '1.7'))
    np.testing.assert_array_equal(h, receptance(table_3_1, f, 1.7, 0.0))
    f, h = complex_column(run('receptance', *options, '--sleeper', '-2'))
    np.testing.assert_array_equal(h, receptance(table_3_1, f, Sleeper(-2), 0.0))


def test_receptance_of_finite_elements(run, table_3_1):
    f, h = complex_column(run(
        'receptance', '--at', '0.2', '--frequencies', '200,900', '--bays', '31',
        '--elements-per-bay', '4', '--elements-per-pad', '1', '--local-system', 'dynamic'))
    track = finite_track(table_3_1, Mesh(4, 1, 'dynamic'), 31)
    np.testing.assert_array_equal(h, receptance(track, f, 0.2))


def test_support_and_loss_factor_replace_those_of_the_file(run):
    f, h = complex_column(run('receptance', '--at', 'midspan', '--frequencies', '1068.16',
                              '--support', 'concentrated', '--loss-factor', '1e-4'))
    assert abs(h[0]) == pytest.approx(4.70e-8, rel=0.02)


def test_decay_rate_writes_what_the_library_computes(run, table_3_1):
    header, rows = read(run('decay-rate'))
    assert header == ['frequency_hz', 'decay_rate_db_per_m']
    result = track_decay_rate(table_3_1)
    np.testing.assert_array_equal(np.array(rows, dtype=float),
                                  np.stack([result.frequency, result.rate], axis=1))


def test_dispersion_writes_what_the_library_computes(run, table_3_1):
    header, rows = read(run('dispersion', '--frequencies', '500,1500'))
    assert header == ['frequency_hz', 'wave_1_real_per_m', 'wave_1_imag_per_m',
                      'wave_2_real_per_m', 'wave_2_imag_per_m']
    kappa = bloch_wavenumbers(table_3_1, [500.0, 1500.0])
    values = np.array(rows, dtype=float)
    np.testing.assert_array_equal(values[:, 1] + 1j * values[:, 2], kappa[:, 0])
    np.testing.assert_array_equal(values[:, 3] + 1j * values[:, 4], kappa[:, 1])


def test_resonances_as_json_and_csv(run, capsys):
    path = run('resonances', '--vehicle', 'blanco_table_3_1', '--json')
    summary = json.loads(capsys.readouterr().out)
    found = {(r['name'], r['place']): r['frequency'] for r in summary['resonances']}
    assert found['pinned-pinned', 'midspan'] == pytest.approx(1080.30, abs=0.05)
    assert found['P2', 'sleeper'] == pytest.approx(63.2, abs=0.1)
    header, rows = read(path)
    assert header == ['resonance', 'place', 'frequency_hz', 'magnitude', 'unit']
    assert [row[:2] for row in rows] == [list(key) for key in found]


@pytest.mark.parametrize(('command', 'options'), [
    ('receptance', ['--at', 'midspan', '--frequencies', '10:2500:50']),
    ('decay-rate', []),
    ('dispersion', ['--frequencies', '10:2500:50']),
    ('resonances', ['--vehicle', 'blanco_table_3_1']),
])
@pytest.mark.parametrize('suffix', ['png', 'svg', 'pdf'])
def test_every_command_draws_its_plot(command, options, suffix, run, tmp_path, capsys):
    plot = tmp_path / f'plot.{suffix}'
    run(command, *options, '--plot', str(plot))
    start = plot.read_bytes()[:200]
    assert {'png': b'\x89PNG', 'svg': b'<svg', 'pdf': b'%PDF'}[suffix] in (
        plot.read_bytes() if suffix == 'svg' else start)
    assert str(plot) in capsys.readouterr().out


@pytest.mark.parametrize(('options', 'said'), [
    (['--at', 'midspan', '--frequencies', '0,10'], '0 Hz'),
    (['--at', 'midspan', '--frequencies', '-10'], '-10 Hz'),
    (['--at', 'midspan', '--frequencies', 'nan'], 'nan Hz'),
    (['--at', 'midspan', '--frequencies', '10:5:1'], '10:5:1'),
    (['--at', 'midspan', '--frequencies', '10:20:0'], '10:20:0'),
    (['--at', 'midspan', '--frequencies', '10;20'], '10;20'),
    (['--at', 'midspan', '--frequencies', '1:1e9:0.001'], 'more than'),
    (['--at', 'midspan', '--frequencies', '40000'], '40000 Hz'),
    (['--at', 'middle', '--frequencies', '10'], "'middle'"),
    (['--at', 'nan', '--frequencies', '10'], '--at'),
    (['--at', '9', '--frequencies', '10', '--bays', '11'], 'around 9 m'),
    (['--at', '0', '--sleeper', '7', '--frequencies', '10', '--bays', '11'], 'bay 7'),
    (['--at', '0', '--frequencies', '10', '--bays', '0'], '--bays'),
    (['--at', '0', '--frequencies', '10', '--local-elements', '5'], '--local-elements'),
    (['--at', '0', '--frequencies', '10', '--response-at', '1', '--sleeper', '1'], '--sleeper'),
    (['--at', '0', '--frequencies', '10', '--plot', 'plot.jpg'], 'plot.jpg'),
])
def test_bad_input_is_one_clear_line(options, said, tmp_path, capsys):
    output = tmp_path / 'out.csv'
    assert main.main(['receptance', *TRACK, '--output', str(output), *options]) == 2
    error = capsys.readouterr().err
    assert error.count('\n') == 1
    assert said in error
    assert not output.exists()


def test_the_infinite_track_has_no_use_for_the_options_of_a_mesh(capsys, tmp_path):
    plain, meshed = tmp_path / 'plain.csv', tmp_path / 'meshed.csv'
    options = ['receptance', *TRACK, '--at', '0.2', '--frequencies', '200,900', '--output']
    assert main.main([*options, str(plain)]) == 0
    assert capsys.readouterr().err == ''
    assert main.main([*options, str(meshed), '--elements-per-bay', '4', '--elements-per-pad', '2',
                      '--local-system', 'static']) == 0
    told = capsys.readouterr().err
    assert told.count('\n') == 1
    for words in ('--local-system, --elements-per-bay, --elements-per-pad', 'infinite', '--bays N'):
        assert words in told
    assert meshed.read_text() == plain.read_text()
    assert main.main([*options, str(meshed), '--bays', '31', '--elements-per-bay', '4']) == 0
    assert capsys.readouterr().err == ''


def test_a_place_far_out_is_named_to_the_centimetre(capsys, tmp_path):
    assert main.main(['receptance', *TRACK, '--at', '350000.4', '--frequencies', '200',
                      '--output', str(tmp_path / 'far.csv')]) == 0
    assert 'force at 350000.4 m' in capsys.readouterr().out


def test_track_with_a_stretch_needs_a_number_of_bays(capsys, tmp_path):
    shipped = paths.config_directory() / 'tracks' / 'blanco_table_3_1.yaml'
    track = tmp_path / 'soft_spot.yaml'
    track.write_text(shipped.read_text(encoding='utf-8') + (
        'stretches:\n  - {from: 0.0, to: 3.0, support: {ballast_stiffness: 20.0e6}}\n'),
        encoding='utf-8')
    options = ['receptance', '--track', str(track), '--at', 'midspan', '--frequencies', '20',
               '--output', str(tmp_path / 'out.csv')]
    assert main.main(options) == 2
    error = capsys.readouterr().err
    assert 'soft_spot' in error
    assert 'stretches' in error
    assert main.main([*options, '--bays', '61']) == 0


def test_unknown_track_is_named(capsys, tmp_path):
    assert main.main(['decay-rate', '--track', 'no_such_track',
                      '--output', str(tmp_path / 'out.csv')]) == 2
    assert 'no_such_track' in capsys.readouterr().err
