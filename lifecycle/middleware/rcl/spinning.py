"""A thread that spins a node of our own, beside whatever loop the program has."""

from __future__ import annotations

import logging
import threading

from rclpy.executors import ExternalShutdownException, ShutdownException, SingleThreadedExecutor
from rclpy.node import Node

_logger = logging.getLogger(__name__)


class Spinner:
    """Spins one node in a thread, from now until `stop` or the end of its context.

    Args:
        node: an observer's, which nobody else spins.
        thread: its name.
    """

    def __init__(self, node: Node, *, thread: str) -> None:
        # Never EventsExecutor: on Jazzy's wheels it spins at full load and loses every call.
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._thread = threading.Thread(target=self._spin, name=thread, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread; again is harmless."""
        self._executor.shutdown()
        self._thread.join()

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except (ExternalShutdownException, ShutdownException):
            _logger.debug("the context was shut down")
