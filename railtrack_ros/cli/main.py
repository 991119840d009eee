"""The program `railtrack`: find the command, run it, tell its outcome.

A command is a module of this package with

- ``EXAMPLE``, a command line that works, shown at the end of ``--help``;
- ``add_arguments(parser)``;
- ``run(args)``, which does the work and returns an :class:`Outcome`.

Only the module of the command that was asked for is imported. Exit status: 0 done, 1 failed,
2 unusable input (:class:`~railtrack_ros.errors.InputError`), 3 done although the input had
defects, 130 interrupted.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import math
import os
import re
import sys
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NoReturn

from railtrack_ros import __version__
from railtrack_ros.errors import InputError
from railtrack_ros.parameters import suggest

COMMANDS = {
    'demo': 'the whole story in two minutes: live vehicle and estimator, replay, report',
    'info': 'what a recording holds, and whether it can be estimated',
    'synthesize': 'make a recording of a virtual measurement run, with its truth',
    'import': 'turn a measurement in CSV, NPZ, MAT, HDF5 or TDMS form into a recording',
    'estimate': 'contact force, deflection and irregularity from a recording',
    'replay': 'the full track model over a recording, compared with the estimator',
    'compare': 'two results over the same track, aligned by position',
    'play': 'publish a recording on ROS 2 topics, with /clock',
    'monitor': 'live numbers of an estimator in the terminal',
    'indicators': 'corrugation indicators per section of a recording',
    'simulate': 'a forward run of wheels over a track with a given irregularity',
    'receptance': 'point and cross receptance of a track',
    'decay-rate': 'track decay rate in one-third octaves',
    'dispersion': 'wavenumbers of the waves that a track carries',
    'resonances': 'resonances of a track, found and named',
    'figures': 'every figure of the thesis, computed again',
    'benchmark': 'measure the speed figures on this machine',
    'cache': 'tables kept on disk: how many, how large; remove them',
}

FAILED = 1
UNUSABLE_INPUT = 2
DONE_WITH_DEFECTS = 3
INTERRUPTED = 130
BROKEN_PIPE = 141


@dataclass(frozen=True)
class Outcome:
    """What a command has done.

    Attributes
    ----------
    summary
        The figures of the run under machine-readable names (``--json``).
    lines
        The same for people.
    defects
        What was wrong with the input although the work was done, a line each.
    remarks
        What else there is to say on the input or the options, a line each: told on standard
        error too, but no reason for another exit status.
    """

    summary: Mapping[str, Any]
    lines: Sequence[str] = ()
    defects: Sequence[str] = field(default=())
    remarks: Sequence[str] = field(default=())


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line, and to which -1e3 is a number."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._negative_number_matcher = re.compile(r'-\.?\d')

    def error(self, message: str) -> NoReturn:
        """Raise the message as an InputError."""
        raise InputError(f'{message} (--help shows how it is used)')

    def print_help(self, file: Any = None) -> None:
        """Print the help at once, so that a reader who has gone is noticed here."""
        super().print_help(file)
        sys.stdout.flush()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `railtrack` with the given arguments (default: those of the process).

    Returns
    -------
    int
        The exit status.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    program = 'railtrack'
    try:
        name = command_name(arguments)
        if name is None:
            return 0
        program = f'railtrack {name}'
        outcome, as_json = execute(name, arguments[1:])
        for line in (*outcome.defects, *outcome.remarks):
            complain(program, line)
        print_outcome(outcome, as_json)
        return DONE_WITH_DEFECTS if outcome.defects else 0
    except InputError as error:
        complain(program, str(error))
        return UNUSABLE_INPUT
    except KeyboardInterrupt:
        complain(program, 'interrupted')
        return INTERRUPTED
    except BrokenPipeError:
        # The reader has gone; keep the interpreter from complaining about it when it exits.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except Exception as error:
        hint = ''
        if os.environ.get('RAILTRACK_DEBUG'):
            traceback.print_exc()
        else:
            hint = ' (RAILTRACK_DEBUG=1 shows where)'
        text = ' '.join(str(error).split())
        complain(program, f'{type(error).__name__}: {text}{hint}')
        return FAILED


def command_name(arguments: Sequence[str]) -> str | None:
    """Return the command asked for, or None when help or the version was asked for and given."""
    first = arguments[0] if arguments else None
    known = available()
    if first in known:
        return first
    if first in ('-h', '--help'):
        print(overview(known), flush=True)
        return None
    if first == '--version':
        print(f'railtrack {__version__}', flush=True)
        return None
    if first is None:
        raise InputError('name a command (railtrack --help lists them)')
    raise InputError(f'unknown command {first!r}; {suggest(first, known)}')


def execute(name: str, arguments: Sequence[str]) -> tuple[Outcome, bool]:
    """Run a command; return its outcome and whether it is wanted as JSON."""
    command = importlib.import_module(module_name(name))
    from railtrack_ros.cli.common import refuse_overwriting

    parser = Parser(
        prog=f'railtrack {name}',
        description=f'{COMMANDS[name][0].upper()}{COMMANDS[name][1:]}.',
        epilog=f'example:\n  {command.EXAMPLE}',
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    command.add_arguments(parser)
    parser.add_argument('--json', action='store_true', help='print a machine-readable summary')
    args = parser.parse_args(arguments)
    refuse_overwriting(args)
    return command.run(args), args.json


def print_outcome(outcome: Outcome, as_json: bool) -> None:
    """Print the summary as JSON or the lines for people."""
    text = json.dumps(plain(outcome.summary), indent=2) if as_json else '\n'.join(outcome.lines)
    if text:
        print(text)
    sys.stdout.flush()


def plain(value: Any) -> Any:
    """Return a value as JSON knows it: NaN and infinity become null, arrays lists."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if hasattr(value, 'tolist'):  # NumPy arrays and scalars
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if value is None or isinstance(value, (bool, int, float, str)) else str(value)


def complain(program: str, message: str) -> None:
    """Print one line on standard error."""
    print(f'{program}: {message}', file=sys.stderr, flush=True)


def available() -> list[str]:
    """Return the names of the commands that are here."""
    return [name for name in COMMANDS if importlib.util.find_spec(module_name(name))]


def module_name(name: str) -> str:
    """Return the module of a command; `import` is a word of Python and gets an underscore."""
    module = 'import_' if name == 'import' else name.replace('-', '_')
    return f'{__package__}.{module}'


def overview(names: Sequence[str]) -> str:
    """Return the help of the program as a whole."""
    listed = '\n'.join(f'  {name:<12}{COMMANDS[name]}' for name in names)
    return (
        'usage: railtrack COMMAND [options]\n\n'
        'Contact force, rail deflection and irregularity from axle-box acceleration.\n\n'
        f'commands:\n{listed}\n\n'
        'options:\n'
        '  --help      this text; railtrack COMMAND --help: that of a command, with an example\n'
        '  --version   the version\n\n'
        'example:\n  railtrack demo --output demo_output'
    )


if __name__ == '__main__':
    sys.exit(main())
