"""Command `railtrack estimate`."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from railtrack_ros.cli import common
from railtrack_ros.cli.main import Outcome
from railtrack_ros.cli.settings_options import add_settings, settings_from
from railtrack_ros.estimation.settings import EstimatorSettings, IndicatorSettings
from railtrack_ros.track.description import load_track
from railtrack_ros.vehicle.description import load_vehicle

EXAMPLE = (
    'railtrack estimate run.mcap --track blanco_table_3_1 --vehicle measurement_coach '
    '--output estimate.mcap'
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    common.add_bags(parser)
    common.add_track(parser)
    common.add_vehicle(parser)
    common.add_output(parser, 'OUT.mcap', 'recording of inputs and results; a folder for rosbag2')
    parser.add_argument(
        '--start-position',
        type=common.number(),
        metavar='M',
        help='track position at the first sample (default: as the recording tells, else 0)',
    )
    parser.add_argument(
        '--acceleration-topic',
        metavar='TOPIC',
        help='waveform of the axle boxes, or what the topics of their single samples begin with '
        '(default: axle_box_acceleration, or the only one)',
    )
    parser.add_argument(
        '--speed-topic', metavar='TOPIC', help='speed (default: speed, or the only one)'
    )
    common.add_sample_block(parser)
    parser.add_argument(
        '--report', metavar='FILE.html', help='also a page on what stands out along the track')
    parser.add_argument(
        '--jobs',
        type=common.count(0),
        default=1,
        metavar='N',
        help='processes that share the work, each a part of the run with a warm-up before it; '
        '0: one for each core (default 1)',
    )
    add_settings(parser, EstimatorSettings, 'estimator', without=['start_position'])
    add_settings(parser, IndicatorSettings, 'sections', names={'section_length': 'section'})


def run(args: argparse.Namespace) -> Outcome:
    """Estimate and tell what was found."""
    from railtrack_ros.runs.estimate import estimate

    track, vehicle = load_track(args.track), load_vehicle(args.vehicle)
    begin = time.perf_counter()
    with common.progress(None, 's', 'estimating') as bar:

        def show(done: float, total: float) -> None:
            bar.total = total
            bar.update(done - bar.n)

        found = estimate(
            args.bag, track, vehicle, args.output,
            settings_from(argparse.Namespace(**{**vars(args), 'start_position': None}),
                          EstimatorSettings),
            settings_from(args, IndicatorSettings),
            args.start_position, args.acceleration_topic, args.speed_topic, show, args.jobs,
            args.sample_block,
        )  # fmt: skip
    if args.report:
        from railtrack_ros.runs.estimate_report import write_estimate_report

        with common.progress(None, 's', 'report') as bar:
            write_estimate_report(args.report, Path(args.bag[0]).name, found, track, vehicle,
                                  settings_from(args, IndicatorSettings), args.output, show,
                                  args.jobs)
    elapsed = time.perf_counter() - begin
    summary = {'output': args.output, **found.summary(), 'elapsed_s': elapsed}
    speed = f'{found.duration / elapsed:.1f} times real time'
    written = ', '.join(filter(None, (args.output, args.report)))
    lines = [*found.lines(), f'written: {written} ({speed})']
    return Outcome(summary, lines, found.defects, found.remarks)
