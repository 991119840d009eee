"""Qualities of service that the nodes use (see the interface description)."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions


def _keep_last(depth: int, reliability: ReliabilityPolicy,
               durability: DurabilityPolicy = DurabilityPolicy.VOLATILE) -> QoSProfile:
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=reliability,
                      durability=durability)


# A sensor never waits for a reader; a best-effort reader takes from either kind of publisher.
SENSOR_INPUT = _keep_last(100, ReliabilityPolicy.BEST_EFFORT)
# A second of single samples at 1 kHz.
SINGLE_INPUT = _keep_last(1000, ReliabilityPolicy.BEST_EFFORT)

RESULT = _keep_last(100, ReliabilityPolicy.RELIABLE)

# What is said once and still told to those who come later.
LATCHED = _keep_last(1, ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL)

# Ten seconds of 10 ms blocks: a recorder may stall for as long and lose nothing.
STREAM = _keep_last(1000, ReliabilityPolicy.RELIABLE)


def overridable() -> QoSOverridingOptions:
    """Let parameters qos_overrides.TOPIC.publisher.depth and the like change a profile."""
    return QoSOverridingOptions.with_default_policies()
