"""Where the files lie that belong to the program but are not code."""

from __future__ import annotations

import os
from pathlib import Path

from railtrack_ros.errors import InputError

PACKAGE = 'railtrack_ros'


def share_directory(module: str | Path = __file__) -> Path:
    """Return the folder that holds config/, launch/ and bags/.

    In a source checkout that is the repository, in an installation (pip, colcon, a Debian
    package) PREFIX/share/railtrack_ros, with PREFIX somewhere above the installed package.

    Parameters
    ----------
    module
        A file of the package, from where the search starts.

    Raises
    ------
    InputError
        The package was copied without its files.
    """
    package = Path(module).resolve().parent
    installed = (parent / 'share' / PACKAGE for parent in package.parents)
    for candidate in (package.parent, *installed):
        if (candidate / 'config' / 'tracks').is_dir():
            return candidate
    raise InputError(f'{PACKAGE} is installed in {package} without its config folder: reinstall it')


def config_directory() -> Path:
    """Return the folder of the shipped tracks, vehicles and node parameters."""
    return share_directory() / 'config'


def reference_data() -> Path | None:
    """Return the folder of reference data that is not shipped, or None where there is none.

    It is the environment variable RAILTRACK_DATA, else ../shared/data beside the repository.
    """
    configured = os.environ.get('RAILTRACK_DATA')
    folder = Path(configured) if configured else share_directory().parent / 'shared' / 'data'
    return folder if folder.is_dir() else None
