"""Publishes a recording on ROS 2 topics with the clock of the recording."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from contextlib import closing
from pathlib import Path
from typing import Any

from rclpy.node import Node

from railtrack_ros.bags.codec import SECOND
from railtrack_ros.bags.message_types import LIVE
from railtrack_ros.bags.reader import Bag, open_bag
from railtrack_ros.errors import InputError
from railtrack_ros.node.client import client
from railtrack_ros.node.playback import Playback, ahead
from railtrack_ros.node.qos import RESULT

NAME = 'railtrack_player'
CLOCK = '/clock'
CLOCK_TYPE = 'rosgraph_msgs/msg/Clock'
CLOCK_RATE = 100  # Hz of wall time

# Longest time to wait for the first subscriber, and for the last messages to arrive, s.
PATIENCE = 10.0
LAST_PATIENCE = 5.0


def play(path: str | Path, rate: float = 1.0, topics: Collection[str] = (),
         say: Callable[[str], None] = lambda line: None,
         progress: Callable[[float], None] = lambda seconds: None,
         reader: str | None = None) -> dict[str, Any]:
    """Publish the messages of a recording at their log times.

    Parameters
    ----------
    path
        The recording.
    rate
        How many times as fast as it was recorded.
    topics
        Only these; all of them by default.
    say
        Called with remarks for people.
    progress
        Called with the seconds of the recording that were played.
    reader
        Full name of a node that has to subscribe first; None: any.

    Raises
    ------
    InputError
        The recording cannot be read, has no such topic or a message type that is not installed.
    """
    with open_bag(path) as bag:
        chosen = _chosen(bag, topics)
        with client(NAME) as (node, _):
            return _play(node, bag, chosen, rate, say, progress, reader)


def _chosen(bag: Bag, topics: Collection[str]) -> list[str]:
    for topic in topics:
        if topic not in bag.topics:
            raise InputError(f'{bag.path}: no topic {topic}; there are: {", ".join(bag.topics)}')
    chosen = [topic for topic in topics or bag.topics if topic != CLOCK]
    for topic in chosen:
        try:
            LIVE.get(bag.topics[topic].type)
        except (ImportError, AttributeError, ValueError):
            raise InputError(f'{bag.path}: {topic}: message type {bag.topics[topic].type!r} is '
                             'not installed; choose other topics with --topics') from None
    return chosen


def _play(node: Node, bag: Bag, topics: list[str], rate: float, say: Callable[[str], None],
          progress: Callable[[float], None], reader: str | None) -> dict[str, Any]:
    playback = Playback(node)
    for topic in topics:
        playback.offer(topic, bag.topics[topic].type)
    clock_type = LIVE.get(CLOCK_TYPE)
    time_type = LIVE.get('builtin_interfaces/msg/Time')
    clock = node.create_publisher(clock_type, CLOCK, RESULT)

    def tick(time_ns: int) -> None:
        seconds, nanoseconds = divmod(time_ns, SECOND)
        clock.publish(clock_type(clock=time_type(sec=seconds, nanosec=nanoseconds)))
        progress((time_ns - bag.start_time) / SECOND)

    if reader is not None:
        say(f'waiting until {reader} subscribes')
        playback.wait_for_node(reader)
    elif not playback.wait_for_any(PATIENCE):
        say(f'nobody has subscribed within {PATIENCE:g} s: playing all the same')
    start = time.monotonic()

    def now_ns() -> int:
        passed = (time.monotonic() - start) * rate
        return min(bag.start_time + round(passed * SECOND), bag.end_time)

    timer = node.create_timer(1.0 / CLOCK_RATE, lambda: tick(now_ns()))
    tick(bag.start_time)
    with closing(ahead(bag.messages(set(topics)))) as messages:
        playback.play(messages, start, bag.start_time, rate)
    timer.cancel()
    tick(bag.end_time)
    playback.finish(LAST_PATIENCE)
    return {
        'path': str(bag.path),
        'duration_s': (bag.end_time - bag.start_time) / SECOND,
        'rate': rate,
        'messages': dict(playback.sent),
        'latest_s': playback.latest,
    }

