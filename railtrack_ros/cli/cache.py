"""Command `railtrack cache`."""

from __future__ import annotations

import argparse
import time

from railtrack_ros.cli.main import Outcome

EXAMPLE = 'railtrack cache --clear'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('--clear', action='store_true',
                        help='remove the tables; they are computed again when they are needed')


def run(args: argparse.Namespace) -> Outcome:
    """List what is kept on disk: modes of tracks and impulse responses."""
    from railtrack_ros.dynamics import cache

    if args.clear:
        freed = cache.clear()
        return Outcome({'folder': str(cache.folder()), 'freed_bytes': freed},
                       [f'{freed / 1e6:.1f} MB removed from {cache.folder()}'])
    entries = cache.entries()
    total = sum(entry.size for entry in entries)
    lines = [f'{entry.size / 1e6:9.2f} MB  '
             f'{time.strftime("%Y-%m-%d %H:%M", time.localtime(entry.path.stat().st_mtime))}  '
             f'{entry.name}' for entry in entries]
    return Outcome(
        {'folder': str(cache.folder()), 'bytes': total, 'largest_bytes': cache.LARGEST,
         'entries': [{'name': entry.name, 'bytes': entry.size} for entry in entries]},
        [*lines, f'{len(entries)} tables, {total / 1e6:.1f} of at most '
         f'{cache.LARGEST / 1e6:.0f} MB in {cache.folder()}'])
