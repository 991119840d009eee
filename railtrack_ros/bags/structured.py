"""Arrays in files with a structure: HDF5, MAT of version 7.3 (which is HDF5) and TDMS.

Arrays stay in the file until they are asked for. Their names are their paths, such as
`run 1/axle1_left`. The libraries are imported only where such a file is read.
"""

from __future__ import annotations

import contextlib
import logging
import math
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from railtrack_ros.errors import InputError

HDF5 = ('.h5', '.hdf5', '.hdf')
TDMS = ('.tdms',)
HDF5_MAGIC = b'\x89HDF\r\n\x1a\n'
# Where the superblock of an HDF5 file may begin; MAT 7.3 keeps its own header before it.
SUPERBLOCKS = (0, 512, 1024, 2048)


class Transposed:
    """An array of a MAT file of version 7.3, which holds rows as columns."""

    def __init__(self, values: Any) -> None:
        self._values = values
        self.dtype, self.ndim, self.size = values.dtype, values.ndim, values.size
        self.shape = values.shape[::-1]

    def __getitem__(self, index: Any) -> np.ndarray:
        first, second = (index if isinstance(index, tuple) else (index, slice(None)))
        return np.asarray(self._values[second, first] if self.ndim == 2 else self._values[first]).T


class TdmsArray:
    """A channel of a TDMS file, scaled as the file says."""

    ndim = 1

    def __init__(self, channel: Any) -> None:
        self._channel = channel
        self.dtype, self.size = np.dtype(channel.dtype), len(channel)
        self.shape = (self.size,)

    def __getitem__(self, part: slice) -> np.ndarray:
        return np.asarray(self._channel[part])


class NpzArray:
    """An array of an NPZ file, whose rows are read one after the other."""

    def __init__(self, archive: zipfile.ZipFile, name: str) -> None:
        self._archive, self._name = archive, name
        with archive.open(name) as file:
            self.shape, self._fortran, self.dtype = _npy_header(file)
        self.size = math.prod(self.shape)
        if 1 in self.shape:
            self.shape = (self.size,)
        self.ndim = len(self.shape)
        self._file: Any = None
        self._at = 0
        self._whole: np.ndarray | None = None

    def __getitem__(self, index: Any) -> np.ndarray:
        rows = index if isinstance(index, slice) else None
        if rows is None or self._fortran and self.ndim > 1:
            if self._whole is None:
                with self._archive.open(self._name) as file:
                    self._whole = np.lib.format.read_array(file, allow_pickle=False)
            return self._whole[index]
        start, stop, _ = rows.indices(self.shape[0])
        if self._file is None or start != self._at:
            self._file = self._archive.open(self._name)
            _npy_header(self._file)
            self._at = 0
        width = self.size // self.shape[0]
        self._file.seek(self._file.tell() + (start - self._at) * width * self.dtype.itemsize)
        count = (stop - start) * width
        data = self._file.read(count * self.dtype.itemsize)
        self._at = stop
        return np.frombuffer(data, self.dtype, count).reshape(-1, *self.shape[1:])


def _npy_header(file: Any) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Read shape, order and type of an array, up to where its numbers begin."""
    version = np.lib.format.read_magic(file)
    read = (np.lib.format.read_array_header_1_0 if version == (1, 0)
            else np.lib.format.read_array_header_2_0)
    return read(file)


@contextlib.contextmanager
def npz_arrays(path: Path) -> Iterator[Mapping[str, Any]]:
    """Give the arrays of an NPZ file by their names.

    Raises
    ------
    InputError
        The file is damaged or no NPZ, or holds something else than plain arrays.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            names = [name for name in archive.namelist() if name.endswith('.npy')]
            arrays = {name.removesuffix('.npy'): NpzArray(archive, name) for name in names}
            if any(array.dtype.hasobject for array in arrays.values()):
                raise ValueError('objects in it are not unpickled')
            yield arrays
    except (InputError, OSError):
        raise
    except Exception as error:  # zipfile, zlib and the array headers each have their own
        raise InputError(f'{path}: is not an NPZ file of plain arrays ({error})') from error


def is_hdf5(path: Path) -> bool:
    """Tell whether a file is HDF5 by what stands in it."""
    with path.open('rb') as file:
        head = file.read(SUPERBLOCKS[-1] + len(HDF5_MAGIC))
    return any(head[at : at + len(HDF5_MAGIC)] == HDF5_MAGIC for at in SUPERBLOCKS)


@contextlib.contextmanager
def hdf5_arrays(path: Path, matlab: bool) -> Iterator[Mapping[str, Any]]:
    """Give the arrays of an HDF5 file by their paths; `matlab`: of a MAT file of version 7.3.

    Raises
    ------
    InputError
        The file is damaged or no HDF5, or the library is missing.
    """
    h5py = _library(path, 'h5py', 'h5py')
    try:
        file = h5py.File(path, 'r')
    except OSError as error:
        kind = 'MAT' if matlab else 'HDF5'
        raise InputError(f'{path}: is not an undamaged {kind} file ({_short(error)})') from error
    with file:
        arrays: dict[str, Any] = {}

        def visit(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset) and not name.startswith('#'):
                arrays[name] = Transposed(item) if matlab else item

        try:
            file.visititems(visit)
            yield arrays
        except (OSError, RuntimeError, KeyError) as error:
            raise InputError(f'{path}: is damaged ({_short(error)})') from error


@contextlib.contextmanager
def tdms_arrays(path: Path) -> Iterator[Mapping[str, Any]]:
    """Give the channels of a TDMS file by group and name.

    Raises
    ------
    InputError
        The file is damaged or no TDMS, or the library is missing.
    """
    with _tdms(path) as file:
        yield {
            f'{group.name}/{channel.name}': TdmsArray(channel)
            for group in file.groups()
            for channel in group.channels()
        }


def tdms_sample_rate(path: Path) -> float | None:
    """Return the sample rate [Hz] that a TDMS file tells; None for none, or more than one."""
    with _tdms(path) as file:
        steps = {
            float(channel.properties['wf_increment'])
            for group in file.groups()
            for channel in group.channels()
            if 'wf_increment' in channel.properties
        }
    step = steps.pop() if len(steps) == 1 else 0.0
    return 1.0 / step if math.isfinite(step) and step > 0.0 else None


def tdms_defects(path: Path) -> list[str]:
    """Return what is wrong with a TDMS file although it can be read, a line each."""
    with _tdms(path) as file:
        cut = file.file_status.incomplete_final_segment
    return [f'{path}: cut off or still being written: its last segment is incomplete'] * bool(cut)


@contextlib.contextmanager
def _tdms(path: Path) -> Iterator[Any]:
    nptdms = _library(path, 'nptdms', 'npTDMS')
    logging.getLogger('nptdms').setLevel(logging.ERROR)  # what it warns of is in its file status
    try:
        with nptdms.TdmsFile.open(path) as file:
            yield file
    except (InputError, OSError):
        raise
    except Exception as error:  # damaged files end in errors of many kinds
        raise InputError(f'{path}: is not an undamaged TDMS file ({_short(error)})') from error


def _library(path: Path, module: str, package: str) -> Any:
    """Import what reads a kind of file; InputError where it is not installed."""
    import importlib

    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError(
            f'{path}: reading it takes the package {package}, which is not installed '
            f'(pip install {package})'
        ) from error


def _short(error: Exception) -> str:
    return ' '.join(str(error).split())[:120] or type(error).__name__
