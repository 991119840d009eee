"""Compiled loops: numba's decorator with a cache of its own that never goes stale.

Numba notices a change in the file of a compiled function, but not in what that function calls from
other files.  So the cache lies in a folder named after the sources of all compiled loops: whenever
one of them changes, every one is compiled again, once.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import shutil
import sys
import tempfile
from pathlib import Path

import numba

_PACKAGE = Path(__file__).parent


def _fingerprint() -> str:
    """A name for the state of all modules that compile something, and of the compiler."""
    digest = hashlib.sha256(f'{numba.__version__} {sys.version_info[:2]}'.encode())
    for path in sorted(_PACKAGE.rglob('*.py')):
        source = path.read_bytes()
        if b'import njit' in source:
            digest.update(source)
    return digest.hexdigest()[:16]


def cache_base() -> Path:
    """The user's cache folder of the program; NUMBA_CACHE_DIR or XDG_CACHE_HOME move it."""
    base = os.environ.get('NUMBA_CACHE_DIR')
    if base is None:
        cache = os.environ.get('XDG_CACHE_HOME') or os.path.expanduser('~/.cache')
        base = os.path.join(cache, 'railtrack_ros')
    return Path(base)


def cache_folder() -> Path:
    """Where compiled loops are kept."""
    return cache_base() / f'compiled-{_fingerprint()}'


def _prepare() -> Path:
    """Make the folder; where the user's cannot be written, one for this process alone."""
    folder = cache_folder()
    try:
        if not folder.is_dir():
            folder.mkdir(parents=True)
            if sys.stderr.isatty():
                print('railtrack: compiling its loops for this machine, once: '
                      'up to half a minute', file=sys.stderr)
    except OSError:
        folder = Path(tempfile.mkdtemp(prefix='railtrack_ros-'))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


numba.config.CACHE_DIR = str(_prepare())

njit = numba.njit
