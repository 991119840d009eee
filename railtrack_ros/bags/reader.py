"""What a recording says, as plain data: the inputs of the estimator, and whole waveforms.

:func:`read_run` yields speed, acceleration and positions in the order of their log time, as
the live node gets them, with the memory of a few messages. :func:`read_waveforms` collects the
samples of waveform topics, such as truth and results, into arrays.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import numpy as np

from railtrack_ros.bags.bag import Bag, NoTopic, Paths, open_bag
from railtrack_ros.bags.codec import (
    ODOMETRY,
    POINT,
    TWIST,
    WAVEFORM,
    WaveformBlock,
    decode_position,
    decode_sample,
    decode_speed,
)
from railtrack_ros.bags.mcap_file import RawMessage
from railtrack_ros.bags.singles import sample_topics
from railtrack_ros.bags.writer import ACCELERATION_TOPIC, SPEED_TOPIC
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.samples import SAMPLE_BLOCK, SampleCollector

__all__ = [
    'AccelerationBlock',
    'Bag',
    'Defect',
    'OtherMessage',
    'PositionSample',
    'Run',
    'SpeedSample',
    'Waveform',
    'open_bag',
    'read_run',
    'read_waveform',
    'read_waveforms',
]

SET_POSITION = 'set_position'


@dataclass(frozen=True)
class SpeedSample:
    """A speed [m/s] at a time [ns], and the message that it came in."""

    stamp_ns: int
    speed: float
    message: RawMessage


@dataclass(frozen=True)
class AccelerationBlock:
    """A block of axle-box acceleration [m/s^2], and the message that it came in.

    gathered: it is made of single samples, whose messages have been events of their own; this is
    the one that completed it.
    """

    block: WaveformBlock
    message: RawMessage
    gathered: bool = False


@dataclass(frozen=True)
class PositionSample:
    """A track position [m] of the reference point at a time [ns], and its message."""

    stamp_ns: int
    position: float
    message: RawMessage


@dataclass(frozen=True)
class Defect:
    """A message of an input topic that cannot be used, and why: one line naming the topic."""

    reason: str
    message: RawMessage


@dataclass(frozen=True)
class OtherMessage:
    """A message of any other topic."""

    message: RawMessage


Event = SpeedSample | AccelerationBlock | PositionSample | Defect | OtherMessage


class Run:
    """The inputs of the estimator in a recording, in the order of their log time.

    Iterating yields the events; each iteration starts from the beginning.

    Attributes
    ----------
    bag
        The recording; its `notes` tell what could not be read.
    acceleration_topic, speed_topic
        The topics that are read; of single samples, what their topics have in common.
    samples
        Axle boxes by topic, where the acceleration comes in single samples; else empty.
    position_topic
        The topic that sets the track position, or None.
    start_position
        Track position [m] at the start, where the recording tells it, else None.
    """

    def __init__(
        self, bag: Bag, acceleration: str | None, speed: str | None, everything: bool,
        names: Sequence[str] | None, sample_block: float,
    ) -> None:  # fmt: skip
        self.bag = bag
        self.acceleration_topic, self.samples = acceleration_topics(bag, acceleration, names)
        self._names = tuple(names or self.samples.values())
        self._sample_block = sample_block
        self.speed_topic = speed_topic(bag, speed)
        setters = [
            topic.name
            for topic in bag.topics.values()
            if topic.type == POINT and topic.name.rsplit('/', 1)[-1] == SET_POSITION
        ]
        self.position_topic = setters[0] if len(setters) == 1 else None
        self.start_position = start_position(bag)
        self._everything = everything

    def __iter__(self) -> Iterator[Event]:
        return self.events()

    def events(self, since: int | None = None, until: int | None = None) -> Iterator[Event]:
        """Yield the events with since <= log time < until [ns], None: without that bound."""
        inputs = {self.acceleration_topic, self.speed_topic, self.position_topic, *self.samples}
        topics = None if self._everything else {topic for topic in inputs if topic}
        collector = SampleCollector(self._names, self._sample_block) if self.samples else None
        for message in self.bag.messages(topics, since, until):
            if message.topic not in inputs:
                yield OtherMessage(message)
                continue
            try:
                if collector is not None and message.topic in self.samples:
                    yield from self._sample(message, collector)
                else:
                    yield self._event(message)
            except InputError as error:
                seconds = (message.log_time - self.bag.start_time) / 1e9
                reason = str(error).removeprefix(f'{message.topic}: ')
                yield Defect(f'{message.topic}: message at {seconds:.3f} s: {reason}', message)

    def _event(self, message: RawMessage) -> Event:
        """Return what an input message says."""
        if message.topic == self.acceleration_topic:
            return AccelerationBlock(self.bag.waveform(message), message)
        content = self.bag.decode(message)
        if message.topic == self.speed_topic:
            return SpeedSample(*decode_speed(content), message)
        return PositionSample(*decode_position(content), message)

    def _sample(self, message: RawMessage, collector: SampleCollector) -> Iterator[Event]:
        """Yield a single sample, and the blocks that it completes."""
        dropped = collector.dropped
        stamp_ns, value = decode_sample(self.bag.decode(message))
        blocks = collector.add(self.samples[message.topic], stamp_ns, value)
        if collector.dropped > dropped:
            raise InputError('its stamp is not after that of the sample before it: left out')
        yield OtherMessage(message)
        for found in blocks:
            block = WaveformBlock(found.stamp_ns, found.t, found.channels)
            yield AccelerationBlock(block, message, gathered=True)

    def close(self) -> None:
        """Close the recording."""
        self.bag.close()

    def __enter__(self) -> Run:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


def read_run(
    path: Paths,
    acceleration: str | None = None,
    speed: str | None = None,
    *,
    everything: bool = False,
    names: Sequence[str] | None = None,
    sample_block: float = SAMPLE_BLOCK,
) -> Run:
    """Open a recording as the inputs of the estimator.

    Parameters
    ----------
    path
        Anything that :func:`open_bag` takes.
    acceleration, speed
        Topics to read; None for `/axle_box_acceleration` and `/speed`, or where these are not there
        the only topic of a fitting type.
    everything
        Also yield the messages of all other topics, as they are.
    names
        Axle boxes whose single samples are taken, the first of them gives the time; None: all.
    sample_block
        Single samples are gathered to blocks of about this length [s].

    Returns
    -------
    Run
        To be used in a `with` statement, and iterated over.

    Raises
    ------
    InputError
        The recording cannot be read, or a topic is not there or not to be told from others.
    """
    bag = open_bag(path)
    try:
        return Run(bag, acceleration, speed, everything, names, sample_block)
    except BaseException:
        bag.close()
        raise


def acceleration_topics(
    bag: Bag, wanted: str | None = None, names: Collection[str] | None = None
) -> tuple[str, Mapping[str, str]]:
    """Return the topic with the acceleration, or what the topics of single samples begin with.

    With the latter come the axle boxes by topic. InputError where it cannot be told.
    """
    try:
        return bag.topic(wanted, ACCELERATION_TOPIC, (WAVEFORM,), 'acceleration'), {}
    except NoTopic:
        found = sample_topics(bag, wanted, ACCELERATION_TOPIC, names)
        if found is None:
            raise
        return found


def speed_topic(bag: Bag, wanted: str | None = None) -> str:
    """Return the topic with the speed; InputError where it cannot be told."""
    return bag.topic(wanted, SPEED_TOPIC, (TWIST, ODOMETRY), 'speed')


def start_position(bag: Bag) -> float | None:
    """Return the start position [m] that is recorded with the run, or None."""
    text = bag.facts.get('start_position')
    if text is None:
        return None
    try:
        position = float(text)
    except ValueError:
        position = math.nan
    if not math.isfinite(position):
        raise InputError(f'{bag.path}: start_position {text!r}, expected a number of metres')
    return position


@dataclass(frozen=True, eq=False)
class Waveform:
    """The samples of a waveform topic.

    Attributes
    ----------
    time_ns
        (n,) int64, nanoseconds since the epoch.
    channels
        Name and samples (n,) of each channel; NaN where a message did not carry it.
    position
        (n,) float64 track position of the reference point [m], or None where there is none.
    """

    time_ns: np.ndarray
    channels: dict[str, np.ndarray]
    position: np.ndarray | None

    def time(self, origin_ns: int) -> np.ndarray:
        """Return the times (n,) in seconds after a time in nanoseconds."""
        return (self.time_ns - origin_ns) * 1e-9


def read_waveform(bag: Bag, topic: str, **limits: Any) -> Waveform:
    """Return the samples of one waveform topic; `limits` as for :func:`read_waveforms`."""
    return read_waveforms(bag, [topic], **limits)[topic]


def read_waveforms(
    bag: Bag,
    topics: Collection[str],
    *,
    time_ns: tuple[int, int] | None = None,
    position: tuple[float, float] | None = None,
    log_time: tuple[int | None, int | None] = (None, None),
) -> dict[str, Waveform]:
    """Return the samples of waveform topics, read in one go through the recording.

    Parameters
    ----------
    bag
        The open recording.
    topics
        Names of the topics.
    time_ns
        Only samples with first <= time < last, nanoseconds since the epoch.
    position
        Only samples with first <= position < last, metres; needs a topic with positions.
    log_time
        Only messages with first <= log time < last, nanoseconds since the epoch: the rest of a
        long recording is not read.

    Raises
    ------
    InputError
        A topic is not there or is not a waveform, or a message of it is damaged.
    """
    for topic in topics:
        bag.topic(topic, topic, (WAVEFORM,), 'waveform')
    blocks: dict[str, list[WaveformBlock]] = {topic: [] for topic in topics}
    for message in bag.messages(set(topics), *log_time):
        try:
            block = bag.waveform(message)
        except InputError as error:
            reason = str(error).removeprefix(f'{message.topic}: ')
            raise InputError(f'{bag.path}: {message.topic}: {reason}') from error
        chosen = np.ones(block.samples, bool)
        if time_ns is not None:
            chosen &= (block.time_ns >= time_ns[0]) & (block.time_ns < time_ns[1])
        if position is not None:
            if block.position is None:
                raise InputError(f'{bag.path}: {message.topic}: has no position')
            chosen &= (block.position >= position[0]) & (block.position < position[1])
        if chosen.all():
            blocks[message.topic].append(block)
        elif chosen.any():
            blocks[message.topic].append(_part(block, chosen))
    return {topic: _join(parts) for topic, parts in blocks.items()}


def _part(block: WaveformBlock, chosen: np.ndarray) -> WaveformBlock:
    """Return the chosen samples (n,) bool of a block."""
    return WaveformBlock(
        block.stamp_ns,
        block.t[chosen],
        {name: samples[chosen] for name, samples in block.channels.items()},
        None if block.position is None else block.position[chosen],
        block.frame_id,
    )


def _join(blocks: list[WaveformBlock]) -> Waveform:
    """Return blocks one after the other, with NaN for a channel that one of them has not."""
    if not blocks:
        return Waveform(np.empty(0, np.int64), {}, None)
    names = dict.fromkeys(name for block in blocks for name in block.channels)
    missing = np.float32(np.nan)
    channels = {
        name: np.concatenate(
            [block.channels.get(name, np.full(block.samples, missing)) for block in blocks]
        )
        for name in names
    }
    positions = [block.position for block in blocks if block.position is not None]
    return Waveform(
        np.concatenate([block.time_ns for block in blocks]),
        channels,
        np.concatenate(positions) if len(positions) == len(blocks) else None,
    )
