"""Options of a command from the declarations of its settings: names, help, ranges, defaults."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Collection, Mapping
from typing import Any, TypeVar

from railtrack_ros.errors import InputError
from railtrack_ros.estimation.settings import Setting, declared

T = TypeVar('T')


def add_settings(
    parser: argparse.ArgumentParser,
    settings: type,
    title: str,
    without: Collection[str] = (),
    names: Mapping[str, str] | None = None,
) -> None:
    """Add an option for every setting that a class declares.

    Parameters
    ----------
    settings
        A class of :mod:`railtrack_ros.estimation.settings`.
    title
        Of the group of options.
    without
        Settings that get no option.
    names
        Options called otherwise than their setting.
    """
    group = parser.add_argument_group(title)
    for setting in declared(settings):
        if setting.name in without:
            continue
        option = '--' + (names or {}).get(setting.name, setting.name).replace('_', '-')
        if setting.kind is bool:
            group.add_argument(
                option, dest=setting.name, action='store_true', default=None,
                help=setting.description,
            )  # fmt: skip
            continue
        unit = f' {setting.unit}' if setting.unit else ''
        group.add_argument(
            option,
            dest=setting.name,
            type=_reader(setting),
            metavar='|'.join(setting.choices) or _metavar(setting),
            help=f'{setting.description} (default: {setting.default:g}{unit})'.replace('%', '%%')
            if setting.kind is not str
            else f'{setting.description} (default: {setting.default})',
        )


def settings_from(args: argparse.Namespace, settings: type[T]) -> T:
    """Return the settings that the options give; the others have their defaults."""
    given = {setting.name: getattr(args, setting.name, None) for setting in declared(settings)}
    return settings(**{name: value for name, value in given.items() if value is not None})


def _metavar(setting: Setting) -> str:
    return {'m': 'M', 's': 'S', 'm/s': 'M_S', 'Hz': 'HZ', 'dB': 'DB'}.get(setting.unit, 'N')


def _reader(setting: Setting) -> Callable[[str], Any]:
    """Return an argument type that checks against the declaration."""

    def read(text: str) -> Any:
        try:
            value: Any = text if setting.kind is str else setting.kind(text)
        except ValueError:
            value = text
        try:
            return setting.check(value)
        except InputError as error:
            raise argparse.ArgumentTypeError(str(error).split(': ', 1)[1]) from None

    return read
