"""Recordings whose acceleration comes in single samples, a topic for each axle box."""

import dataclasses
import json

import numpy as np
import pytest

from railtrack_ros.bags import codec
from railtrack_ros.bags.codec import ACCELERATION, IMU, SECOND, START_NS, WaveformBlock
from railtrack_ros.bags.message_types import OFFLINE
from railtrack_ros.bags.reader import open_bag, read_run, read_waveforms
from railtrack_ros.bags.writer import ACCELERATION_TOPIC, Recording
from railtrack_ros.cli.main import main
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.estimator import Estimator
from railtrack_ros.estimation.samples import SAMPLE_BLOCK, SampleCollector
from railtrack_ros.runs.estimate import NODE, estimate
from railtrack_ros.vehicle.description import load_vehicle

RATE, SECONDS, SPEED = 1000.0, 6.0, 15.0
NAMES = ('axle1_left', 'axle2_left')


@pytest.fixture(scope='module')
def bogie():
    coach = load_vehicle('measurement_coach')
    return dataclasses.replace(coach, name='bogie', axle_boxes=coach.on_rail('left')[:2])


def sample(kind, stamp_ns, value):
    """Return a message with a vertical acceleration."""
    def vector(z=0.0):
        return OFFLINE.get('geometry_msgs/msg/Vector3')(0.0, 0.0, z)

    header = codec.encode_header(stamp_ns, 'box', OFFLINE)
    if kind == ACCELERATION:
        return OFFLINE.get(kind)(
            header, OFFLINE.get('geometry_msgs/msg/Accel')(vector(value), vector()))
    return OFFLINE.get(kind)(
        header, OFFLINE.get('geometry_msgs/msg/Quaternion')(0.0, 0.0, 0.0, 1.0), np.zeros(9),
        vector(), np.zeros(9), vector(value), np.zeros(9))


def sent(lost=()):
    """Samples in the order of their arrival: name, stamp [ns], value; stamps jitter."""
    rng = np.random.default_rng(7)
    found = []
    for name in NAMES:
        for k in range(round(SECONDS * RATE)):
            if name == NAMES[0] and k in lost:
                continue
            stamp = START_NS + round(k * SECOND / RATE) + int(rng.integers(-20_000, 20_000))
            found.append((stamp + int(rng.integers(200_000)), name, stamp,
                          float(rng.standard_normal() * 5.0)))
    return sorted(found)


def write(path, kind, samples, prefix=ACCELERATION_TOPIC):
    speeds = [(START_NS + n * SECOND // 50, SPEED + 0.01 * n)
              for n in range(-5, round(50 * SECONDS))]
    with Recording(path) as recording:
        events = [(log_time, 1, name, stamp, value) for log_time, name, stamp, value in samples]
        for event in sorted([*events, *((stamp, 0, '', stamp, v) for stamp, v in speeds)]):
            log_time, is_sample, name, stamp, value = event
            if is_sample:
                recording.write(f'{prefix}/{name}', sample(kind, stamp, value), log_time)
            else:
                recording.write_speed(stamp, value)
    return path


@pytest.mark.parametrize('kind', [IMU, ACCELERATION])
def test_single_samples_give_the_results_of_the_node_to_the_last_bit(
        table_3_1, bogie, tmp_path, kind):
    samples = sent(lost=range(2500, 2520))
    run = write(tmp_path / 'run.mcap', kind, samples)
    found = estimate(run, table_3_1, bogie, tmp_path / 'out.mcap', jobs=2)
    assert any('gap of' in remark for remark in found.remarks)

    # As the node does: each sample into the collector, each block into the estimator.
    estimator, collector = Estimator(table_3_1, bogie), SampleCollector(NAMES, SAMPLE_BLOCK)
    expected = []
    with open_bag(run) as bag:
        for message in bag.messages():
            content = bag.decode(message)
            if message.topic == '/speed':
                estimator.add_speed(*codec.decode_speed(content))
                continue
            name = message.topic.rsplit('/', 1)[-1]
            for block in collector.add(name, *codec.decode_sample(content)):
                result = estimator.process(block.stamp_ns, block.t, block.channels)
                if result is not None:
                    expected.append(result)
        copied = {topic.name: topic.count for topic in bag.topics.values()}
    with open_bag(tmp_path / 'out.mcap') as bag:
        waves = read_waveforms(bag, [f'{NODE}/contact_force', f'{NODE}/irregularity'])
        assert {name: bag.topics[name].count for name in copied} == copied
    for quantity in ('contact_force', 'irregularity'):
        wave = waves[f'{NODE}/{quantity}']
        for name in NAMES:
            values = np.concatenate([getattr(block, quantity)[name] for block in expected])
            np.testing.assert_array_equal(wave.channels[name], values.astype(np.float32))
            assert np.isfinite(wave.channels[name]).mean() > 0.5
        np.testing.assert_array_equal(
            wave.position, np.concatenate([block.position for block in expected]))


def test_info_tells_rate_gap_and_channels_of_single_samples(tmp_path, capsys):
    run = write(tmp_path / 'run.mcap', IMU, sent(lost=range(2500, 2700)), '/bogie/imu')
    assert main(['info', str(run), '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    acceleration = found['acceleration']
    assert acceleration['topic'] == '/bogie/imu'
    assert acceleration['sample_rate_hz'] == pytest.approx(RATE, rel=1e-2)
    assert sorted(acceleration['channels']) == sorted(NAMES)
    assert found['can_be_estimated'] is True


def test_topics_of_single_samples_are_found_or_asked_for(tmp_path, bogie):
    path = tmp_path / 'run.mcap'
    with Recording(path) as recording:
        for prefix in ('/front', '/rear'):
            for name in (*NAMES, 'roof'):
                recording.write(f'{prefix}/{name}', sample(IMU, START_NS, 0.0), START_NS)
        recording.write_speed(START_NS, SPEED)
    with pytest.raises(InputError, match='single samples under any of /front, /rear; say which'):
        read_run(path)
    with read_run(path, 'rear', names=NAMES) as run:
        assert run.acceleration_topic == '/rear'
        assert run.samples == {f'/rear/{name}': name for name in NAMES}
    with pytest.raises(InputError, match='no topic with the acceleration'):
        read_run(path, names=['other'])
    with pytest.raises(InputError, match='no topic /middle'):
        read_run(path, 'middle')
    with Recording(path) as recording:
        for name in NAMES:
            recording.write(f'/imu/{name}', sample(IMU, START_NS, 0.0), START_NS)
        t = np.arange(100) / 10e3
        block = WaveformBlock(START_NS, t, {NAMES[0]: t})
        recording.write_waveform('/waves', block)
        recording.write_speed(START_NS, SPEED)
    with read_run(path) as run:
        assert (run.acceleration_topic, run.samples) == ('/waves', {})


def test_samples_that_come_back_in_time_are_left_out_and_told(table_3_1, bogie, tmp_path):
    samples = sent()
    log_time, name, stamp, value = samples[3000]
    run = write(tmp_path / 'run.mcap', IMU,
                sorted([*samples, (log_time + 5_000_000, name, stamp, value)]))
    found = estimate(run, table_3_1, bogie, tmp_path / 'out.mcap')
    assert len(found.defects) == 1
    assert 'not after that of the sample before it' in found.defects[0]
