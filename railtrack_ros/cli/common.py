"""Arguments that commands share, and their progress bar."""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from railtrack_ros.errors import InputError
from railtrack_ros.output import refuse_inputs
from railtrack_ros.parameters import ANY, NOT_NEGATIVE, Range
from railtrack_ros.track.description import SUPPORT_KINDS, Track, load_track, shipped_tracks
from railtrack_ros.vehicle.description import shipped_vehicles

if TYPE_CHECKING:
    from railtrack_ros.track.bay import Mesh

MOST_FREQUENCIES = 1_000_000

# Arguments of all commands that name what is written; whatever else names a file is an input.
OUTPUTS = ('output', 'plot', 'report', 'page', 'rails', 'grind_list', 'spectra', 'wheels',
           'waveforms')


def number(allowed: Range = ANY) -> Callable[[str], float]:
    """Return an argument type: a finite number inside a range."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float('nan')
        if value not in allowed:
            raise argparse.ArgumentTypeError(f'expected {allowed}, got {text!r}')
        return value

    return read


def count(least: int = 1) -> Callable[[str], int]:
    """Return an argument type: a whole number of at least `least`."""

    def read(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if value < least:
            raise argparse.ArgumentTypeError(
                f'expected a whole number of at least {least}, got {text!r}'
            )
        return value

    return read


def add_track(parser: argparse.ArgumentParser) -> None:
    """Add --track, a name or a path for load_track."""
    shipped = ', '.join(shipped_tracks())
    parser.add_argument(
        '--track', metavar='T', required=True, help=f'YAML file or shipped track: {shipped}'
    )


def add_vehicle(parser: argparse.ArgumentParser, required: bool = True) -> None:
    """Add --vehicle, a name or a path for load_vehicle."""
    shipped = ', '.join(shipped_vehicles())
    parser.add_argument(
        '--vehicle', metavar='V', required=required, help=f'YAML file or shipped vehicle: {shipped}'
    )


def add_bags(parser: argparse.ArgumentParser) -> None:
    """Add BAG, one recording or several that are one run."""
    parser.add_argument(
        'bag',
        metavar='BAG',
        nargs='+',
        help='a rosbag2 folder, or an .mcap or .db3 file; several are read as one run',
    )


def add_sample_block(parser: argparse.ArgumentParser) -> None:
    """Add how single samples are gathered."""
    from railtrack_ros.estimation.samples import SAMPLE_BLOCK

    parser.add_argument(
        '--sample-block', type=number(Range(minimum=0.002, maximum=1.0)), default=SAMPLE_BLOCK,
        metavar='S',
        help='single samples (Imu, AccelStamped) are gathered to blocks of this length '
        f'(default {SAMPLE_BLOCK:g} s, as the node does)')


def add_output(parser: argparse.ArgumentParser, metavar: str, help: str) -> None:
    """Add --output, required."""
    parser.add_argument('--output', metavar=metavar, required=True, help=help)


def add_plot(parser: argparse.ArgumentParser) -> None:
    """Add --plot."""
    parser.add_argument('--plot', metavar='FILE', help='also draw it: .png, .svg or .pdf')


def written(args: argparse.Namespace) -> list[str]:
    """Return a line that names the files which --output and --plot have made."""
    files = [name for name in (args.output, args.plot) if name]
    return [f'written: {", ".join(files)}'] if files else []


def refuse_overwriting(args: argparse.Namespace) -> None:
    """Refuse arguments that would replace an input by an output, or one output by another.

    Raises
    ------
    InputError
        Two arguments mean the same file, or an output lies in an input folder.
    """
    values = vars(args)
    outputs = [values[name] for name in OUTPUTS if values.get(name)]
    inputs: list[str] = []
    for name, value in values.items():
        if name not in OUTPUTS:
            inputs += [x for x in (value if isinstance(value, list) else [value])
                       if isinstance(x, str)]
    written: set[str] = set()
    for output in outputs:
        refuse_inputs(output, inputs)
        place = os.path.realpath(os.path.expanduser(output))
        if place in written and not place.startswith('/dev/'):
            raise InputError(f'{output}: is named for two outputs; choose another for one of them')
        written.add(place)


def add_frequencies(parser: argparse.ArgumentParser) -> None:
    """Add --frequencies, a list of Hz."""
    parser.add_argument(
        '--frequencies',
        type=frequencies,
        required=True,
        metavar='F1,F2,...|LO:HI:STEP',
        help='Hz: a list, or a range with both ends',
    )


def frequencies(text: str) -> list[float]:
    """Argument type: F1,F2,... or LO:HI:STEP; the values are not checked further."""
    try:
        if ':' not in text:
            return [float(part) for part in text.split(',')]
        low, high, step = (float(part) for part in text.split(':'))
        if not (step > 0.0 and high >= low):
            raise ValueError
        steps = (high - low) / step
        if not steps < MOST_FREQUENCIES:
            raise argparse.ArgumentTypeError(
                f'{text!r} are more than {MOST_FREQUENCIES} frequencies'
            )
        return [low + step * i for i in range(int(steps + 1e-6) + 1)]
    except ValueError:
        raise argparse.ArgumentTypeError(
            f'expected F1,F2,... or LO:HI:STEP in Hz, got {text!r}'
        ) from None


def add_track_options(parser: argparse.ArgumentParser) -> Any:
    """Add the options that change the track itself; :func:`track` applies them."""
    group = parser.add_argument_group('track model')
    group.add_argument(
        '--support', choices=SUPPORT_KINDS, help="kind of support (default: the track's)"
    )
    group.add_argument(
        '--loss-factor',
        type=number(NOT_NEGATIVE),
        metavar='X',
        help="hysteretic loss factor of the rail (default: the track's)",
    )
    return group


def add_model_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that change how a track is modelled; :func:`model` applies them."""
    from railtrack_ros.track.bay import LOCAL_SYSTEMS

    group = add_track_options(parser)
    group.add_argument(
        '--local-system', choices=LOCAL_SYSTEMS, help='local deflection under the contact point'
    )
    group.add_argument(
        '--elements-per-bay', type=count(), metavar='N', help='elements from sleeper to sleeper'
    )
    group.add_argument(
        '--elements-per-pad', type=count(), metavar='N', help='of them on a distributed support'
    )


def track(args: argparse.Namespace) -> Track:
    """Return the track of the arguments with --support and --loss-factor applied.

    Raises
    ------
    InputError
        No such track.
    """
    track = load_track(args.track)
    if args.support is not None:
        support = dataclasses.replace(track.support, kind=args.support)
        track = dataclasses.replace(track, support=support)
    if args.loss_factor is not None:
        rail = dataclasses.replace(track.rail, loss_factor=args.loss_factor)
        track = dataclasses.replace(track, rail=rail)
    return track


def model(args: argparse.Namespace, usual: Mesh | None = None) -> tuple[Track, Mesh]:
    """Return the track of the arguments with its model options applied, and the mesh.

    What the options leave open is as in the usual mesh.

    Raises
    ------
    InputError
        No such track, or a mesh that cannot be.
    """
    from railtrack_ros.track.bay import Mesh

    chosen = {
        'local_system': args.local_system,
        'elements_per_bay': args.elements_per_bay,
        'elements_per_pad': args.elements_per_pad,
    }
    given = {key: value for key, value in chosen.items() if value is not None}
    return track(args), dataclasses.replace(usual or Mesh(), **given)


def progress(total: float | None, unit: str, description: str) -> Any:
    """Return a progress bar, a context manager whose ``update(n)`` counts on.

    It is drawn on standard error when that is a terminal and the work takes over a second.
    """
    return tqdm(
        total=total,
        unit=unit,
        desc=description,
        file=sys.stderr,
        disable=None,
        delay=1.0,
        leave=False,
        bar_format='{desc} {percentage:3.0f} % |{bar}| {remaining} left' if total else None,
    )
