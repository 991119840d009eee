"""A virtual measurement run as a stream of messages, and as a recording of them."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from railtrack_ros import __version__
from railtrack_ros.bags.codec import (
    SECOND,
    START_NS,
    WaveformBlock,
    encode_speed,
    encode_waveform,
)
from railtrack_ros.bags.message_types import OFFLINE, MessageTypes
from railtrack_ros.bags.writer import ACCELERATION_TOPIC, FRAME, SPEED_TOPIC, Recording
from railtrack_ros.runs.virtual_run import RunSettings, VirtualBlock, simulate_run
from railtrack_ros.track.description import Track
from railtrack_ros.vehicle.description import Vehicle

TRUTH = ('contact_force', 'rail_deflection', 'irregularity')
TRUTH_TOPICS = tuple(f'/truth/{name}' for name in TRUTH)

SPEED_RATE = 100  # Hz
# The speed sensor is already at work when the first acceleration arrives, s.
SPEED_LEAD = 0.1


@dataclass(frozen=True)
class Event:
    """A message that a measuring system sends.

    Attributes
    ----------
    due_ns
        When it is sent: a waveform at the end of its last sample period, a speed at its stamp.
    topic
        Full name.
    content
        A waveform, or a speed [m/s] at `due_ns`.
    """

    due_ns: int
    topic: str
    content: WaveformBlock | float

    def message(self, types: MessageTypes, frame_id: str = FRAME) -> Any:
        """Return the message made of the classes of `types`."""
        if isinstance(self.content, WaveformBlock):
            return encode_waveform(self.content, types)
        return encode_speed(self.due_ns, self.content, frame_id, types)


def run_events(track: Track, vehicle: Vehicle, settings: RunSettings, start_ns: int = START_NS,
               frame_id: str = FRAME) -> Iterator[Event]:
    """Yield the messages of a virtual run in the order in which they are sent.

    Parameters
    ----------
    start_ns
        Time of the first acceleration sample.

    Raises
    ------
    InputError
        The roughness does not fit the run.
    """
    waveforms = (event for block in simulate_run(track, vehicle, settings)
                 for event in _block_events(block, settings, start_ns, frame_id))
    speeds = _speed_events(settings, start_ns)
    return heapq.merge(speeds, waveforms, key=lambda event: event.due_ns)


def _block_events(block: VirtualBlock, settings: RunSettings, start_ns: int, frame_id: str
                  ) -> Iterator[Event]:
    n = block.position.size
    stamp_ns = start_ns + round(block.first / settings.sample_rate * SECOND)
    due_ns = start_ns + round((block.first + n) / settings.sample_rate * SECOND)
    t = np.arange(n) / settings.sample_rate
    yield Event(due_ns, ACCELERATION_TOPIC,
                WaveformBlock(stamp_ns, t, dict(block.acceleration), None, frame_id))
    for name, topic in zip(TRUTH, TRUTH_TOPICS, strict=True):
        channels = dict(getattr(block, name))
        yield Event(due_ns, topic, WaveformBlock(stamp_ns, t, channels, block.position, frame_id))


def _speed_events(settings: RunSettings, start_ns: int) -> Iterator[Event]:
    first = -round(SPEED_LEAD * SPEED_RATE)
    last = math.floor(settings.samples / settings.sample_rate * SPEED_RATE)
    for index in range(first, last + 1):
        stamp_ns = start_ns + round(index / SPEED_RATE * SECOND)
        yield Event(stamp_ns, SPEED_TOPIC, float(settings.speed_at(index / SPEED_RATE)))


def synthesize(track: Track, vehicle: Vehicle, settings: RunSettings, path: str | Path,
               progress: Callable[[float], None] = lambda seconds: None) -> dict[str, Any]:
    """Write a virtual measurement run with its truth as a recording.

    Parameters
    ----------
    path
        `NAME.mcap` for a single file, any other name for a rosbag2 folder.
    progress
        Called with the seconds of running that are done.

    Returns
    -------
    dict
        Figures of the run under machine-readable names.

    Raises
    ------
    InputError
        The roughness does not fit the run, or the recording cannot be written.
    """
    with Recording(path) as recording:
        recording.write_facts(run_facts(track, vehicle, settings))
        for event in run_events(track, vehicle, settings):
            recording.write(event.topic, event.message(OFFLINE), event.due_ns)
            if event.topic == ACCELERATION_TOPIC:
                progress((event.due_ns - START_NS) / SECOND)
        messages = recording.messages
    return {
        'path': str(path),
        'duration_s': settings.samples / settings.sample_rate,
        'distance_m': float(settings.position_at(settings.duration)) - settings.start_position,
        'final_speed_m_s': float(settings.speed_at(settings.duration)),
        'sample_rate_hz': settings.sample_rate,
        'axle_boxes': [box.name for box in vehicle.axle_boxes],
        'time_step_of_truth_s': 1.0 / (settings.sample_rate * settings.oversampling),
        'messages': messages,
    }


def run_facts(track: Track, vehicle: Vehicle, settings: RunSettings) -> dict[str, Any]:
    """Return what a recording says of its making, so that it can be made again."""
    parts = {'irregularity': ' '.join(part.text for part in settings.irregularity)}
    corrugations = ' '.join(str(stretch) for stretch in settings.corrugations)
    return {
        'source': f'virtual run, railtrack_ros {__version__}',
        'track': track.name,
        'vehicle': vehicle.name,
        'start_position': settings.start_position,
        'speed': settings.speed,
        'acceleration': settings.acceleration,
        'roughness': settings.roughness,
        'roughness_level_db': settings.roughness_level,
        'corrugation': corrugations,
        **(parts if settings.irregularity else {}),
        'noise': settings.noise,
        'sample_rate': settings.sample_rate,
        'seed': settings.seed,
    }
