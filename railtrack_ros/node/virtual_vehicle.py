"""Node `virtual_vehicle`: a measurement run over a virtual track, sent in real time."""

from __future__ import annotations

if __name__ == '__main__':  # before the long imports: a signal may come at any time
    import sys

    from railtrack_ros.node.start import start

    sys.exit(start('virtual_vehicle'))

import itertools
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import partial

from rclpy.node import Node

from railtrack_ros.bags.codec import SECOND
from railtrack_ros.bags.mcap_file import RawMessage
from railtrack_ros.bags.message_types import OFFLINE
from railtrack_ros.bags.reader import Run, read_run
from railtrack_ros.bags.writer import ACCELERATION_TOPIC, SPEED_TOPIC
from railtrack_ros.errors import InputError
from railtrack_ros.node import parameters
from railtrack_ros.node.parameters import setting
from railtrack_ros.node.playback import Playback, ahead, restamped
from railtrack_ros.node.runner import run
from railtrack_ros.parameters import NOT_NEGATIVE, POSITIVE, Range
from railtrack_ros.runs.synthesize import SPEED_LEAD, TRUTH_TOPICS, run_events
from railtrack_ros.runs.virtual_run import Corrugation, RunSettings
from railtrack_ros.track.description import load_track
from railtrack_ros.vehicle.description import load_vehicle

NAME = 'virtual_vehicle'

# Time [s] between the decision to start and the first message, and between lines of progress.
LEAD = 0.5
REPORT_PERIOD = 2.0
# Time for reliable subscribers to get the last messages, s.
PATIENCE = 5.0

SETTINGS = (
    setting('track', 'mainline_soft_pads', 'shipped track or path of a YAML file'),
    setting('vehicle', 'measurement_coach', 'shipped vehicle or path of a YAML file'),
    setting('duration', 20.0, 'length of the run', 's', POSITIVE),
    setting('speed', 25.0, 'speed at the start', 'm/s', NOT_NEGATIVE),
    setting('acceleration', 0.0, 'negative to brake', 'm/s2'),
    setting('start_position', 0.0, 'track position of the reference point at the start', 'm'),
    setting('roughness', 'iso3095', 'none, iso3095 or a CSV file'),
    setting('roughness_level', 0.0, 'gain of the roughness, -6 is half of it', 'dB',
            Range(minimum=-60.0, maximum=20.0)),
    setting('corrugation', '', 'WAVELENGTH:AMPLITUDE:FROM:TO or WAVELENGTH:AMPLITUDE:FROM:TO:RAIL '
            'in metres, several separated by spaces'),
    setting('noise', 0.3, 'white noise of the accelerometers, rms', 'm/s2', NOT_NEGATIVE),
    setting('sample_rate', 25600.0, 'sampling frequency of the accelerometers', 'Hz', POSITIVE),
    setting('block', 0.01, 'duration of a message', 's', POSITIVE),
    setting('seed', 1, 'of roughness and noise', '', NOT_NEGATIVE),
    setting('recording', '', 'bag to send instead of a computed run, with the stamps of today'),
    setting('loop', False, 'go on with the beginning at the end of the run: a computed one without '
            'a gap, a recording after a pause'),
    setting('truth', True, 'send the true forces, deflections and irregularities as well'),
    setting('subscribers', 1, 'the run starts once so many subscribe to acceleration and speed',
            '', Range(minimum=0, maximum=100)),
    setting('patience', 60.0, 'longest time to wait for them', 's', NOT_NEGATIVE),
    setting('frame_id', 'base_link', "the vehicle's frame"),
)

OF_THE_RUN = ('duration', 'speed', 'acceleration', 'start_position', 'roughness',
              'roughness_level', 'noise', 'sample_rate', 'block', 'seed')


class VirtualVehicle(Node):
    """Computes or reads a run, waits for its readers and sends it."""

    def __init__(self) -> None:
        super().__init__(NAME)
        parameters.declare(self, SETTINGS, fixed=[item.name for item in SETTINGS])
        for sentence in parameters.unknown(self):
            self.get_logger().warning(sentence)
        self._given = parameters.values(self, SETTINGS)
        self.playback = Playback(self, rename=_input_relative)

    def drive(self) -> int:
        """Do the whole work of the node; return the exit status of its process."""
        given, log = self._given, self.get_logger()
        messages: Callable[[], Iterable[RawMessage]]
        if given['recording']:
            recording = self._open(given['recording'])
            messages = partial(_recorded, recording, self._truth)
            start_ns = recording.bag.start_time
        else:
            self._offer_computed()
            computed = self._compute()
            messages, start_ns = partial(iter, computed), computed[0].log_time
            if given['loop']:
                period_ns = round(given['duration'] * SECOND)
                messages = partial(endless, computed, period_ns)
        wanted = dict.fromkeys((ACCELERATION_TOPIC, SPEED_TOPIC), given['subscribers'])
        if not self.playback.wait_for_subscribers(wanted, given['patience']):
            found = min(self.playback.subscribers(topic) for topic in wanted)
            log.warning(f'{found} of {given["subscribers"]} subscribers came within '
                        f'{given["patience"]:g} s: starting all the same')
        while True:
            self._send(messages(), start_ns)
            if not given['loop']:
                break
        self.playback.finish(PATIENCE)
        counts = ', '.join(f'{count} on {topic}' for topic, count in self.playback.sent.items())
        log.info(f'sent {counts}; at most {1e3 * self.playback.latest:.1f} ms late')
        return 0

    def _send(self, messages: Iterable[RawMessage], start_ns: int) -> None:
        self.get_logger().info('running')
        start = time.monotonic() + LEAD
        shift = self.get_clock().now().nanoseconds + round(LEAD * SECOND) - start_ns
        self.playback.play(
            (message._replace(data=restamped(message.data, shift)) for message in messages),
            start, start_ns)

    def _offer_computed(self) -> None:
        self.playback.offer(ACCELERATION_TOPIC, 'sensor_msgs/msg/PointCloud2')
        self.playback.offer(SPEED_TOPIC, 'geometry_msgs/msg/TwistStamped')
        for topic in self._truth:
            self.playback.offer(topic, 'sensor_msgs/msg/PointCloud2')

    @property
    def _truth(self) -> tuple[str, ...]:
        """Topics of the truth, if they are wanted."""
        return TRUTH_TOPICS if self._given['truth'] else ()

    def _compute(self) -> list[RawMessage]:
        """Return all messages of a computed run, ready to be sent."""
        given, log = self._given, self.get_logger()
        track, vehicle = load_track(given['track']), load_vehicle(given['vehicle'])
        settings = RunSettings(
            corrugations=tuple(Corrugation.parse(x) for x in given['corrugation'].split()),
            **{name: given[name] for name in OF_THE_RUN})
        log.info(f'computing {settings.duration:g} s of {vehicle.name} on {track.name} '
                 'with the full model')
        messages, said, begun = [], time.monotonic(), time.monotonic()
        for event in run_events(track, vehicle, settings, frame_id=given['frame_id']):
            if event.topic in TRUTH_TOPICS and not given['truth']:
                continue
            message = event.message(OFFLINE, given['frame_id'])
            messages.append(RawMessage(event.topic, message.__msgtype__, event.due_ns,
                                       OFFLINE.serialize(message)))
            if time.monotonic() - said > REPORT_PERIOD:
                said = time.monotonic()
                done = (event.due_ns - messages[0].log_time) / SECOND - SPEED_LEAD
                log.info(f'computed {max(done, 0.0):.1f} of {settings.duration:g} s')
        log.info(f'computed {settings.duration:g} s in {time.monotonic() - begun:.1f} s')
        return messages

    def _open(self, path: str) -> Run:
        """Open a recording and offer its topics."""
        recording = read_run(path)
        if recording.samples:
            raise InputError(f'{path}: holds single samples; railtrack play sends them as they are')
        for topic in _topics(recording, self._truth):
            self.playback.offer(_canonical(recording, topic), recording.bag.topics[topic].type)
        return recording


def _topics(recording: Run, truth_topics: Collection[str]) -> list[str]:
    truth = [topic for topic in truth_topics if topic in recording.bag.topics]
    return [recording.acceleration_topic, recording.speed_topic, *truth]


def _canonical(recording: Run, topic: str) -> str:
    """Return the name under which this node sends a topic of a recording."""
    names = {recording.acceleration_topic: ACCELERATION_TOPIC, recording.speed_topic: SPEED_TOPIC}
    return names.get(topic, topic)


def endless(messages: Sequence[RawMessage], period_ns: int) -> Iterator[RawMessage]:
    """Yield the messages of a run again and again, each round a period [ns] later.

    What belongs to the time before the run comes in the first round only.
    """
    first_ns = min(m.log_time for m in messages if m.topic == ACCELERATION_TOPIC)
    end_ns = max(m.log_time for m in messages if m.topic == ACCELERATION_TOPIC)
    for shift_ns in itertools.count(0, period_ns):
        for message in messages:
            if end_ns - period_ns < message.log_time <= end_ns or (
                    not shift_ns and message.log_time < first_ns):
                yield message._replace(log_time=message.log_time + shift_ns,
                                       data=restamped(message.data, shift_ns))


def _recorded(recording: Run, truth: Collection[str]) -> Iterator[RawMessage]:
    for message in ahead(recording.bag.messages(_topics(recording, truth))):
        yield message._replace(topic=_canonical(recording, message.topic))


def _input_relative(topic: str) -> str:
    """Return an input topic without its leading slash, so that a namespace applies to it."""
    return topic.lstrip('/') if topic in (ACCELERATION_TOPIC, SPEED_TOPIC) else topic


def main() -> int:
    """Run the node."""
    return run(VirtualVehicle, VirtualVehicle.drive)
