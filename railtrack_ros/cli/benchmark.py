"""Command `railtrack benchmark`."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from typing import TYPE_CHECKING, Any

from railtrack_ros.cli.main import Outcome
from railtrack_ros.errors import InputError

if TYPE_CHECKING:
    from types import ModuleType

EXAMPLE = 'railtrack benchmark --only full_model --json'

# Modules of the folder benchmarks/: each has a TITLE and figures() that yields what it measures.
MODULES = ('bags', 'frequency_domain', 'full_model', 'indicators', 'online', 'peer', 'thesis_speed')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('--only', choices=MODULES, help='measure this part alone')


def run(args: argparse.Namespace) -> Outcome:
    """Measure and print figure by figure."""
    summary: dict[str, Any] = {'processor': processor(), 'cores': os.cpu_count()}
    stream = sys.stderr if args.json else sys.stdout
    print(f'{summary["processor"]}, {summary["cores"]} cores; one thread, best of several '
          'repeats', file=stream)
    for name in [args.only] if args.only else MODULES:
        module = benchmark_module(name)
        print(f'\n{module.TITLE}', file=stream, flush=True)
        summary[name] = []
        for figure in module.figures():
            summary[name].append({
                'name': figure.name, 'value': figure.value, 'unit': figure.unit,
                'at_most': figure.at_most, 'at_least': figure.at_least, 'met': figure.met})
            target = ''
            if figure.met is not None:
                bound = (f'at most {figure.at_most:g}' if figure.at_least is None
                         else f'at least {figure.at_least:g}')
                target = f'  ({bound}{"" if figure.met else ": NOT MET"})'
            print(f'  {figure.name:<76}{figure.value:10.4g} {figure.unit}{target}',
                  file=stream, flush=True)
    return Outcome(summary)


def benchmark_module(name: str) -> ModuleType:
    """Import a module of the folder benchmarks/, in the checkout or installed beside config/."""
    from railtrack_ros.paths import share_directory

    folder = share_directory() / 'benchmarks'
    if not (folder / f'{name}.py').is_file():
        raise InputError(f'benchmark {name}: {folder / name}.py is missing, reinstall')
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
    return importlib.import_module(name)


def processor() -> str:
    """Name of the processor, as far as the system tells."""
    try:
        with open('/proc/cpuinfo', encoding='utf-8') as file:
            for line in file:
                if line.startswith('model name'):
                    return line.partition(':')[2].strip()
    except OSError:
        pass
    return 'unknown processor'
