"""Command `railtrack synthesize`."""

from __future__ import annotations

import argparse

from railtrack_ros.cli import common
from railtrack_ros.cli.main import Outcome
from railtrack_ros.parameters import NOT_NEGATIVE, POSITIVE, Range

EXAMPLE = (
    'railtrack synthesize --track mainline_soft_pads --vehicle measurement_coach\n'
    '      --duration 10 --speed 25 --roughness iso3095\n'
    '      --corrugation 0.045:10e-6:100:150:left --seed 1 run.mcap'
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    common.add_track(parser)
    common.add_vehicle(parser)
    number = common.number
    parser.add_argument('--duration', type=number(POSITIVE), required=True, metavar='S',
                        help='length of the run, s')
    parser.add_argument('--speed', type=number(NOT_NEGATIVE), required=True, metavar='V0',
                        help='speed at the start, m/s')
    parser.add_argument('--acceleration', type=number(), default=0.0, metavar='A',
                        help='m/s2, negative to brake (default 0)')
    parser.add_argument('--start-position', type=number(), default=0.0, metavar='M',
                        help='track position of the reference point at the start, m (default 0); '
                        'sleepers lie at multiples of their spacing')
    parser.add_argument('--roughness', default='none', metavar='R',
                        help='iso3095: random, at the limit curve of ISO 3095; or a CSV file with '
                        'position_m and irregularity_m, or irregularity_left_m and '
                        'irregularity_right_m; or none (default)')
    parser.add_argument('--roughness-level', type=number(Range(minimum=-60.0, maximum=20.0)),
                        default=0.0, metavar='DB',
                        help='gain of the roughness, -6 is half of it (default 0)')
    parser.add_argument('--corrugation', action='append', default=[],
                        metavar='WAVELENGTH:AMPLITUDE:FROM:TO[:RAIL]',
                        help='a sinusoidal stretch, all in metres, on both rails or on the left or '
                        'right one; can be given several times')
    parser.add_argument('--irregularity', action='append', default=[], metavar='PART',
                        help='a further part, all in metres: joint:AT:DEPTH:LENGTH, '
                        'flat:LENGTH:DEPTH[:AXLE_BOX], sine:WAVELENGTH:AMPLITUDE or a CSV file; '
                        'can be given several times')
    parser.add_argument('--noise', type=number(NOT_NEGATIVE), default=0.3, metavar='RMS',
                        help='white noise of the accelerometers, m/s2 rms (default 0.3)')
    parser.add_argument('--sample-rate', type=number(POSITIVE), default=25600.0, metavar='HZ',
                        help='of the accelerometers (default 25600)')
    parser.add_argument('--block', type=number(POSITIVE), default=0.01, metavar='S',
                        help='duration of a message (default 0.01)')
    parser.add_argument('--seed', type=common.count(0), required=True, metavar='N',
                        help='of roughness and noise: the same seed gives the same recording')
    parser.add_argument('output', metavar='OUT', help='NAME.mcap, or a rosbag2 folder')


def run(args: argparse.Namespace) -> Outcome:
    """Write the recording."""
    from railtrack_ros.irregularity.surface import read_part
    from railtrack_ros.runs.synthesize import synthesize
    from railtrack_ros.runs.virtual_run import Corrugation, RunSettings
    from railtrack_ros.track.description import load_track
    from railtrack_ros.vehicle.description import load_vehicle

    settings = RunSettings(
        duration=args.duration, speed=args.speed, acceleration=args.acceleration,
        start_position=args.start_position, roughness=args.roughness,
        roughness_level=args.roughness_level,
        corrugations=tuple(Corrugation.parse(text) for text in args.corrugation),
        irregularity=tuple(read_part(text) for text in args.irregularity),
        noise=args.noise, sample_rate=args.sample_rate, block=args.block, seed=args.seed)
    track, vehicle = load_track(args.track), load_vehicle(args.vehicle)
    with common.progress(args.duration, 's', 'virtual run') as bar:
        summary = synthesize(track, vehicle, settings, args.output,
                             lambda seconds: bar.update(seconds - bar.n))
    lines = [
        f'{args.output}: {summary["duration_s"]:g} s, {summary["distance_m"]:.1f} m, '
        f'{len(vehicle.axle_boxes)} axle boxes at {settings.sample_rate:g} Hz, '
        f'{summary["messages"]} messages',
        f'truth: full model of {track.name}, time step '
        f'{1e6 * summary["time_step_of_truth_s"]:.3g} us',
    ]
    return Outcome(summary, lines)
