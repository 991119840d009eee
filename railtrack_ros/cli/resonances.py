"""Command `railtrack resonances`."""

from __future__ import annotations

import argparse
import dataclasses

from railtrack_ros.cli import common
from railtrack_ros.cli.main import Outcome

EXAMPLE = (
    'railtrack resonances --track blanco_table_3_1 --vehicle blanco_table_3_1 '
    '--plot resonances.png'
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    common.add_track(parser)
    common.add_vehicle(parser, required=False)
    parser.add_argument('--output', metavar='CSV',
                        help='resonance, place, frequency_hz, magnitude, unit')
    common.add_plot(parser)
    common.add_track_options(parser)


def run(args: argparse.Namespace) -> Outcome:
    """Find the resonances."""
    import numpy as np

    from railtrack_ros.dynamics.receptance import receptance
    from railtrack_ros.dynamics.resonances import p2_resonances, track_resonances
    from railtrack_ros.output import write_csv
    from railtrack_ros.report import curves
    from railtrack_ros.track.rail import pinned_pinned_frequency
    from railtrack_ros.vehicle.description import load_vehicle

    if args.plot:
        curves.check_format(args.plot)
    track = common.track(args)
    found = track_resonances(track)
    if args.vehicle is not None:
        found += p2_resonances(track, load_vehicle(args.vehicle))
    units = ['N/m' if r.name == 'P2' else 'm/N' for r in found]
    if args.output:
        write_csv(args.output, {
            'resonance': [r.name for r in found], 'place': [r.place for r in found],
            'frequency_hz': [r.frequency for r in found],
            'magnitude': [r.magnitude for r in found], 'unit': units,
        })
    pinned = pinned_pinned_frequency(track.rail, track.support.spacing)
    if args.plot:
        grid = np.geomspace(10.0, 1.6 * pinned, 900)
        marks = [
            curves.Mark(r.name.replace(' ', '\n'), r.frequency, r.magnitude,
                        below=r.name in ('dip', 'pinned-pinned antiresonance'))
            for r in found if (r.place == 'midspan') != (r.name == 'pinned-pinned antiresonance')
            and r.name != 'P2']
        midspan = 0.5 * track.support.spacing
        marks += [curves.Mark('P2', r.frequency,
                              float(abs(receptance(track, [r.frequency], midspan)[0])), below=True)
                  for r in found if r.name == 'P2' and r.place == 'midspan']
        curves.draw_receptance(
            args.plot, grid,
            {'mid-span': receptance(track, grid, midspan),
             'above a sleeper': receptance(track, grid, 0.0)},
            marks, f'Point receptance of {track.name}, {track.support.kind} supports')
    summary = {
        'track': track.name, 'support': track.support.kind, 'vehicle': args.vehicle,
        'resonances': [{**dataclasses.asdict(r), 'unit': unit}
                       for r, unit in zip(found, units, strict=True)],
        'pinned_pinned_of_the_rail_alone_hz': pinned, 'output': args.output, 'plot': args.plot,
    }
    lines = [f'{r.place:<8}  {r.name:<28}{r.frequency:8.1f} Hz  {r.magnitude:.4e} {unit}'
             for r, unit in zip(found, units, strict=True)]
    lines.append(f'pinned-pinned frequency of the rail alone: {pinned:.1f} Hz')
    return Outcome(summary, [*lines, *common.written(args)])
