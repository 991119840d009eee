"""Command `railtrack demo`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from railtrack_ros.cli import common
from railtrack_ros.cli.main import Outcome
from railtrack_ros.errors import InputError
from railtrack_ros.parameters import Range

EXAMPLE = 'railtrack demo --output demo_output'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    common.add_output(parser, 'DIR', 'folder for report.html, live.mcap, the other results and '
                      'logs; what an earlier demonstration left there is replaced')
    parser.add_argument('--duration', type=common.number(Range(minimum=2.0, maximum=600.0)),
                        default=20.0, metavar='S', help='length of the run, s (default 20)')
    parser.add_argument('--seed', type=common.count(0), default=1, metavar='N',
                        help='of roughness and noise (default 1)')


def run(args: argparse.Namespace) -> Outcome:
    """Run the demonstration."""
    try:
        from railtrack_ros.node.demo import run_demo, summary
    except ImportError as error:
        raise InputError(f'the demonstration needs ROS 2, which is not installed ({error}); '
                         '`make setup` installs it') from error

    output = Path(args.output)
    if output.exists() and not output.is_dir():
        raise InputError(f'{output}: is a file; choose another output')
    result = run_demo(output, args.duration, args.seed, _say)
    lines = [
        '',
        *result.replay.report.findings,
        '',
        f'report: {result.report.resolve()}',
        f'bag:    {result.bag.resolve()}',
    ]
    return Outcome(summary(result), lines, result.defects)


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
