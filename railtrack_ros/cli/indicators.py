"""Command `railtrack indicators`."""

from __future__ import annotations

import argparse
import math

from railtrack_ros.cli import common
from railtrack_ros.cli.main import Outcome
from railtrack_ros.cli.settings_options import add_settings, settings_from
from railtrack_ros.estimation.settings import IndicatorSettings
from railtrack_ros.vehicle.description import load_vehicle

EXAMPLE = 'railtrack indicators estimate.mcap --section 10 --output indicators.csv'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('bag', metavar='BAG', help='a recording with an estimate')
    common.add_output(parser, 'FILE.csv', 'table with a row per section and axle box')
    common.add_vehicle(parser, required=False)
    parser.add_argument(
        '--topic', metavar='TOPIC', help='irregularity (default: /track_estimator/irregularity)'
    )
    add_settings(parser, IndicatorSettings, 'sections', names={'section_length': 'section'})


def run(args: argparse.Namespace) -> Outcome:
    """Write the table and tell what stands out."""
    from railtrack_ros.runs.indicators import indicators, write_sections
    from railtrack_ros.runs.results import describe

    vehicle = load_vehicle(args.vehicle) if args.vehicle else None
    with common.progress(None, 's', 'reading') as bar:

        def show(done: float, total: float) -> None:
            bar.total = total
            bar.update(done - bar.n)

        settings = settings_from(args, IndicatorSettings)
        found = indicators(args.bag, settings, vehicle, args.topic, show)
    write_sections(args.output, found.sections)
    named = [s for s in found.sections if math.isfinite(s.dominant_wavelength)]
    named.sort(key=lambda section: -section.dominant_above_limit)
    lines = [
        f'{len(found.sections)} sections of {settings.section_length:g} m, a wavelength stands '
        f'out in {len(named)}',
        *(f'  {section.axle_box}, {describe(section)}' for section in named[:5]),
        f'written: {args.output}',
    ]
    summary = {
        'output': args.output,
        'sections': len(found.sections),
        'sections_with_dominant_wavelength': len(named),
        'most_prominent': [section.row() for section in named[:5]],
    }
    return Outcome(summary, lines, found.defects)
