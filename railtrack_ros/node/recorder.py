"""Node `recorder`: topics into an MCAP recording as they are on the wire, and what was lost."""

from __future__ import annotations

if __name__ == '__main__':  # before the long imports: a signal may come at any time
    import sys

    from railtrack_ros.node.start import start

    sys.exit(start('recorder'))

import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from railtrack_ros.bags.mcap_file import RawMessage
from railtrack_ros.bags.message_types import LIVE
from railtrack_ros.bags.writer import Recording
from railtrack_ros.errors import InputError
from railtrack_ros.node import parameters
from railtrack_ros.node.parameters import setting
from railtrack_ros.node.runner import run, spin

NAME = 'recorder'

# Between two looks for new topics, s.
DISCOVERY_PERIOD = 0.2

# Messages of a topic which wait while a chunk is compressed and written: 10 s of 10 ms blocks.
DEPTH = 1000

SETTINGS = (
    setting('output', '', 'recording to write: NAME.mcap, or a rosbag2 folder'),
    setting('topics', '', 'names of the topics separated by spaces; empty: every topic'),
)


class Recorder:
    """Writes what is published on topics to a recording.

    Topics are taken up as they appear, with a quality of service that their publishers offer:
    reliable where all of them are. Only a best-effort publisher or a full queue can lose
    messages; the publishers' sequence numbers tell how many.

    Parameters
    ----------
    node
        The node to subscribe with.
    recording
        Where to; it stays open.
    topics
        Full names of the topics; empty for every topic that there is.
    listen
        Called with each message and what DDS says about it (times of publication and reception).

    Attributes
    ----------
    received, lost
        Number of messages by topic.
    """

    def __init__(
        self, node: Node, recording: Recording, topics: Collection[str] = (),
        listen: Callable[[RawMessage, Mapping[str, Any]], None] = lambda message, info: None,
    ) -> None:
        self.received: Counter[str] = Counter()
        self.lost: Counter[str] = Counter()
        self._node = node
        self._recording = recording
        self._topics = set(topics)
        self._listen = listen
        self._subscriptions: dict[str, Subscription] = {}
        self._refused: set[str] = set()
        self._sequence: dict[str, int] = {}
        self._timer = node.create_timer(DISCOVERY_PERIOD, self.discover)
        self.discover()

    def matched(self, topic: str) -> bool:
        """Return whether a topic is subscribed to and has a publisher."""
        subscription = self._subscriptions.get(topic)
        return subscription is not None and subscription.get_publisher_count() > 0

    def discover(self) -> None:
        """Subscribe to wanted topics that have appeared."""
        for topic, types in self._node.get_topic_names_and_types():
            if topic in self._subscriptions or topic in self._refused:
                continue
            if self._topics and topic not in self._topics:
                continue
            publishers = self._node.get_publishers_info_by_topic(topic)
            if publishers:
                self._subscribe(topic, types[0], publishers)

    def _subscribe(self, topic: str, type_name: str, publishers: list[TopicEndpointInfo]) -> None:
        try:
            message_type = LIVE.get(type_name)
        except (ImportError, AttributeError, ValueError):
            self._refused.add(topic)
            self._node.get_logger().warning(
                f'{topic} is not recorded: the message type {type_name} is not installed')
            return

        def take(data: bytes, info: Mapping[str, Any]) -> None:
            self._take(topic, type_name, data, info)

        self._subscriptions[topic] = self._node.create_subscription(
            message_type, topic, take, offered_by(publishers), raw=True)  # type: ignore[arg-type]

    def _take(self, topic: str, type_name: str, data: bytes, info: Mapping[str, Any]) -> None:
        log_time = int(info['received_timestamp']) or time.time_ns()
        self._recording.write_raw(topic, type_name, log_time, data)
        self.received[topic] += 1
        self._count_lost(topic, info.get('publication_sequence_number'))
        self._listen(RawMessage(topic, type_name, log_time, data), info)

    def _count_lost(self, topic: str, number: int | None) -> None:
        """Count gaps in the publisher's numbers; they mean nothing with several publishers."""
        if number is None or self._subscriptions[topic].get_publisher_count() != 1:
            self._sequence.pop(topic, None)
            return
        expected = self._sequence.get(topic, number)
        if expected < number < expected + 1_000_000:
            self.lost[topic] += number - expected
        self._sequence[topic] = number + 1


def offered_by(publishers: list[TopicEndpointInfo]) -> QoSProfile:
    """Return the strictest quality of service that all these publishers offer."""
    offers = [publisher.qos_profile for publisher in publishers]
    reliable = all(offer.reliability == ReliabilityPolicy.RELIABLE for offer in offers)
    latched = all(offer.durability == DurabilityPolicy.TRANSIENT_LOCAL for offer in offers)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


class RecorderNode(Node):
    """A recorder as a process of its own; it records until it is told to end."""

    def __init__(self) -> None:
        super().__init__(NAME)
        parameters.declare(self, SETTINGS, fixed=[item.name for item in SETTINGS])
        for sentence in parameters.unknown(self):
            self.get_logger().warning(sentence)

    def record(self) -> int:
        """Record; return the exit status of the process."""
        given = parameters.values(self, SETTINGS)
        if not given['output']:
            raise InputError('parameter output: name the recording to write')
        topics = [self.resolve_topic_name(name) for name in given['topics'].split()]
        with Recording(given['output'], survive=True) as recording:
            recorder = Recorder(self, recording, topics)
            try:
                self.get_logger().info(f'recording to {given["output"]}')
                return spin(self)
            finally:
                counts = ', '.join(
                    f'{topic} {count}' + (f' ({recorder.lost[topic]} lost)'
                                          if recorder.lost[topic] else '')
                    for topic, count in sorted(recorder.received.items()))
                print(f'{given["output"]}: {counts or "nothing was published"}', flush=True)


def main() -> int:
    """Run the node."""
    return run(RecorderNode, RecorderNode.record)
