"""Strict reading of the YAML files that describe a case.

A file is read once, at the border, and everything in it that is not understood is refused:
an unknown or repeated key, a missing key, a wrong type, NaN, a value outside its range. Each
refusal is one :class:`~railtrack_ros.errors.InputError` naming the file, the dotted key
and what was expected there.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from railtrack_ros.errors import InputError

# YAML 1.1 wants a dot and a signed exponent in a float: PyYAML reads 1e3 and 2.1e11 as text.
EXPONENT_NUMBER = re.compile(r'[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+')


@dataclass(frozen=True)
class Range:
    """The numbers that a parameter may take: above < x < below, minimum <= x <= maximum.

    NaN and the infinities are in no range.
    """

    above: float = -math.inf
    minimum: float = -math.inf
    maximum: float = math.inf
    below: float = math.inf

    def __contains__(self, value: float) -> bool:
        return (self.above < value < self.below) and (self.minimum <= value <= self.maximum)

    def __str__(self) -> str:
        limits = (
            ('above', self.above),
            ('of at least', self.minimum),
            ('of at most', self.maximum),
            ('below', self.below),
        )
        words = [f'{word} {limit:g}' for word, limit in limits if math.isfinite(limit)]
        return ' '.join(['a number', ' and '.join(words)]).strip()


ANY = Range()
POSITIVE = Range(above=0.0)
NOT_NEGATIVE = Range(minimum=0.0)


class Section:
    """A mapping of a file together with its place there, for messages.

    Parameters
    ----------
    values
        The mapping as YAML gave it; anything else is refused.
    source
        What the messages call the file.
    place
        Dotted key of the mapping in the file, empty at the top level.
    """

    def __init__(self, values: Any, source: str | Path, place: str = '') -> None:
        self.source = str(source)
        self.place = place
        if not isinstance(values, Mapping):
            raise self.error(None, f'expected keys with values, got {describe(values)}')
        self.values = values

    def error(self, key: str | None, message: str) -> InputError:
        """Return the error that says `message` about `key` (None: about the whole section)."""
        place = '.'.join(part for part in (self.place, key) if part)
        return InputError(': '.join(part for part in (self.source, place, message) if part))

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def expect(
        self,
        required: Iterable[str],
        optional: Iterable[str] = (),
        not_yet: Iterable[str] = (),
    ) -> None:
        """Refuse unknown keys, then keys of later versions, then missing ones."""
        required, optional, not_yet = list(required), list(optional), list(not_yet)
        known = [*required, *optional]
        for key in self.values:
            if key in not_yet:
                raise self.error(key, 'not supported yet by this version')
            if key not in known:
                raise self.error(str(key), f'unknown key; {suggest(str(key), known)}')
        for key in required:
            if key not in self.values:
                raise self.error(key, 'missing key')

    def number(self, key: str, allowed: Range = ANY) -> float:
        """Return the value of `key` as a float inside `allowed`; true and false are no numbers."""
        value = self.values[key]
        if isinstance(value, str) and EXPONENT_NUMBER.fullmatch(value):
            value = float(value)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise self.error(key, f'expected {allowed}, got {describe(value)}')
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if number not in allowed:
            raise self.error(key, f'expected {allowed}, got {number:g}')
        return number

    def numbers(self, allowed: Mapping[str, Range]) -> dict[str, float]:
        """Return the numbers of several keys, each inside its own range."""
        return {key: self.number(key, limits) for key, limits in allowed.items()}

    def text(self, key: str, default: str | None = None) -> str:
        """Return the text of `key`, or `default` where the key is absent and has one."""
        if default is not None and key not in self.values:
            return default
        value = self.values[key]
        if not isinstance(value, str):
            raise self.error(key, f'expected text, got {describe(value)}')
        return value

    def choice(self, key: str, choices: Sequence[str]) -> str:
        """Return the text of `key`, which must be one of `choices`."""
        value = self.values[key]
        if not isinstance(value, str):
            raise self.error(key, f'expected one of {", ".join(choices)}, got {describe(value)}')
        if value not in choices:
            raise self.error(key, f'unknown value {value!r}; {suggest(value, choices)}')
        return value

    def section(self, key: str) -> Section:
        """Return the mapping under `key`."""
        return Section(self.values[key], self.source, self._under(key))

    def sections(self, key: str) -> list[Section]:
        """Return the mappings of the list under `key`; an empty list is refused."""
        items = self.values[key]
        if not isinstance(items, list) or not items:
            raise self.error(key, f'expected a list of at least one entry, got {describe(items)}')
        return [
            Section(item, self.source, f'{self._under(key)}[{index}]')
            for index, item in enumerate(items)
        ]

    def _under(self, key: str) -> str:
        return f'{self.place}.{key}' if self.place else key


def suggest(word: str, known: Sequence[str]) -> str:
    """Return a hint for a word that is not among the known ones: the closest one, or all."""
    close = difflib.get_close_matches(word, known, n=1)
    return f'did you mean {close[0]!r}?' if close else f'expected one of {", ".join(known)}'


def describe(value: Any) -> str:
    """Return a few words for a value of the wrong kind."""
    if value is None:
        return 'nothing'
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return 'a mapping'
    if isinstance(value, (list, tuple, set)):
        return 'a list' if value else 'an empty list'
    text = str(value) if len(str(value)) <= 40 else f'{str(value)[:37]}...'
    return f'the text {text!r}' if isinstance(value, str) else text


def read_yaml(path: str | Path) -> Section:
    """Return the top-level mapping of a YAML file.

    Raises
    ------
    InputError
        The file is missing, unreadable, empty, no YAML, repeats a key, or is no mapping.
    """
    try:
        with open(path, encoding='utf-8') as file:
            values = yaml.load(file, Loader=_UniqueKeyLoader)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(f'{path}: cannot be read: {reason}') from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        where = f'line {mark.line + 1}, column {mark.column + 1}: ' if mark else ''
        raise InputError(f'{path}: not valid YAML: {where}{error.problem}') from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f'{path}: not valid YAML: {reason}') from error
    if values is None:
        raise InputError(f'{path}: the file is empty')
    return Section(values, path)


def find_described(kind: str, name: str | Path, folder: Path) -> Path:
    """Return the file of a shipped description, or the file that the user points to.

    Parameters
    ----------
    kind
        What is described, for the message: ``'track'`` or ``'vehicle'``.
    name
        A shipped name, or a path to a YAML file.
    folder
        Where the shipped ones lie, each as NAME.yaml.

    Raises
    ------
    InputError
        The name is not shipped and no such file exists; the message lists the shipped ones.
    """
    shipped = shipped_names(folder)
    if isinstance(name, str) and name in shipped:
        return folder / f'{name}.yaml'
    path = Path(name).expanduser()
    if path.is_file():
        return path
    listed = f'shipped: {", ".join(shipped)}'
    if path.suffix in ('.yaml', '.yml') or path.name != str(name):
        raise InputError(f'{name}: no such {kind} file ({listed})')
    close = difflib.get_close_matches(str(name), shipped, n=1)
    hint = f'did you mean {close[0]!r}? ' if close else ''
    raise InputError(f'unknown {kind} {str(name)!r}; {hint}give a YAML file or a name ({listed})')


def shipped_names(folder: Path) -> list[str]:
    """Return the sorted names of the YAML files of a folder."""
    return sorted(path.stem for path in folder.glob('*.yaml'))


class _UniqueKeyLoader(yaml.SafeLoader):
    """PyYAML's safe loader, which also refuses a key given twice in one mapping."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen = set()
        for key_node, _ in node.value:
            if isinstance(key_node, yaml.ScalarNode) and key_node.tag != 'tag:yaml.org,2002:merge':
                if key_node.value in seen:
                    problem = f'the key {key_node.value!r} is given twice'
                    raise yaml.constructor.ConstructorError(
                        None, None, problem, key_node.start_mark
                    )
                seen.add(key_node.value)
        return super().construct_mapping(node, deep)
