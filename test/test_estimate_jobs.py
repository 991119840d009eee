"""Estimates by several processes and of several recordings: the same as by one, of one."""

import dataclasses
import multiprocessing

import numpy as np
import pytest

from railtrack_ros.bags import codec
from railtrack_ros.bags.codec import SECOND, START_NS, WaveformBlock
from railtrack_ros.bags.message_types import OFFLINE
from railtrack_ros.bags.reader import open_bag, read_waveforms
from railtrack_ros.bags.writer import ACCELERATION_TOPIC, Recording
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.settings import IndicatorSettings
from railtrack_ros.runs.estimate import NODE, estimate
from railtrack_ros.vehicle.description import load_vehicle


@pytest.fixture(scope='module')
def bogie():
    """Return a vehicle of two wheels on one rail."""
    coach = load_vehicle('measurement_coach')
    return dataclasses.replace(coach, name='bogie', axle_boxes=coach.on_rail('left')[:2])


@pytest.fixture(scope='module')
def long_run(tmp_path_factory):
    """Return a run of 9 s over 250 m with a gap, a dead channel and a kilometre post."""
    path = tmp_path_factory.mktemp('long') / 'run.mcap'
    rng = np.random.default_rng(5)
    rate, size = 12800.0, 128
    t = np.arange(size) / rate
    with Recording(path) as recording:
        recording.write_facts({'start_position': 20.0})
        for block in range(900):
            if 700 <= block < 705:
                continue
            stamp = START_NS + block * SECOND // 100
            speed = 22.0 + 10.0 * np.sin(0.004 * block)
            recording.write_speed(stamp, speed)
            channels = {
                name: (30.0 * rng.standard_normal(size)).astype(np.float32)
                for name in ('axle1_left', 'axle2_left')
                if name == 'axle1_left' or not 500 <= block < 530
            }
            recording.write_waveform(
                ACCELERATION_TOPIC, WaveformBlock(stamp, t, channels, None, 'train'))
            if block == 300:
                message = codec.encode_position(stamp, 95.0, 'train', OFFLINE)
                recording.write('/set_position', message, stamp)
    return path


def everything(path):
    """Messages by topic but for those of the sections, and waveforms of the results."""
    with open_bag(path) as bag:
        waves = read_waveforms(bag, [f'{NODE}/{name}' for name in (
            'contact_force', 'rail_deflection', 'irregularity')])
        others = {}
        for message in bag.messages():
            if message.topic not in waves:
                others.setdefault(message.topic, []).append((message.log_time, message.data))
        return waves, others, bag.facts, bag.notes


@pytest.mark.parametrize('jobs', [2, 3])
def test_several_processes_give_the_results_of_one(long_run, table_3_1, bogie, tmp_path, jobs):
    settings = IndicatorSettings(section_length=5.0)
    one = estimate(long_run, table_3_1, bogie, tmp_path / 'one.mcap', None, settings)
    many = estimate(long_run, table_3_1, bogie, tmp_path / 'many', None, settings, jobs=jobs)
    (waves, others, facts, _), (found, also, told, notes) = (
        everything(tmp_path / name) for name in ('one.mcap', 'many'))
    assert not notes
    assert told == facts
    bounds = {'contact_force': 1e-6 * bogie.wheel.static_load, 'rail_deflection': 1e-9,
              'irregularity': 1e-9}
    for topic, wave in waves.items():
        np.testing.assert_array_equal(found[topic].time_ns, wave.time_ns)
        np.testing.assert_array_equal(found[topic].position, wave.position)
        for name, samples in wave.channels.items():
            np.testing.assert_allclose(
                found[topic].channels[name], samples, rtol=0.0,
                atol=bounds[topic.removeprefix(f'{NODE}/')], equal_nan=True)
    for topic in ('/axle_box_acceleration', '/speed', '/set_position',
                  f'{NODE}/configuration', f'{NODE}/wheel/axle2_left/contact_force',
                  f'{NODE}/corrugation'):
        assert [time for time, _ in also[topic]] == [time for time, _ in others[topic]]
    rows = [{(s.axle_box, s.start): s for s in x.sections} for x in (one, many)]
    assert len(many.sections) == len(one.sections) > 60
    assert rows[0].keys() == rows[1].keys()
    for key, section in rows[0].items():
        np.testing.assert_allclose(rows[1][key].rms, section.rms, rtol=1e-5)  # 1e-4 dB
        assert rows[1][key].valid_fraction == section.valid_fraction
    summaries = one.summary(), many.summary()
    assert summaries[1]['defects'] == summaries[0]['defects'] == []
    assert summaries[1]['remarks'] == summaries[0]['remarks']
    assert any('gap of 0.05 s' in remark for remark in one.remarks)
    assert summaries[1]['distance_m'] == pytest.approx(summaries[0]['distance_m'])
    for name, figures in summaries[0]['axle_boxes'].items():
        assert summaries[1]['axle_boxes'][name] == pytest.approx(figures, rel=1e-6)
    health = [OFFLINE.deserialize(x['/diagnostics'][-1][1], codec.DIAGNOSTICS)
              for x in (others, also)]
    values = [[(s.name, s.message, [(v.key, v.value) for v in s.values]) for s in h.status]
              for h in health]
    assert values[1] == values[0]


def test_more_processes_than_the_run_has_room_for_do_no_harm(
        long_run, table_3_1, bogie, tmp_path):
    with open_bag(long_run) as bag, Recording(tmp_path / 'short.mcap') as recording:
        for message in bag.messages(None, None, bag.start_time + 2 * SECOND):
            recording.write_raw(message.topic, message.type, message.log_time, message.data)
    estimate(tmp_path / 'short.mcap', table_3_1, bogie, tmp_path / 'one.mcap')
    estimate(tmp_path / 'short.mcap', table_3_1, bogie, tmp_path / 'many.mcap', jobs=6)
    one, many = (everything(tmp_path / f'{name}.mcap')[0] for name in ('one', 'many'))
    for topic, wave in one.items():
        np.testing.assert_array_equal(many[topic].time_ns, wave.time_ns)
        np.testing.assert_array_equal(many[topic].channels['axle1_left'],
                                      wave.channels['axle1_left'])


def test_an_interrupted_estimate_of_several_processes_leaves_nothing(
        long_run, table_3_1, bogie, tmp_path):

    def interrupt(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        estimate(long_run, table_3_1, bogie, tmp_path / 'out.mcap', jobs=2, progress=interrupt)
    assert not list(tmp_path.iterdir())
    assert not multiprocessing.active_children()


def test_two_recordings_of_a_run_are_one(long_run, table_3_1, bogie, tmp_path):
    with open_bag(long_run) as bag:
        middle = bag.start_time + 4 * SECOND
        types = {name: topic.type for name, topic in bag.topics.items()}
        for name, since, until in (('first', None, middle), ('second', middle, None)):
            with Recording(tmp_path / f'{name}.mcap') as recording:
                if name == 'first':
                    recording.write_facts(bag.facts)
                for message in bag.messages(None, since, until):
                    recording.write_raw(
                        message.topic, types[message.topic], message.log_time, message.data)
    parts = [tmp_path / 'second.mcap', tmp_path / 'first.mcap']
    estimate(parts, table_3_1, bogie, tmp_path / 'joined.mcap')
    estimate(long_run, table_3_1, bogie, tmp_path / 'whole.mcap')
    joined, whole = (everything(tmp_path / f'{name}.mcap') for name in ('joined', 'whole'))
    assert joined[2] == whole[2]
    for topic, wave in whole[0].items():
        np.testing.assert_array_equal(joined[0][topic].position, wave.position)
        for name, samples in wave.channels.items():
            np.testing.assert_array_equal(joined[0][topic].channels[name], samples)
    with pytest.raises(InputError, match='named twice'):
        estimate([long_run, long_run], table_3_1, bogie, tmp_path / 'twice.mcap')
