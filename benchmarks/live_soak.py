"""Hours of running in minutes: the node fed with serialised messages as fast as it takes them.

Everything of the node takes part, decoding, estimate, publishing and diagnostics; only the way of
the blocks through DDS is left out. Two axle boxes at 2.56 kHz in blocks of 0.1 s, at 25 m/s.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import rclpy
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions

from railtrack_ros.bags.codec import SECOND, WaveformBlock, encode_speed, encode_waveform
from railtrack_ros.bags.message_types import LIVE
from railtrack_ros.node.playback import restamped
from railtrack_ros.node.processes import Domain, resident_memory
from railtrack_ros.node.track_estimator import TrackEstimator
from railtrack_ros.paths import share_directory

RATE, BLOCK, SPEED = 2560.0, 0.1, 25.0
# Different blocks that are sent over and over again.
BLOCKS = 50


def soak(hours: float) -> dict[str, Any]:
    """Feed so many hours; return memory and position over the time."""
    domain = Domain()
    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=domain.number,
               signal_handler_options=SignalHandlerOptions.NO)
    vehicle = str(share_directory() / 'bags' / 'two_wheels.yaml')
    node = TrackEstimator(context=context, parameter_overrides=[
        Parameter('vehicle', value=vehicle)])
    try:
        node.trigger_configure()
        node.trigger_activate()
        return _feed(node, round(hours * 3600.0 / BLOCK))
    finally:
        node.destroy_node()
        context.try_shutdown()
        domain.close()


def _feed(node: TrackEstimator, blocks: int) -> dict[str, Any]:
    rng = np.random.default_rng(1)
    samples = round(RATE * BLOCK)
    t = np.arange(samples) / RATE
    names = [box.name for box in node._vehicle.axle_boxes]
    waves = [serialize_message(encode_waveform(WaveformBlock(0, t, {
        name: rng.normal(0.0, 5.0, samples).astype(np.float32) for name in names}), LIVE))
        for _ in range(BLOCKS)]
    speed = serialize_message(encode_speed(0, SPEED, 'base_link', LIVE))
    acceleration, odometer = node._blocks[0], node._speed
    begun, looks = time.monotonic(), []
    for index in range(blocks):
        stamp_ns = SECOND + round(index * BLOCK * SECOND)
        odometer._receive(restamped(speed, stamp_ns), {})
        now = time.time_ns()
        acceleration._receive(restamped(waves[index % BLOCKS], stamp_ns),
                              {'received_timestamp': now, 'source_timestamp': now})
        if index % 10 == 9:
            node._diagnose()
        if index % max(blocks // 100, 1) == 0 or index == blocks - 1:
            health = node._estimator.health
            exact = SPEED * (index * BLOCK + (samples - 1) / RATE)
            looks.append((index * BLOCK, resident_memory() / 1e6, health.position - exact))
    health = node._estimator.health
    settled = [look for look in looks if look[0] >= 0.05 * looks[-1][0]]
    return {
        'hours': blocks * BLOCK / 3600.0, 'minutes': (time.monotonic() - begun) / 60.0,
        'blocks': health.blocks, 'gaps': health.gaps, 'restarts': health.restarts,
        'distance_m': health.position, 'drift_m': looks[-1][2],
        'memory_mb': settled[-1][1], 'growth_mb': settled[-1][1] - settled[0][1],
    }


def describe(found: dict[str, Any]) -> str:
    """One sentence for the document."""
    return (
        f'Soak: {found["hours"]:.1f} h of running ({found["blocks"]} blocks, '
        f'{found["distance_m"] / 1e3:.0f} km) in {found["minutes"]:.1f} min; position off by '
        f'{abs(found["drift_m"]):.1e} m at the end, {found["gaps"]} gaps, memory grew by '
        f'{found["growth_mb"]:.1f} MB after the first twentieth.')
