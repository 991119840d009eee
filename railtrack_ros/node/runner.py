"""Start, spin and end a node: the same way, whichever node it is."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Sequence
from types import FrameType
from typing import NoReturn, TypeVar

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from railtrack_ros.errors import InputError

NodeType = TypeVar('NodeType', bound=Node)

# Longest time a signal waits for the executor to wake up, s.
WAKE_UP = 0.1


class Ended(BaseException):
    """A signal has told the process to end; no handler of errors may catch it."""


def _end(number: int, frame: FrameType | None) -> NoReturn:
    raise Ended


def run(make_node: Callable[[], NodeType], serve: Callable[[NodeType], int] | None = None,
        arguments: Sequence[str] | None = None) -> int:
    """Run a node until it has done its work or is told to end; return the exit status.

    SIGINT and SIGTERM both end it with status 0, also while it is still being built: they
    raise :class:`Ended` in the main thread. (rclpy's own handlers would shut the context down
    from a second thread, which races with the shutdown here; and Python may end with the status
    of a signal after a KeyboardInterrupt that was caught.)

    Parameters
    ----------
    make_node
        Builds the node; an :class:`InputError` from it ends the process with status 2.
    serve
        Does the work of the node and returns the exit status; :func:`spin` by default.
    arguments
        Command line arguments, those of the process by default.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _end)
    node = None
    try:
        rclpy.init(
            args=list(sys.argv if arguments is None else arguments),
            signal_handler_options=SignalHandlerOptions.NO,
        )
        node = make_node()
        return (serve or spin)(node)
    except InputError as error:
        print(f'error: {error}', file=sys.stderr)
        return 2
    except (Ended, ExternalShutdownException):
        return 0
    finally:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


def spin(node: Node) -> int:
    """Serve the callbacks of a node for ever; one that fails is logged and left."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while rclpy.ok():
        try:
            executor.spin_once(timeout_sec=WAKE_UP)
        except (ExternalShutdownException, InputError):
            raise
        except Exception as error:
            node.get_logger().error(f'a callback failed and was left: {error!r}')
            time.sleep(WAKE_UP)
    return 0
