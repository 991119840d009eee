"""Command `railtrack play`."""

from __future__ import annotations

import argparse
import sys

from railtrack_ros.cli import common
from railtrack_ros.cli.main import Outcome
from railtrack_ros.parameters import POSITIVE

EXAMPLE = 'railtrack play run.mcap --rate 2 --topics /axle_box_acceleration /speed'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('bag', metavar='BAG', help='recording to publish')
    parser.add_argument('--rate', type=common.number(POSITIVE), default=1.0, metavar='R',
                        help='times as fast as it was recorded (default 1)')
    parser.add_argument('--topics', nargs='+', default=[], metavar='TOPIC',
                        help='publish only these (default: all)')
    parser.add_argument('--wait-for', metavar='NODE',
                        help='begin when this node has subscribed, however long it takes to '
                             'prepare itself (default: with the first subscriber, at the latest '
                             'after 10 s)')


def run(args: argparse.Namespace) -> Outcome:
    """Publish the recording."""
    from railtrack_ros.bags.reader import open_bag
    from railtrack_ros.node.player import play

    with open_bag(args.bag) as bag:
        seconds = (bag.end_time - bag.start_time) / 1e9
    with common.progress(seconds, 's', 'playing') as bar:
        summary = play(args.bag, args.rate, args.topics,
                       say=lambda line: print(line, file=sys.stderr),
                       progress=lambda seconds: bar.update(seconds - bar.n),
                       reader=args.wait_for)
    count = sum(summary['messages'].values())
    lines = [f'{args.bag}: {count} messages on {len(summary["messages"])} topics published']
    return Outcome(summary, lines)
