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
    parser.add_argument('file', metavar='FILE', help='a .csv, .npz, .mat, .h5 or .tdms file')
    parser.add_argument(
        '--channels',
        metavar='A,B',
        required=True,
        help='columns with vertical acceleration, up positive, gravity removed: names of axle '
        'boxes, or COLUMN=NAME to rename; name[0], name[1], ... are the columns of an array, '
        'GROUP/NAME an array in a group',
    )
    parser.add_argument(
        '--acceleration-unit', choices=('m/s2', 'g'), default='m/s2', help='(default m/s2)'
    )
    sensors = parser.add_argument_group('sensors')
    sensors.add_argument(
        '--sensitivity', metavar='S|NAME=S,...',
        help='number in the file per acceleration unit, for all channels or by name '
        '(such as 0.01 for volts of a sensor with 10 mV/g, with --acceleration-unit g)')
    sensors.add_argument(
        '--offset', metavar='X|NAME=X,...', help='number in the file at rest (default 0)')
    sensors.add_argument(
        '--invert', metavar='NAME,...', help='channels with down positive, or all')
    sensors.add_argument(
        '--undo-high-pass', metavar='HZ[:ORDER[:LOWEST]]',
        help='undo the Butterworth high-pass of the sensor chain (order 1 unless given) down to '
        'LOWEST Hz (a tenth of HZ unless given)')
    sensors.add_argument(
        '--decimate', type=common.count(), default=1, metavar='N',
        help='keep one of N samples, after an anti-aliasing filter')
    base = parser.add_argument_group('time base, one of (a .tdms file may tell its own)')
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
    from railtrack_ros.bags.import_settings import (
        HighPass,
        ImportSettings,
        parse_calibration,
        parse_channels,
    )
    from railtrack_ros.bags.importers import import_measurement

    if args.position_unit and not args.position_column:
        raise InputError('--position-unit needs a --position-column')
    channels = parse_channels(args.channels)
    settings = ImportSettings(
        channels=channels,
        calibration=parse_calibration(
            list(channels.values()), args.sensitivity, args.offset, args.invert),
        undo_high_pass=HighPass.parse(args.undo_high_pass) if args.undo_high_pass else None,
        decimate=args.decimate,
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
