"""Command `railtrack decay-rate`."""

from __future__ import annotations

import argparse

from railtrack_ros.cli import common
from railtrack_ros.cli.main import Outcome

EXAMPLE = ('railtrack decay-rate --track blanco_table_3_1 --output decay_rate.csv '
           '--plot decay_rate.png')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    common.add_track(parser)
    parser.add_argument('--at', choices=('midspan', 'sleeper'), default='midspan',
                        help='place of the accelerometer (default midspan, as in EN 15461)')
    common.add_output(parser, 'CSV', 'frequency_hz, decay_rate_db_per_m')
    common.add_plot(parser)
    common.add_track_options(parser)


def run(args: argparse.Namespace) -> Outcome:
    """Compute the decay rates."""
    from railtrack_ros.dynamics import decay_rate as decay
    from railtrack_ros.output import write_csv
    from railtrack_ros.report import curves

    if args.plot:
        curves.check_format(args.plot)
    track = common.track(args)
    with common.progress(decay.CENTRES.size * decay.LINES_PER_BAND, 'Hz', 'decay rate') as bar:
        result = decay.track_decay_rate(track, args.at == 'midspan', bar.update)
    write_csv(args.output, {'frequency_hz': result.frequency,
                            'decay_rate_db_per_m': result.rate})
    if args.plot:
        limited = result.frequency >= decay.LIMIT_FROM
        curves.draw_decay_rate(
            args.plot, result.frequency, {track.name: result.rate},
            limit=(result.frequency[limited], decay.LIMIT),
            title=f'Vertical track decay rate, {track.support.kind} supports')
    below = decay.below_limit(result)
    summary = {
        'track': track.name, 'support': track.support.kind, 'at': args.at,
        'frequency_hz': result.frequency, 'decay_rate_db_per_m': result.rate,
        'floor_db_per_m': result.floor, 'below_limit_iso_3095_hz': below,
        'output': args.output, 'plot': args.plot,
    }
    lines = [f'{f:6.0f} Hz  {rate:6.2f} dB/m' for f, rate in
             zip(result.frequency, result.rate, strict=True)]
    lines.append('below the lower limit of ISO 3095:2013 at ' + ', '.join(f'{f:g}' for f in below)
                 + ' Hz' if below.size else 'at or above the lower limit of ISO 3095:2013 from '
                 f'{decay.LIMIT_FROM:g} Hz')
    return Outcome(summary, [*lines, *common.written(args)])
