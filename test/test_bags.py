import json
import random
import shutil
import signal
import subprocess
import sys
import tracemalloc
from pathlib import Path

import mcap.writer
import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from railtrack_ros.bags import codec, writer
from railtrack_ros.bags.codec import SECOND, START_NS, WaveformBlock
from railtrack_ros.bags.message_types import OFFLINE
from railtrack_ros.bags.reader import (
    AccelerationBlock,
    Defect,
    OtherMessage,
    PositionSample,
    SpeedSample,
    open_bag,
    read_run,
    read_waveform,
    read_waveforms,
)
from railtrack_ros.bags.survey import survey
from railtrack_ros.bags.writer import ACCELERATION_TOPIC, SPEED_TOPIC, Recording
from railtrack_ros.cli.main import main
from railtrack_ros.errors import InputError

RATE, SIZE, BLOCKS = 25600, 256, 100
TIMES = np.arange(SIZE) / RATE


def signal_of(name, block):
    seed = [block, *name.encode()]
    return np.random.default_rng(seed).normal(size=SIZE).astype(np.float32)


def stamp(block):
    return START_NS + round(block * SIZE / RATE * SECOND)


def acceleration(block, names=('a', 'b')):
    channels = {name: signal_of(name, block) for name in names}
    return WaveformBlock(stamp(block), TIMES, channels, None, 'base_link')


def fill(recording, blocks=range(BLOCKS), speed=25.0):
    for block in blocks:
        recording.write_speed(stamp(block), speed)
        recording.write_waveform(ACCELERATION_TOPIC, acceleration(block))


@pytest.fixture(scope='module')
def run_file(tmp_path_factory):
    path = tmp_path_factory.mktemp('bags') / 'run.mcap'
    with Recording(path) as recording:
        recording.write_facts({'start_position': 1234.5, 'source': 'test'})
        fill(recording)
    return path


def variant(path, **options):
    """Write the same run with other options of the MCAP library."""
    original = writer.Writer
    writer.Writer = lambda file: mcap.writer.Writer(file, **options)
    try:
        with Recording(path) as recording:
            fill(recording)
    finally:
        writer.Writer = original
    return path


def content(path):
    """Everything that the inputs of a recording say, as plain comparable data."""
    found = []
    with read_run(path) as run:
        for event in run:
            if isinstance(event, SpeedSample):
                found.append((event.stamp_ns, event.speed))
            elif isinstance(event, AccelerationBlock):
                samples = {name: x.tobytes() for name, x in event.block.channels.items()}
                found.append((event.block.stamp_ns, event.block.t.tobytes(), samples))
            else:
                found.append(event)
        notes = run.bag.notes
    return found, notes


def expected_content(blocks=range(BLOCKS)):
    found = []
    for block in blocks:
        samples = {name: signal_of(name, block).tobytes() for name in ('a', 'b')}
        found += [(stamp(block), 25.0), (stamp(block), TIMES.tobytes(), samples)]
    return found


# Writing


def test_file_is_read_by_the_mcap_library(run_file):
    with run_file.open('rb') as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert reader.get_header().profile == 'ros2'
        messages = list(reader.iter_messages())
        assert {record.name for record in reader.iter_metadata()} == {'railtrack'}
    assert len(messages) == 2 * BLOCKS
    assert summary.chunk_indexes
    assert all(chunk.message_index_offsets for chunk in summary.chunk_indexes)
    assert {chunk.compression for chunk in summary.chunk_indexes} == {'zstd'}
    for schema, channel, _ in messages:
        assert (schema.encoding, channel.message_encoding) == ('ros2msg', 'cdr')
        assert b'std_msgs/Header header' in schema.data
        assert channel.metadata['topic_type_hash'].startswith('RIHS01_')


@pytest.mark.parametrize('name', ['run.mcap', 'folder'])
def test_recording_is_read_by_rosbags_sample_for_sample(tmp_path, name):
    with Recording(tmp_path / name) as recording:
        fill(recording)
    with AnyReader([tmp_path / name]) as reader:
        blocks = 0
        for connection, time, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            if connection.topic == ACCELERATION_TOPIC:
                found, sent = codec.decode_waveform(message), acceleration(blocks)
                assert time == sent.end_ns
                np.testing.assert_array_equal(found.t, sent.t)
                np.testing.assert_array_equal(found.channels['b'], sent.channels['b'])
                blocks += 1
            else:
                assert connection.topic == SPEED_TOPIC
                assert codec.decode_speed(message) == (stamp(blocks), 25.0)
    assert blocks == BLOCKS


def test_folder_is_laid_out_as_ros2_bag_reindex_expects(tmp_path):
    with Recording(tmp_path / 'folder') as recording:
        recording.write_facts({'start_position': 7.0})
        fill(recording)
    assert sorted(x.name for x in (tmp_path / 'folder').iterdir()) == [
        'folder_0.mcap',
        'metadata.yaml',
    ]
    text = (tmp_path / 'folder' / 'metadata.yaml').read_text()
    assert '&' not in text  # no YAML anchors, which other readers may not know
    told = yaml.safe_load(text)['rosbag2_bagfile_information']
    last = acceleration(BLOCKS - 1).end_ns
    assert told['relative_file_paths'] == ['folder_0.mcap']
    assert told['files'][0]['path'] == 'folder_0.mcap'
    assert told['message_count'] == told['files'][0]['message_count'] == 2 * BLOCKS
    assert told['starting_time']['nanoseconds_since_epoch'] == START_NS
    assert told['duration']['nanoseconds'] == last - START_NS
    assert told['custom_data'] == {'start_position': '7.0'}
    counts = {x['topic_metadata']['name']: x['message_count']
              for x in told['topics_with_message_count']}  # fmt: skip
    assert counts == {SPEED_TOPIC: BLOCKS, ACCELERATION_TOPIC: BLOCKS}


def test_serialized_messages_are_kept_to_the_byte(run_file, tmp_path):
    with open_bag(run_file) as bag, Recording(tmp_path / 'copy.mcap', inputs=[run_file]) as copy:
        sent = list(bag.messages())
        for message in sent:
            copy.write_raw(message.topic, message.type, message.log_time, message.data)
    with open_bag(tmp_path / 'copy.mcap') as bag:
        assert list(bag.messages()) == sent


def test_same_content_gives_the_same_file(run_file, tmp_path):
    with Recording(tmp_path / 'run.mcap') as recording:
        recording.write_facts({'start_position': 1234.5, 'source': 'test'})
        fill(recording)
    assert (tmp_path / 'run.mcap').read_bytes() == run_file.read_bytes()


@pytest.mark.parametrize('name', ['run.mcap', 'folder'])
@pytest.mark.parametrize('error', [ValueError, KeyboardInterrupt])
def test_interrupted_recording_leaves_nothing(tmp_path, name, error):
    def broken():
        with Recording(tmp_path / name) as recording:
            fill(recording)
            raise error

    pytest.raises(error, broken)
    assert list(tmp_path.iterdir()) == []


def test_interrupted_recording_leaves_the_one_before(run_file, tmp_path):
    path = shutil.copy(run_file, tmp_path / 'run.mcap')
    with pytest.raises(ValueError, match='stop'), Recording(path):
        raise ValueError('stop')
    assert path.read_bytes() == run_file.read_bytes()


def test_recording_never_replaces_its_input_or_a_full_folder(run_file, tmp_path):
    with pytest.raises(InputError, match='is the input itself'):
        Recording(run_file, inputs=[run_file])
    (tmp_path / 'full').mkdir()
    (tmp_path / 'full' / 'thesis.tex').touch()
    for survive in (False, True):
        with pytest.raises(InputError, match='not empty'):
            Recording(tmp_path / 'full', survive=survive)
    with pytest.raises(InputError, match='cannot be written'):
        Recording(run_file / 'run.mcap')


def test_full_disk_is_told_and_leaves_nothing(tmp_path, monkeypatch):
    class FullDisk(mcap.writer.Writer):
        def finish(self):
            raise OSError(28, 'No space left on device')

    monkeypatch.setattr(writer, 'Writer', FullDisk)
    recording = Recording(tmp_path / 'x.mcap')
    with pytest.raises(InputError, match='x.mcap: cannot be written .No space left'):
        recording.close()
    assert list(tmp_path.iterdir()) == []


def test_closing_twice_is_closing_once(tmp_path):
    with Recording(tmp_path / 'folder') as recording:
        fill(recording)
        recording.close()
    assert content(tmp_path / 'folder') == (expected_content(), [])


def test_log_times_out_of_range_are_refused(tmp_path):
    with Recording(tmp_path / 'x.mcap') as recording:
        for time in (-1, 2**63):
            with pytest.raises(InputError, match='/speed: log time'):
                recording.write_raw('/speed', codec.TWIST, time, b'')


KILLED = """
import os, signal, sys
sys.path.insert(0, {test!r})
from test_bags import fill
from railtrack_ros.bags.writer import Recording
recording = Recording(sys.argv[1], survive=True)
recording.write_facts({{'start_position': 3.0}})
fill(recording, range(1000))
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize('name', ['live.mcap', 'live'])
def test_killed_recorder_leaves_all_but_the_last_second(tmp_path, name):
    code = KILLED.format(test=str(Path(__file__).parent))
    done = subprocess.run([sys.executable, '-c', code, str(tmp_path / name)], check=False)
    assert done.returncode == -signal.SIGKILL
    found, notes = content(tmp_path / name)
    assert found == expected_content(range(1000))[: len(found)]
    assert stamp(1000) - found[-1][0] < 1.05 * SECOND
    assert any('not a finished recording' in note for note in notes)
    with read_run(tmp_path / name) as run:
        assert run.start_position == 3.0
    assert survey(tmp_path / name).obstacles == []


def test_error_while_recording_live_keeps_what_came_before(tmp_path):
    def broken():
        with Recording(tmp_path / 'live', survive=True) as recording:
            fill(recording)
            raise KeyboardInterrupt

    pytest.raises(KeyboardInterrupt, broken)
    assert content(tmp_path / 'live') == (expected_content(), [])


# Reading


MCAP_OPTIONS = {
    'plain': {'compression': CompressionType.NONE},
    'lz4': {'compression': CompressionType.LZ4},
    'small chunks': {'chunk_size': 30_000},
    'without chunks': {'use_chunking': False},
    'without summary': {
        'index_types': IndexType.NONE,
        'repeat_channels': False,
        'repeat_schemas': False,
        'use_statistics': False,
        'use_summary_offsets': False,
    },
    'without checksums': {'enable_crcs': False},
}


@pytest.mark.parametrize('options', MCAP_OPTIONS)
def test_every_kind_of_mcap_is_read(tmp_path, options):
    path = variant(tmp_path / 'x.mcap', **MCAP_OPTIONS[options])
    assert content(path) == (expected_content(), [])


def rosbags_run(path, compression=None, plugin=StoragePlugin.SQLITE3, version=9):
    bag = RosbagsWriter(path, version=version, storage_plugin=plugin)
    if compression:
        bag.set_compression(compression, CompressionFormat.ZSTD)
    with bag:
        store = OFFLINE.store
        speed = bag.add_connection(SPEED_TOPIC, codec.TWIST, typestore=store)
        waveform = bag.add_connection(ACCELERATION_TOPIC, codec.WAVEFORM, typestore=store)
        for block in range(BLOCKS):
            sent = acceleration(block)
            message = codec.encode_speed(stamp(block), 25.0, 'base_link', OFFLINE)
            bag.write(speed, stamp(block), OFFLINE.serialize(message))
            message = codec.encode_waveform(sent, OFFLINE)
            bag.write(waveform, sent.end_ns, OFFLINE.serialize(message))
    return path


FOLDERS = {
    'sqlite': (None, StoragePlugin.SQLITE3, 8),
    'sqlite, messages compressed': (CompressionMode.MESSAGE, StoragePlugin.SQLITE3, 9),
    'sqlite, file compressed': (CompressionMode.FILE, StoragePlugin.SQLITE3, 9),
    'mcap': (None, StoragePlugin.MCAP, 9),
    'mcap, chunks compressed': (CompressionMode.STORAGE, StoragePlugin.MCAP, 8),
    'mcap, messages compressed': (CompressionMode.MESSAGE, StoragePlugin.MCAP, 9),
    'mcap, file compressed': (CompressionMode.FILE, StoragePlugin.MCAP, 9),
}


@pytest.mark.parametrize('kind', FOLDERS)
def test_every_kind_of_folder_is_read(tmp_path, kind):
    assert content(rosbags_run(tmp_path / 'run', *FOLDERS[kind])) == (expected_content(), [])


def test_bare_sqlite_file_is_read(tmp_path):
    rosbags_run(tmp_path / 'run')
    (file,) = (tmp_path / 'run').glob('*.db3')
    assert content(file)[0] == expected_content()


def split(folder):
    folder.mkdir()
    parts = []
    for k in range(12):
        with Recording(folder / f'run_{k}.mcap') as recording:
            fill(recording, range(3 * k, 3 * k + 3))
        parts.append(f'run_{k}.mcap')
    return parts


def test_cut_sqlite_file_is_read_as_far_as_it_goes(tmp_path):
    rosbags_run(tmp_path / 'run')
    (file,) = (tmp_path / 'run').glob('*.db3')
    data = file.read_bytes()
    path = tmp_path / 'cut.db3'
    path.write_bytes(data[: int(0.6 * len(data))])
    found, notes = content(path)
    assert 0.4 * BLOCKS < len(found) < 2 * BLOCKS
    assert found == expected_content()[: len(found)]
    assert any('cut off' in note and ' s, what came after is lost' in note for note in notes)
    file.write_bytes(path.read_bytes())
    assert content(tmp_path / 'run')[0] == found


def test_split_recording_is_read_in_order(tmp_path):
    folder = tmp_path / 'run'
    parts = split(folder)
    found, notes = content(folder)
    assert found == expected_content(range(36))
    assert notes == [f'{folder}: no metadata.yaml, the recording was not closed']
    listing = {
        'storage_identifier': 'mcap',
        'relative_file_paths': parts,
        'compression_mode': '',
        'compression_format': '',
    }
    text = yaml.safe_dump({'rosbag2_bagfile_information': listing})
    (folder / 'metadata.yaml').write_text(text)
    assert content(folder) == (expected_content(range(36)), [])
    (folder / 'run_3.mcap').unlink()
    with pytest.raises(InputError, match='run_3.mcap of metadata.yaml is missing'):
        open_bag(folder)


def test_messages_come_in_the_order_of_their_log_time(tmp_path):
    rng = random.Random(5)
    times = [START_NS + rng.randrange(1000) for _ in range(3000)]
    original = writer.Writer
    writer.Writer = lambda file: mcap.writer.Writer(file, chunk_size=5000)
    try:
        with Recording(tmp_path / 'x.mcap') as recording:
            for k, time in enumerate(times):
                data = OFFLINE.serialize(codec.encode_number(k, OFFLINE))
                recording.write_raw('/x', codec.FLOAT64, time, data)
    finally:
        writer.Writer = original
    with open_bag(tmp_path / 'x.mcap') as bag:
        found = [(m.log_time, int(bag.decode(m).data)) for m in bag.messages()]
    assert found == sorted((time, k) for k, time in enumerate(times))


def test_memory_does_not_grow_with_the_recording(tmp_path):
    noise = np.random.default_rng(0).bytes(100_000)
    with Recording(tmp_path / 'x.mcap') as recording:
        for k in range(400):
            recording.write_raw('/x', codec.WAVEFORM, START_NS + k, noise)
    tracemalloc.start()
    with open_bag(tmp_path / 'x.mcap') as bag:
        total = sum(len(message.data) for message in bag.messages())
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert total == 40_000_000
    assert peak < 10_000_000


# Topics


def test_topics_are_found_by_type_if_there_is_one_candidate(tmp_path):
    with Recording(tmp_path / 'x.mcap') as recording:
        odometry = OFFLINE.get(codec.ODOMETRY)
        twist = codec.encode_speed(stamp(0), 12.0, '', OFFLINE)
        pose = OFFLINE.get('geometry_msgs/msg/PoseWithCovariance')(
            pose=OFFLINE.get('geometry_msgs/msg/Pose')(
                position=OFFLINE.get('geometry_msgs/msg/Point')(x=0.0, y=0.0, z=0.0),
                orientation=OFFLINE.get('geometry_msgs/msg/Quaternion')(x=0.0, y=0.0, z=0.0, w=1.0),
            ),
            covariance=np.zeros(36),
        )
        covariant = OFFLINE.get('geometry_msgs/msg/TwistWithCovariance')
        covariant = covariant(twist=twist.twist, covariance=np.zeros(36))
        message = odometry(header=twist.header, child_frame_id='', pose=pose, twist=covariant)
        recording.write('/coach/odometry', message, stamp(0))
        recording.write_waveform('/coach/daq', acceleration(0))
        recording.write_waveform('/truth/contact_force', acceleration(0))
        recording.write_waveform('/track_estimator/irregularity', acceleration(0))
    with read_run(tmp_path / 'x.mcap') as run:
        assert (run.acceleration_topic, run.speed_topic) == ('/coach/daq', '/coach/odometry')
        assert [e.speed for e in run if isinstance(e, SpeedSample)] == [12.0]


def test_ambiguous_missing_and_wrong_topics_are_named(tmp_path, run_file):
    with Recording(tmp_path / 'two.mcap') as recording:
        recording.write_speed(stamp(0), 1.0)
        recording.write_waveform('/daq1', acceleration(0))
        recording.write_waveform('/daq2', acceleration(0))
    with pytest.raises(InputError, match='acceleration may be any of /daq1, /daq2; say which'):
        read_run(tmp_path / 'two.mcap')
    with read_run(tmp_path / 'two.mcap', 'daq2') as run:
        assert run.acceleration_topic == '/daq2'
    with pytest.raises(InputError, match=r'no topic /daq3; there are: /speed \(geometry_msgs'):
        read_run(tmp_path / 'two.mcap', 'daq3')
    with pytest.raises(InputError, match='/speed is a geometry_msgs/msg/TwistStamped, expected'):
        read_run(run_file, SPEED_TOPIC)
    with Recording(tmp_path / 'none.mcap') as recording:
        recording.write_waveform('/daq1', acceleration(0))
    with pytest.raises(InputError, match='no topic with the speed.*there are: /daq1'):
        read_run(tmp_path / 'none.mcap')


def test_run_tells_positions_defects_and_on_request_the_rest(tmp_path):
    good = codec.encode_waveform(acceleration(1), OFFLINE)
    bad = codec.encode_waveform(acceleration(2), OFFLINE)
    bad.width = 3
    with Recording(tmp_path / 'x.mcap') as recording:
        recording.write_speed(stamp(0), 10.0)
        position = codec.encode_position(stamp(0), 500.0, 'map', OFFLINE)
        recording.write('/track_estimator/set_position', position, stamp(0))
        recording.write(ACCELERATION_TOPIC, good, stamp(1))
        recording.write(ACCELERATION_TOPIC, bad, stamp(2))
        recording.write_raw(ACCELERATION_TOPIC, codec.WAVEFORM, stamp(3), b'\0\1\0\0garbage')
        recording.write_waveform('/truth/contact_force', acceleration(3))
    with read_run(tmp_path / 'x.mcap') as run:
        events = list(run)
        assert run.start_position is None
    kinds = [SpeedSample, PositionSample, AccelerationBlock, Defect, Defect]
    assert [type(event) for event in events] == kinds
    assert (events[1].stamp_ns, events[1].position) == (stamp(0), 500.0)
    assert events[3].reason.startswith('/axle_box_acceleration: message at 0.020 s: data: ')
    assert 'the bytes are not a sensor_msgs/msg/PointCloud2' in events[4].reason
    with read_run(tmp_path / 'x.mcap', everything=True) as run:
        events = list(run)
    assert [type(event) for event in events] == [*kinds, OtherMessage]
    assert events[-1].message.topic == '/truth/contact_force'


def test_start_position_comes_back_exactly(tmp_path, run_file):
    with read_run(run_file) as run:
        assert run.start_position == 1234.5
    for name in ('x.mcap', 'folder'):
        with Recording(tmp_path / name) as recording:
            recording.write_facts({'start_position': 1.0 / 3.0})
            fill(recording, range(1))
        with read_run(tmp_path / name) as run:
            assert run.start_position == 1.0 / 3.0
    with Recording(tmp_path / 'y.mcap') as recording:
        recording.write_facts({'start_position': 'here'})
        fill(recording, range(1))
    with pytest.raises(InputError, match="start_position 'here', expected a number of metres"):
        read_run(tmp_path / 'y.mcap')


# Whole waveforms


@pytest.fixture(scope='module')
def results(tmp_path_factory):
    path = tmp_path_factory.mktemp('results') / 'run.mcap'
    with Recording(path) as recording:
        for block in range(20):
            position = 100.0 + 0.25 * (block + TIMES * RATE / SIZE)
            channels = {'a': signal_of('a', block)}
            if block >= 10:
                channels['late'] = signal_of('late', block)
            waveform = WaveformBlock(stamp(block), TIMES, channels, position)
            recording.write_waveform('/truth/contact_force', waveform)
            recording.write_waveform('/force', acceleration(block))
    return path


def test_waveform_topic_comes_as_arrays(results):
    with open_bag(results) as bag:
        both = read_waveforms(bag, ['/truth/contact_force', '/force'])
    force = both['/truth/contact_force']
    np.testing.assert_array_equal(
        force.channels['a'], np.concatenate([signal_of('a', k) for k in range(20)])
    )
    assert np.isnan(force.channels['late'][: 10 * SIZE]).all()
    assert np.isfinite(force.channels['late'][10 * SIZE :]).all()
    np.testing.assert_allclose(np.diff(force.position), 0.25 / SIZE, rtol=1e-9)
    np.testing.assert_allclose(force.time(START_NS), np.arange(20 * SIZE) / RATE, atol=1e-9)
    assert both['/force'].position is None


def test_waveform_topic_is_cut_by_time_and_by_position(results):
    with open_bag(results) as bag:
        whole = read_waveform(bag, '/truth/contact_force')
        limits = (START_NS + 33_000_000, START_NS + 88_000_000)
        part = read_waveform(bag, '/truth/contact_force', time_ns=limits)
        chosen = (whole.time_ns >= limits[0]) & (whole.time_ns < limits[1])
        np.testing.assert_array_equal(part.channels['a'], whole.channels['a'][chosen])
        part = read_waveform(bag, '/truth/contact_force', position=(101.1, 102.3))
        chosen = (whole.position >= 101.1) & (whole.position < 102.3)
        assert 0 < chosen.sum() < chosen.size
        np.testing.assert_array_equal(part.position, whole.position[chosen])
        assert read_waveform(bag, '/force', time_ns=(0, 1)).time_ns.size == 0
        with pytest.raises(InputError, match='/force: has no position'):
            read_waveform(bag, '/force', position=(0.0, 1.0))
        with pytest.raises(InputError, match='no topic /truth/forse; there are'):
            read_waveform(bag, '/truth/forse')


# Damage


def test_cut_off_file_is_read_up_to_the_cut(tmp_path):
    whole = variant(tmp_path / 'x.mcap', chunk_size=30_000).read_bytes()
    kept = []
    for share in (0.3, 0.6, 0.9):
        path = tmp_path / 'cut.mcap'
        path.write_bytes(whole[: int(share * len(whole))])
        found, notes = content(path)
        assert found == expected_content()[: len(found)]
        assert len(notes) == 1
        assert 'not a finished recording' in notes[0]
        kept.append(len(found) / (2 * BLOCKS))
    np.testing.assert_allclose(kept, [0.3, 0.6, 0.9], atol=0.1)


def test_loss_is_told_in_seconds(tmp_path):
    path = variant(tmp_path / 'x.mcap', chunk_size=100_000)
    whole = path.read_bytes()
    with path.open('rb') as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    third = chunks[2]
    path.write_bytes(whole[: third.chunk_start_offset + third.chunk_length // 2])
    _, notes = content(path)
    lost = (third.message_end_time - chunks[1].message_end_time) / SECOND
    assert notes[0].endswith(f'bytes left out, {lost:.3f} s')


@pytest.mark.parametrize('summary', [True, False])
def test_bit_flip_costs_one_chunk(tmp_path, summary):
    path = variant(tmp_path / 'x.mcap', chunk_size=30_000)
    data = bytearray(path.read_bytes())
    with path.open('rb') as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    hit = chunks[len(chunks) // 2]
    data[hit.chunk_start_offset + hit.chunk_length // 2] ^= 4
    path.write_bytes(data if summary else data[:-1])
    found, notes = content(path)
    lost = [x for x in expected_content() if x not in found]
    assert [x for x in expected_content() if x in found] == found
    assert 0 < len(lost) < 20
    assert all(hit.message_start_time <= x[0] <= hit.message_end_time for x in lost)
    seconds = (hit.message_end_time - hit.message_start_time) / SECOND
    assert f'{path}: damaged at byte {hit.chunk_start_offset}, {seconds:.3f} s left out' in notes[0]


def damage(data, rng):
    """Damage a file in one of the ways in which files get damaged."""
    data = bytearray(data)
    at, kind = rng.randrange(len(data)), rng.randrange(5)
    if kind == 0:
        del data[at:]
    elif kind == 1:
        for _ in range(rng.randint(1, 4)):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    elif kind == 2:
        data[at : at + 8] = b'\xff' * len(data[at : at + 8])
    elif kind == 3:
        del data[at : at + rng.randrange(1, 3000)]
    else:
        data[at : at + 500] = rng.randbytes(len(data[at : at + 500]))
    return bytes(data)


@pytest.mark.parametrize('options', ['small chunks', 'without summary'])
def test_damaged_file_never_loses_messages_silently(tmp_path, options):
    """150 damaged files: one line of error, or a true part of the messages and a note."""
    rng = random.Random(options)
    base = {**MCAP_OPTIONS['small chunks'], **MCAP_OPTIONS[options]}
    whole = variant(tmp_path / 'x.mcap', **base).read_bytes()
    sent = expected_content()
    path = tmp_path / 'damaged.mcap'
    read = 0
    for _ in range(75):
        path.write_bytes(damage(whole, rng))
        try:
            found, notes = content(path)
        except InputError:
            continue
        read += 1
        remaining = iter(sent)
        assert all(any(x == y for y in remaining) for x in found)
        assert notes or found == sent
    assert read > 50


def test_what_is_no_recording_is_refused_in_one_line(tmp_path, run_file):
    empty = tmp_path / 'empty.mcap'
    empty.touch()
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'text.mcap').write_text('position_m,irregularity_m\n')
    (tmp_path / 'ros1.bag').write_bytes(b'#ROSBAG V2.0\n')
    (tmp_path / 'bad.db3').write_bytes(b'SQLite format 3\0' + bytes(100))
    (tmp_path / 'magic.mcap').write_bytes(run_file.read_bytes()[:8])
    with Recording(tmp_path / 'nothing.mcap'):
        pass
    bad = tmp_path / 'metadata'
    bad.mkdir()
    (bad / 'metadata.yaml').write_text('- 1')
    for name, said in {
        'nowhere.mcap': 'no such file or folder',
        'empty.mcap': 'is empty',
        'folder': 'is not a recording',
        'text.mcap': 'is not a recording',
        'ros1.bag': 'is a ROS 1 bag',
        'bad.db3': 'cannot be read',
        'magic.mcap': 'holds no messages',
        'nothing.mcap': 'holds no messages',
        'metadata': 'is not the metadata of a recording',
    }.items():
        with pytest.raises(InputError, match=said) as caught:
            open_bag(tmp_path / name)
        assert str(tmp_path / name) in str(caught.value)


# Survey and the command `info`


def gapped(path):
    with Recording(path) as recording:
        for block in (*range(50), *range(70, 100), 99, *range(100, 110)):
            recording.write_speed(stamp(block), 20.0 + 0.1 * block)
            sent = acceleration(block)
            if block == 5:
                sent.channels['b'][3:10] = np.nan
            recording.write_waveform(ACCELERATION_TOPIC, sent)
    return path


def test_survey_counts_gaps_overlaps_and_missing_samples(tmp_path):
    found = survey(gapped(tmp_path / 'x.mcap'))
    assert found.acceleration.sample_rate == pytest.approx(RATE)
    assert found.acceleration.gap_count == 1
    assert found.acceleration.gaps[0] == pytest.approx((0.5 - 1 / RATE, 0.2))
    assert found.acceleration.overlaps == 1
    assert found.acceleration.channels['a'].missing == 0
    assert found.acceleration.channels['b'].missing == 7
    assert found.acceleration.channels['b'].rms == pytest.approx(1.0, rel=0.05)
    duration = 1.1 - 1 / RATE
    assert found.acceleration.duration == pytest.approx(duration)
    # The last speed is that of the start of the last block and holds to its end.
    speed_up_to = 1.09
    distance = 20 * duration + 0.5 * 10 * speed_up_to**2 + 10.9 * (duration - speed_up_to)
    assert found.distance == pytest.approx(distance, rel=1e-6)
    assert {x.name: x.count for x in found.topics} == {SPEED_TOPIC: 91, ACCELERATION_TOPIC: 91}
    assert found.obstacles == []


def told(capsys, *arguments):
    status = main(['info', *map(str, arguments)])
    said = capsys.readouterr()
    return status, said.out, said.err


def test_info_tells_what_there_is(run_file, capsys):
    status, out, err = told(capsys, run_file)
    assert (status, err) == (0, '')
    assert '2 channels at 25600 Hz, 1.000 s in 100 blocks, no gaps' in out
    assert 'distance: 25.0 m' in out
    assert 'start_position: 1234.5' in out
    assert out.endswith('can be estimated\n')


def test_info_as_json(run_file, capsys):
    status, out, _ = told(capsys, run_file, '--json')
    found = json.loads(out)
    assert status == 0
    assert found['can_be_estimated'] is True
    assert found['start_position_m'] == 1234.5
    assert found['distance_m'] == pytest.approx(25.0, rel=1e-3)
    assert found['acceleration']['channels']['a']['samples'] == BLOCKS * SIZE
    assert [x['rate_hz'] for x in found['topics']] == pytest.approx([100.0, 100.0])


def test_info_tells_why_a_recording_cannot_be_estimated(tmp_path, capsys):
    def verdict(write):
        with Recording(tmp_path / 'x.mcap') as recording:
            write(recording)
        status, out, err = told(capsys, tmp_path / 'x.mcap')
        assert (status, err) == (0, '')
        return out.partition('cannot be estimated:\n')[2]

    def missing(recording):
        for block in range(10):
            sent = acceleration(block)
            for samples in sent.channels.values():
                samples[:] = np.nan
            recording.write_waveform(ACCELERATION_TOPIC, sent)

    def late(recording):
        fill(recording, range(10))
        recording.write_waveform('/other', acceleration(0))

    def apart(recording):
        recording.write_speed(START_NS - 9 * SECOND, 1.0)
        recording.write_waveform(ACCELERATION_TOPIC, acceleration(0))

    def only_speed(recording):
        recording.write_speed(START_NS, 1.0)

    assert 'the speed is zero throughout' in verdict(lambda x: fill(x, range(10), speed=0.0))
    assert 'no topic with the speed' in verdict(missing)
    assert 'all samples are NaN' in verdict(missing)
    assert 'no topic with the acceleration' in verdict(only_speed)
    assert 'are stamped 9 s apart' in verdict(apart)
    assert verdict(late) == ''


def test_info_tells_of_damage_and_ends_with_status_3(tmp_path, run_file, capsys):
    path = tmp_path / 'cut.mcap'
    path.write_bytes(run_file.read_bytes()[:-20])
    status, out, err = told(capsys, path)
    assert status == 3
    assert err.startswith(f'railtrack info: {path}: not a finished recording')
    assert out.endswith('can be estimated\n')
    with Recording(path) as recording:
        fill(recording, range(10))
        recording.write_raw(ACCELERATION_TOPIC, codec.WAVEFORM, stamp(10), b'\0\1\0\0')
    status, out, err = told(capsys, path)
    assert status == 3
    assert '1 of 11 messages cannot be used' in err


def test_info_of_nothing_ends_with_status_2(tmp_path, capsys):
    path = tmp_path / 'nowhere.mcap'
    assert told(capsys, path) == (2, '', f'railtrack info: {path}: no such file or folder\n')
