"""Results of long computations kept on disk, under a key of all that they depend on.

The key is a digest of the input (matrices, numbers) and of the sources that compute with it, so
an entry can never be out of date. Entries are written beside their place and moved there at once:
processes that start together do no harm to each other, the last one to finish wins. An entry that
is damaged, which its checksum tells, is computed again. The folder is that of the compiled loops,
`compiled.cache_base`; the entries used longest ago are removed when there are too many.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import io
import os
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from railtrack_ros.compiled import cache_base

SUFFIX = '.cache'

# Beyond this the entries used longest ago are removed [bytes].
LARGEST = 500_000_000


@dataclasses.dataclass(frozen=True)
class Entry:
    """An entry on disk."""

    name: str
    size: int  # bytes
    path: Path


def folder() -> Path:
    """Where the entries are."""
    return cache_base() / 'tables'


def key(sources: Iterable[str], *inputs: Any) -> str:
    """Digest of inputs (numbers, strings, arrays, dataclasses of them) and of source files.

    sources: paths of Python modules whose code the result depends on.
    """
    digest = hashlib.sha256(f'{np.__version__} {sys.version_info[:2]}'.encode())
    for source in sources:
        digest.update(Path(source).read_bytes())
    _feed(digest, inputs)
    return digest.hexdigest()[:32]


def _feed(digest: Any, item: Any) -> None:
    digest.update(type(item).__name__.encode())
    if isinstance(item, np.ndarray):
        digest.update(f'{item.dtype.str}{item.shape}'.encode() + item.tobytes())
    elif dataclasses.is_dataclass(item):
        for field in dataclasses.fields(item):
            digest.update(field.name.encode())
            _feed(digest, getattr(item, field.name))
    elif isinstance(item, (tuple, list)):
        for part in item:
            _feed(digest, part)
    else:
        digest.update(repr(item).encode() + b';')


def stored(kind: str, digest: str,
           compute: Callable[[], Mapping[str, NDArray[Any]]]) -> Mapping[str, NDArray[Any]]:
    """Arrays by name from the cache, or computed and put there.

    kind names the entry for people. Where the folder cannot be written nothing is kept.
    """
    path = folder() / f'{kind}-{digest}{SUFFIX}'
    try:
        content = path.read_bytes()
    except OSError:
        content = b''
    if content:
        arrays = _decode(content)
        if arrays is not None:
            with contextlib.suppress(OSError):
                os.utime(path)  # used
            return arrays
        print(f'railtrack: {path} is damaged and made anew', file=sys.stderr)
    result = compute()
    with contextlib.suppress(OSError):
        _write(path, result)
        _limit()
    return result


def _decode(content: bytes) -> dict[str, NDArray[Any]] | None:
    """Arrays of an entry, None if it is not what was written."""
    head, body = content[:32], content[32:]
    if hashlib.sha256(body).digest() != head:
        return None
    try:
        with np.load(io.BytesIO(body), allow_pickle=False) as file:
            return dict(file)
    except (OSError, ValueError, zipfile.BadZipFile):
        return None


def _write(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    body = buffer.getvalue()
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, suffix='.part')
    try:
        with os.fdopen(handle, 'wb') as file:
            file.write(hashlib.sha256(body).digest() + body)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def entries() -> list[Entry]:
    """All entries, the one used last first."""
    found = []
    for path in folder().glob(f'*{SUFFIX}'):
        with contextlib.suppress(OSError):
            status = path.stat()
            found.append((status.st_mtime, Entry(path.name, status.st_size, path)))
    return [entry for _, entry in sorted(found, key=lambda item: -item[0])]


def clear() -> int:
    """Remove all entries and what interrupted writing has left; returns the bytes freed."""
    freed = 0
    for path in [entry.path for entry in entries()] + list(folder().glob('*.part')):
        with contextlib.suppress(OSError):
            freed += path.stat().st_size
            path.unlink()
    return freed


def _limit() -> None:
    total = 0
    for entry in entries():
        total += entry.size
        if total > LARGEST:
            with contextlib.suppress(OSError):
                entry.path.unlink()
