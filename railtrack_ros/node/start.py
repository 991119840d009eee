"""The programs of the nodes: ready for a signal before the long import of anything else.

SIGINT and SIGTERM end a node with status 0 at any time. Once it is imported that is up to
:func:`railtrack_ros.node.runner.run`; the second or more before that is up to this module, which
must import nothing but what Python itself has loaded already.
"""

from __future__ import annotations

import os
import signal
import sys
from importlib import import_module
from types import FrameType
from typing import NoReturn


def _leave(number: int, frame: FrameType | None) -> NoReturn:
    # An exception in the middle of somebody's import might be caught there; nothing is open yet.
    os._exit(0)


def start(name: str) -> int:
    """Import the node `name`, a module of this package, and run it; return the exit status.

    A thread that still computes for a node which was told to end is not waited for.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _leave)
    status = int(import_module(f'railtrack_ros.node.{name}').main())
    import threading  # long loaded by now

    if threading.active_count() > 1:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    return status


def track_estimator() -> int:
    """Run the node `track_estimator`."""
    return start('track_estimator')


def virtual_vehicle() -> int:
    """Run the node `virtual_vehicle`."""
    return start('virtual_vehicle')


def recorder() -> int:
    """Run the node `recorder`."""
    return start('recorder')
