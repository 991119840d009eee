"""Command `railtrack import`."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from railtrack_ros.cli import common
from railtrack_ros.cli.main import Outcome
from railtrack_ros.errors import InputError
from railtrack_ros.parameters import POSITIVE

if TYPE_CHECKING:
    from railtrack_ros.bags.importers import ImportSummary

EXAMPLE = (
    'railtrack import measured.npz --channels left=axle1_left,right=axle1_right\n'
    '      --position-column position_km --position-unit km\n'
    '      --speed-column speed_km_h --speed-unit km/h run.mcap'
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    number = common.number
    parser.add_argument('file', metavar='FILE', help='a .csv, .npz or .mat file')
    parser.add_argument(
        '--channels',
        metavar='A,B',
        required=True,
        help='columns with vertical acceleration, up positive, gravity removed: names of axle '
        'boxes, or COLUMN=NAME to rename; name[0], name[1], ... are the columns of an array',
    )
    parser.add_argument(
        '--acceleration-unit', choices=('m/s2', 'g'), default='m/s2', help='(default m/s2)'
    )
    base = parser.add_argument_group('time base, one of')
    base.add_argument('--sample-rate', type=number(POSITIVE), metavar='HZ')
    base.add_argument('--time-column', metavar='C', help='time, s')
    base.add_argument(
        '--position-column', metavar='C', help='track position; time comes from the speed'
    )
    parser.add_argument(
        '--position-unit', choices=('m', 'km'), help='of the position column (default m)'
    )
    speed = parser.add_argument_group('speed, one of')
    speed.add_argument('--speed-column', metavar='C')
    speed.add_argument('--speed', type=number(POSITIVE), metavar='V', help='constant speed')
    parser.add_argument(
        '--speed-unit', choices=('m/s', 'km/h'), default='m/s', help='(default m/s)'
    )
    parser.add_argument('output', metavar='OUT', help='NAME.mcap, or a rosbag2 folder')


def run(args: argparse.Namespace) -> Outcome:
    """Write the recording."""
    from railtrack_ros.bags.importers import ImportSettings, import_measurement, parse_channels

    if args.position_unit and not args.position_column:
        raise InputError('--position-unit needs a --position-column')
    settings = ImportSettings(
        channels=parse_channels(args.channels),
        acceleration_unit=args.acceleration_unit,
        sample_rate=args.sample_rate,
        time_column=args.time_column,
        position_column=args.position_column,
        position_unit=args.position_unit or 'm',
        speed_column=args.speed_column,
        speed=args.speed,
        speed_unit=args.speed_unit,
    )
    with common.progress(1.0, '', 'import') as bar:
        found = import_measurement(
            args.file, args.output, settings, lambda part: bar.update(part - bar.n)
        )
    return Outcome(summary(args, found), lines(args, found), found.notes)


def summary(args: argparse.Namespace, found: ImportSummary) -> dict[str, Any]:
    """Return the figures under machine-readable names."""
    return {
        'path': args.output,
        'channels': list(found.missing),
        'sample_rate_hz': found.sample_rate,
        'resampled': found.resampled,
        'samples': found.samples,
        'blocks': found.blocks,
        'duration_s': found.duration,
        'distance_m': found.distance,
        'start_position_m': found.start_position,
        'gaps': found.gaps,
        'missing_samples': found.missing,
    }


def lines(args: argparse.Namespace, found: ImportSummary) -> list[str]:
    """Return the figures for people."""
    text = [
        f'{args.output}: {len(found.missing)} channels at {found.sample_rate:.6g} Hz, '
        f'{found.duration:.3f} s, {found.distance:.1f} m, {found.blocks} blocks'
    ]
    if found.resampled:
        text.append('resampled to a uniform rate: the samples are not uniform in time')
    if found.start_position is not None:
        text.append(f'start position: {found.start_position:.3f} m')
    return text
