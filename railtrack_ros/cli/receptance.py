"""Command `railtrack receptance`."""

from __future__ import annotations

import argparse
import math

from railtrack_ros.cli import common
from railtrack_ros.cli.main import Outcome
from railtrack_ros.errors import InputError

EXAMPLE = (
    'railtrack receptance --track blanco_table_3_1 --at midspan --frequencies 10:2500:5\n'
    '      --output receptance.csv --plot receptance.png'
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    common.add_track(parser)
    parser.add_argument('--at', type=place, required=True, metavar='PLACE',
                        help='where the force acts: midspan, sleeper (on the rail above it), or '
                        'metres along the rail, sleepers at multiples of their spacing')
    response = parser.add_mutually_exclusive_group()
    response.add_argument('--response-at', type=place, metavar='PLACE',
                          help='where the rail answers (default: under the force)')
    response.add_argument('--sleeper', type=int, metavar='K',
                          help='the answer of sleeper K instead of the rail; 0 lies at 0 m')
    common.add_frequencies(parser)
    parser.add_argument('--bays', type=bays, default=None, metavar='infinite|N',
                        help='infinite: exact, without mesh or ends (default); N: finite elements '
                        'with free ends, sleeper 0 in the middle bay')
    parser.add_argument('--local-elements', type=common.count(), metavar='N',
                        help='with --local-system dynamic: local modes in N elements around the '
                        'force only (an odd number; the thesis takes 5) instead of in all')
    common.add_output(parser, 'CSV', 'frequency_hz, receptance_real_m_per_n, '
                      'receptance_imag_m_per_n, for a force exp(i omega t)')
    common.add_plot(parser)
    common.add_model_options(parser)


def run(args: argparse.Namespace) -> Outcome:
    """Compute the receptance."""
    import numpy as np

    from railtrack_ros.dynamics.receptance import (
        FiniteTrack,
        checked_frequencies,
        finite_track,
        local_modes_around,
        receptances,
    )
    from railtrack_ros.output import metres, write_csv
    from railtrack_ros.report import curves
    from railtrack_ros.track.description import Track
    from railtrack_ros.track.infinite import Sleeper

    if args.plot:
        curves.check_format(args.plot)
    track, mesh = common.model(args)
    remarks = []
    if args.bays is None:
        if args.local_elements is not None:
            raise InputError('--local-elements: the infinite track is exact and has no mesh; give '
                             '--bays N for finite elements')
        unused = [f'--{option.replace("_", "-")}'
                  for option in ('local_system', 'elements_per_bay', 'elements_per_pad')
                  if getattr(args, option) is not None]
        if unused:
            remarks = [f'{", ".join(unused)}: without effect, as the infinite track is exact and '
                       'has no mesh; give --bays N for finite elements']
    frequencies = checked_frequencies(args.frequencies)
    force = position(args.at, track.support.spacing)
    response: float | Sleeper = force
    if args.sleeper is not None:
        response = Sleeper(args.sleeper)
    elif args.response_at is not None:
        response = position(args.response_at, track.support.spacing)
    subject: Track | FiniteTrack = track
    if args.bays is not None:
        subject = finite_track(track, mesh, args.bays)
        if args.local_elements is not None:
            subject = local_modes_around(subject, force, args.local_elements)
    with common.progress(frequencies.size, 'Hz', 'receptance') as bar:
        h = receptances(subject, frequencies, [response], force, bar.update)[0]
    write_csv(args.output, {
        'frequency_hz': frequencies,
        'receptance_real_m_per_n': h.real,
        'receptance_imag_m_per_n': h.imag,
    })
    where = f'force at {metres(force)} m'
    if isinstance(response, Sleeper):
        where += f', sleeper {response.number}'
    elif response != force:
        where += f', rail at {metres(response)} m'
    kind = 'infinite track' if args.bays is None else f'{args.bays} bays'
    what = f'{track.name}, {track.support.kind} supports, {kind}, {where}'
    if args.plot:
        curves.draw_receptance(args.plot, frequencies, {where: h},
                               title=f'{track.name}, {track.support.kind} supports, {kind}')
    top = int(np.abs(h).argmax())
    summary = {
        'track': track.name, 'support': track.support.kind, 'bays': args.bays or 'infinite',
        'force_at_m': force,
        'response_at_m': None if isinstance(response, Sleeper) else response,
        'sleeper': args.sleeper, 'frequencies': frequencies.size,
        'largest_m_per_n': abs(h[top]), 'largest_at_hz': frequencies[top],
        'output': args.output, 'plot': args.plot, 'remarks': remarks,
    }
    lines = [
        what,
        f'{frequencies.size} frequencies, the largest answer {abs(h[top]):.4e} m/N at '
        f'{frequencies[top]:g} Hz',
        *common.written(args),
    ]
    return Outcome(summary, lines, remarks=remarks)


def place(text: str) -> str | float:
    """Argument type: midspan, sleeper or finite metres."""
    if text in ('midspan', 'sleeper'):
        return text
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f'expected midspan, sleeper or metres, got {text!r}')
    return value


def position(place: str | float, spacing: float) -> float:
    """Return the position [m] of a place."""
    if isinstance(place, float):
        return place
    return 0.5 * spacing if place == 'midspan' else 0.0


def bays(text: str) -> int | None:
    """Argument type: `infinite` (None) or a number of bays."""
    if text == 'infinite':
        return None
    try:
        return common.count()(text)
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(
            f'expected infinite or a whole number of at least 1, got {text!r}') from None
