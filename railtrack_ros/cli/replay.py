"""Command `railtrack replay`."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from railtrack_ros.cli import common
from railtrack_ros.cli.main import Outcome
from railtrack_ros.cli.settings_options import add_settings, settings_from
from railtrack_ros.errors import InputError
from railtrack_ros.estimation.settings import EstimatorSettings
from railtrack_ros.parameters import Range

if TYPE_CHECKING:
    from railtrack_ros.runs.replay_input import Bound

EXAMPLE = (
    'railtrack replay run.mcap --track mainline_soft_pads --vehicle measurement_coach\n'
    '      --from 100 --to 200 --output replayed'
)
# Options of these names are the full model's; the start position has an option of its own.
NOT_OF_THE_ESTIMATOR = ('start_position', 'elements_per_bay', 'local_system')
SECTIONS = Range(minimum=1.0, maximum=1000.0)
MICROSECONDS = Range(minimum=1.0, maximum=25.0)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    common.add_bags(parser)
    common.add_track(parser)
    common.add_vehicle(parser)
    parser.add_argument('--start-position', type=common.number(), metavar='M',
                        help='track position of the reference point at the first sample, m '
                        '(default: what the recording says, else 0)')
    parser.add_argument('--from', dest='begin', type=bound, metavar='WHERE',
                        help='begin of the stretch: 120 or 120m for a track position of the '
                        'reference point, 4.5s for a time after the first sample')
    parser.add_argument('--to', dest='end', type=bound, metavar='WHERE',
                        help='its end, in the same way')
    parser.add_argument('--time-step', type=common.number(MICROSECONDS), default=25.0,
                        metavar='US', help='longest time step of the full model, us (default 25); '
                        'it takes a whole fraction of the sample period')
    common.add_output(parser, 'DIR', 'folder for report.html, comparison.csv, errors.csv and '
                      'replay.mcap')
    parser.add_argument('--acceleration-topic', metavar='TOPIC',
                        help='waveform of the axle boxes (default: axle_box_acceleration, or the '
                        'only one)')
    parser.add_argument('--speed-topic', metavar='TOPIC',
                        help='speed (default: speed, or the only one)')
    common.add_sample_block(parser)
    parser.add_argument('--section', type=common.number(SECTIONS), default=10.0, metavar='M',
                        help='length of the sections that errors are summed up over (default 10)')
    parser.add_argument('--model-track', metavar='T',
                        help='track of the full model, which may be uneven and non-linear '
                        '(default: that of --track)')
    common.add_model_options(parser)
    add_settings(parser, EstimatorSettings, 'estimator', without=NOT_OF_THE_ESTIMATOR)


def bound(text: str) -> Bound:
    """Argument type: one end of a stretch."""
    from railtrack_ros.runs.replay_input import Bound

    try:
        return Bound.parse(text)
    except InputError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def run(args: argparse.Namespace) -> Outcome:
    """Replay the recording."""
    from railtrack_ros.bags.bag import open_bag
    from railtrack_ros.bags.codec import SECOND
    from railtrack_ros.runs.replay import replay_recording
    from railtrack_ros.runs.replay_input import Stretch
    from railtrack_ros.track.description import load_track
    from railtrack_ros.vehicle.description import load_vehicle

    stretch = Stretch(args.begin, args.end)
    chosen = {**vars(args), 'track': args.model_track or args.track}
    given = {**vars(args), **dict.fromkeys(NOT_OF_THE_ESTIMATOR)}
    settings = settings_from(argparse.Namespace(**given), EstimatorSettings)
    model_track, mesh = common.model(argparse.Namespace(**chosen), settings.mesh)
    with open_bag(args.bag) as bag:
        duration = (bag.end_time - bag.start_time) / SECOND
    with common.progress(duration, 's', 'replay') as bar:
        result = replay_recording(
            args.bag, load_track(args.track), load_vehicle(args.vehicle), args.output, stretch,
            start_position=args.start_position, settings=settings, model_track=model_track,
            mesh=mesh, longest_step=1e-6 * args.time_step,
            acceleration_topic=args.acceleration_topic, speed_topic=args.speed_topic,
            progress=lambda seconds: bar.update(seconds - bar.n), section_length=args.section,
            sample_block=args.sample_block)
    return Outcome(result.summary, [*result.report.findings, f'report: {args.output}/report.html'],
                   result.defects, result.remarks)
