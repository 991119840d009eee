"""The commands estimate and indicators, from recording to recording and table."""

import csv
import json
import math

import numpy as np
import pytest
import yaml

from railtrack_ros.bags.bag import open_bag
from railtrack_ros.bags.codec import (
    SECOND,
    WaveformBlock,
    decode_diagnostics,
    decode_speed,
    decode_waveform,
    encode_speed,
    encode_waveform,
)
from railtrack_ros.bags.message_types import OFFLINE
from railtrack_ros.bags.reader import read_waveforms
from railtrack_ros.bags.writer import Recording
from railtrack_ros.cli.main import main
from railtrack_ros.estimation.estimator import Estimator
from railtrack_ros.estimation.settings import EstimatorSettings
from railtrack_ros.track.description import load_track
from railtrack_ros.vehicle.description import load_vehicle

START = 1_700_000_000 * SECOND
RATE = 10_000.0
BLOCK = 100  # 10 ms
SPEED = 30.0
RESULTS = ('contact_force', 'rail_deflection', 'irregularity')

VEHICLE = {
    'wheel': {'mass': 550.0, 'static_load': 100e3, 'radius': 0.46},
    'contact': {'stiffness': 100e9, 'exponent': 1.5},
    'axle_boxes': [{'name': 'lead', 'rail': 'left', 'offset': 0.0},
                   {'name': 'trail', 'rail': 'left', 'offset': -2.5}],
}


@pytest.fixture(scope='module')
def vehicle(tmp_path_factory):
    path = tmp_path_factory.mktemp('vehicle') / 'two.yaml'
    path.write_text(yaml.safe_dump(VEHICLE))
    return path


def accelerations(seconds=1.0):
    """A wheel on 8 um of 100 mm corrugation under both axle boxes, roughly, and noise."""
    t = np.arange(round(seconds * RATE)) / RATE
    rng = np.random.default_rng(0)
    k = 2.0 * math.pi / 0.1
    wave = -8e-6 * (k * SPEED) ** 2 * np.sin(k * SPEED * t)
    return {name: wave + 0.3 * rng.standard_normal(t.size) for name in ('lead', 'trail')}


def write_run(path, channels=None, speed=SPEED, facts=None, extra=(), speed_lead=5):
    channels = channels or accelerations()
    n = len(next(iter(channels.values())))
    with Recording(path) as recording:
        if facts:
            recording.write_facts(facts)
        for k in range(-speed_lead, n // BLOCK + 1):
            if speed is not None:
                value = speed(k / 100.0) if callable(speed) else speed
                recording.write_speed(START + k * SECOND // 100, value)
            if not 0 <= k - 1 < n // BLOCK:
                continue
            part = slice((k - 1) * BLOCK, k * BLOCK)
            block = WaveformBlock(
                START + (k - 1) * SECOND // 100, np.arange(BLOCK) / RATE,
                {name: a[part].astype(np.float32) for name, a in channels.items()},
                None, 'bogie')
            recording.write_waveform('/axle_box_acceleration', block, START + k * SECOND // 100)
            for topic, message in extra:
                recording.write(topic, message, START + k * SECOND // 100)
    return path


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    note = OFFLINE.get('std_msgs/msg/String')(data='remark')
    return write_run(tmp_path_factory.mktemp('run') / 'run.mcap', facts={'start_position': 40.0},
                     extra=[('/remarks', note)])


@pytest.fixture(scope='module')
def estimated(run, vehicle, tmp_path_factory):
    output = tmp_path_factory.mktemp('estimated') / 'estimate.mcap'
    assert estimate(run, vehicle, output) == 0
    return output


def estimate(bag, vehicle, output, *options):
    return main(['estimate', str(bag), '--track', 'blanco_table_3_1', '--vehicle', str(vehicle),
                 '--output', str(output), *options])


def waveforms(path):
    with open_bag(path) as bag:
        return read_waveforms(bag, [f'/track_estimator/{name}' for name in RESULTS])


def read_table(path):
    with open(path, newline='') as file:
        return list(csv.DictReader(file))


# What is written


def test_results_are_those_of_the_estimator_to_the_last_bit(run, estimated, vehicle):
    direct = Estimator(load_track('blanco_table_3_1'), load_vehicle(vehicle),
                       EstimatorSettings(start_position=40.0))
    channels = accelerations()
    found = waveforms(estimated)
    blocks = []
    for k in range(-5, 101):
        direct.add_speed(START + k * SECOND // 100, SPEED)
    for k in range(100):
        part = slice(k * BLOCK, (k + 1) * BLOCK)
        blocks.append(direct.process(
            START + k * SECOND // 100, np.arange(BLOCK) / RATE,
            {name: a[part].astype(np.float32) for name, a in channels.items()}))
    for quantity in RESULTS:
        waveform = found[f'/track_estimator/{quantity}']
        assert np.array_equal(waveform.position, np.concatenate([b.position for b in blocks]))
        for name in channels:
            expected = np.concatenate([getattr(b, quantity)[name] for b in blocks])
            assert np.array_equal(waveform.channels[name], expected.astype(np.float32),
                                  equal_nan=True)
            assert waveform.channels[name].dtype == np.float32


def test_inputs_are_copied_as_they_are(run, estimated):
    with open_bag(run) as source, open_bag(estimated) as output:
        inputs = ['/axle_box_acceleration', '/speed', '/remarks']
        for topic in inputs:
            a, b = (list(bag.messages({topic})) for bag in (source, output))
            assert [(m.log_time, m.data, m.type) for m in a] == [
                (m.log_time, m.data, m.type) for m in b]
        assert output.facts['start_position'] == '40.0'


def test_results_are_logged_with_their_block_and_carry_its_frame(estimated):
    with open_bag(estimated) as bag:
        blocks = list(bag.messages({'/axle_box_acceleration'}))
        results = list(bag.messages({'/track_estimator/irregularity'}))
        assert [m.log_time for m in results] == [m.log_time for m in blocks]
        stamps = [decode_waveform(bag.decode(m)).stamp_ns for m in results]
        assert stamps == [decode_waveform(bag.decode(m)).stamp_ns for m in blocks]
        assert decode_waveform(bag.decode(results[0])).frame_id == 'bogie'


def test_all_topics_of_the_node_are_there(estimated):
    with open_bag(estimated) as bag:
        types = {name: topic.type for name, topic in bag.topics.items()}
        assert types['/track_estimator/corrugation'] == 'diagnostic_msgs/msg/DiagnosticArray'
        assert types['/diagnostics'] == 'diagnostic_msgs/msg/DiagnosticArray'
        for name in ('lead', 'trail'):
            prefix = f'/track_estimator/wheel/{name}'
            assert types[f'{prefix}/contact_force'] == 'geometry_msgs/msg/WrenchStamped'
            assert types[f'{prefix}/rms_30_100'] == 'std_msgs/msg/Float64'
        topic = '/track_estimator/wheel/lead/contact_force'
        forces = [bag.decode(message) for message in bag.messages({topic})]
    assert len(forces) == pytest.approx(8, abs=1)
    assert all(100e3 < m.wrench.force.z < 130e3 for m in forces)


def test_corrugation_messages_and_table_hold_the_same_numbers(estimated, tmp_path):
    table = tmp_path / 'indicators.csv'
    assert main(['indicators', str(estimated), '--section', '10', '--output', str(table)]) == 0
    rows = read_table(table)
    with open_bag(estimated) as bag:
        statuses = [status for m in bag.messages({'/track_estimator/corrugation'})
                    for status in decode_diagnostics(bag.decode(m))[1]]
    key = ('axle_box', 'from_m')
    assert sorted((status.values for status in statuses), key=lambda r: [r[k] for k in key]) == (
        sorted(rows, key=lambda r: [r[k] for k in key]))
    inside = next(row for row in rows if row['axle_box'] == 'lead' and row['from_m'] == '50.0')
    assert float(inside['dominant_wavelength_m']) == pytest.approx(0.1, rel=0.03)
    assert inside['rail'] == 'left'
    assert float(inside['speed_m_s']) == pytest.approx(30.0)


def test_estimate_of_an_estimate_replaces_the_results(estimated, vehicle, tmp_path):
    again = tmp_path / 'again.mcap'
    assert estimate(estimated, vehicle, again) == 0
    with open_bag(estimated) as a, open_bag(again) as b:
        assert {n: t.count for n, t in a.topics.items() if n != '/diagnostics'} == {
            n: t.count for n, t in b.topics.items() if n != '/diagnostics'}
    for one, other in zip(waveforms(estimated).values(), waveforms(again).values(), strict=True):
        assert np.array_equal(one.channels['lead'], other.channels['lead'], equal_nan=True)


def test_output_may_be_a_folder(run, vehicle, tmp_path):
    assert estimate(run, vehicle, tmp_path / 'bag') == 0
    assert (tmp_path / 'bag' / 'metadata.yaml').is_file()
    assert waveforms(tmp_path / 'bag')


def test_start_position_of_the_option_goes_before_that_of_the_recording(run, vehicle, tmp_path):
    output = tmp_path / 'moved.mcap'
    assert estimate(run, vehicle, output, '--start-position', '-12.5') == 0
    position = waveforms(output)['/track_estimator/contact_force'].position
    assert position[0] == -12.5


def test_settings_are_options(run, vehicle, tmp_path):
    output = tmp_path / 'short.mcap'
    assert estimate(run, vehicle, output, '--cut-on-wavelength', '1', '--section', '5') == 0
    force = waveforms(output)['/track_estimator/contact_force'].channels['lead']
    assert int(np.argmax(np.isfinite(force))) / RATE == pytest.approx(0.1, abs=2 / RATE)
    assert main(['indicators', str(output), '--output', str(tmp_path / 'x.csv')]) == 0
    rows = read_table(tmp_path / 'x.csv')
    # The cut-on is known to the indicators from the recording: 300-1000 mm is out of reach.
    assert {row['rms_300_1000_um'] for row in rows} == {''}
    assert '' not in {row['rms_30_100_um'] for row in rows}


def test_the_report_has_the_plots_of_the_rails_for_the_bands_and_limits_asked_for(
        run, vehicle, tmp_path):
    page = tmp_path / 'page.html'
    assert estimate(run, vehicle, tmp_path / 'out.mcap', '--report', str(page), '--section', '5',
                    '--bands', '60-200,200-500', '--limits', 'en_13231_3_2012') == 0
    text = page.read_text()
    for words in ('Corrugation of the rails', 'Wavelength and place', 'Spectrum against ISO 3095',
                  'Exceedance', '60-200 mm', '200-500 mm'):
        assert words in text, words
    assert '30-100 mm:' not in text
    assert '1999' not in text.split('<script>')[0]


def test_summary_is_machine_readable(run, vehicle, tmp_path, capsys):
    assert estimate(run, vehicle, tmp_path / 'out.mcap', '--json') == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary['distance_m'] == pytest.approx(30.0, rel=1e-3)
    assert summary['start_m'] == 40.0
    assert 75e3 < summary['axle_boxes']['lead']['lowest_force_n'] < 90e3
    assert summary['worst_section']['dominant_wavelength_m'] == pytest.approx(0.1, rel=0.03)
    assert summary['defects'] == []


def test_speed_logged_with_a_block_serves_it_whatever_stands_first(vehicle, tmp_path):
    # All messages of a block have one log time, the speed behind the acceleration.
    outputs = []
    for speed_first in (True, False):
        path = tmp_path / f'{speed_first}.mcap'
        with Recording(path) as recording:
            for k in range(60):
                stamp = START + k * SECOND // 100
                block = WaveformBlock(stamp, np.arange(BLOCK) / RATE,
                                      {'lead': np.zeros(BLOCK), 'trail': np.zeros(BLOCK)})
                order = [lambda b=block, s=stamp: recording.write_waveform(
                    '/axle_box_acceleration', b, s), lambda s=stamp, v=k: recording.write_speed(
                        s, 30.0 + 0.01 * v)]
                for write in reversed(order) if speed_first else order:
                    write()
        assert estimate(path, vehicle, tmp_path / f'out_{speed_first}.mcap', '--speed-delay', '0',
                        '--cut-on-wavelength', '1') == 0
        outputs.append(waveforms(tmp_path / f'out_{speed_first}.mcap'))
    topic = '/track_estimator/contact_force'
    assert np.array_equal(*(o[topic].position for o in outputs), equal_nan=True)


# Bad input


def complaint(capsys):
    text = capsys.readouterr().err.strip()
    assert 'Traceback' not in text
    return text.splitlines()


@pytest.mark.parametrize(('case', 'words'), [
    ('no_speed', 'no topic with the speed'),
    ('no_acceleration', 'no topic with the acceleration'),
    ('standstill', 'never above 0 m/s'),
    ('other_names', 'none of the axle boxes of vehicle two: lead, trail'),
    ('short', 'no valid sample in'),
    ('speed_elsewhen', 'gives no speed at the time of the acceleration'),
])
def test_recording_that_cannot_be_estimated_is_refused(case, words, vehicle, tmp_path, capsys):
    bag = tmp_path / 'bad.mcap'
    long, short = accelerations(0.5), accelerations(0.1)
    if case == 'no_speed':
        write_run(bag, long, speed=None)
    elif case == 'no_acceleration':
        with Recording(bag) as recording:
            recording.write_speed(START, 30.0)
    elif case == 'standstill':
        write_run(bag, long, speed=0.0)
    elif case == 'other_names':
        write_run(bag, {'a1': long['lead'], 'a2': long['trail']})
    elif case == 'short':
        write_run(bag, short)
    else:
        write_run(bag, long, speed=None)
        with open_bag(bag) as source, Recording(tmp_path / 'late.mcap') as recording:
            for m in source.messages():
                recording.write_raw(m.topic, m.type, m.log_time, m.data)
            recording.write_speed(START + 1000 * SECOND, 30.0)
        bag = tmp_path / 'late.mcap'
    output = tmp_path / 'out.mcap'
    assert estimate(bag, vehicle, output) == 2
    lines = complaint(capsys)
    assert len(lines) == 1
    assert words in lines[0]
    assert str(bag) in lines[0]
    assert not output.exists()


def rewritten(bag, path, change):
    """A recording with the list of (topic, type, log time, CDR) that a function makes of another's.

    The function gets each message decoded, and the seconds at which it was logged.
    """
    with open_bag(bag) as source, Recording(path) as recording:
        messages = [new for m in source.messages() for new in change(
            (m.topic, m.type, m.log_time, m.data), source.decode(m),
            (m.log_time - START) / SECOND)]
        for new in sorted(messages, key=lambda new: new[2]):
            recording.write_raw(*new)
    return path


def again(message, content, shift_ns, log_shift_ns=0, without=()):
    """A message with other stamps, and without some channels."""
    topic, kind, log_time, _ = message
    if topic == '/speed':
        stamp_ns, speed = decode_speed(content)
        new = encode_speed(stamp_ns + shift_ns, speed, 'bogie', OFFLINE)
    else:
        block = decode_waveform(content)
        channels = {name: x for name, x in block.channels.items() if name not in without}
        new = encode_waveform(WaveformBlock(block.stamp_ns + shift_ns, block.t, channels), OFFLINE)
    return topic, kind, log_time + log_shift_ns, OFFLINE.serialize(new)


def at_half_time(change):
    """Change the blocks from 0.505 s to 0.605 s."""
    return lambda message, content, seconds: (
        change(message, content)
        if message[0] == '/axle_box_acceleration' and 0.505 < seconds < 0.605 else [message])


def after_half_time_later(message, content, seconds):
    later = 7 * SECOND
    return [again(message, content, later, later) if seconds > 0.505 else message]


def one_speed_late(message, content, seconds):
    late = message[0] == '/speed' and abs(seconds - 0.5) < 1e-3
    return [again(message, content, 0, SECOND // 4) if late else message]


@pytest.mark.parametrize(('change', 'words'), [
    (at_half_time(lambda m, _: []), ['gap of 0.1 s (1000 samples)']),
    (after_half_time_later, ['stamped 7.000 s after the expected time', 'gap of 7', 'no speed']),
    (lambda m, c, _: [again(m, c, 0, without=['trail'])], ['trail: no channel']),
    (at_half_time(lambda m, c: [again(m, c, 0, without=['lead'])]),
     ['lead: no channel', 'lead: good samples again']),
    (at_half_time(lambda m, c: [m, m]), ['it has the stamp of the last one']),
    (at_half_time(lambda m, c: [m, again(m, c, -SECOND // 50)]), ['0.020 s before the last one']),
    (one_speed_late, ['too late and not used (1 so far)']),
], ids=['gap', 'long gap', 'dead', 'missing', 'duplicate', 'out of order', 'late speed'])
def test_normal_operation_is_told_and_is_no_defect(change, words, vehicle, run, tmp_path, capsys):
    bag = rewritten(run, tmp_path / 'changed.mcap', lambda message, content, seconds: (
        [message] if message[0] == '/remarks' else change(message, content, seconds)))
    output = tmp_path / 'out.mcap'
    assert estimate(bag, vehicle, output, '--json') == 0
    told = capsys.readouterr()
    summary = json.loads(told.out)
    assert summary['defects'] == []
    assert all(str(bag) in line for line in summary['remarks'])
    assert told.err == ''.join(f'railtrack estimate: {line}\n' for line in summary['remarks'])
    for word in words:
        assert any(word in line for line in summary['remarks']), word


def test_neighbours_of_a_dead_axle_box_are_warned_of(run, tmp_path, capsys):
    path = tmp_path / 'four.yaml'
    boxes = [*VEHICLE['axle_boxes'], {'name': 'other', 'rail': 'right', 'offset': 0.0}]
    path.write_text(yaml.safe_dump({**VEHICLE, 'axle_boxes': boxes}))

    def levels(name, change):
        def give(message, content, seconds):
            if message[0] != '/axle_box_acceleration':
                return [message]
            block = decode_waveform(content)
            channels = {**block.channels, 'other': block.channels['lead'].copy()}
            change(channels, seconds)
            block = WaveformBlock(block.stamp_ns, block.t, channels)
            return [(*message[:3], OFFLINE.serialize(encode_waveform(block, OFFLINE)))]

        bag, output = tmp_path / f'{name}.mcap', tmp_path / f'{name}_out.mcap'
        assert estimate(rewritten(run, bag, give), path, output) in (0, 3)
        with open_bag(output) as opened:
            status = [s for m in opened.messages({'/diagnostics'})
                      for s in decode_diagnostics(opened.decode(m))[1]]
        return {s.name.rsplit(' ', 1)[1]: (s.level, s.message) for s in status[1:]}

    def absent(channels, seconds):
        del channels['trail']

    def absent_for_a_while(channels, seconds):
        if 0.5 < seconds < 0.6:
            del channels['trail']

    def one_sample(channels, seconds):
        if abs(seconds - 0.5) < 1e-3:
            channels['trail'] = np.where(np.arange(BLOCK) == 7, np.nan, channels['trail'])

    for name, change, trail in (('dead', absent, 2), ('while', absent_for_a_while, 1)):
        found = levels(name, change)
        assert found['trail'][0] == trail
        assert found['lead'][0] == 1
        assert 'trail on the same rail is dead' in found['lead'][1]
        assert found['other'][0] == 0
    found = levels('sample', one_sample)
    assert [found[box][0] for box in ('lead', 'trail', 'other')] == [0, 1, 0]


@pytest.mark.parametrize(('case', 'words'), [
    ('nan', 'lead: 1 of 100 samples are no number'),
    ('garbage', 'message at'),
    ('silent', 'no speed for'),
    ('clock', 's before the expected time, which is believed'),
    ('leap', '1000000.000 s after the expected time, which is believed'),
])
def test_defects_are_told_and_the_rest_is_estimated(case, words, vehicle, tmp_path, capsys):
    channels = accelerations(1.0)
    bag = tmp_path / 'defect.mcap'
    if case == 'nan':
        channels['lead'][9000] = np.nan
    write_run(bag, channels)
    if case == 'garbage':
        bag = rewritten(bag, tmp_path / 'cut.mcap', at_half_time(
            lambda m, c: [(*m[:3], m[3][:57])]))
    elif case == 'silent':
        bag = rewritten(bag, tmp_path / 'silent.mcap', lambda m, c, seconds: (
            [] if m[0] == '/speed' and 0.4 < seconds < 5.0 else [m]))
    elif case == 'clock':
        bag = rewritten(bag, tmp_path / 'jump.mcap', at_half_time(
            lambda m, c: [again(m, c, -60 * SECOND), m]))
    elif case == 'leap':
        bag = rewritten(bag, tmp_path / 'leap.mcap', lambda m, c, seconds: [
            again(m, c, 1_000_000 * SECOND) if m[0] != '/speed' and 0.505 < seconds < 0.515 else m])
    output = tmp_path / 'out.mcap'
    options = ['--speed-timeout', '0.2'] if case == 'silent' else []
    assert estimate(bag, vehicle, output, *options) == 3
    lines = complaint(capsys)
    assert any(words in line for line in lines)
    assert all(str(bag) in line for line in lines)
    assert len(lines) <= 13
    force = waveforms(output)['/track_estimator/contact_force'].channels['lead']
    assert np.isfinite(force[-100:]).all() == (case not in ('nan', 'silent'))
    with open_bag(output) as opened:
        status = [s for m in opened.messages({'/diagnostics'})
                  for s in decode_diagnostics(opened.decode(m))[1]]
    assert status[0].level == 1


def test_indicators_need_an_estimate(run, estimated, tmp_path, capsys):
    table = tmp_path / 'x.csv'
    assert main(['indicators', str(run), '--output', str(table)]) == 2
    assert 'railtrack estimate' in complaint(capsys)[0]
    assert main(['indicators', str(estimated), '--section', '1000', '--output', str(table)]) == 2
    assert 'shorter sections' in complaint(capsys)[0]
    assert main(['indicators', str(estimated), '--section', '0', '--output', str(table)]) == 2
    assert '--section: expected a number of at least 1 ' in complaint(capsys)[0]
    assert not table.exists()


def test_recording_without_configuration_needs_the_vehicle(estimated, vehicle, tmp_path, capsys):
    bag, table = tmp_path / 'bare.mcap', tmp_path / 'x.csv'
    with open_bag(estimated) as source, Recording(bag) as recording:
        for m in source.messages({'/track_estimator/irregularity'}):
            recording.write_raw(m.topic, m.type, m.log_time, m.data)
    assert main(['indicators', str(bag), '--output', str(table)]) == 2
    assert '--vehicle' in complaint(capsys)[0]
    assert main(['indicators', str(bag), '--vehicle', str(vehicle), '--output', str(table)]) == 0


# Reference data


def test_virtual_measurement_comes_back(reference_data, vehicle, table_3_1, tmp_path):
    """Force, deflection and irregularity of a run whose truth another solver computed."""
    import dataclasses

    from scipy import signal

    from railtrack_ros.runs.estimate import estimate as estimate_run

    data = np.load(reference_data / 'virtual_run.npz')
    bag = tmp_path / 'virtual.mcap'
    rate, size = 25600.0, 256
    a = data['axle_box_acceleration']
    with Recording(bag) as recording:
        for k in range(0, len(a), size):
            stamp = START + round(k / rate * SECOND)
            recording.write_speed(stamp, data['speed'][k])
            recording.write_waveform('/axle_box_acceleration', WaveformBlock(
                stamp, np.arange(size) / rate,
                {'lead': a[k:k + size, 0], 'trail': a[k:k + size, 1]}))
    rail = dataclasses.replace(table_3_1.rail, loss_factor=0.0)
    output = tmp_path / 'estimate.mcap'
    found = estimate_run(bag, dataclasses.replace(table_3_1, rail=rail), load_vehicle(vehicle),
                         output)
    assert found.defects == []
    result = waveforms(output)
    t = data['time']
    inside = (t > 0.8) & (t < 2.9)
    grid = np.arange(25.0, 70.0, 0.001)
    for i, name in enumerate(('lead', 'trail')):
        for quantity, limit in (('contact_force', 0.045), ('rail_deflection', 0.015)):
            estimate_ = result[f'/track_estimator/{quantity}'].channels[name][inside].astype(float)
            truth = data[quantity][inside, i].astype(float)
            assert np.std(estimate_ - truth) < limit * np.std(truth)
        x = data['position'] + (0.0, -2.5)[i]
        back = np.interp(grid, x, result['/track_estimator/irregularity'].channels[name])
        given = np.interp(grid, data['profile_position'], data['profile'])
        for centre in (0.02, 0.0315, 0.05, 0.08, 0.125, 0.2, 0.315):
            edges = [2 ** (-1 / 6) / centre, 2 ** (1 / 6) / centre]
            band = signal.butter(3, edges, 'bandpass', fs=1000.0, output='sos')
            levels = [signal.sosfiltfilt(band, y)[2000:-2000].std() for y in (back, given)]
            assert abs(20.0 * math.log10(levels[0] / levels[1])) < 0.25
    for section in found.sections:
        if section.start >= 31.0 and section.end <= 50.0:
            assert section.dominant_wavelength == pytest.approx(0.045, rel=0.01)
        elif section.start >= 52.0:
            assert section.rms[1] < 3e-6
            assert math.isnan(section.dominant_wavelength)


def test_measured_corrugation_stands_out_on_both_rails(reference_data, tmp_path):
    """Half a kilometre of corrugated against normal track, from measured vibration."""
    layout = dict(VEHICLE, axle_boxes=[{'name': side, 'rail': side, 'offset': 0.0}
                                       for side in ('left', 'right')])
    vehicle = tmp_path / 'measured.yaml'
    vehicle.write_text(yaml.safe_dump(layout))
    medians, named = {}, {}
    for kind in ('normal', 'corrugated'):
        bag, output, table = (tmp_path / f'{kind}{end}' for end in ('.mcap', '_out.mcap', '.csv'))
        assert main([
            'import', str(reference_data / f'measured_{kind}_a.npz'), '--channels', 'left,right',
            '--position-column', 'position_km', '--position-unit', 'km',
            '--speed-column', 'speed_km_h', '--speed-unit', 'km/h', str(bag)]) in (0, 3)
        assert estimate(bag, vehicle, output) in (0, 3)
        assert main(['indicators', str(output), '--section', '10', '--output', str(table)]) == 0
        rows = read_table(table)
        assert {row['rms_10_30_um'] for row in rows} == {''}
        for side in ('left', 'right'):
            mine = [row for row in rows if row['axle_box'] == side]
            medians[kind, side] = np.median([float(row['rms_100_300_um']) for row in mine])
            named[kind, side] = np.mean([0.225 <= float(row['dominant_wavelength_m'] or 0) <= 0.25
                                         for row in mine])
    for side in ('left', 'right'):
        level = 20.0 * math.log10(medians['corrugated', side] / medians['normal', side])
        assert level > 6.0
        assert named['corrugated', side] > 0.6
        assert named['normal', side] < 0.1
