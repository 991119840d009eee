"""Recorded or computed messages onto topics, each at its time."""

from __future__ import annotations

import math
import queue
import struct
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Mapping
from typing import TypeVar

from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from railtrack_ros.bags.codec import SECOND
from railtrack_ros.bags.mcap_file import RawMessage
from railtrack_ros.bags.message_types import LIVE
from railtrack_ros.node.qos import STREAM, overridable

Item = TypeVar('Item')

# Messages which are read before they are due.
READ_AHEAD = 2000

# No more readers are expected when none has come for this time, s.
GATHERING = 1.0

# Between two looks at whether readers have come, s.
POLL = 0.1


def restamped(data: bytes, shift_ns: int) -> bytes:
    """Return the CDR bytes of a message that begins with a header, its stamp moved by shift_ns."""
    order = '<' if data[1] & 1 else '>'
    seconds, nanoseconds = struct.unpack_from(f'{order}iI', data, 4)
    seconds, nanoseconds = divmod(seconds * SECOND + nanoseconds + shift_ns, SECOND)
    return data[:4] + struct.pack(f'{order}iI', seconds, nanoseconds) + data[12:]


def ahead(items: Iterable[Item], limit: int = READ_AHEAD) -> Generator[Item, None, None]:
    """Yield items that a thread fetches up to `limit` ahead, so that slow reads delay nothing."""
    fetched: queue.Queue[tuple[Item | None, BaseException | None]] = queue.Queue(limit)
    left = threading.Event()

    def put(entry: tuple[Item | None, BaseException | None]) -> bool:
        while not left.is_set():
            try:
                fetched.put(entry, timeout=POLL)
                return True
            except queue.Full:
                continue
        return False

    def fetch() -> None:
        try:
            for item in items:
                if not put((item, None)):
                    return
            put((None, StopIteration()))
        except BaseException as error:
            put((None, error))

    thread = threading.Thread(target=fetch, name='read ahead')
    thread.start()
    try:
        while True:
            item, error = fetched.get()
            if isinstance(error, StopIteration):
                return
            if error is not None:
                raise error
            yield item  # type: ignore[misc]
    finally:
        left.set()
        thread.join()


class Playback:
    """Publishes messages on an absolute schedule, so that no delay adds up.

    Parameters
    ----------
    node
        Its callbacks are served while the next message is not due.
    rename
        Name on which a topic is published.
    """

    def __init__(self, node: Node, rename: Callable[[str], str] = str) -> None:
        self.node = node
        self.sent: Counter[str] = Counter()
        self.latest = 0.0  # most that a message was sent after its time, s
        self._rename = rename
        self._publishers: dict[str, Publisher] = {}
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)

    def offer(self, topic: str, type_name: str, qos: QoSProfile = STREAM) -> None:
        """Create the publisher of a topic."""
        self._publishers[topic] = self.node.create_publisher(
            LIVE.get(type_name), self._rename(topic), qos, qos_overriding_options=overridable())

    def subscribers(self, topic: str) -> int:
        """Return the number of subscriptions that are matched on a topic."""
        return self._publishers[topic].get_subscription_count()

    def wait_for_subscribers(self, wanted: Mapping[str, int], patience: float) -> bool:
        """Wait for so many subscriptions on topics; return whether they came within `patience` s.

        Then wait until no more come.
        """
        return self._wait(lambda: all(
            self.subscribers(topic) >= count for topic, count in wanted.items()), patience)

    def wait_for_any(self, patience: float) -> bool:
        """Wait for a subscription on any topic, and then until no more come."""
        return self._wait(lambda: any(map(self.subscribers, self._publishers)), patience)

    def wait_for_node(self, name: str) -> None:
        """Wait for a subscription of a node of this full name, and then until no more come."""
        parts = name.strip('/').split('/')
        wanted = ('/' + '/'.join(parts[:-1]), parts[-1])

        def subscribed() -> bool:
            return any(
                (reader.node_namespace, reader.node_name) == wanted
                for publisher in self._publishers.values()
                for reader in self.node.get_subscriptions_info_by_topic(publisher.topic_name))

        self._wait(subscribed, math.inf)

    def _wait(self, enough: Callable[[], bool], patience: float) -> bool:
        deadline = time.monotonic() + patience
        while not enough():
            if time.monotonic() > deadline:
                return False
            self.serve(POLL)
        count, since = 0, time.monotonic()
        while time.monotonic() - since < GATHERING:
            self.serve(POLL)
            now = sum(map(self.subscribers, self._publishers))
            if now != count:
                count, since = now, time.monotonic()
        return True

    def serve(self, seconds: float) -> None:
        """Serve the callbacks of the node for a time."""
        self.serve_until(time.monotonic() + seconds)

    def serve_until(self, moment: float) -> None:
        """Serve the callbacks of the node until time.monotonic() reaches `moment`."""
        while (left := moment - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=min(left, POLL))

    def play(self, messages: Iterable[RawMessage], start: float, start_ns: int, rate: float = 1.0
             ) -> None:
        """Publish messages whose topics were offered, at their log times.

        Parameters
        ----------
        messages
            In the order of their log time.
        start, start_ns
            What time.monotonic() [s] reads when a message of log time start_ns is due.
        rate
            Log time that passes in a second.
        """
        for message in messages:
            due = start + (message.log_time - start_ns) / SECOND / rate
            self.serve_until(due)
            self._publishers[message.topic].publish(message.data)
            self.sent[message.topic] += 1
            self.latest = max(self.latest, time.monotonic() - due)

    def finish(self, patience: float) -> None:
        """Wait until reliable subscribers have got everything, at most `patience` s."""
        deadline = time.monotonic() + patience
        for publisher in self._publishers.values():
            left = max(deadline - time.monotonic(), 0.0)
            publisher.wait_for_all_acked(Duration(seconds=left))
