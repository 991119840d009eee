"""What the health of the estimator means, and what to do about it: one status per part."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from railtrack_ros.bags.codec import Status
from railtrack_ros.estimation.estimator import STANDARD_GRAVITY, Health
from railtrack_ros.estimation.odometer import FASTEST
from railtrack_ros.node.latency import LatencyFigures
from railtrack_ros.node.limits import Limits
from railtrack_ros.node.watch import Signal, Stamps
from railtrack_ros.vehicle.description import Vehicle

OK, WARN, ERROR = range(3)

# So many messages in a period are too few to tell their rate by counting.
FEW = 2

# A mean acceleration this near to that of gravity [m/s2] tells how the sensor stands.
NEAR_GRAVITY = 2.0


@dataclass(frozen=True)
class Picture:
    """How things stand with the node at one moment.

    Attributes
    ----------
    health
        Counts of the estimator.
    acceleration_topic, speed_topic, gnss_topic
        Names of the inputs.
    publishers
        Number of publishers by input topic.
    refused, last_refusal
        Messages skipped by topic, and why the last one was.
    lost, shed
        Blocks that the publisher numbered and that never arrived; that were dropped as too old.
    latency
        Figures of the last blocks.
    stamps, signals, reversed
        What was seen since the picture before: the stamps, the channels by axle box, and the
        axle boxes that seem to be wired the wrong way round with their correlation.
    includes_gravity
        Whether the sensors are said to report gravity.
    speed_change
        Largest since the picture before, m/s2.
    speed_interval
        Between the last two speed messages, s.
    speed_overdue
        Whether no speed message has come for longer than the estimator does without.
    fixes, gnss_speed, gnss_difference
        GNSS fixes so far, the speed [m/s] from the last ones, and the share by which it differs.
    residuals
        Share of the acceleration that the model leaves unexplained, by axle box and band.
    load, memory
        Share of a processor core used since the picture before, and bytes of memory.
    """

    health: Health
    acceleration_topic: str
    speed_topic: str
    gnss_topic: str = ''
    publishers: Mapping[str, int] = field(default_factory=dict)
    refused: Mapping[str, int] = field(default_factory=dict)
    last_refusal: Mapping[str, str] = field(default_factory=dict)
    lost: int = 0
    shed: int = 0
    latency: LatencyFigures = field(default_factory=lambda: LatencyFigures(0, 0.0, 0.0, 0.0))
    stamps: Stamps = field(default_factory=Stamps)
    signals: Mapping[str, Signal] = field(default_factory=dict)
    reversed: Mapping[str, float] = field(default_factory=dict)
    includes_gravity: bool = False
    speed_change: float = 0.0
    speed_interval: float = math.nan
    speed_overdue: bool = False
    fixes: int = 0
    gnss_speed: float = math.nan
    gnss_difference: float = math.nan
    residuals: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    load: float = 0.0
    memory: int = 0


@dataclass(frozen=True)
class Change:
    """Two pictures, and how much time [s] lies between them."""

    now: Picture
    before: Picture
    period: float

    def of(self, name: str) -> int:
        """Return by how much a count has grown, of the picture or of its health."""
        if hasattr(self.now, name):
            return int(getattr(self.now, name)) - int(getattr(self.before, name))
        return int(getattr(self.now.health, name)) - int(getattr(self.before.health, name))

    def refused(self, topic: str) -> int:
        """Return how many messages of a topic were refused."""
        return self.now.refused.get(topic, 0) - self.before.refused.get(topic, 0)


Remark = tuple[int, str]
Finding = tuple[str, str, list[Remark], dict[str, str]]


def statuses(now: Picture, before: Picture, period: float, vehicle: Vehicle, node: str,
             limits: Limits) -> list[Status]:
    """Return the status of each part of the system.

    Each names all that is wrong, the worst first, with what to do about it.

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
    limits
        What is worth a warning.
    """
    change = Change(now, before, period)
    parts = [
        _acceleration(change, limits),
        _clock(change, limits),
        _speed(change, limits),
        _latency(change, limits),
        _load(change, limits),
        *([_model(now, limits)] if now.residuals else []),
        *([_gnss(change)] if now.publishers.get(now.gnss_topic) or now.fixes else []),
        *(_axle_box(box.name, change, vehicle, limits) for box in vehicle.axle_boxes),
    ]
    return [_status(node, vehicle, *part) for part in parts]


def _status(node: str, vehicle: Vehicle, name: str, well: str, remarks: Iterable[Remark],
            values: dict[str, str]) -> Status:
    ordered = sorted(remarks, key=lambda remark: -remark[0])
    level = ordered[0][0] if ordered else OK
    message = '; '.join(text for _, text in ordered) or well
    return Status(level, f'{node}: {name}', message, vehicle.name, values)


def _acceleration(change: Change, limits: Limits) -> Finding:
    now, topic, period = change.now, change.now.acceleration_topic, change.period
    health, stamps = now.health, now.stamps
    blocks, refused = change.of('blocks'), change.refused(topic)
    values = {
        'blocks_per_second': f'{blocks / period:.1f}',
        'sample_rate_hz': f'{health.sample_rate:.1f}',
        'blocks': str(health.blocks),
        'gaps': str(health.gaps),
        'lost_blocks': str(now.lost),
        'shed_blocks': str(now.shed),
        'dropped_blocks': str(health.dropped_blocks),
        'duplicates': str(stamps.duplicates),
        'out_of_order': str(stamps.out_of_order),
        'refused_messages': str(now.refused.get(topic, 0)),
        'extra_channels': ' '.join(health.extra_channels),
    }
    remarks: list[Remark] = []

    def remark(level: int, text: str) -> None:
        remarks.append((level, text))

    if refused:
        remark(ERROR, f'{refused} messages on {topic} cannot be used: '
                      f'{now.last_refusal.get(topic, "")}')
    if not blocks and not change.of('dropped_blocks') and not refused and not change.of('shed'):
        if not now.publishers.get(topic, 0):
            remark(ERROR, f'nobody publishes on {topic}: start the sensor, or remap the topic '
                          'to its name')
        else:
            remark(ERROR, f'no blocks on {topic} although it has a publisher: see whether the '
                          'sensor runs and this machine keeps up')
    if change.of('shed'):
        remark(ERROR, f'overload: {change.of("shed")} blocks were dropped because they had waited '
                      'too long: give the node a core of its own, send longer blocks, or '
                      'lower the sample rate')
    if change.of('lost') > limits.lost_limit:
        remark(WARN, f'{change.of("lost")} blocks were lost on the way: the machine or the network '
                     'is overloaded, or the publisher offers best effort only')
    if stamps.duplicates > limits.duplicate_limit:
        remark(WARN, f'{stamps.duplicates} blocks are repeated and were dropped: see whether two '
                     f'publishers send on {topic}')
    if stamps.out_of_order > limits.out_of_order_limit:
        remark(WARN, f'{stamps.out_of_order} blocks came out of order: see whether two publishers '
                     f'send on {topic}, or the clock of the sensor was set back')
    if change.of('gaps') > limits.gap_limit:
        remark(WARN, f'{change.of("gaps")} gaps between blocks: see whether the sensor drops '
                     'samples')
    if blocks and health.sample_rate < limits.sample_rate_limit:
        remark(WARN, f'the sample rate is {health.sample_rate:.6g} Hz, less than '
                     f'{limits.sample_rate_limit:g} Hz: check the settings of the sensor')
    well = f'{blocks / period:.0f} blocks a second at {health.sample_rate:g} Hz'
    return 'acceleration', well, remarks, values


def _clock(change: Change, limits: Limits) -> Finding:
    stamps, health = change.now.stamps, change.now.health
    values = {
        'offset_s': _number(stamps.offset, 4),
        'jumps': str(stamps.jumps),
        'clock_resets': str(health.clock_resets),
    }
    remarks: list[Remark] = []
    if stamps.jumps:
        remarks.append((WARN, (
            f'the stamps of the acceleration jumped by {stamps.jump:+.3g} s against the time of '
            'sending: see whether the clock of the sensor was set; let it be steered slowly')))
    if change.of('clock_resets'):
        remarks.append((WARN, 'the stamps went back and the estimate began anew at the start '
                              'position: set the position at the next kilometre post'))
    if abs(stamps.offset) > limits.clock_offset_limit:
        side = 'behind' if stamps.offset > 0.0 else 'ahead of'
        remarks.append((WARN, (
            f'the acceleration is stamped {abs(stamps.offset):.4g} s {side} the clock of this '
            'node: synchronise the clocks (NTP, PTP), or set use_sim_time for a recording')))
    well = ('no blocks to judge it by' if math.isnan(stamps.offset)
            else f'blocks are sent {1e3 * stamps.offset:.1f} ms after their last sample')
    return 'clock', well, remarks, values


def _speed(change: Change, limits: Limits) -> Finding:
    now, topic, period = change.now, change.now.speed_topic, change.period
    health, messages = now.health, change.of('speed_messages')
    rate = messages / period
    if messages <= FEW:
        rate = 1.0 / now.speed_interval if now.speed_interval > 0.0 else math.inf
    refused = change.refused(topic) + change.of('refused_speeds')
    values = {
        'messages_per_second': f'{messages / period:.1f}',
        'speed_m_s': _number(health.speed, 3),
        'position_m': _number(health.position, 2),
        'change_m_s2': f'{now.speed_change:.2f}',
        'late_messages': str(health.late_speeds),
        'refused_messages': str(health.refused_speeds + now.refused.get(topic, 0)),
        'position_corrections': str(health.corrections),
        'blocks_without_speed': str(health.unlocated_blocks),
    }
    remarks: list[Remark] = []
    if refused:
        reason = (now.last_refusal.get(topic, '') if change.refused(topic)
                  else f'not a plausible speed, which is up to {FASTEST:g} m/s')
        remarks.append((ERROR, f'{refused} messages on {topic} cannot be used: {reason}: check '
                               'the odometer'))
    if not messages and not now.publishers.get(topic, 0):
        remarks.append((ERROR, f'nobody publishes on {topic}: nothing is estimated without the '
                               'speed; start the odometer, or remap the topic to its name'))
    elif _speed_lost(change):
        remarks.append((ERROR, f'no speed on {topic}: nothing is estimated until it is back; '
                               'check the odometer'))
    elif rate < limits.speed_rate_limit:
        remarks.append((WARN, f'{rate:.2g} speed messages a second: the position between '
                              'them is guessed; publish the speed more often'))
    if change.of('late_speeds'):
        remarks.append((WARN, f'{change.of("late_speeds")} speed messages came too late to be '
                              'used: raise speed_delay, or publish the speed sooner'))
    if 0.0 < limits.slip_limit < now.speed_change:
        remarks.append((WARN, (
            f'the speed changes by {now.speed_change:.3g} m/s2: its wheel slips or slides; measure '
            'at an axle without brake and drive, and set the position at the next post')))
    if 0.0 < limits.gnss_limit < now.gnss_difference:
        remarks.append((WARN, (
            f'the speed differs by {100.0 * now.gnss_difference:.0f} % from that of the GNSS '
            f'fixes, {now.gnss_speed:.4g} m/s: check slip, and the wheel diameter set there')))
    well = f'{_number(health.speed, 2)} m/s at {_number(health.position, 1)} m'
    return 'speed', well, remarks, values


def _speed_lost(change: Change) -> bool:
    """Tell whether the estimator has to do without a speed.

    As long as there are blocks it knows from the stamps; messages may be further apart than two
    reports. Without blocks it cannot know.
    """
    health = change.now.health
    unknowing = health.speed_state == 'none' or not change.of('blocks')
    return (not health.speed_messages or health.speed_state == 'silent'
            or (unknowing and change.now.speed_overdue))


def _latency(change: Change, limits: Limits) -> Finding:
    figures = change.now.latency
    values = {
        'p50_ms': f'{1e3 * figures.p50:.3f}',
        'p99_ms': f'{1e3 * figures.p99:.3f}',
        'worst_ms': f'{1e3 * figures.worst:.3f}',
        'blocks': str(figures.blocks),
    }
    remarks: list[Remark] = []
    if figures.p99 > limits.latency_limit:
        remarks.append((WARN, f'1 % of the results come more than {1e3 * figures.p99:.0f} ms after '
                              'their block: give the node a core of its own, or longer blocks'))
    return 'latency', f'half of the results within {1e3 * figures.p50:.1f} ms', remarks, values


def _load(change: Change, limits: Limits) -> Finding:
    load, memory = change.now.load, change.now.memory
    values = {'core_share': f'{load:.3f}', 'memory_mb': f'{memory / 1e6:.1f}'}
    remarks: list[Remark] = []
    if load > limits.load_limit:
        remarks.append((WARN, f'the node uses {100.0 * load:.0f} % of a processor core and will '
                              'soon drop blocks: send longer blocks, lower the sample rate, or '
                              'take fewer axle boxes into the vehicle file'))
    return 'load', f'{100.0 * load:.0f} % of a processor core', remarks, values


def _model(now: Picture, limits: Limits) -> Finding:
    shares = {(name, band): share for name, bands in now.residuals.items()
              for band, share in bands.items() if not math.isnan(share)}
    values = {f'{name} {band}': f'{share:.3f}' for (name, band), share in shares.items()}
    remarks: list[Remark] = []
    high = {name: share for (name, _), share in shares.items() if share > limits.residual_limit}
    if high:
        remarks.append((WARN, (
            f'the model leaves up to {100.0 * max(high.values()):.0f} % of the acceleration of '
            f'{", ".join(sorted(high))} unexplained: check the track file against the line (pads, '
            'sleeper spacing), the speed, and these sensors and wheels')))
    most = max(shares.values(), default=math.nan)
    return 'model', f'at most {100.0 * most:.0f} % unexplained', remarks, values


def _gnss(change: Change) -> Finding:
    now = change.now
    fixes = change.of('fixes')
    values = {'fixes': str(now.fixes), 'speed_m_s': _number(now.gnss_speed, 2),
              'refused_messages': str(now.refused.get(now.gnss_topic, 0))}
    remarks: list[Remark] = []
    if change.refused(now.gnss_topic):
        remarks.append((WARN, f'{change.refused(now.gnss_topic)} messages on {now.gnss_topic} are '
                              f'no fix: {now.last_refusal.get(now.gnss_topic, "")}: check the '
                              'aerial; positions are not affected'))
    return 'gnss', f'{fixes / change.period:.1f} fixes a second', remarks, values


def _axle_box(name: str, change: Change, vehicle: Vehicle, limits: Limits) -> Finding:
    now, health, before = change.now, change.now.health, change.before.health
    signal = now.signals.get(name, Signal())
    bad = health.bad_samples.get(name, 0)
    missing = health.missing_blocks.get(name, 0)
    values = {
        'bad_samples': str(bad),
        'blocks_without_channel': str(missing),
        'saturated_samples': str(signal.saturated),
        'mean_m_s2': _number(signal.mean, 3),
        'same_value_s': f'{signal.stuck:.2f}',
    }
    remarks: list[Remark] = []
    if name in health.dead:
        # Without blocks in this period the last ones tell.
        if missing > before.missing_blocks.get(name, 0) or (missing and not change.of('blocks')):
            reason = f'the messages carry no channel {name}: name it so in the sensor driver'
        else:
            reason = 'no sample is a number: check sensor and cable'
        remarks.append((ERROR, f'{reason}; it is taken to carry its static load'))
    else:
        fresh = bad - before.bad_samples.get(name, 0)
        if fresh > limits.bad_sample_limit * max(change.of('samples'), 1):
            remarks.append((WARN, 'some samples are no number: check sensor and cable'))
        remarks += _sensor(name, signal, now, limits)
    rail = next(box.rail for box in vehicle.axle_boxes if box.name == name)
    dead = [box.name for box in vehicle.on_rail(rail)
            if box.name in health.dead and box.name != name]
    if dead:
        remarks.append((WARN, f'{", ".join(dead)} on the same rail is dead: its part of the rail '
                              'deflection is the static one only'))
    return f'axle box {name}', 'measuring', remarks, values


def _sensor(name: str, signal: Signal, now: Picture, limits: Limits) -> list[Remark]:
    """What the samples of a channel that is not dead tell of its sensor."""
    remarks: list[Remark] = []
    if signal.stuck > limits.stuck_limit:
        remarks.append((ERROR, f'stuck: one and the same value for {signal.stuck:.1f} s: check the '
                               'supply of the sensor and its cable'))
    if signal.saturated > limits.saturation_limit * max(signal.samples, 1):
        remarks.append((WARN, f'saturated: {signal.saturated} samples at the end of the range: use '
                              'a sensor with a larger range, or set full_scale if this is wrong'))
    if name in now.reversed:
        remarks.append((ERROR, (
            f'polarity: what it finds is the reverse of what others on its rail find at the '
            f'same place (correlation {now.reversed[name]:.2f}): turn the sensor over or change '
            'the sign of its channel')))
    if abs(signal.mean) <= limits.offset_limit and not now.includes_gravity:
        return remarks
    offset = signal.mean - STANDARD_GRAVITY * now.includes_gravity
    if abs(offset) > limits.offset_limit:
        if not now.includes_gravity and abs(signal.mean - STANDARD_GRAVITY) < NEAR_GRAVITY:
            hint = 'the sensor reports gravity: set input_includes_gravity'
        elif abs(signal.mean + STANDARD_GRAVITY) < NEAR_GRAVITY:
            hint = 'the sensor is mounted upside down: turn it over or change its sign'
        elif now.includes_gravity and abs(signal.mean) < NEAR_GRAVITY:
            hint = 'the sensor does not report gravity: set input_includes_gravity to false'
        else:
            hint = 'check its zero and its scale'
        remarks.append((WARN, f'the mean acceleration is {signal.mean:.3g} m/s2: {hint}'))
    return remarks


def _number(value: float, digits: int) -> str:
    return 'unknown' if math.isnan(value) else f'{value:.{digits}f}'
