"""A node inside a program that is no node itself: to listen, to play, to record."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions


@contextmanager
def client(name: str) -> Iterator[tuple[Node, SingleThreadedExecutor]]:
    """Give a node of that name and the executor that serves it when it is spun, and end both.

    Signals stay with the program.
    """
    context = rclpy.Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = rclpy.create_node(name, context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        try:
            yield node, executor
        finally:
            node.destroy_node()
    finally:
        context.try_shutdown()
