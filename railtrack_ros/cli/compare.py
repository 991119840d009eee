"""Command `railtrack compare`."""

from __future__ import annotations

import argparse
from pathlib import Path

from railtrack_ros.cli import common
from railtrack_ros.cli.main import Outcome
from railtrack_ros.parameters import Range
from railtrack_ros.vehicle.description import load_vehicle

EXAMPLE = 'railtrack compare spring.mcap autumn.mcap --output compared'
SEARCH = Range(minimum=0.0, maximum=100.0)
SECTIONS = Range(minimum=1.0, maximum=1000.0)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('first', metavar='A', help='a recording with results: of estimate, of '
                        'replay (replay.mcap), or with truth')
    parser.add_argument('second', metavar='B', help='another, or the same with other results')
    parser.add_argument('--first-results', metavar='NODE',
                        help='whose results in A, such as /full_model or /truth (default: those '
                        'of the estimator, else what there is)')
    parser.add_argument('--second-results', metavar='NODE', help='the same in B')
    common.add_vehicle(parser, required=False)
    parser.add_argument('--search', type=common.number(SEARCH), metavar='M',
                        help='how far positions of the two may be apart at the beginning '
                        '(default 5; 0, that is as they are, for two results of one recording)')
    parser.add_argument('--section', type=common.number(SECTIONS), default=10.0, metavar='M',
                        help='length of the sections that differences are summed up over '
                        '(default 10)')
    common.add_output(parser, 'DIR', 'folder for report.html, errors.csv and shifts.csv')


def run(args: argparse.Namespace) -> Outcome:
    """Compare two results along the track."""
    from railtrack_ros.runs.compare import compare
    from railtrack_ros.runs.compare_report import summary, write_comparison

    vehicle = load_vehicle(args.vehicle) if args.vehicle else None
    with common.progress(None, 'm', 'comparing') as bar:
        found = compare(args.first, args.second, (args.first_results, args.second_results),
                        vehicle, args.search, args.section,
                        lambda metres: bar.update(metres - bar.n))
    report = write_comparison(Path(args.output), found)
    return Outcome({**summary(found), 'output': args.output},
                   [*report.findings, f'report: {args.output}/report.html'], found.notes)
