"""What a recording holds, and whether it can be estimated."""

from __future__ import annotations

import array
import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from railtrack_ros.bags.bag import Paths, open_bag
from railtrack_ros.bags.codec import SECOND, WaveformBlock, decode_sample, decode_speed
from railtrack_ros.bags.reader import acceleration_topics, speed_topic, start_position
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.samples import SAMPLE_BLOCK, SampleCollector

# A block that begins more than this many sample periods off its place is not the next one.
CONTINUITY = 0.5
SAME_RATE = 1e-3
KEPT = 20  # gaps and defects that are listed one by one


@dataclass
class TopicSurvey:
    """A topic: type, number of messages, rate [Hz] between the first and the last of them."""

    name: str
    type: str
    count: int = 0
    first_ns: int = 0
    last_ns: int = 0

    @property
    def rate(self) -> float:
        """Return the mean rate of messages [Hz], NaN where there are too few to tell."""
        span = (self.last_ns - self.first_ns) / SECOND
        return (self.count - 1) / span if span > 0.0 else math.nan

    def add(self, log_time: int) -> None:
        """Count a message."""
        self.first_ns = log_time if self.count == 0 else min(self.first_ns, log_time)
        self.last_ns = max(self.last_ns, log_time)
        self.count += 1


@dataclass
class ChannelSurvey:
    """A channel: samples, how many of them are missing, sum of squares and largest value."""

    samples: int = 0
    missing: int = 0
    squares: float = 0.0
    peak: float = 0.0

    def add(self, samples: np.ndarray) -> None:
        """Count the samples of a block."""
        known = samples[np.isfinite(samples)].astype(np.float64)
        self.samples += samples.size
        self.missing += samples.size - known.size
        if known.size:
            self.squares += float(known @ known)
            self.peak = max(self.peak, float(np.abs(known).max()))

    @property
    def rms(self) -> float:
        """Return the root mean square [m/s^2], NaN without a sample."""
        known = self.samples - self.missing
        return math.sqrt(self.squares / known) if known else math.nan


@dataclass
class AccelerationSurvey:
    """The acceleration topic, followed block by block."""

    topic: str
    blocks: int = 0
    samples: int = 0
    sample_rate: float = math.nan
    rate_changes: int = 0
    channels: dict[str, ChannelSurvey] = field(default_factory=dict)
    gaps: list[tuple[float, float]] = field(default_factory=list)
    gap_count: int = 0
    gap_seconds: float = 0.0
    overlaps: int = 0
    start_ns: int = 0
    end_ns: int = 0

    def add(self, block: WaveformBlock) -> None:
        """Follow the stream by one block."""
        step = block.time_step
        if not math.isnan(step):
            if math.isnan(self.sample_rate):
                self.sample_rate = 1.0 / step
            elif abs(step * self.sample_rate - 1.0) > max(SAME_RATE, CONTINUITY / block.samples):
                self.rate_changes += 1
                self.sample_rate = 1.0 / step
        if self.blocks == 0:
            self.start_ns = block.start_ns
        elif not math.isnan(self.sample_rate):
            off = (block.start_ns - self.end_ns) / SECOND - 1.0 / self.sample_rate
            if off > CONTINUITY / self.sample_rate:
                self.gap_count += 1
                self.gap_seconds += off
                if len(self.gaps) < KEPT:
                    self.gaps.append(((self.end_ns - self.start_ns) / SECOND, off))
            elif off < -CONTINUITY / self.sample_rate:
                self.overlaps += 1
        self.end_ns = block.end_ns
        self.blocks += 1
        self.samples += block.samples
        for name, samples in block.channels.items():
            self.channels.setdefault(name, ChannelSurvey()).add(samples)

    @property
    def duration(self) -> float:
        """Return the time from the first to the last sample [s]."""
        return (self.end_ns - self.start_ns) / SECOND


@dataclass
class SpeedSurvey:
    """The speed topic: stamps [ns] and speeds [m/s] of all its messages."""

    topic: str
    stamps: array.array[int] = field(default_factory=lambda: array.array('q'))
    speeds: array.array[float] = field(default_factory=lambda: array.array('d'))

    def add(self, stamp_ns: int, speed: float) -> None:
        """Take a message."""
        self.stamps.append(stamp_ns)
        self.speeds.append(speed)

    @property
    def count(self) -> int:
        """Return the number of messages."""
        return len(self.speeds)

    def distance(self, start_ns: int, end_ns: int) -> float:
        """Return the distance [m] run from one time to another, the speed linear in between."""
        order = np.argsort(self.stamps, kind='stable')
        times = (np.array(self.stamps)[order] - start_ns) / SECOND
        end = (end_ns - start_ns) / SECOND
        grid = np.unique(np.concatenate(([0.0, end], times[(times > 0.0) & (times < end)])))
        speeds = np.abs(np.interp(grid, times, np.array(self.speeds)[order]))
        return float(np.sum(0.5 * (speeds[1:] + speeds[:-1]) * np.diff(grid)))


@dataclass
class Survey:
    """What a recording holds.

    Attributes
    ----------
    topics
        All topics.
    start_ns, end_ns
        Log times [ns] of the first and the last message.
    acceleration, speed
        The inputs of the estimator, None where they are missing.
    distance
        Way [m] that was run while acceleration was recorded, NaN where it cannot be told.
    start_position
        Track position [m] of the first sample where the recording tells it.
    facts
        What else the recording says of the run.
    obstacles
        Why it cannot be estimated; empty if it can.
    defects
        What is damaged, a line each.
    """

    path: Path
    topics: list[TopicSurvey]
    start_ns: int
    end_ns: int
    acceleration: AccelerationSurvey | None = None
    speed: SpeedSurvey | None = None
    distance: float = math.nan
    start_position: float | None = None
    facts: dict[str, str] = field(default_factory=dict)
    obstacles: list[str] = field(default_factory=list)
    defects: list[str] = field(default_factory=list)


def survey(
    path: Paths,
    acceleration: str | None = None,
    speed: str | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Survey:
    """Read a recording through once and tell what it holds.

    Parameters
    ----------
    path
        Anything that `open_bag` takes.
    acceleration, speed
        Topics of the inputs, None to find them; a missing one is an obstacle here.
    progress
        Called now and then with the number of messages read and that of all messages.

    Raises
    ------
    InputError
        Nothing of the recording can be read.
    """
    with open_bag(path) as bag:
        topics = {x.name: TopicSurvey(x.name, x.type) for x in bag.topics.values()}
        found = Survey(bag.path, list(topics.values()), bag.start_time, bag.end_time)
        found.start_position, found.facts = start_position(bag), bag.facts
        singles: Mapping[str, str] = {}
        try:
            topic, singles = acceleration_topics(bag, acceleration)
            found.acceleration = AccelerationSurvey(topic)
        except InputError as error:
            found.obstacles.append(str(error))
        try:
            found.speed = SpeedSurvey(speed_topic(bag, speed))
        except InputError as error:
            found.obstacles.append(str(error))
        samples = SampleCollector(tuple(singles.values()), SAMPLE_BLOCK)
        unusable: Counter[str] = Counter()
        for done, message in enumerate(bag.messages()):
            topics[message.topic].add(message.log_time)
            try:
                if found.acceleration and message.topic == found.acceleration.topic:
                    found.acceleration.add(bag.waveform(message))
                elif found.acceleration and message.topic in singles:
                    sample = decode_sample(bag.decode(message))
                    for block in samples.add(singles[message.topic], *sample):
                        found.acceleration.add(
                            WaveformBlock(block.stamp_ns, block.t, block.channels))
                elif found.speed and message.topic == found.speed.topic:
                    found.speed.add(*decode_speed(bag.decode(message)))
            except InputError as error:
                unusable[message.topic] += 1
                if unusable[message.topic] == 1:
                    reason = str(error).removeprefix(f'{message.topic}: ')
                    found.defects.append(f'{bag.path}: {message.topic}: {reason}')
            if done % 1000 == 0:
                progress(done, bag.message_count)
        for topic, count in unusable.items():
            found.defects.append(
                f'{bag.path}: {topic}: {count} of {topics[topic].count} messages cannot be used'
            )
        found.defects.extend(bag.notes)
    _judge(found)
    return found


def _judge(found: Survey) -> None:
    """Tell what keeps the recording from being estimated."""
    acceleration, speed = found.acceleration, found.speed
    if acceleration and not acceleration.blocks:
        found.obstacles.append(f'{acceleration.topic}: no usable message')
    elif acceleration and all(x.missing == x.samples for x in acceleration.channels.values()):
        found.obstacles.append(f'{acceleration.topic}: all samples are NaN')
    elif acceleration and math.isnan(acceleration.sample_rate):
        found.obstacles.append(f'{acceleration.topic}: the sample rate cannot be told')
    if speed and not speed.count:
        found.obstacles.append(f'{speed.topic}: no usable message')
    elif speed and not any(speed.speeds):
        found.obstacles.append(f'{speed.topic}: the speed is zero throughout')
    if acceleration and speed and acceleration.blocks and speed.count:
        found.distance = speed.distance(acceleration.start_ns, acceleration.end_ns)
        apart = max(
            acceleration.start_ns - max(speed.stamps), min(speed.stamps) - acceleration.end_ns
        )
        if apart > SECOND:
            found.obstacles.append(
                f'{speed.topic} and {acceleration.topic} are stamped {apart / SECOND:.3g} s apart'
            )
