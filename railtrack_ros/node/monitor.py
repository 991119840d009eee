"""What `railtrack monitor` knows: the newest numbers of an estimator, and listens for them."""

from __future__ import annotations

import math
import re
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from railtrack_ros.bags import codec
from railtrack_ros.bags.codec import Status
from railtrack_ros.bags.message_types import LIVE
from railtrack_ros.node.client import client
from railtrack_ros.node.qos import RESULT

NAME = 'railtrack_monitor'

# Numbers that are kept of each axle box for the sparklines.
KEPT = 40
# A look for topics that have appeared, every so many seconds.
DISCOVERY_PERIOD = 1.0
# Without a message for so long [s], what is shown is old.
STALE = 3.0

FORCE = re.compile(r'/wheel/(?P<box>[^/]+)/contact_force$')
BAND = re.compile(r'/wheel/(?P<box>[^/]+)/rms_(?P<band>\d+_\d+)$')


@dataclass
class BoxView:
    """Contact forces [N] of an axle box, the newest last, and RMS [um] by band."""

    forces: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT))
    bands: dict[str, deque[float]] = field(default_factory=dict)


@dataclass
class View:
    """What is known of an estimator.

    boxes: by axle box. parts: newest status by part. corrugation: newest section by axle box.
    heard: monotonic time [s] of the last message.
    """

    node: str
    boxes: dict[str, BoxView] = field(default_factory=dict)
    parts: dict[str, Status] = field(default_factory=dict)
    corrugation: dict[str, Status] = field(default_factory=dict)
    heard: float = -math.inf

    @property
    def stale(self) -> bool:
        """Whether nothing has come for a while."""
        return time.monotonic() - self.heard > STALE

    @property
    def level(self) -> int:
        """The worst level of all parts, 3 where nothing is known or it is old."""
        if not self.parts or self.stale:
            return 3
        return max(status.level for status in self.parts.values())

    def summary(self) -> dict[str, Any]:
        """Return the newest numbers under machine-readable names."""
        return {
            'node': self.node,
            'level': ('OK', 'WARN', 'ERROR', 'STALE')[self.level],
            'axle_boxes': {
                name: {
                    'contact_force_n': box.forces[-1] if box.forces else None,
                    **{f'rms_{band}_um': values[-1] for band, values in box.bands.items()},
                } for name, box in self.boxes.items()
            },
            'parts': {
                name: {'level': status.level, 'message': status.message, **status.values}
                for name, status in self.parts.items()
            },
        }


class Monitor:
    """Listens to the low-rate topics of an estimator as they appear."""

    def __init__(self, node: Node, estimator: str) -> None:
        self.view = View(estimator)
        self.node = node
        self._prefix = f'{estimator}/'
        self._topics: set[str] = set()
        self._subscribe('/diagnostics', codec.DIAGNOSTICS, self._diagnosed)
        self._timer = node.create_timer(DISCOVERY_PERIOD, self.discover)
        self.discover()

    def discover(self) -> None:
        """Subscribe to topics of the estimator that have appeared."""
        for topic, _ in self.node.get_topic_names_and_types():
            if topic in self._topics or not topic.startswith(self._prefix):
                continue
            force, band = FORCE.search(topic), BAND.search(topic)
            if force:
                self._subscribe(topic, codec.WRENCH, self._force_of(force['box']))
            elif band:
                self._subscribe(topic, codec.FLOAT64, self._band_of(band['box'], band['band']))
            elif topic == f'{self._prefix}corrugation':
                self._subscribe(topic, codec.DIAGNOSTICS, self._corrugated)

    def _subscribe(self, topic: str, type_name: str, take: Any) -> None:
        self._topics.add(topic)

        def receive(message: Any) -> None:
            take(message)

        self.node.create_subscription(LIVE.get(type_name), topic, receive, RESULT)

    def _box(self, name: str) -> BoxView:
        self.view.heard = time.monotonic()
        return self.view.boxes.setdefault(name, BoxView())

    def _force_of(self, name: str) -> Any:
        return lambda message: self._box(name).forces.append(message.wrench.force.z)

    def _band_of(self, name: str, band: str) -> Any:
        def take(message: Any) -> None:
            bands = self._box(name).bands
            bands.setdefault(band, deque(maxlen=KEPT)).append(message.data)

        return take

    def _corrugated(self, message: Any) -> None:
        for status in codec.decode_diagnostics(message)[1]:
            self.view.corrugation[status.name.split(': ', 1)[-1]] = status

    def _diagnosed(self, message: Any) -> None:
        own = self._prefix.strip('/')
        for status in codec.decode_diagnostics(message)[1]:
            name, _, part = status.name.partition(': ')
            if name == own:
                self.view.heard = time.monotonic()
                self.view.parts[part] = status


@contextmanager
def monitored(estimator: str) -> Iterator[tuple[Monitor, SingleThreadedExecutor]]:
    """Listen to an estimator with a node of this process; the executor is to be spun."""
    with client(NAME) as (node, executor):
        yield Monitor(node, estimator), executor


def find_estimators(seconds: float) -> list[str]:
    """Return the full names of the estimators that are there, waiting so long for the first."""
    with monitored('/') as (monitor, executor):
        end = time.monotonic() + seconds
        while not (found := _estimators(monitor.node)) and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.1)
        return found


def _estimators(node: Node) -> list[str]:
    names = (topic.removesuffix('/irregularity') for topic, types
             in node.get_topic_names_and_types()
             if topic.endswith('/irregularity') and codec.WAVEFORM in types)
    return sorted(name for name in names if name and name != '/truth')
