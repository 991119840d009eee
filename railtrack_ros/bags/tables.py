"""Columns of numbers out of the files that loggers and analysis programs write.

CSV (comma, semicolon, tab or blanks; decimal point or comma; with or without header), NPZ of
NumPy, MAT of MATLAB, HDF5 and TDMS. Only the columns that are asked for are kept.
"""

from __future__ import annotations

import array
import csv
import itertools
import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.bags.columns import PIECE, pieces
from railtrack_ros.bags.structured import (
    HDF5,
    TDMS,
    hdf5_arrays,
    is_hdf5,
    npz_arrays,
    tdms_arrays,
    tdms_defects,
    tdms_sample_rate,
)
from railtrack_ros.errors import InputError
from railtrack_ros.parameters import suggest

Array = NDArray[np.float64]
Progress = Callable[[float], None]

TEXT = ('.csv', '.txt', '.tsv', '.asc', '.dat')
MISSING = ('', 'nan', 'na', 'n/a', 'null', '-')
LINES_PER_PROGRESS = 20_000


def read_columns(
    path: str | Path, wanted: Collection[str], progress: Progress = lambda part: None
) -> Iterator[dict[str, Array]]:
    """Yield columns of a file, piece by piece; memory does not depend on its length.

    Only a MAT file of a version below 7.3, and an NPZ array in Fortran order, are read as a whole.

    Parameters
    ----------
    path
        A `.csv` (`.txt`, `.tsv`, `.asc`, `.dat`), `.npz`, `.mat`, `.h5` (`.hdf5`, `.hdf`) or
        `.tdms` file.
    wanted
        Names of the columns: of the header, or '1', '2', ... where a text file has none; the
        name of an array, with [0], [1], ... for the columns of an array of several. Arrays in
        groups are called by their path, or by the last part of it where that is unmistakable.
    progress
        Called with the part of the file that is read, 0 to 1.

    Yields
    ------
    dict
        (n,) float64 each, all of the same length; NaN for a field without a value.

    Raises
    ------
    InputError
        The file cannot be read, or a column is not there, not of numbers, or of another length.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f'{path}: no such file')
    suffix = path.suffix.lower()
    rows = 0
    try:
        for piece in _pieces(path, suffix, wanted, progress):
            rows += next(iter(piece.values())).size
            yield piece
    except OSError as error:
        raise InputError(f'{path}: cannot be read ({error.strerror or error})') from error
    if not rows:
        raise InputError(f'{path}: holds no rows')


def _pieces(path: Path, suffix: str, wanted: Collection[str], progress: Progress
            ) -> Iterator[dict[str, Array]]:
    if suffix in TEXT:
        yield from _read_text(path, wanted, progress)
    elif suffix == '.npz':
        with npz_arrays(path) as arrays:
            yield from _choose(path, arrays, wanted, progress)
    elif suffix in HDF5 or (suffix == '.mat' and is_hdf5(path)):
        with hdf5_arrays(path, suffix == '.mat') as arrays:
            yield from _choose(path, arrays, wanted, progress)
    elif suffix == '.mat':
        yield from _choose(path, _mat_arrays(path, wanted), wanted, progress)
    elif suffix in TDMS:
        with tdms_arrays(path) as arrays:
            yield from _choose(path, arrays, wanted, progress)
    else:
        known = ', '.join([*TEXT, '.npz', '.mat', *HDF5, *TDMS])
        raise InputError(f'{path}: unknown kind of file {suffix!r}; expected {known}')


def _no_column(path: Path, name: str, names: Iterable[str]) -> InputError:
    """Return the error for a column that is not there, with what is."""
    names = list(names)
    listed = ', '.join(names[:40]) + (', ...' if len(names) > 40 else '')
    hint = suggest(name, names) if names else ''
    close = f'; {hint}' if hint.startswith('did you mean') else ''
    return InputError(f'{path}: no column {name!r}{close}; there are: {listed or "none"}')


# Arrays


def sample_rate(path: str | Path) -> float | None:
    """Return the sample rate [Hz] that a file itself tells, None where it does not."""
    path = Path(path)
    if path.suffix.lower() in TDMS and path.is_file():
        return tdms_sample_rate(path)
    return None


def defects(path: str | Path) -> list[str]:
    """Return what is wrong with a file although it can be read, a line each."""
    path = Path(path)
    return tdms_defects(path) if path.suffix.lower() in TDMS else []


def _choose(
    path: Path, arrays: Mapping[str, Any], wanted: Collection[str], progress: Progress
) -> Iterator[dict[str, Array]]:
    """Yield columns of named arrays of one or two dimensions, piece by piece."""
    names: dict[str, tuple[str, int | None]] = {}
    for name, values in arrays.items():
        if values.dtype.kind not in 'fiub' or values.ndim > 2 or values.size == 0:
            continue
        if values.ndim == 2 and min(values.shape) > 1:
            names.update({f'{name}[{k}]': (name, k) for k in range(values.shape[1])})
        elif values.ndim:
            names[name] = (name, None)
    lasts = [name.rsplit('/', 1)[-1] for name in names]
    names.update({
        last: place for last, place in zip(lasts, list(names.values()), strict=True)
        if lasts.count(last) == 1
    })  # fmt: skip
    for name in wanted:
        if name not in names:
            raise _no_column(path, name, names)
    places = {name: names[name] for name in wanted}
    lengths = {name: arrays[key].size if index is None else arrays[key].shape[0]
               for name, (key, index) in places.items()}
    if len(set(lengths.values())) > 1:
        said = ', '.join(f'{name} has {size}' for name, size in lengths.items())
        raise InputError(f'{path}: columns of different length: {said}')
    size = max(lengths.values())
    # The columns of an array are read together.
    keys = dict.fromkeys(key for key, _ in places.values())
    for part in pieces(size):
        read = {key: _rows(arrays[key], part) for key in keys}
        yield {
            name: np.array(read[key] if index is None else read[key][:, index], np.float64).ravel()
            for name, (key, index) in places.items()
        }
        progress(part.stop / size)


def _rows(array: Any, part: slice) -> np.ndarray:
    """Return rows of an array; one of a single row or column counts as a row of numbers."""
    if array.ndim == 1 or min(array.shape) > 1 or array.shape[1] == 1:
        return np.asarray(array[part])
    return np.asarray(array[:, part])


def _mat_arrays(path: Path, wanted: Collection[str]) -> dict[str, np.ndarray]:
    """Return the variables of a MAT file: the wanted ones alone if they are there, else all."""
    import scipy.io

    names = {re.sub(r'\[\d+]$', '', name) for name in wanted}
    try:
        there = {name for name, *_ in scipy.io.whosmat(path)}
        content = scipy.io.loadmat(path, variable_names=names if names <= there else None)
    except OSError:
        raise
    except Exception as error:  # damaged files end in errors of many kinds
        raise InputError(f'{path}: is not a MAT file ({error})') from error
    return {name: values for name, values in content.items() if isinstance(values, np.ndarray)}


# Text


@dataclass(frozen=True)
class Layout:
    """How a text file is laid out.

    Attributes
    ----------
    encoding
        Of the characters.
    delimiter
        Between fields; None for blanks.
    comma
        Whether numbers have a decimal comma.
    names
        Of the columns.
    first
        Number of lines before the first row of data.
    """

    encoding: str
    delimiter: str | None
    comma: bool
    names: list[str]
    first: int

    def fields(self, line: str) -> list[str]:
        """Return the fields of a line."""
        return _split(line, self.delimiter)

    def value(self, text: str) -> float:
        """Return the number in a field, NaN where it is empty; ValueError for anything else."""
        if text.strip().lower() in MISSING:
            return math.nan
        return float(text.replace(',', '.') if self.comma else text)


def _read_text(
    path: Path, wanted: Collection[str], progress: Progress
) -> Iterator[dict[str, Array]]:
    """Yield columns of a text file, piece by piece."""
    layout = _layout(path)
    for name in wanted:
        if name not in layout.names:
            raise _no_column(path, name, layout.names)
        if layout.names.count(name) > 1:
            raise InputError(f'{path}: {layout.names.count(name)} columns are called {name!r}')
    indices = [layout.names.index(name) for name in wanted]
    lines, number = _lines(path, layout, progress), layout.first
    while some := list(itertools.islice(lines, PIECE)):
        if any(line.strip() and not line.startswith('#') for line in some):
            table = _table(path, layout, indices, some, number)
            yield {name: np.ascontiguousarray(table[:, k]) for k, name in enumerate(wanted)}
        number += len(some)


def _table(path: Path, layout: Layout, indices: list[int], lines: list[str], before: int) -> Array:
    """Return columns (n, columns) of lines that come after so many others."""
    try:
        return np.loadtxt(lines, delimiter=layout.delimiter, usecols=indices, ndmin=2,
                          comments='#', quotechar='"')
    except ValueError:
        # Some field is not a plain number: find out which, or that it is an empty one.
        return _read_carefully(path, layout, indices, lines, before)


def _read_carefully(
    path: Path, layout: Layout, indices: list[int], lines: list[str], before: int
) -> Array:
    """Return columns (n, columns) of lines that have empty fields, or say what is wrong."""
    values = array.array('d')
    for number, line in enumerate(lines, before + 1):
        if not line.strip() or line.startswith('#'):
            continue
        fields = layout.fields(line)
        for index in indices:
            if index >= len(fields):
                raise InputError(
                    f'{path}: line {number}: {len(fields)} fields, expected {len(layout.names)}'
                )
            try:
                values.append(layout.value(fields[index]))
            except ValueError:
                raise InputError(
                    f'{path}: line {number}: column {layout.names[index]!r} holds '
                    f'{fields[index][:40]!r}, expected a number'
                ) from None
    return np.frombuffer(values, np.float64).reshape(-1, len(indices)).copy()


def _lines(path: Path, layout: Layout, progress: Progress) -> Iterator[str]:
    """Yield the lines of data, with a decimal point in every number."""
    total, done = max(1, path.stat().st_size), 0
    with path.open(encoding=layout.encoding, errors='replace') as file:
        for number, line in enumerate(itertools.islice(file, layout.first, None)):
            done += len(line)
            if number % LINES_PER_PROGRESS == 0:
                progress(min(1.0, done / total))
            yield line.replace(',', '.') if layout.comma else line
    progress(1.0)


def _layout(path: Path) -> Layout:
    """Find out how a text file is laid out from its first lines."""
    encoding = _encoding(path)
    with path.open(encoding=encoding, errors='replace') as file:
        head = [line.rstrip('\n') for line in itertools.islice(file, 200)]
    filled = [k for k, line in enumerate(head) if line.strip() and not line.startswith('#')]
    if not filled:
        raise InputError(f'{path}: holds no rows')
    top = head[filled[0]]
    delimiter = next((mark for mark in ('\t', ';', ',') if mark in top), None)
    names = [name.strip() for name in _split(top, delimiter)]
    has_header = not all(_is_number(name) for name in names)
    first = filled[0] + 1 if has_header else filled[0]
    if not has_header:
        names = [str(k + 1) for k in range(len(names))]
    data = [head[k] for k in filled if k >= first]
    if not data:
        raise InputError(f'{path}: holds no rows')
    comma = delimiter != ',' and any(re.search(r'\d,\d', line) for line in data)
    return Layout(encoding, delimiter, comma, names, first)


def _encoding(path: Path) -> str:
    """Return the encoding of a text file: UTF-8 with or without mark, else Windows' Western."""
    with path.open('rb') as file:
        sample = file.read(1 << 20)
    if b'\0' in sample:
        raise InputError(f'{path}: is not a text file')
    try:
        sample[: sample.rfind(b'\n') + 1 or None].decode('utf-8-sig')
    except UnicodeDecodeError:
        return 'latin-1'
    return 'utf-8-sig'


def _split(line: str, delimiter: str | None) -> list[str]:
    """Return the fields of a line."""
    if delimiter is None:
        return line.split()
    try:
        return next(csv.reader([line.rstrip('\n')], delimiter=delimiter), [])
    except csv.Error:  # a line of absurd length: not a table, as whoever reads it will find
        return []


def _is_number(text: str) -> bool:
    """Return whether a field of the first line belongs to data rather than to a header."""
    if text.strip().lower() in MISSING:
        return True
    try:
        float(text.replace(',', '.'))
    except ValueError:
        return False
    return True
