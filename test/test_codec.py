import contextlib
import math
import random
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message

from railtrack_ros.bags import codec
from railtrack_ros.bags.codec import SECOND, Status, WaveformBlock
from railtrack_ros.bags.message_types import LIVE, OFFLINE
from railtrack_ros.bags.waveform_cdr import WaveformReader, waveform_bytes
from railtrack_ros.errors import InputError

BOTH = pytest.mark.parametrize('types', [LIVE, OFFLINE], ids=['rclpy', 'rosbags'])
STAMP = 1_767_225_600_123_456_789


def block(samples=256, channels=3, position=True, rate=25600.0):
    rng = np.random.default_rng(samples)
    return WaveformBlock(
        STAMP,
        np.arange(samples) / rate,
        {f'axle{k}_left': rng.normal(size=samples).astype(np.float32) for k in range(channels)},
        1e4 + np.arange(samples) * 1e-3 if position else None,
        'base_link',
    )


def cloud(types, columns, *, offsets=None, step=None, order='<', width=None, **changes):
    """Build a point cloud by hand from (name, kind, samples), as some other program might."""
    kinds = [np.dtype(order + kind) for _, kind, _ in columns]
    ends = np.cumsum([kind.itemsize for kind in kinds])
    offsets = offsets or [int(end) - kind.itemsize for end, kind in zip(ends, kinds, strict=True)]
    names = [f'{k}' for k in range(len(columns))]
    step = step or int(ends[-1])
    layout = {'names': names, 'formats': kinds, 'offsets': offsets, 'itemsize': step}
    points = np.zeros(len(columns[0][2]), np.dtype(layout))
    for name, (_, _, samples) in zip(names, columns, strict=True):
        points[name] = samples
    field = types.get('sensor_msgs/msg/PointField')
    number = {'f4': 7, 'f8': 8, 'i4': 5}
    content = {
        'header': codec.encode_header(STAMP, 'sensor', types),
        'height': 1,
        'width': len(points) if width is None else width,
        'fields': [
            field(name=name, offset=offset, datatype=number[kind], count=1)
            for (name, kind, _), offset in zip(columns, offsets, strict=True)
        ],
        'is_bigendian': order == '>',
        'point_step': step,
        'row_step': points.nbytes,
        'data': types.octets(points.tobytes()),
        'is_dense': True,
    }
    content.update(changes)
    return types.get(codec.WAVEFORM)(**content)


T = np.arange(8) / 1000
SAMPLES = np.linspace(-1.0, 1.0, 8)
PLAIN = [('t', 'f8', T), ('a', 'f4', SAMPLES)]


def same(found, expected):
    assert found.stamp_ns == expected.stamp_ns
    assert found.frame_id == expected.frame_id
    np.testing.assert_array_equal(found.t, expected.t)
    assert list(found.channels) == list(expected.channels)
    for name, samples in expected.channels.items():
        np.testing.assert_array_equal(found.channels[name], samples)
        assert found.channels[name].dtype == np.float32
    np.testing.assert_array_equal(found.position, expected.position)


# Round trips


@BOTH
@pytest.mark.parametrize('samples', [1, 2, 255, 4096])
def test_waveform_survives_encoding(types, samples):
    expected = block(samples)
    same(codec.decode_waveform(codec.encode_waveform(expected, types)), expected)


def test_live_and_offline_messages_hold_the_same_bytes():
    live = codec.encode_waveform(block(), LIVE)
    offline = codec.encode_waveform(block(), OFFLINE)
    assert bytes(live.data) == offline.data.tobytes()
    assert len(serialize_message(live)) == len(OFFLINE.serialize(offline))


@pytest.mark.parametrize('samples', [1, 255])
def test_the_short_way_to_bytes_gives_those_of_the_message_classes(samples):
    for expected in (block(samples), block(samples, channels=2),
                     replace(block(samples), position=None, stamp_ns=-5, frame_id='Wagen ü')):
        for channel in (None, 'axle1_left'):
            if channel is not None:
                expected.channels[channel][0] = np.inf
            message = codec.encode_waveform(expected, OFFLINE)
            assert message.is_dense == (channel is None)
            assert waveform_bytes(expected) == OFFLINE.serialize(message)


def test_a_reader_of_many_messages_reads_each_as_if_it_were_the_only_one():
    reader = WaveformReader()
    blocks = [block(8), block(8), block(9), block(9, channels=2), block(9, channels=2), block(8)]
    blocks += [replace(block(8), stamp_ns=k * SECOND + 7, frame_id='x' * k) for k in range(3)]
    for number, expected in enumerate(blocks):
        expected.channels['axle1_left'][0] = number
        data = waveform_bytes(expected)
        found = reader.read(data)
        same(found, expected)
        assert not np.shares_memory(found.t, np.frombuffer(data, np.uint8))
        cut = reader.read(serialize_message(codec.encode_waveform(expected, LIVE)))
        same(cut, expected)


def test_a_reader_of_many_messages_refuses_each_damaged_one():
    reader = WaveformReader()
    good = waveform_bytes(block(16))
    same(reader.read(good), block(16))
    nanosec = good[:8] + (2 * SECOND).to_bytes(4, 'little') + good[12:]
    for bad in (good[:-20], nanosec, b'\0\0\0\0' + good[4:], good[:200] + good[204:], b''):
        with pytest.raises(InputError):
            reader.read(bad)
        same(reader.read(good), block(16))


def test_each_side_decodes_what_the_other_serialized():
    expected = block()
    live, offline = (codec.encode_waveform(expected, types) for types in (LIVE, OFFLINE))
    same(
        codec.decode_waveform(OFFLINE.deserialize(serialize_message(live), codec.WAVEFORM)),
        expected,
    )
    received = deserialize_message(OFFLINE.serialize(offline), LIVE.get(codec.WAVEFORM))
    same(codec.decode_waveform(received), expected)


def test_wire_form_is_float64_time_then_float32_channels_then_float64_position():
    message = codec.encode_waveform(block(4, channels=2), OFFLINE)
    form = [(field.name, field.offset, field.datatype, field.count) for field in message.fields]
    assert form == [('t', 0, 8, 1), ('axle0_left', 8, 7, 1), ('axle1_left', 12, 7, 1),
                    ('position', 16, 8, 1)]  # fmt: skip
    assert (message.height, message.width, message.point_step, message.row_step) == (1, 4, 24, 96)
    assert not message.is_bigendian
    assert message.is_dense


def test_is_dense_tells_of_missing_samples():
    missing = block()
    missing.channels['axle1_left'][5] = np.nan
    message = codec.encode_waveform(missing, OFFLINE)
    assert not message.is_dense
    assert np.isnan(codec.decode_waveform(message).channels['axle1_left'][5])


def test_decoded_samples_are_the_callers_own():
    message = codec.encode_waveform(block(), OFFLINE)
    found = codec.decode_waveform(message)
    before = message.data.tobytes()
    for samples in (found.t, found.position, *found.channels.values()):
        samples[:] = 0.0
    assert message.data.tobytes() == before


def test_times_of_a_block():
    half = WaveformBlock(10 * SECOND, np.array([0.5, 0.75, 1.0]), {})
    assert (half.start_ns, half.end_ns) == (10_500_000_000, 11_000_000_000)
    assert half.time_ns.tolist() == [10_500_000_000, 10_750_000_000, 11_000_000_000]
    assert half.time_step == 0.25
    assert math.isnan(block(1).time_step)


# What other programs may send


@BOTH
@pytest.mark.parametrize('order', ['<', '>'])
@pytest.mark.parametrize('time', ['f4', 'f8'])
@pytest.mark.parametrize('samples', ['f4', 'f8'])
def test_obeys_datatypes_offsets_and_byte_order(types, order, time, samples):
    columns = [('b', samples, SAMPLES), ('a', 'f4', 2 * SAMPLES), ('t', time, T)]
    message = cloud(types, columns, offsets=[20, 4, 32], step=47, order=order)
    found = codec.decode_waveform(message)
    assert list(found.channels) == ['b', 'a']
    assert found.t.dtype == np.float64
    np.testing.assert_array_equal(found.t, T.astype(time))
    np.testing.assert_array_equal(found.channels['b'], SAMPLES.astype(samples))
    np.testing.assert_array_equal(found.channels['a'], (2 * SAMPLES).astype('f4'))


def test_microsecond_clocks_are_uniform_enough():
    t = np.round(np.arange(256) / 25600, 6)
    found = codec.decode_waveform(cloud(OFFLINE, [('t', 'f8', t), ('a', 'f4', t)]))
    np.testing.assert_array_equal(found.t, t)


def test_bytes_after_the_last_point_are_no_harm():
    data = OFFLINE.octets(cloud(OFFLINE, PLAIN).data.tobytes() + b'\0\0\0\0')
    found = codec.decode_waveform(cloud(OFFLINE, PLAIN, data=data))
    assert found.samples == 8


def without_t():
    return [('a', 'f8', T), ('b', 'f4', SAMPLES)]


def time(values):
    return [('t', 'f8', values), ('a', 'f4', np.zeros(len(values)))]


def hole(at, size=64):
    return np.delete(np.arange(size + 1) / 1000, at)


MALFORMED = {
    'height': (PLAIN, {'height': 2}, 'height: 2, expected 1'),
    'no points': (PLAIN, {'width': 0, 'data': b'', 'row_step': 0}, 'width: 0'),
    'width too large': (PLAIN, {'width': 9}, 'data: 96 bytes'),
    'width absurd': (PLAIN, {'width': 2**32 - 1}, 'data: 96 bytes'),
    'width too small': (PLAIN, {'width': 7}, 'data: 96 bytes'),
    'step zero': (PLAIN, {'point_step': 0}, 'data: 96 bytes'),
    'step too small': (PLAIN, {'point_step': 11}, "'a': ends at byte 12, past point_step 11"),
    'step absurd': (PLAIN, {'point_step': 2**32 - 1}, 'data: 96 bytes'),
    'row step': (PLAIN, {'row_step': 13}, 'row_step 13'),
    'data short': (PLAIN, {'data': bytes(95)}, 'data: 95 bytes'),
    'data empty': (PLAIN, {'data': b''}, 'data: 0 bytes'),
    'no fields': (PLAIN, {'fields': []}, "field 't': missing"),
    'no t': (without_t(), {}, "field 't': missing.*fields are: a, b"),
    'no channel': ([('t', 'f8', T)], {}, 'no channel'),
    'position alone': ([('t', 'f8', T), ('position', 'f8', T)], {}, 'no channel'),
    'twice': ([*PLAIN, ('a', 'f4', SAMPLES)], {}, "'a': given twice"),
    'no name': ([*PLAIN, ('', 'f4', SAMPLES)], {}, 'without a name'),
    'integers': ([*PLAIN, ('b', 'i4', T)], {}, "'b': datatype INT32, expected FLOAT32 or"),
    't of NaN': (time(np.r_[0.0, np.nan, 2e-3]), {}, "'t': nan at sample 1"),
    't infinite': (time(np.r_[0.0, 1e-3, np.inf]), {}, "'t': inf at sample 2"),
    't constant': (time(np.zeros(8)), {}, "'t': does not increase"),
    't falling': (time(T[::-1]), {}, "'t': does not increase"),
    't unsorted': (time(T[[0, 1, 3, 2, 4, 5, 6, 7]]), {}, "'t': not uniform, sample"),
    't of the clock': (time(1.7e9 + T), {}, "'t': reaches 1.7e\\+09 s"),
    'a sample lost': (time(hole(30)), {}, "'t': not uniform.*new message"),
    'first lost': (time(hole(1)), {}, "'t': not uniform"),
    'last lost': (time(hole(63)), {}, "'t': not uniform"),
}


@BOTH
@pytest.mark.parametrize('case', MALFORMED)
def test_malformed_waveform_is_refused_naming_the_field(types, case):
    columns, changes, expected = MALFORMED[case]
    changes = dict(changes)
    if 'data' in changes:
        changes['data'] = types.octets(changes['data'])
    message = cloud(types, columns, **changes)
    with pytest.raises(InputError, match=expected):
        codec.decode_waveform(message)


@pytest.mark.parametrize(
    ('change', 'expected'),
    [
        ({'offset': 4}, "'a': offset 4 overlaps field 't'"),
        ({'offset': 2**32 - 1}, "'a': ends at byte"),
        ({'count': 2}, "'a': count 2, expected 1"),
        ({'count': 0}, "'a': count 0, expected 1"),
        ({'datatype': 0}, "'a': datatype 0"),
        ({'datatype': 200}, "'a': datatype 200"),
    ],
)
@BOTH
def test_malformed_field_is_refused(types, change, expected):
    message = cloud(types, PLAIN)
    for name, value in change.items():
        setattr(message.fields[1], name, value)
    with pytest.raises(InputError, match=expected):
        codec.decode_waveform(message)


@BOTH
def test_random_damage_ends_in_input_error_or_in_samples(types):
    """500 messages with up to three fields replaced: nothing but InputError is raised."""
    rng = random.Random(7)
    numbers = [0, 1, 2, 3, 7, 8, 11, 12, 13, 95, 96, 97, 255, 2**16, 2**31, 2**32 - 1]
    refused = 0
    for _ in range(500):
        t = rng.choice([T, T[::-1], T + 1e9, np.full(8, np.nan), np.sqrt(T)])
        message = cloud(types, [('t', rng.choice(['f4', 'f8']), t), ('a', 'f4', SAMPLES)])
        for _ in range(rng.randint(1, 3)):
            kind = rng.randrange(6)
            if kind == 0:
                name = rng.choice(['height', 'width', 'point_step', 'row_step'])
                setattr(message, name, rng.choice(numbers))
            elif kind == 1:
                field = rng.choice(message.fields) if message.fields else None
                if field is not None:
                    setattr(field, rng.choice(['offset', 'count']), rng.choice(numbers))
            elif kind == 2 and message.fields:
                rng.choice(message.fields).datatype = rng.randrange(256)
            elif kind == 3 and message.fields:
                rng.choice(message.fields).name = rng.choice(['', 't', 'a', 'position', 'ä\n'])
            elif kind == 4:
                message.data = types.octets(rng.randbytes(rng.choice([0, 1, 12, 95, 96, 97, 960])))
            else:
                message.fields = message.fields[: rng.randrange(3)]
        try:
            found = codec.decode_waveform(message)
        except InputError:
            refused += 1
        else:
            assert np.isfinite(found.t).all()
            assert all(x.shape == found.t.shape for x in found.channels.values())
    assert refused > 400


def test_random_bytes_raise_nothing_but_input_error():
    rng = random.Random(11)
    good = bytearray(OFFLINE.serialize(codec.encode_waveform(block(16), OFFLINE)))
    for _ in range(500):
        data = bytearray(good)
        for _ in range(rng.randint(1, 8)):
            data[rng.randrange(len(data))] = rng.randrange(256)
        if rng.random() < 0.5:
            del data[rng.randrange(len(data)) :]
        with contextlib.suppress(InputError):
            codec.decode_waveform(OFFLINE.deserialize(bytes(data), codec.WAVEFORM))


# Other messages


@BOTH
@pytest.mark.parametrize('stamp', [0, 1, -1, STAMP, (2**31 - 1) * SECOND + 999_999_999])
def test_stamps_survive(types, stamp):
    message = codec.encode_speed(stamp, 12, 'base_link', types)
    assert codec.decode_speed(message) == (stamp, 12.0)


def test_impossible_stamps_are_refused():
    with pytest.raises(InputError, match='outside what a ROS 2 message can hold'):
        codec.encode_speed(2**31 * SECOND, 1.0, '', OFFLINE)
    message = codec.encode_waveform(block(), OFFLINE)
    message.header.stamp.nanosec = SECOND
    with pytest.raises(InputError, match='header.stamp.nanosec'):
        codec.decode_waveform(message)


@BOTH
def test_speed_comes_from_twist_and_from_odometry(types):
    sent = codec.encode_speed(STAMP, np.float32(12.5), 'base_link', types)
    assert sent.header.frame_id == 'base_link'
    odometry = types.get(codec.ODOMETRY)
    if types is LIVE:
        message = odometry(header=sent.header)
        message.twist.twist = sent.twist
    else:
        covariant = types.get('geometry_msgs/msg/TwistWithCovariance')
        message = odometry(
            header=sent.header,
            child_frame_id='',
            pose=None,
            twist=covariant(twist=sent.twist, covariance=np.zeros(36)),
        )
    assert codec.decode_speed(sent) == codec.decode_speed(message) == (STAMP, 12.5)


@BOTH
@pytest.mark.parametrize('value', [math.nan, math.inf])
def test_speed_that_is_no_number_is_refused(types, value):
    with pytest.raises(InputError, match='twist.linear.x'):
        codec.decode_speed(codec.encode_speed(STAMP, value, '', types))


@BOTH
def test_position_survives(types):
    message = codec.encode_position(STAMP, np.float64(1234.5), 'map', types)
    assert codec.decode_position(message) == (STAMP, 1234.5)


@BOTH
def test_single_samples_are_the_vertical_acceleration(types):
    header = codec.encode_header(STAMP, 'sensor', types)
    vector = types.get('geometry_msgs/msg/Vector3')
    up = vector(x=1.0, y=2.0, z=3.0)
    still = vector(x=0.0, y=0.0, z=0.0)
    accel = types.get('geometry_msgs/msg/Accel')(linear=up, angular=still)
    stamped = types.get(codec.ACCELERATION)(header=header, accel=accel)
    imu = types.get(codec.IMU)(
        header=header,
        orientation=types.get('geometry_msgs/msg/Quaternion')(x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.zeros(9),
        angular_velocity=still,
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=up,
        linear_acceleration_covariance=np.zeros(9),
    )
    assert codec.decode_sample(stamped) == codec.decode_sample(imu) == (STAMP, 3.0)


@BOTH
def test_force_and_number_are_plain_floats(types):
    force = codec.encode_force(STAMP, np.float32(81250.0), 'base_link', types)
    assert (force.wrench.force.z, force.wrench.force.x) == (81250.0, 0.0)
    assert codec.encode_number(np.float32(0.5), types).data == 0.5
    for message in (force, codec.encode_number(3, types)):
        data = serialize_message(message) if types is LIVE else OFFLINE.serialize(message)
        assert len(data) > 8


@BOTH
def test_diagnostics_survive_the_wire(types):
    expected = [
        Status(0, 'track_estimator: inputs', 'fine', 'coach 7', {'blocks': '12'}),
        Status(2, 'axle1_left', 'dead', '', {'samples': '0', 'since': '3 s'}),
    ]
    message = codec.encode_diagnostics(STAMP, expected, types)
    if types is LIVE:
        data = serialize_message(message)
        again = deserialize_message(data, LIVE.get(codec.DIAGNOSTICS))
    else:
        data = OFFLINE.serialize(message)
        again = OFFLINE.deserialize(data, codec.DIAGNOSTICS)
    assert codec.decode_diagnostics(again) == (STAMP, expected)


def test_codec_needs_neither_ros_nor_the_bag_library():
    check = (
        'import sys, railtrack_ros.bags.codec; '
        'sys.exit(any(name in sys.modules for name in ("rclpy", "rosbags", "mcap")))'
    )
    assert subprocess.run([sys.executable, '-c', check], check=False).returncode == 0
