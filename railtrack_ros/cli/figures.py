"""Command `railtrack figures`."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from railtrack_ros.cli import common
from railtrack_ros.cli.main import Outcome
from railtrack_ros.errors import InputError

if TYPE_CHECKING:
    from railtrack_ros.figures.evidence import Section

EXAMPLE = 'railtrack figures --output figures\n  railtrack figures --only 3.4 --output figures'
PAGE = 'validation.md'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('--only', metavar='NUMBERS', type=lambda text: text.split(','), default=[],
                        help='some figures only, such as 2.5a,3.4 (3.4 is 3.4a and 3.4b); no page '
                        'is written then')
    parser.add_argument('--page', metavar='FILE',
                        help=f'where the page goes that holds figures against the thesis '
                        f'(default: {PAGE} in the folder)')
    common.add_output(parser, 'DIR', 'figure_N.png and the data as figure_N.csv, or '
                      'figure_N_PART.csv for parts, and ' + PAGE)


def run(args: argparse.Namespace) -> Outcome:
    """Compute the figures, then the independent evidence, then write the page."""
    from railtrack_ros.figures import catalogue, page

    if args.page and args.only:
        raise InputError('--page: the page needs all figures; leave --only out')
    folder = Path(args.output).expanduser()
    entries = catalogue.chosen(args.only)
    sections = [] if args.only else [*page.SECTIONS, _decay_rates, _speed]
    begun = time.monotonic()
    made, files, written = [], [], []
    with common.progress(len(entries) + len(sections), 'parts', 'figures') as bar:
        for entry, figure, paths in catalogue.produce(folder, entries, bar.update):
            made.append((entry, figure))
            files += paths
        for make in sections:
            written.append(make())
            bar.update(1)
    if not args.only:
        target = Path(args.page).expanduser() if args.page else folder / PAGE
        page.write_page(target, folder, made, written)
        files.append(target)
    taken = time.monotonic() - begun
    findings = [finding for _, figure in made for finding in figure.findings]
    differing = [f'figure {entry.number}: {finding.thesis}' for entry, figure in made
                 for finding in figure.findings if finding.verdict == 'differs']
    summary = {
        'figures': [entry.number for entry, _ in made], 'findings': len(findings),
        'differing': differing, 'seconds': taken, 'files': [str(path) for path in files],
        'output': args.output,
    }
    lines = [f'{len(made)} figures in {taken:.0f} s, {len(findings)} statements compared',
             *(f'differs: {text}' for text in differing), f'written: {args.output}']
    if not args.only:
        lines.append(f'the page: {target}')
    return Outcome(summary, lines)


def _decay_rates() -> Section:
    """Measured decay rates, if they are at hand."""
    from railtrack_ros.cli.benchmark import benchmark_module
    from railtrack_ros.dynamics.decay_rate import track_decay_rate
    from railtrack_ros.figures.page import decay_section
    from railtrack_ros.paths import reference_data

    folder = reference_data()
    if folder is None:
        return decay_section()
    module = benchmark_module('measured_decay_rates')
    measured = module.measurements(folder)
    values = module.fit(10.0 ** np.log10(measured).mean(axis=0))
    rate = track_decay_rate(module.plausible_track(values)).rate
    return decay_section(measured, rate, values)


def _speed() -> Section:
    """The thesis' claim of speed, measured on this machine."""
    from railtrack_ros.cli.benchmark import benchmark_module, processor
    from railtrack_ros.figures.page import speed_section

    return speed_section(benchmark_module('thesis_speed').measure(), processor())
