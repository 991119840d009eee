"""The processes of the live benchmark that are not part of the product.

`python -m live_roles node FILE ...` is the estimator's node that also keeps every delay;
`python -m live_roles echo FILE ...` sends every block back as it came. FILE gets the delays [s].
"""

from __future__ import annotations

import sys
import time
from array import array
from collections.abc import Mapping
from typing import Any

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from railtrack_ros.bags.writer import ACCELERATION_TOPIC
from railtrack_ros.node import track_estimator
from railtrack_ros.node.inputs import arrival_ns
from railtrack_ros.node.latency import Latency
from railtrack_ros.node.qos import RESULT, SENSOR_INPUT
from railtrack_ros.node.runner import run

ECHO_TOPIC = '/echo'

# Room for so many delays is taken at the start, so that they are no growth of memory.
MOST = 500_000


class Kept:
    """Delays in memory of their own."""

    def __init__(self) -> None:
        self.delays = array('d', bytes(8 * MOST))
        self.count = 0

    def add(self, delay: float) -> None:
        if self.count < MOST:
            self.delays[self.count] = delay
            self.count += 1

    def save(self, path: str) -> None:
        np.save(path, np.frombuffer(self.delays)[: self.count])


KEPT = Kept()


class KeepingLatency(Latency):
    """Keeps all delays besides."""

    def add(self, arrival_ns: int, published_ns: int) -> None:
        super().add(arrival_ns, published_ns)
        KEPT.add(1e-9 * (published_ns - arrival_ns))


class Echo(Node):
    """Sends back what comes, and nothing else."""

    def __init__(self) -> None:
        super().__init__('echo')
        self._publisher = self.create_publisher(PointCloud2, ECHO_TOPIC, RESULT)
        self.create_subscription(
            PointCloud2, ACCELERATION_TOPIC, self._take, SENSOR_INPUT, raw=True)

    def _take(self, data: bytes, info: Mapping[str, Any]) -> None:
        arrived = arrival_ns(info)
        self._publisher.publish(data)
        KEPT.add(1e-9 * (time.time_ns() - arrived))


def main() -> int:
    """Run a role until it is told to end."""
    role, path = sys.argv[1:3]
    sys.argv[1:3] = []
    try:
        if role == 'echo':
            return run(Echo)
        track_estimator.Latency = KeepingLatency  # type: ignore[misc]
        return track_estimator.main()
    finally:
        KEPT.save(path)


if __name__ == '__main__':
    sys.exit(main())
