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

    from railtrack_ros.node.monitor import View

EXAMPLE = 'railtrack monitor --node /track_estimator'

BLOCKS = '▁▂▃▄▅▆▇█'
LEVELS = ('OK', 'WARN', 'ERROR', 'STALE')
COLOURS = ('green', 'yellow', 'bold red', 'dim')
REFRESH = 0.25  # s

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
                    screen.update(page(monitor.view), refresh=True)
        except KeyboardInterrupt:
            pass
        finally:
            if screen:
                screen.stop()
        view = monitor.view
    if not args.json:
        wide.print(page(view))
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


def page(view: View) -> Group:
    """Return all that is shown."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    level = view.level
    values = {name: dict(status.values) for name, status in view.parts.items()}
    speed, load, latency = (values.get(name, {}) for name in ('speed', 'load', 'latency'))
    head = Text.assemble(
        (f' {LEVELS[level]} ', f'reverse {COLOURS[level]}'), f'  {view.node}   ',
        f'{speed.get("speed_m_s", "?")} m/s at {speed.get("position_m", "?")} m   ',
        f'latency {latency.get("p50_ms", "?")} / {latency.get("p99_ms", "?")} ms (p50, p99)   ',
        f'{_percent(load.get("core_share"))} of a core   {load.get("memory_mb", "?")} MB')
    bands = sorted({band for box in view.boxes.values() for band in box.bands},
                   key=lambda band: int(band.split('_')[0]))
    table = Table(expand=False, pad_edge=False, header_style='bold')
    table.add_column('axle box')
    table.add_column('largest force [kN]', no_wrap=True)
    for band in bands:
        table.add_column(f'{band.replace("_", "-")} mm [µm]', no_wrap=True)
    table.add_column('last section')
    table.add_column('health')
    for name, box in sorted(view.boxes.items()):
        status = view.parts.get(f'axle box {name}')
        section = view.corrugation.get(name)
        table.add_row(
            name, _cell([1e-3 * force for force in box.forces], 0),
            *(_cell(box.bands.get(band, ()), 1) for band in bands),
            Text(section.message, style=COLOURS[section.level] if section.level else '')
            if section else '', _health(status))
    rows: list[Any] = [head, table]
    for name, status in view.parts.items():
        if not name.startswith('axle box'):
            rows.append(Text.assemble(
                (f'{LEVELS[status.level]:>6} ', COLOURS[status.level]), f'{name}: ',
                status.message))
    return Group(*rows)


def _health(status: Any) -> Any:
    from rich.text import Text

    if status is None:
        return ''
    return Text(f'{LEVELS[status.level]} {status.message}', style=COLOURS[status.level])


def _cell(values: Iterable[float], digits: int) -> str:
    numbers = list(values)
    if not numbers:
        return ''
    return f'{numbers[-1]:7.{digits}f} {sparkline(numbers[-16:])}'


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

