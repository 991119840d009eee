"""Command `railtrack monitor`."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from railtrack_ros.cli import common
from railtrack_ros.cli.main import Outcome
from railtrack_ros.errors import InputError
from railtrack_ros.parameters import POSITIVE

if TYPE_CHECKING:
    from rich.console import Group
    from rich.table import Table

    from railtrack_ros.node.monitor import View

EXAMPLE = 'railtrack monitor --node /track_estimator'

BLOCKS = '▁▂▃▄▅▆▇█'
LEVELS = ('OK', 'WARN', 'ERROR', 'STALE')
COLOURS = ('green', 'yellow', 'bold red', 'dim')
REFRESH = 0.25  # s

# Characters of a number, and of the shortest and longest sparkline.
NUMBER = 6
SHORTEST, LONGEST = 3, 24

COMFORTABLE = 80  # columns; below it they stand closer together

BOX = 'axle box '

# Without --seconds on something that is no terminal: long enough for every topic to speak.
SNAPSHOT = 3.0
SEARCH = 5.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('--node', metavar='NAME', help='full name of the estimator (default: the '
                        'only one that is there)')
    parser.add_argument('--seconds', type=common.number(POSITIVE), metavar='S',
                        help='end after so long (default: on a terminal when Ctrl-C is pressed, '
                             f'else {SNAPSHOT:g})')


def run(args: argparse.Namespace) -> Outcome:
    """Show an estimator until it is enough."""
    try:
        from railtrack_ros.node.monitor import find_estimators, monitored
    except ImportError as error:
        raise InputError(f'the monitor needs ROS 2, which is not installed ({error}); '
                         '`make setup` installs it') from error
    from rich.console import Console
    from rich.live import Live

    wide = Console()
    live = wide.is_terminal and not args.json
    seconds = args.seconds or (math.inf if live else SNAPSHOT)
    node = f'/{args.node.strip("/")}' if args.node else _only(find_estimators(SEARCH))
    with monitored(node) as (monitor, executor):
        begun, shown = time.monotonic(), 0.0
        screen = Live(console=wide, screen=True, auto_refresh=False) if live else None
        try:
            if screen:
                screen.start()
            while (passed := time.monotonic() - begun) < seconds:
                executor.spin_once(timeout_sec=0.05)
                if screen and passed - shown > REFRESH:
                    shown = passed
                    screen.update(page(monitor.view, wide.width), refresh=True)
        except KeyboardInterrupt:
            pass
        finally:
            if screen:
                screen.stop()
        view = monitor.view
    if not args.json:
        wide.print(page(view, wide.width))
    if view.stale:
        raise InputError(f'{node}: nothing was heard of it: see `--node`, ROS_DOMAIN_ID and '
                         'whether it is active')
    return Outcome(view.summary())


def _only(found: Sequence[str]) -> str:
    if not found:
        raise InputError(f'no estimator within {SEARCH:g} s: start one, or see ROS_DOMAIN_ID')
    if len(found) > 1:
        raise InputError(f'several estimators: choose one with --node: {", ".join(found)}')
    return found[0]


def page(view: View, width: int = 160) -> Group:
    """Return all that is shown, in so many columns: numbers by axle box, then what is wrong.

    What matters least gives way in a small terminal: the sparklines become shorter, and what is
    well comes last, where it may be cut off.
    """
    from rich.console import Group
    from rich.text import Text

    level = view.level
    values = {name: dict(status.values) for name, status in view.parts.items()}
    speed, load, latency = (values.get(name, {}) for name in ('speed', 'load', 'latency'))
    head = Text.assemble(
        (f' {LEVELS[level]} ', f'reverse {COLOURS[level]}'), f' {view.node}  ',
        f'{speed.get("speed_m_s", "?")} m/s  {speed.get("position_m", "?")} m  ',
        f'latency {latency.get("p50_ms", "?")}, {latency.get("p99_ms", "?")} ms (p50, p99)  ',
        f'{_percent(load.get("core_share"))} of a core  {load.get("memory_mb", "?")} MB')
    rows: list[Any] = [head, _table(view, width)]
    told = [(status.level, name, status.message) for name, status in view.parts.items()
            if status.level or not name.startswith(BOX)]
    told += [(status.level, f'last section of {name}', status.message)
             for name, status in view.corrugation.items() if status.level]
    for of_level, name, message in sorted(told, key=lambda part: -part[0]):
        line = Text.assemble((f'{LEVELS[of_level]:>5} ', COLOURS[of_level]), f'{name}: ', message)
        if not of_level:
            line.no_wrap, line.overflow = True, 'ellipsis'
        rows.append(line)
    return Group(*rows)


def _table(view: View, width: int) -> Table:
    """Return the numbers of the axle boxes, with sparklines as long as there is room for."""
    from rich.table import Table
    from rich.text import Text

    bands = sorted({band for box in view.boxes.values() for band in box.bands},
                   key=lambda band: int(band.split('_')[0]))
    gap = 2 if width >= COMFORTABLE else 1
    first, last = max(map(len, view.boxes), default=8) + gap, 5
    # A column that would be cut is not shown at all.
    widest = max((len(band) for band in bands), default=0)
    bands = bands[:max((width - first - last) // (max(widest, 8) + gap) - 1, 0)]
    room = (width - first - last) // (len(bands) + 1) - gap
    length = min(room - NUMBER - 1, LONGEST)
    table = Table(box=None, pad_edge=False, header_style='bold', padding=(0, gap, 0, 0))
    table.add_column('axle box', no_wrap=True)
    table.add_column('force kN', no_wrap=True)
    for band in bands:
        unit = ' mm' if room >= widest + 3 else ''
        table.add_column(band.replace('_', '-') + unit, no_wrap=True)
    table.add_column('', no_wrap=True)
    for name, box in sorted(view.boxes.items()):
        status = view.parts.get(f'{BOX}{name}')
        state = '' if status is None else LEVELS[status.level]
        table.add_row(
            name, _cell([1e-3 * force for force in box.forces], 0, length),
            *(_cell(box.bands.get(band, ()), 1, length) for band in bands),
            Text(state, style=COLOURS[status.level] if status else ''))
    caption = 'largest force in 0.1 s' + (
        ', RMS of the irregularity by wavelength in µm' if bands else '')
    table.caption, table.caption_justify = caption, 'left'
    return table


def _cell(values: Iterable[float], digits: int, length: int) -> str:
    numbers = list(values)
    if not numbers:
        return ''
    number = f'{numbers[-1]:{NUMBER}.{digits}f}'
    return f'{number} {sparkline(numbers[-length:])}' if length >= SHORTEST else number


def _percent(text: str | None) -> str:
    return '?' if text is None else f'{100.0 * float(text):.0f} %'


def sparkline(values: Sequence[float]) -> str:
    """Return one block character for each number, from the lowest to the highest of them."""
    finite = [value for value in values if math.isfinite(value)]
    if not finite:
        return ' ' * len(values)
    low, high = min(finite), max(finite)
    scale = (len(BLOCKS) - 1) / (high - low) if high > low else 0.0
    return ''.join(
        BLOCKS[round((value - low) * scale)] if math.isfinite(value) else ' ' for value in values)

