"""Start, spin and end a node: the same way, whichever node it is."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
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


# Time after which a signal is insisted on, s.
INSISTENCE = 0.5


class Ended(BaseException):
    """A signal has told the process to end; no handler of errors may catch it."""


class _Ending:
    """What SIGINT and SIGTERM do while a node runs.

    The first of them asks :func:`spin` to leave after the callback under way, and interrupts
    anything else with :class:`Ended`; further ones change nothing. What goes on all the same is
    interrupted some time later: a callback that computes a model, or a place where Python or a
    library swallows exceptions, as numba does in the middle of compiling.
    """

    def __init__(self) -> None:
        self.told = False
        self.spinning = False

    def listen(self) -> None:
        """Begin."""
        self.told = self.spinning = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._tell)
        signal.signal(signal.SIGALRM, self._insist)
        sys.unraisablehook = _unraisable

    def leave(self) -> None:
        """Be deaf from now on."""
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM):
            signal.signal(number, signal.SIG_IGN)

    @contextmanager
    def spun(self) -> Iterator[None]:
        """Leave it to the block to look whether it was told to end."""
        self.spinning = True
        try:
            yield
        finally:
            # What the node does to end, such as closing a recording, is not interrupted.
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            self.spinning = False

    def _tell(self, number: int, frame: FrameType | None) -> None:
        if self.told:
            return
        self.told = True
        signal.setitimer(signal.ITIMER_REAL, INSISTENCE, INSISTENCE)
        if not self.spinning:
            raise Ended

    def _insist(self, number: int, frame: FrameType | None) -> NoReturn:
        raise Ended


def _unraisable(fault: sys.UnraisableHookArgs) -> None:
    """Say nothing of a signal that was swallowed."""
    if not issubclass(fault.exc_type, Ended):
        sys.__unraisablehook__(fault)


_ending = _Ending()


def run(make_node: Callable[[], NodeType], serve: Callable[[NodeType], int] | None = None,
        arguments: Sequence[str] | None = None) -> int:
    """Run a node until it has done its work or is told to end; return the exit status.

    SIGINT and SIGTERM both end it with status 0, also while it is still being built. (rclpy's
    own handlers would shut the context down from a second thread, which races with the shutdown
    here; and Python may end with the status of a signal after a KeyboardInterrupt that was
    caught.)

    Parameters
    ----------
    make_node
        Builds the node; an :class:`InputError` from it ends the process with status 2.
    serve
        Does the work of the node and returns the exit status; :func:`spin` by default.
    arguments
        Command line arguments, those of the process by default.
    """
    _ending.listen()
    node = None
    try:
        _init(list(sys.argv if arguments is None else arguments))
        node = make_node()
        return (serve or spin)(node)
    except (Ended, ExternalShutdownException):
        return 0
    except Exception as error:
        if _ending.told:  # a fault of the interruption, whatever it is
            return 0
        if not isinstance(error, InputError):
            raise
        print(f'error: {error}', file=sys.stderr)
        return 2
    finally:
        _ending.leave()
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


def _init(arguments: list[str]) -> None:
    """Begin with ROS; InputError for arguments after --ros-args which it does not understand."""
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        # The first sentence has the argument; places in the source of rcl follow.
        reason = str(error).partition(', at /')[0].removeprefix('failed to initialize rcl: ')
        raise InputError(f'arguments after --ros-args: {reason}') from None


def spin(node: Node) -> int:
    """Serve the callbacks of a node until it is told to end; one that fails is logged and left."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    with _ending.spun():
        while rclpy.ok() and not _ending.told:
            try:
                executor.spin_once(timeout_sec=WAKE_UP)
            except (ExternalShutdownException, InputError):
                raise
            except Exception as error:
                node.get_logger().error(f'a callback failed and was left: {error!r}')
                time.sleep(WAKE_UP)
    return 0
