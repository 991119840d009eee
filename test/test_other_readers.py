"""Recordings read by the tools of others: JavaScript's as in browsers, rosbags and mcap."""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from railtrack_ros.bags import codec
from railtrack_ros.bags.codec import SECOND, START_NS, WaveformBlock
from railtrack_ros.bags.writer import ACCELERATION_TOPIC, Recording, join_recordings

READERS = Path(__file__).parent / 'readers'
BLOCKS, SIZE, RATE = 400, 256, 25600.0
TOPICS = {'/speed': codec.TWIST, ACCELERATION_TOPIC: codec.WAVEFORM}


def fill(recording, blocks=range(BLOCKS)):
    t = np.arange(SIZE) / RATE
    for block in blocks:
        stamp = START_NS + block * SECOND // 100
        recording.write_speed(stamp, 25.5)
        samples = np.random.default_rng(block).normal(size=SIZE).astype(np.float32)
        recording.write_waveform(
            ACCELERATION_TOPIC, WaveformBlock(stamp, t, {'a': samples, 'b': -samples}))


def written(folder):
    with Recording(folder / 'written.mcap') as recording:
        recording.write_facts({'start_position': 5.0})
        fill(recording)
    return folder / 'written.mcap'


def joined(folder):
    parts = []
    for number, blocks in enumerate((range(150), range(150, BLOCKS))):
        parts.append(folder / f'part{number}.mcap')
        with Recording(parts[-1]) as recording:
            recording.declare(TOPICS)
            if number == 0:
                recording.write_facts({'start_position': 5.0})
            fill(recording, blocks)
    join_recordings(parts, TOPICS, folder / 'joined.mcap', {'start_position': 5.0})
    return folder / 'joined.mcap'


def live(folder):
    with Recording(folder / 'live.mcap', survive=True) as recording:
        fill(recording)
    return folder / 'live.mcap'


@pytest.fixture(scope='module', params=[written, joined, live])
def file(request, tmp_path_factory):
    """Return a recording as it is written, joined of parts, or recorded live."""
    return request.param(tmp_path_factory.mktemp('file'))


@pytest.fixture(scope='module')
def javascript(tmp_path_factory):
    """Install the readers of npm; skip the test where that cannot be."""
    node, npm = shutil.which('node'), shutil.which('npm')
    if node is None or npm is None:
        pytest.skip('no node and npm')
    folder = tmp_path_factory.mktemp('readers')
    for name in ('package.json', 'read_mcap.mjs'):
        shutil.copy(READERS / name, folder)
    command = [npm, 'install', '--no-package-lock', '--no-audit', '--no-fund', '--prefer-offline']
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, timeout=120)
    except subprocess.TimeoutExpired:
        pytest.skip('npm cannot install the readers: it took too long')
    if done.returncode:
        pytest.skip(f'npm cannot install the readers: {done.stderr.decode()[-200:]}')
    return lambda path: json.loads(subprocess.run(
        [node, 'read_mcap.mjs', str(path)], cwd=folder, check=True, capture_output=True,
        timeout=60).stdout)


def test_the_javascript_reader_reads_every_message_by_the_index(javascript, file):
    found = javascript(file)
    assert found['profile'] == 'ros2'
    assert found['chunks'] > 1
    assert found['counts'] == {'/speed': BLOCKS, ACCELERATION_TOPIC: BLOCKS}
    assert found['statistics'] == 2 * BLOCKS
    assert found['ordered']
    assert found['speed'] == 25.5
    wave = found['waveform']
    assert (wave['topic'], wave['width']) == (ACCELERATION_TOPIC, SIZE)
    assert wave['fields'] == ['t', 'a', 'b']
    assert wave['t'] == [0.0, 1.0 / RATE]
    first = np.random.default_rng(0).normal(size=SIZE).astype(np.float32)[0]
    assert wave['sample'] == first


def test_rosbags_and_mcap_read_every_message(file):
    with file.open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True)
        raw = [(channel.topic, message.log_time, message.data)
               for _, channel, message in reader.iter_messages()]
    with AnyReader([file]) as bag:
        other = [(connection.topic, time, bytes(data)) for connection, time, data in bag.messages()]
        assert {x.topic: x.msgtype for x in bag.connections} == TOPICS
    assert len(raw) == 2 * BLOCKS
    assert sorted(other) == sorted(raw)


def test_a_joined_folder_is_read_by_rosbags_with_its_metadata(tmp_path):
    parts = []
    for number, blocks in enumerate((range(30), range(30, 60))):
        parts.append(tmp_path / f'{number}.mcap')
        with Recording(parts[-1]) as recording:
            recording.declare(TOPICS)
            fill(recording, blocks)
    join_recordings(parts, TOPICS, tmp_path / 'run', {'start_position': 5.0})
    assert {path.name for path in (tmp_path / 'run').iterdir()} == {'metadata.yaml', 'run_0.mcap'}
    with AnyReader([tmp_path / 'run']) as bag:
        assert bag.message_count == 120
        assert bag.start_time == START_NS
        assert {x.topic: x.msgcount for x in bag.connections} == dict.fromkeys(TOPICS, 60)
        assert sum(1 for _ in bag.messages()) == 120


def test_parts_of_different_topics_are_not_joined(tmp_path):
    for name, topics in (('a', TOPICS), ('b', dict(reversed(TOPICS.items())))):
        with Recording(tmp_path / f'{name}.mcap') as recording:
            recording.declare(topics)
            fill(recording, range(2))
    with pytest.raises(ValueError, match='declare the same topics'):
        join_recordings([tmp_path / 'a.mcap', tmp_path / 'b.mcap'], TOPICS, tmp_path / 'c.mcap', {})
    assert not (tmp_path / 'c.mcap').exists()
