"""What the health of the estimator means, and what to do about it: one status per part."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from railtrack_ros.bags.codec import Status
from railtrack_ros.estimation.estimator import Health
from railtrack_ros.node.latency import LatencyFigures
from railtrack_ros.vehicle.description import Vehicle

OK, WARN, ERROR = range(3)


@dataclass(frozen=True)
class Picture:
    """How things stand with the node at one moment.

    Attributes
    ----------
    health
        Counts of the estimator.
    acceleration_topic, speed_topic
        Names of the inputs.
    publishers
        Number of publishers by input topic.
    refused, last_refusal
        Messages skipped by topic, and why the last one was.
    lost
        Blocks that the publisher numbered and that never arrived.
    latency
        Figures of the last blocks.
    """

    health: Health
    acceleration_topic: str
    speed_topic: str
    publishers: Mapping[str, int] = field(default_factory=dict)
    refused: Mapping[str, int] = field(default_factory=dict)
    last_refusal: Mapping[str, str] = field(default_factory=dict)
    lost: int = 0
    latency: LatencyFigures = field(default_factory=lambda: LatencyFigures(0, 0.0, 0.0, 0.0))


def statuses(now: Picture, before: Picture, period: float, vehicle: Vehicle, node: str,
             latency_limit: float) -> list[Status]:
    """Return the status of each part of the system.

    Parameters
    ----------
    now, before
        The pictures at the end and at the beginning of the period.
    period
        Its length, s.
    vehicle
        Its axle boxes.
    node
        Name of the node.
    latency_limit
        Delay beyond which the latency is worth a warning, s.
    """
    parts = [
        ('acceleration', *_acceleration(now, before, period)),
        ('speed', *_speed(now, before, period)),
        ('latency', *_latency(now, latency_limit)),
        *((f'axle box {box.name}', *_axle_box(box.name, now, before, vehicle))
          for box in vehicle.axle_boxes),
    ]
    return [Status(level, f'{node}: {name}', message, vehicle.name, values)
            for name, level, message, values in parts]


Finding = tuple[int, str, dict[str, str]]


def _acceleration(now: Picture, before: Picture, period: float) -> Finding:
    health, topic = now.health, now.acceleration_topic
    blocks = health.blocks - before.health.blocks
    refused = now.refused.get(topic, 0) - before.refused.get(topic, 0)
    gaps = health.gaps - before.health.gaps
    lost = now.lost - before.lost
    dropped = health.dropped_blocks - before.health.dropped_blocks
    values = {
        'blocks_per_second': f'{blocks / period:.1f}',
        'sample_rate_hz': f'{health.sample_rate:.1f}',
        'blocks': str(health.blocks),
        'gaps': str(health.gaps),
        'lost_blocks': str(now.lost),
        'dropped_blocks': str(health.dropped_blocks),
        'clock_resets': str(health.clock_resets),
        'refused_messages': str(now.refused.get(topic, 0)),
        'extra_channels': ' '.join(health.extra_channels),
    }
    if refused:
        reason = now.last_refusal.get(topic, '')
        return ERROR, f'{refused} messages on {topic} are no waveforms: {reason}', values
    if not blocks and not dropped:
        if not now.publishers.get(topic, 0):
            return ERROR, (f'nobody publishes on {topic}: start the sensor, or remap the topic '
                           'to its name'), values
        return ERROR, (f'no blocks on {topic} although it has a publisher: see whether the '
                       'sensor runs and this machine keeps up'), values
    if lost:
        return WARN, (f'{lost} blocks were lost on the way: the machine or the network is '
                      'overloaded, or the publisher offers best effort only'), values
    if dropped:
        return WARN, (f'{dropped} blocks are repeated or from the past: two publishers on '
                      f'{topic}, or a sensor with a bad clock'), values
    if gaps:
        return WARN, f'{gaps} gaps between blocks: see whether the sensor drops samples', values
    return OK, f'{blocks / period:.0f} blocks a second at {health.sample_rate:g} Hz', values


def _speed(now: Picture, before: Picture, period: float) -> Finding:
    health, topic = now.health, now.speed_topic
    messages = health.speed_messages - before.health.speed_messages
    late = health.late_speeds - before.health.late_speeds
    refused = (now.refused.get(topic, 0) - before.refused.get(topic, 0)
               + health.refused_speeds - before.health.refused_speeds)
    values = {
        'messages_per_second': f'{messages / period:.1f}',
        'speed_m_s': _number(health.speed, 3),
        'position_m': _number(health.position, 2),
        'late_messages': str(health.late_speeds),
        'refused_messages': str(health.refused_speeds + now.refused.get(topic, 0)),
        'position_corrections': str(health.corrections),
        'blocks_without_speed': str(health.unlocated_blocks),
    }
    if refused:
        reason = now.last_refusal.get(topic, 'not a plausible speed')
        return ERROR, f'{refused} messages on {topic} cannot be used: {reason}', values
    if not messages and not now.publishers.get(topic, 0):
        return ERROR, (f'nobody publishes on {topic}: nothing is estimated without the speed; '
                       'start the odometer, or remap the topic to its name'), values
    if health.speed_state == 'silent' or not messages:
        return ERROR, f'no speed on {topic}: nothing is estimated until it is back', values
    if late:
        return WARN, (f'{late} speed messages came too late to be used: raise speed_delay, or '
                      'publish the speed sooner'), values
    return OK, f'{_number(health.speed, 2)} m/s at {_number(health.position, 1)} m', values


def _latency(now: Picture, limit: float) -> Finding:
    figures = now.latency
    values = {
        'p50_ms': f'{1e3 * figures.p50:.3f}',
        'p99_ms': f'{1e3 * figures.p99:.3f}',
        'worst_ms': f'{1e3 * figures.worst:.3f}',
        'blocks': str(figures.blocks),
    }
    if figures.p99 > limit:
        return WARN, (f'1 % of the results come more than {1e3 * figures.p99:.0f} ms after their '
                      'block: give the node a core of its own, or longer blocks'), values
    return OK, f'half of the results within {1e3 * figures.p50:.1f} ms', values


def _axle_box(name: str, now: Picture, before: Picture, vehicle: Vehicle) -> Finding:
    health = now.health
    bad = health.bad_samples.get(name, 0)
    missing = health.missing_blocks.get(name, 0)
    values = {'bad_samples': str(bad), 'blocks_without_channel': str(missing)}
    if name in health.dead:
        if missing > before.health.missing_blocks.get(name, 0):
            reason = f'the messages carry no channel {name}: name it so in the sensor driver'
        else:
            reason = 'no sample is a number: check sensor and cable'
        return ERROR, f'{reason}; it is taken to carry its static load', values
    if bad > before.health.bad_samples.get(name, 0):
        return WARN, 'some samples are no number: check sensor and cable', values
    rail = next(box.rail for box in vehicle.axle_boxes if box.name == name)
    dead = [box.name for box in vehicle.on_rail(rail) if box.name in health.dead]
    if dead:
        return WARN, (f'{", ".join(dead)} on the same rail is dead: its part of the rail '
                      'deflection is the static one only'), values
    return OK, 'measuring', values


def _number(value: float, digits: int) -> str:
    return 'unknown' if math.isnan(value) else f'{value:.{digits}f}'
