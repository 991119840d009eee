"""One input topic of the estimator: raw messages in, decoded, counted, and shed when too old."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message

from railtrack_ros.bags.message_types import LIVE
from railtrack_ros.errors import InputError
from railtrack_ros.node.guard import Guard
from railtrack_ros.node.qos import SENSOR_INPUT, overridable

Info = Mapping[str, Any]

# A jump of a publisher's numbers by more than this is a new publisher, not a loss.
LARGEST_LOSS = 10**6

# Messages of a topic that are taken before the other topics have their turn.
MOST_AT_ONCE = 100


class Input:
    """A subscription of the node.

    Parameters
    ----------
    node, name, type_name
        The node, the topic and its message type.
    take
        Called with each message and what DDS says about it; InputError refuses it.
    guard
        Counts what is refused.
    qos
        Quality of service of the subscription.
    greedy
        Take with a message all that have come behind it: a round of the executor costs more
        than a small message.

    Attributes
    ----------
    topic
        Full name of the topic, after remapping.
    received, lost, shed
        Number of messages that came, that the publisher numbered and that never came, and that
        came and were thrown away by `discard_waiting`.
    """

    def __init__(self, node: Node, name: str, type_name: str,
                 take: Callable[[Any, Info], None], guard: Guard,
                 qos: QoSProfile = SENSOR_INPUT, greedy: bool = False) -> None:
        self.received = self.lost = self.shed = 0
        self._node = node
        self._take = take
        self._guard = guard
        self._greedy = greedy
        self._type = LIVE.get(type_name)
        self._next_number: int | None = None
        # As bytes: a message that cannot be decoded would otherwise vanish without a word.
        self._subscription = node.create_subscription(
            self._type, name, self._come, qos, raw=True,  # type: ignore[arg-type]
            qos_overriding_options=overridable())
        self.topic = str(self._subscription.topic_name)

    @property
    def publishers(self) -> int:
        """Number of publishers on the topic."""
        return self._subscription.get_publisher_count()

    def close(self) -> None:
        """Leave the topic."""
        self._node.destroy_subscription(self._subscription)

    def take_waiting(self) -> None:
        """Take the messages that have arrived."""
        for _ in range(MOST_AT_ONCE):
            taken = self._next()
            if taken is None:
                return
            self._receive(*taken)

    def discard_waiting(self) -> None:
        """Throw away every message that has arrived."""
        while (taken := self._next()) is not None:
            self.received += 1
            self.shed += 1
            self._count(taken[1])

    def _next(self) -> tuple[bytes, Info] | None:
        handle = self._subscription.handle
        with handle:
            taken: tuple[bytes, Info] | None = handle.take_message(
                self._subscription.msg_type, self._subscription.raw)
        return taken

    def _come(self, data: bytes, info: Info) -> None:
        """Take a message from the executor."""
        self._receive(data, info)
        if self._greedy:
            self.take_waiting()

    def _receive(self, data: bytes, info: Info) -> None:
        self.received += 1
        self._count(info)
        self._guard.call(self.topic, lambda: self._take(decoded(data, self._type), info))

    def _count(self, info: Info) -> None:
        """Count gaps in the publisher's numbers; they mean nothing with several publishers."""
        number = info.get('publication_sequence_number')
        if number is None or self.publishers != 1:
            self._next_number = None
            return
        if self._next_number is not None and 0 < number - self._next_number < LARGEST_LOSS:
            self.lost += number - self._next_number
        self._next_number = number + 1


def decoded(data: bytes, message_type: Any) -> Any:
    """Return the message in CDR bytes; InputError where they are not of that type."""
    try:
        return deserialize_message(data, message_type)
    except Exception as error:
        raise InputError(f'the bytes are not a {message_type.__name__}') from error


def arrival_ns(info: Info) -> int:
    """Return when a message arrived [ns of the system's clock]."""
    return int(info.get('received_timestamp') or 0) or time.time_ns()


def sent_ns(info: Info) -> int:
    """Return when a message was sent [ns of the sender's system clock]."""
    return int(info.get('source_timestamp') or 0) or arrival_ns(info)
