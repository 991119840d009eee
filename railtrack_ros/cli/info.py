"""Command `railtrack info`."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from datetime import datetime, timezone
from typing import TYPE_CHECKING, Any

from railtrack_ros.cli import common
from railtrack_ros.cli.main import Outcome

if TYPE_CHECKING:
    from railtrack_ros.bags.survey import AccelerationSurvey, SpeedSurvey, Survey

EXAMPLE = 'railtrack info run.mcap'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    common.add_bags(parser)
    parser.add_argument(
        '--acceleration-topic',
        metavar='TOPIC',
        help='waveform of the axle boxes (default: axle_box_acceleration, or the only one)',
    )
    parser.add_argument(
        '--speed-topic', metavar='TOPIC', help='speed (default: speed, or the only one)'
    )


def run(args: argparse.Namespace) -> Outcome:
    """Read the recording through and tell what it holds."""
    from railtrack_ros.bags.survey import survey

    with common.progress(None, 'messages', 'reading') as bar:

        def count(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        found = survey(args.bag, args.acceleration_topic, args.speed_topic, count)
    return Outcome(summary(found), lines(found), found.defects)


def summary(found: Survey) -> dict[str, Any]:
    """Return the survey under machine-readable names."""
    acceleration, speed = found.acceleration, found.speed
    return {
        'path': str(found.path),
        'start': when(found.start_ns),
        'duration_s': (found.end_ns - found.start_ns) / 1e9,
        'topics': [
            {'name': x.name, 'type': x.type, 'messages': x.count, 'rate_hz': x.rate}
            for x in found.topics
        ],
        'acceleration': acceleration and acceleration_summary(acceleration),
        'speed': speed and speed_summary(speed),
        'distance_m': found.distance,
        'start_position_m': found.start_position,
        'facts': found.facts,
        'can_be_estimated': not found.obstacles,
        'obstacles': found.obstacles,
        'defects': found.defects,
    }


def acceleration_summary(found: AccelerationSurvey) -> dict[str, Any]:
    """Return the figures of the acceleration under machine-readable names."""
    return {
        'topic': found.topic,
        'sample_rate_hz': found.sample_rate,
        'sample_rate_changes': found.rate_changes,
        'blocks': found.blocks,
        'samples': found.samples,
        'duration_s': found.duration,
        'gaps': found.gap_count,
        'gap_duration_s': found.gap_seconds,
        'first_gaps': [{'at_s': at, 'duration_s': length} for at, length in found.gaps],
        'overlaps': found.overlaps,
        'channels': {
            name: {
                'samples': channel.samples,
                'missing': channel.missing,
                'rms_m_s2': channel.rms,
                'peak_m_s2': channel.peak,
            }
            for name, channel in found.channels.items()
        },
    }


def speed_summary(found: SpeedSurvey) -> dict[str, Any]:
    """Return the figures of the speed under machine-readable names."""
    return {
        'topic': found.topic,
        'messages': found.count,
        'lowest_m_s': min(found.speeds, default=None),
        'highest_m_s': max(found.speeds, default=None),
    }


def lines(found: Survey) -> list[str]:
    """Return the survey for people."""
    duration = (found.end_ns - found.start_ns) / 1e9
    text = [f'{found.path}: {duration:.3f} s from {when(found.start_ns)}', '']
    rows = [('topic', 'type', 'messages', 'rate')]
    for topic in found.topics:
        rate = '' if math.isnan(topic.rate) else f'{topic.rate:.4g} Hz'
        rows.append((topic.name, topic.type, str(topic.count), rate))
    text += table(rows, '<<>>')
    acceleration, speed = found.acceleration, found.speed
    if acceleration and acceleration.blocks:
        text += ['', acceleration_line(acceleration)]
        rows = [('channel', 'rms m/s2', 'peak m/s2', 'missing samples')]
        for name, channel in acceleration.channels.items():
            rms = '' if math.isnan(channel.rms) else f'{channel.rms:.4g}'
            rows.append((name, rms, f'{channel.peak:.4g}', str(channel.missing)))
        text += table(rows, '<>>>')
        for at, length in acceleration.gaps:
            text.append(f'  gap of {length:.4g} s at {at:.4g} s')
        if acceleration.gap_count > len(acceleration.gaps):
            text.append(f'  and {acceleration.gap_count - len(acceleration.gaps)} more gaps')
    if speed and speed.count:
        low, high = min(speed.speeds), max(speed.speeds)
        text += ['', f'{speed.topic}: {low:.4g} to {high:.4g} m/s ({3.6 * high:.4g} km/h)']
    if not math.isnan(found.distance):
        text.append(f'distance: {found.distance:.1f} m')
    text += [f'{key}: {value}' for key, value in found.facts.items()]
    text += ['', 'cannot be estimated:' if found.obstacles else 'can be estimated']
    text += [f'  {obstacle}' for obstacle in found.obstacles]
    return text


def acceleration_line(found: AccelerationSurvey) -> str:
    """Return the acceleration in one line."""
    if found.gap_count:
        gaps = f'{found.gap_count} gaps of {found.gap_seconds:.4g} s in all'
    else:
        gaps = 'no gaps'
    remarks = [gaps]
    if found.overlaps:
        remarks.append(f'{found.overlaps} blocks that overlap or go back in time')
    if found.rate_changes:
        remarks.append(f'{found.rate_changes} changes of the sample rate')
    return (
        f'{found.topic}: {len(found.channels)} channels at {found.sample_rate:.6g} Hz, '
        f'{found.duration:.3f} s in {found.blocks} blocks, {", ".join(remarks)}'
    )


def table(rows: Sequence[tuple[str, ...]], alignment: str) -> list[str]:
    """Return rows as lines with columns of equal width."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(alignment))]
    return [
        '  '
        + '  '.join(
            f'{cell:{side}{width}}'
            for cell, side, width in zip(row, alignment, widths, strict=True)
        ).rstrip()
        for row in rows
    ]


def when(time_ns: int) -> str:
    """Return a time [ns since the epoch] as ISO 8601; recordings may tell any number."""
    try:
        moment = datetime.fromtimestamp(time_ns / 1e9, timezone.utc)
    except (OverflowError, ValueError, OSError):
        return f'{time_ns} ns'
    return moment.isoformat(timespec='milliseconds').replace('+00:00', 'Z')
