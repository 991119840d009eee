"""Two results over the same track: aligned by position, then told apart."""

import csv
import dataclasses
import json

import numpy as np
import pytest

from railtrack_ros.bags.bag import open_bag
from railtrack_ros.bags.codec import SECOND, START_NS, WaveformBlock
from railtrack_ros.bags.message_types import OFFLINE
from railtrack_ros.bags.writer import Recording
from railtrack_ros.cli.main import main
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.settings import EstimatorSettings, IndicatorSettings
from railtrack_ros.irregularity import profile
from railtrack_ros.runs import configuration
from railtrack_ros.runs.compare import compare, shifted_by
from railtrack_ros.runs.compare_report import comparison_report
from railtrack_ros.vehicle.description import load_vehicle

RATE, SIZE = 12800.0, 128
RAIL = profile.iso3095(200.0, 1e-3, seed=4, start=-20.0)


@pytest.fixture(scope='module')
def bogie():
    coach = load_vehicle('measurement_coach')
    return dataclasses.replace(coach, name='bogie', axle_boxes=coach.on_rail('left')[:2])


def write(path, track, vehicle, speed, off=0.0, gain=1.0, prefix='/track_estimator', rail=RAIL,
          told=True, gap=None):
    """Write results of a run over 120 m whose odometer is off by so many metres."""
    with Recording(path) as recording:
        if told:
            text = configuration.write_configuration(
                track, vehicle, EstimatorSettings(), IndicatorSettings())
            recording.write(f'{prefix}/configuration',
                            OFFLINE.get(configuration.TYPE)(data=text), START_NS)
        for block in range(int(120.0 / speed * RATE / SIZE)):
            t = np.arange(SIZE) / RATE
            stamp = START_NS + round(block * SIZE / RATE * SECOND)
            true = 5.0 + speed * (t + block * SIZE / RATE)
            if gap and gap[0] < true[0] < gap[1]:
                continue
            channels = {box.name: gain * rail.at(true + box.offset)
                        for box in vehicle.axle_boxes}
            forces = {name: 1e5 + 5e8 * values for name, values in channels.items()}
            recording.write_waveform(f'{prefix}/contact_force',
                                     WaveformBlock(stamp, t, forces, true + off))
            recording.write_waveform(f'{prefix}/irregularity',
                                     WaveformBlock(stamp, t, channels, true + off))
    return path


def test_a_run_is_its_own_equal(tmp_path, table_3_1, bogie):
    one = write(tmp_path / 'a.mcap', table_3_1, bogie, 20.0)
    found = compare(one, one)
    assert all(e.rms_difference == 0.0 for e in found.errors)
    assert found.axle_boxes == [box.name for box in bogie.axle_boxes]


@pytest.mark.parametrize('off', [1.3217, -2.404])
def test_runs_at_other_speeds_and_positions_are_aligned_and_levels_compared(
        tmp_path, table_3_1, bogie, off):
    one = write(tmp_path / 'a.mcap', table_3_1, bogie, 20.0)
    other = write(tmp_path / 'b.mcap', table_3_1, bogie, 27.0, off, 10.0**(1.5 / 20.0))
    found = compare(one, other)
    assert shifted_by(found)['lowest'] == pytest.approx(off, abs=1e-3)
    assert shifted_by(found)['highest'] == pytest.approx(off, abs=1e-3)
    levels = [e for e in found.errors if e.quantity == 'irregularity'
              and (e.band == 'section' or e.wavelength > 0.04)]
    assert {e.band for e in levels} == {'wavelength', 'section'}
    assert all(e.level_difference == pytest.approx(1.5, abs=0.05) for e in levels)
    coherence = [e.coherence for e in levels if e.band == 'wavelength' and e.wavelength < 0.3]
    assert min(coherence) > 0.99
    text = comparison_report(found).findings
    assert any(f'{off:+.3f} m off' in line for line in text)


def test_a_gap_is_left_out_and_not_compared(tmp_path, table_3_1, bogie):
    one = write(tmp_path / 'a.mcap', table_3_1, bogie, 20.0)
    other = write(tmp_path / 'b.mcap', table_3_1, bogie, 20.0, gap=(60.0, 77.0))
    found = compare(one, other)
    lead = bogie.axle_boxes[0]
    sections = sorted(e.begin for e in found.errors if e.band == 'section'
                      and e.quantity == 'irregularity' and e.axle_box == lead.name)
    assert 60.0 + lead.offset not in sections
    assert 70.0 + lead.offset not in sections
    assert {30.0, 90.0} <= set(sections)
    worst = max(abs(e.level_difference) for e in found.errors if e.quantity == 'irregularity')
    assert worst < 0.01


def test_strangers_are_told(tmp_path, table_3_1, bogie):
    one = write(tmp_path / 'a.mcap', table_3_1, bogie, 20.0)
    other = write(tmp_path / 'b.mcap', table_3_1, bogie, 20.0,
                  rail=profile.iso3095(200.0, 1e-3, seed=5, start=-20.0))
    found = compare(one, other)
    assert shifted_by(found) == {}
    assert any('do not look like the same rail' in text
               for text in comparison_report(found).findings)


def test_results_of_two_kinds_in_one_recording_are_compared(tmp_path, table_3_1, bogie):
    path = tmp_path / 'both.mcap'
    with Recording(path) as recording:
        for gain, prefix in ((1.0, '/truth'), (2.0, '/track_estimator')):
            write(tmp_path / 'part.mcap', table_3_1, bogie, 20.0, gain=gain, prefix=prefix,
                  told=gain == 2.0)
            with open_bag(tmp_path / 'part.mcap') as bag:
                for message in bag.messages():
                    recording.write_raw(
                        message.topic, message.type, message.log_time, message.data)
    found = compare(path, path, ('/truth', '/track_estimator'))
    level = 20.0 * np.log10(2.0)
    assert all(e.level_difference == pytest.approx(level, abs=1e-3) for e in found.errors)


@pytest.mark.parametrize(('change', 'options', 'said'), [
    ({'told': False}, {}, 'does not tell where the axle boxes of /track_estimator are'),
    ({}, {'prefixes': (None, '/truth')}, 'no results of /truth; there are those of: /track_est'),
    ({'off': 500.0}, {}, 'nothing in common'),
])
def test_what_cannot_be_compared_is_refused(tmp_path, table_3_1, bogie, change, options, said):
    one = write(tmp_path / 'a.mcap', table_3_1, bogie, 30.0)
    other = write(tmp_path / 'b.mcap', table_3_1, bogie, 30.0, **change)
    with pytest.raises(InputError, match=said):
        compare(one, other, **options)


def test_the_command_writes_report_and_tables(tmp_path, table_3_1, bogie, capsys):
    one = write(tmp_path / 'a.mcap', table_3_1, bogie, 20.0)
    other = write(tmp_path / 'b.mcap', table_3_1, bogie, 25.0, 0.7, 1.2)
    out = tmp_path / 'out'
    assert main(['compare', str(one), str(other), '--output', str(out), '--json']) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary['shift_m']['median'] == pytest.approx(0.7, abs=1e-3)
    assert {path.name for path in out.iterdir()} == {'report.html', 'errors.csv', 'shifts.csv'}
    with open(out / 'shifts.csv', newline='') as file:
        assert all(float(row['correlation']) > 0.9 for row in csv.DictReader(file))
    page = (out / 'report.html').read_text()
    assert 'Two results over the same track' in page
    assert 'cross-correlation' in page
    assert main(['compare', str(one), str(tmp_path / 'none.mcap'), '--output', str(out)]) == 2
    assert 'no such file' in capsys.readouterr().err
