"""Messages to arrays and back: the one codec of the live node and the recordings.

A waveform, that is a stretch of uniformly sampled channels, travels as one
`sensor_msgs/msg/PointCloud2` with one point a sample: FLOAT64 field `t`, the seconds after
`header.stamp`, then one FLOAT32 field per channel, then for results a FLOAT64 field `position`.
Decoding obeys the fields' own offsets and datatypes and trusts nothing: whatever is wrong
with a message ends in an :class:`InputError` that names the field and what was expected.

Messages are built through `types` (:mod:`railtrack_ros.bags.message_types`) and read by
their attributes alone, so that the classes of rclpy and those of recordings both serve.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from railtrack_ros.bags.message_types import MessageTypes
from railtrack_ros.errors import InputError

WAVEFORM = 'sensor_msgs/msg/PointCloud2'
TWIST = 'geometry_msgs/msg/TwistStamped'
ODOMETRY = 'nav_msgs/msg/Odometry'
POINT = 'geometry_msgs/msg/PointStamped'
WRENCH = 'geometry_msgs/msg/WrenchStamped'
FLOAT64 = 'std_msgs/msg/Float64'
DIAGNOSTICS = 'diagnostic_msgs/msg/DiagnosticArray'
IMU = 'sensor_msgs/msg/Imu'
ACCELERATION = 'geometry_msgs/msg/AccelStamped'

SECOND = 1_000_000_000

# Recordings that are made rather than measured begin at 2026-01-01T00:00:00Z, so that the same
# call always writes the same file.
START_NS = 1_767_225_600 * SECOND

# Numbers of sensor_msgs/msg/PointField; only the two real ones carry a waveform.
DATATYPES = ('?', 'INT8', 'UINT8', 'INT16', 'UINT16', 'INT32', 'UINT32', 'FLOAT32', 'FLOAT64')
REAL = {7: 'f4', 8: 'f8'}
NUMBER_OF = {'f4': 7, 'f8': 8}

# A sample may lie this much of a sample period off the uniform grid (clocks that count in
# microseconds), and no block lasts longer than this many seconds (a clock time in `t` would).
UNIFORMITY = 0.1
LONGEST_OFFSET = 86400.0


@dataclass(frozen=True, eq=False)
class WaveformBlock:
    """A stretch of uniformly sampled channels.

    Attributes
    ----------
    stamp_ns
        Time which `t` counts from, nanoseconds since the epoch.
    t
        (n,) float64, seconds after the stamp, uniformly increasing.
    channels
        Name and samples (n,) of each channel, float32 or float64; NaN where there is no value.
    position
        (n,) float64 track position of the vehicle's reference point [m], or None.
    frame_id
        Coordinate frame that the message was stamped with.
    """

    stamp_ns: int
    t: np.ndarray
    channels: dict[str, np.ndarray]
    position: np.ndarray | None = None
    frame_id: str = ''

    @property
    def samples(self) -> int:
        """Return the number of samples."""
        return self.t.size

    @property
    def time_step(self) -> float:
        """Return the sample period [s]; NaN for a single sample."""
        return float((self.t[-1] - self.t[0]) / (self.t.size - 1)) if self.t.size > 1 else math.nan

    @property
    def start_ns(self) -> int:
        """Return the time of the first sample, nanoseconds since the epoch."""
        return self.stamp_ns + round(float(self.t[0]) * SECOND)

    @property
    def end_ns(self) -> int:
        """Return the time of the last sample, nanoseconds since the epoch."""
        return self.stamp_ns + round(float(self.t[-1]) * SECOND)

    @property
    def time_ns(self) -> np.ndarray:
        """Return the times of all samples (n,) int64, nanoseconds since the epoch."""
        return self.stamp_ns + np.rint(self.t * SECOND).astype(np.int64)


# Stamps


def decode_stamp(message: Any) -> int:
    """Return `header.stamp` in nanoseconds since the epoch."""
    try:
        seconds, nanoseconds = int(message.header.stamp.sec), int(message.header.stamp.nanosec)
    except (AttributeError, TypeError, ValueError) as error:
        raise InputError(f'header.stamp: not a time ({error})') from error
    return join_stamp(seconds, nanoseconds)


def join_stamp(seconds: int, nanoseconds: int) -> int:
    """Return a stamp in nanoseconds since the epoch."""
    if not 0 <= nanoseconds < SECOND:
        raise InputError(f'header.stamp.nanosec: {nanoseconds}, expected less than {SECOND}')
    return seconds * SECOND + nanoseconds


def split_stamp(stamp_ns: int) -> tuple[int, int]:
    """Return seconds and nanoseconds of a stamp; InputError where no message can hold it."""
    seconds, nanoseconds = divmod(int(stamp_ns), SECOND)
    if not -(2**31) <= seconds < 2**31:
        raise InputError(f'time stamp {stamp_ns} ns: outside what a ROS 2 message can hold')
    return seconds, nanoseconds


def encode_header(stamp_ns: int, frame_id: str, types: MessageTypes) -> Any:
    """Return a std_msgs/msg/Header for a time in nanoseconds since the epoch."""
    seconds, nanoseconds = split_stamp(stamp_ns)
    time = types.get('builtin_interfaces/msg/Time')(sec=seconds, nanosec=nanoseconds)
    return types.get('std_msgs/msg/Header')(stamp=time, frame_id=str(frame_id))


# Waveforms


def decode_waveform(message: Any) -> WaveformBlock:
    """Return the samples of a waveform message.

    Parameters
    ----------
    message
        A `sensor_msgs/msg/PointCloud2` of rclpy or of a recording. Its fields may stand
        in any order, at any offset, as FLOAT32 or FLOAT64, in either byte order.

    Returns
    -------
    WaveformBlock
        Own copies of the samples, in the precision they were sent in; `t` and `position`
        as float64. A field called `position` is the track position, every other a channel.

    Raises
    ------
    InputError
        The message is not a waveform: wrong height, no samples, a field twice, overlapping, of
        another datatype or outside the point, fewer or more bytes than samples, no `t`, no
        channel, or a `t` that is not finite and uniformly increasing. Nothing else is raised.
    """
    try:
        points = _points(message)
        stamp, frame_id = message.header.stamp, str(message.header.frame_id)
        seconds, nanoseconds = int(stamp.sec), int(stamp.nanosec)
    except (AttributeError, TypeError, ValueError, OverflowError, MemoryError) as error:
        raise InputError(f'not a {WAVEFORM} of samples: {error}') from error
    return block_of(points, seconds, nanoseconds, frame_id)


def block_of(points: np.ndarray, seconds: int, nanoseconds: int, frame_id: str) -> WaveformBlock:
    """Return the samples (n,) of a structured array as a block; see `decode_waveform`."""
    stamp_ns = join_stamp(seconds, nanoseconds)
    if not points.dtype.isnative:
        points = points.astype(points.dtype.newbyteorder('='))
    columns = {name: points[name].copy() for name in points.dtype.names or ()}
    t = columns.pop('t').astype(np.float64, copy=False)
    _check_times(t)
    position = columns.pop('position', None)
    if position is not None:
        position = position.astype(np.float64, copy=False)
    if not columns:
        raise InputError("fields: no channel, expected a FLOAT32 field per channel beside 't'")
    return WaveformBlock(stamp_ns, t, columns, position, frame_id)


def _points(message: Any) -> np.ndarray:
    """Return the samples of a message as a structured array that shares its memory."""
    width, step, size = int(message.width), int(message.point_step), len(message.data)
    if int(message.height) != 1:
        raise InputError(f'height: {message.height}, expected 1 (one point a sample)')
    if width < 1:
        raise InputError(f'width: {width}, expected at least one sample')
    if not 0 <= size - width * step < step or int(message.row_step) not in (0, size, width * step):
        raise InputError(
            f'data: {size} bytes, row_step {message.row_step}, expected {width * step} '
            f'(width {width} times point_step {step})'
        )
    octets = np.frombuffer(message.data, np.uint8)
    return octets[: width * step].view(waveform_layout(message))


def waveform_layout(message: Any) -> np.dtype:
    """Return the structured type of a point of a message; InputError where it is no waveform."""
    fields = tuple(
        (str(x.name), int(x.offset), int(x.datatype), int(x.count)) for x in message.fields
    )
    return _layout(fields, int(message.point_step), '>' if message.is_bigendian else '<')


@functools.lru_cache(maxsize=64)
def _layout(fields: tuple[tuple[str, int, int, int], ...], step: int, order: str) -> np.dtype:
    """Return the structured type of one point, from name, offset, datatype, count of its fields."""
    formats: dict[str, str] = {}
    offsets: list[int] = []
    for name, offset, datatype, count in fields:
        if not name:
            raise InputError('fields: a field without a name')
        if name in formats:
            raise InputError(f'field {name!r}: given twice')
        if datatype not in REAL:
            kind = DATATYPES[datatype] if 0 < datatype < len(DATATYPES) else str(datatype)
            raise InputError(f'field {name!r}: datatype {kind}, expected FLOAT32 or FLOAT64')
        if count != 1:
            raise InputError(f'field {name!r}: count {count}, expected 1')
        formats[name] = order + REAL[datatype]
        offsets.append(offset)
    end, before = 0, ''
    for offset, (name, kind) in sorted(zip(offsets, formats.items(), strict=True)):
        if offset < end:
            raise InputError(f'field {name!r}: offset {offset} overlaps field {before!r}')
        end, before = offset + int(kind[-1]), name
    if end > step:
        raise InputError(f'field {before!r}: ends at byte {end}, past point_step {step}')
    if 't' not in formats:
        found = ', '.join(formats) or 'none'
        raise InputError(f"field 't': missing (seconds after header.stamp), fields are: {found}")
    return np.dtype(
        {
            'names': list(formats),
            'formats': list(formats.values()),
            'offsets': offsets,
            'itemsize': step,
        }
    )


def _check_times(t: np.ndarray) -> None:
    """Refuse times that are not finite, small and on a uniform grid."""
    if not np.isfinite(t).all():
        bad = int(np.flatnonzero(~np.isfinite(t))[0])
        raise InputError(f"field 't': {t[bad]} at sample {bad}, expected finite seconds")
    if np.abs(t).max() > LONGEST_OFFSET:
        raise InputError(f"field 't': reaches {t[-1]:g} s, expected seconds after header.stamp")
    if t.size == 1:
        return
    step = (t[-1] - t[0]) / (t.size - 1)
    if step <= 0.0:
        raise InputError("field 't': does not increase from the first sample to the last")
    off = np.abs(t - (t[0] + step * np.arange(t.size)))
    bad = int(off.argmax())
    if off[bad] > UNIFORMITY * step:
        raise InputError(
            f"field 't': not uniform, sample {bad} lies {off[bad] / step:.2g} sample periods "
            f'off (a gap must begin a new message)'
        )


def encode_waveform(block: WaveformBlock, types: MessageTypes) -> Any:
    """Return the waveform message of a block.

    `t` is written as FLOAT64, the channels as FLOAT32 in the order they stand in, a position
    as FLOAT64 field `position`. The same arrays always give the same bytes of `data`, whichever
    `types` the message is made of; `is_dense` tells that no sample is NaN or infinite.
    """
    points = points_of(block)
    names, tracked = tuple(block.channels), block.position is not None
    return types.get(WAVEFORM)(
        header=encode_header(block.stamp_ns, block.frame_id, types),
        height=1,
        width=block.samples,
        fields=_fields(names, tracked, types),
        is_bigendian=False,
        point_step=points.itemsize,
        row_step=points.nbytes,
        data=types.octets(points.tobytes()),
        is_dense=is_dense(points, len(names)),
    )


def points_of(block: WaveformBlock) -> np.ndarray:
    """Return the samples of a block as a structured array (n,), as they stand in a message."""
    layout = _outgoing(tuple(block.channels), block.position is not None)
    points = np.empty(block.samples, layout)
    points['t'] = block.t
    for name, samples in block.channels.items():
        points[name] = samples
    if block.position is not None:
        points['position'] = block.position
    return points


@functools.lru_cache(maxsize=64)
def _outgoing(names: tuple[str, ...], tracked: bool) -> np.dtype:
    """Return the type of a point that is written."""
    columns = [('t', '<f8'), *((name, '<f4') for name in names)]
    return np.dtype([*columns, ('position', '<f8')] if tracked else columns)


@functools.lru_cache(maxsize=64)
def _fields(names: tuple[str, ...], tracked: bool, types: MessageTypes) -> list[Any]:
    """Return the fields of a message that is written."""
    layout = _outgoing(names, tracked)
    point_field = types.get('sensor_msgs/msg/PointField')
    return [
        point_field(name=name, offset=offset, datatype=NUMBER_OF[kind.str[1:]], count=1)
        for name, (kind, offset, *_) in (layout.fields or {}).items()
    ]


def is_dense(points: np.ndarray, channels: int) -> bool:
    """Return whether no value of points is NaN or infinite."""
    octets = points.view(np.uint8).reshape(points.size, -1)
    samples = octets[:, 8:8 + 4 * channels].view('<f4')
    rest = octets[:, 8 + 4 * channels:].view('<f8')
    return bool(np.isfinite(samples).all() and np.isfinite(rest).all()
                and np.isfinite(points['t']).all())


# Speed and position


def decode_speed(message: Any) -> tuple[int, float]:
    """Return stamp [ns] and speed [m/s] of a TwistStamped or an Odometry message."""
    twist = getattr(message.twist, 'twist', message.twist)
    return decode_stamp(message), _finite(twist.linear.x, 'twist.linear.x')


def encode_speed(stamp_ns: int, speed: float, frame_id: str, types: MessageTypes) -> Any:
    """Return a geometry_msgs/msg/TwistStamped with `twist.linear.x` = speed [m/s]."""
    twist = types.get('geometry_msgs/msg/Twist')(
        linear=_vector((speed, 0.0, 0.0), types), angular=_vector((0.0, 0.0, 0.0), types)
    )
    return types.get(TWIST)(header=encode_header(stamp_ns, frame_id, types), twist=twist)


def decode_position(message: Any) -> tuple[int, float]:
    """Return stamp [ns] and `point.x`, the track position [m], of a PointStamped message."""
    return decode_stamp(message), _finite(message.point.x, 'point.x')


def encode_position(stamp_ns: int, position: float, frame_id: str, types: MessageTypes) -> Any:
    """Return a geometry_msgs/msg/PointStamped with `point.x` = track position [m]."""
    point = types.get('geometry_msgs/msg/Point')(x=float(position), y=0.0, z=0.0)
    return types.get(POINT)(header=encode_header(stamp_ns, frame_id, types), point=point)


def decode_sample(message: Any) -> tuple[int, float]:
    """Return stamp [ns] and vertical acceleration [m/s^2] of an Imu or AccelStamped message.

    A value that is not finite is returned as it is: it is a missing sample.
    """
    if hasattr(message, 'linear_acceleration'):
        return decode_stamp(message), float(message.linear_acceleration.z)
    return decode_stamp(message), float(message.accel.linear.z)


def _vector(values: Sequence[float], types: MessageTypes) -> Any:
    x, y, z = (float(value) for value in values)
    return types.get('geometry_msgs/msg/Vector3')(x=x, y=y, z=z)


def _finite(value: Any, name: str) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise InputError(f'{name}: {number}, expected a finite number')
    return number


# Summaries and health


def encode_force(stamp_ns: int, force: float, frame_id: str, types: MessageTypes) -> Any:
    """Return a geometry_msgs/msg/WrenchStamped with `force.z` [N], compression positive."""
    wrench = types.get('geometry_msgs/msg/Wrench')(
        force=_vector((0.0, 0.0, force), types), torque=_vector((0.0, 0.0, 0.0), types)
    )
    return types.get(WRENCH)(header=encode_header(stamp_ns, frame_id, types), wrench=wrench)


def encode_number(value: float, types: MessageTypes) -> Any:
    """Return a std_msgs/msg/Float64."""
    return types.get(FLOAT64)(data=float(value))


@dataclass(frozen=True)
class Status:
    """One diagnostic status: level 0 OK, 1 WARN, 2 ERROR, 3 STALE, and named values."""

    level: int
    name: str
    message: str
    hardware_id: str = ''
    values: Mapping[str, str] = field(default_factory=dict)


def encode_diagnostics(
    stamp_ns: int, statuses: Sequence[Status], types: MessageTypes, frame_id: str = ''
) -> Any:
    """Return a diagnostic_msgs/msg/DiagnosticArray."""
    status_type = types.get('diagnostic_msgs/msg/DiagnosticStatus')
    pair = types.get('diagnostic_msgs/msg/KeyValue')
    # rclpy holds the level, a `byte`, as bytes of length one, recordings hold it as a number:
    # the constants of either class are of the right kind.
    levels = (status_type.OK, status_type.WARN, status_type.ERROR, status_type.STALE)
    return types.get(DIAGNOSTICS)(
        header=encode_header(stamp_ns, frame_id, types),
        status=[
            status_type(
                level=levels[status.level],
                name=status.name,
                message=status.message,
                hardware_id=status.hardware_id,
                values=[pair(key=key, value=str(text)) for key, text in status.values.items()],
            )
            for status in statuses
        ],
    )


def decode_diagnostics(message: Any) -> tuple[int, list[Status]]:
    """Return stamp [ns] and the statuses of a DiagnosticArray message."""
    return decode_stamp(message), [
        Status(
            level=ord(item.level) if isinstance(item.level, bytes) else int(item.level),
            name=item.name,
            message=item.message,
            hardware_id=item.hardware_id,
            values={pair.key: pair.value for pair in item.values},
        )
        for item in message.status
    ]
