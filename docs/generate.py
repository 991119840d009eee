"""Write the pages of docs/reference that come from the program itself.

    python docs/generate.py

docs/reference/commands.md comes from the arguments of every command, parameters.md from the
declarations of the nodes. A test compares them with what is there.
"""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path

FOLDER = Path(__file__).resolve().parent / 'reference'
WRITTEN = '<!-- Written by docs/generate.py: change the program, not this page. -->'


def commands() -> str:
    """Return the reference of the command line."""
    from railtrack_ros.cli.main import COMMANDS, available

    parts = [
        '# Commands', WRITTEN,
        'Every command knows `--help`, which ends in an example, and `--json` for a '
        'machine-readable summary on standard output. A track or a vehicle is the name of a '
        'shipped one or the path of a YAML file. Exit status: 0 done; 2 refused, with one line '
        'that says why; 3 done, but the input had defects, which are named; 1 failed; 130 '
        'interrupted.',
        '\n'.join(f'- [`railtrack {name}`](#railtrack-{name}): {COMMANDS[name]}'
                  for name in available()),
    ]
    for name in available():
        parts += [f'## railtrack {name}', f'{COMMANDS[name][0].upper()}{COMMANDS[name][1:]}.',
                  *_arguments(parser(name)), f'```sh\n{example(name)}\n```']
    return '\n\n'.join(parts) + '\n'


def parser(name: str) -> argparse.ArgumentParser:
    """Return the parser of a command."""
    from railtrack_ros.cli.main import Parser, module_name

    made = Parser(prog=f'railtrack {name}', allow_abbrev=False)
    importlib.import_module(module_name(name)).add_arguments(made)
    made.add_argument('--json', action='store_true', help='print a machine-readable summary')
    return made


def example(name: str) -> str:
    """Return the example of a command, continued lines and all."""
    from railtrack_ros.cli.main import module_name

    lines = importlib.import_module(module_name(name)).EXAMPLE.splitlines()
    out = lines[0]
    for line in lines[1:]:
        fresh = line.strip().startswith('railtrack ')
        out += f'\n{line.strip()}' if fresh else f' \\\n    {line.strip().rstrip(chr(92)).strip()}'
    return out.replace(' \\ \\', ' \\')


def _arguments(made: argparse.ArgumentParser) -> list[str]:
    """One table for each group of arguments."""
    tables = []
    for group in made._action_groups:
        actions = [action for action in group._group_actions
                   if not isinstance(action, argparse._HelpAction)]
        if not actions:
            continue
        title = '' if group.title in ('options', 'positional arguments') else group.title
        rows = [f'| `{_name(action)}` | {_help(made, action)} |' for action in actions]
        head = f'| {title or "argument"} | |\n| --- | --- |\n'
        tables.append(head + '\n'.join(rows))
    return tables


def _name(action: argparse.Action) -> str:
    """How an argument is given."""
    value = action.metavar or ('{' + ','.join(map(str, action.choices)) + '}'
                               if action.choices else action.dest.upper())
    text = ' '.join(value) if isinstance(value, tuple) else str(value)
    if action.nargs in ('+', '*'):
        text += ' ...'
    if not action.option_strings:
        return _cell(text)
    option = action.option_strings[-1]
    return _cell(option if action.nargs == 0 else f'{option} {text}')


def _help(made: argparse.ArgumentParser, action: argparse.Action) -> str:
    text = made._get_formatter()._expand_help(action) if action.help else ''
    if action.required and action.option_strings:
        text += ' (required)'
    return _cell(text).replace('<', '&lt;')


def _cell(text: str) -> str:
    return ' '.join(text.split()).replace('|', '\\|')


def parameters() -> str:
    """Return the reference of the nodes' parameters."""
    from railtrack_ros.node import track_estimator, virtual_vehicle

    parts = [
        '# Parameters', WRITTEN,
        'Each parameter is declared once in the program, with its type, unit and range; a value '
        'outside is refused in words, a parameter that the node does not know is told by name. '
        "`config/estimator.yaml` holds all of the estimator's with their defaults.",
    ]
    for name, module in (('track_estimator', track_estimator),
                         ('virtual_vehicle', virtual_vehicle)):
        rows = ['| parameter | type | default | unit | allowed | |',
                '| --- | --- | --- | --- | --- | --- |']
        for item in module.SETTINGS:
            allowed = ', '.join(item.choices) or _range(item)
            default = str(item.default).lower() if item.kind is bool else str(item.default)
            rows.append(f'| `{item.name}` | {item.kind.__name__} | '
                        f'{f"`{default}`" if default else ""} | {item.unit} | {allowed} | '
                        f'{_cell(item.description)} |')
        parts += [f'## {name}', '\n'.join(rows)]
    return '\n\n'.join(parts) + '\n'


def _range(item: object) -> str:
    from railtrack_ros.node.parameter_file import _limits

    return _limits(item.range).replace('>', '&gt;').replace('<', '&lt;')  # type: ignore[attr-defined]


PAGES = {'commands.md': commands, 'parameters.md': parameters}


def main() -> None:
    """Write the pages."""
    for name, make in PAGES.items():
        (FOLDER / name).write_text(make(), encoding='utf-8')


if __name__ == '__main__':
    main()
