"""Writing results so that an interrupted run leaves no half-written file."""

from __future__ import annotations

import contextlib
import csv
import math
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from railtrack_ros.errors import InputError


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Give a place to write to; what is written there becomes `path` when the block succeeds.

    The block writes a file or a folder at the path it is given, which has the name of `path`
    and lies in a temporary folder beside it. A file that was there before is replaced, a
    folder that is not empty never. After an exception or an interrupt `path` is as it was.
    A device or a pipe (/dev/stdout) is written to directly.

    Raises
    ------
    InputError
        `path` cannot be written: a folder that is not empty, or one that may not be written to.
    """
    target = Path(path).expanduser()
    if target.is_relative_to('/dev') or (target.exists() and not target.is_file()):
        if not target.is_dir():
            yield target
            return
        if any(target.iterdir()):
            raise InputError(f'{path}: is a folder that is not empty; name another or remove it')
    target = target.resolve()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        beside = Path(tempfile.mkdtemp(prefix=f'.{target.name}.', dir=target.parent))
    except OSError as error:
        raise InputError(f'{path}: cannot be written: {(error.strerror or "").lower()}') from error
    try:
        written = beside / target.name
        yield written
        if target.is_dir() and written.is_file():
            raise InputError(f'{path}: is a folder; name a file')
        os.replace(written, target)
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def refuse_inputs(output: str | Path, inputs: Iterable[str | Path]) -> None:
    """Refuse an output that would replace an input.

    Raises
    ------
    InputError
        The output is one of the inputs, by whatever name, or lies in a folder that is one.
    """
    target = os.path.expanduser(output)
    for name in inputs:
        source = os.path.expanduser(name)  # os.path: any text may be asked for, of any length
        if os.path.isdir(source):
            if Path(os.path.realpath(target)).is_relative_to(os.path.realpath(source)):
                raise InputError(f'{output}: is or lies in the input {name}; choose another output')
        elif os.path.isfile(source) and os.path.isfile(target) and os.path.samefile(source, target):
            raise InputError(f'{output}: is the input itself; choose another output')


def metres(position: float) -> str:
    """Return a track position [m] for people: to the millimetre, however far out it is."""
    return f'{round(position, 3) + 0.0:.3f}'.rstrip('0').rstrip('.')


def write_csv(path: str | Path, columns: Mapping[str, Sequence[Any] | NDArray[Any]]) -> None:
    """Write columns of equal length as CSV with a header; NaN becomes an empty field.

    Numbers are written so that they read back as the very same float64.
    """
    with replacing(path) as place, open(place, 'w', encoding='utf-8', newline='') as file:
        writer = csv.writer(file, lineterminator='\n')
        writer.writerow(columns)
        writer.writerows(zip(*(_fields(column) for column in columns.values()), strict=True))


def _fields(column: Sequence[Any] | NDArray[Any]) -> list[Any]:
    values = column.tolist() if hasattr(column, 'tolist') else list(column)
    return ['' if isinstance(value, float) and math.isnan(value) else value for value in values]
