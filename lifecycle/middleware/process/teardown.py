"""Clean, bounded exit of a process that had DDS participants.

Owns: leaving in the order that notifies peers at once and leaves nothing in /dev/shm, within a
bound. A normal exit sleeps 100 ms in Fast DDS; `os._exit` alone leaves a ghost in the graph for the
whole lease (20 s) and shared memory files for ever.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import sys
from collections.abc import Callable, Iterable
from typing import Any, NoReturn

from lifecycle.middleware.discovery.tcp import give_up_dead_connections
from lifecycle.middleware.process.prctl import exit_after

_logger = logging.getLogger(__name__)


def leave_and_exit(
    code: int, *, nodes: Iterable[Any] = (), contexts: Iterable[Any] = (), deadline_s: float = 2.0
) -> NoReturn:
    """Destroy what is given, flush the standard streams and end the process; never returns.

    Executors must have stopped spinning. Destroying a participant can hang in Fast DDS with the GIL
    held: at the deadline the process ends with the same code, and its supervisor sweeps /dev/shm.

    Args:
        code: exit code, 0–255.
        nodes: rclpy nodes, destroyed in this order.
        contexts: rclpy contexts, shut down and destroyed after the nodes.
        deadline_s: seconds, > 0, for all of it.
    """
    try:
        exit_after(deadline_s, code)
        give_up_dead_connections()
        for node in nodes:
            _release(node)
        for context in contexts:
            _attempt(context.try_shutdown)
            _attempt(context.destroy)
        # Fast DDS objects go with the last Python reference to them; cycles hold some.
        gc.collect()
        logging.shutdown()
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError, AttributeError):
                stream.flush()
    finally:
        os._exit(code)


def _release(node: Any) -> None:
    """Destroy a node and everything hanging on it that would keep its participant alive.

    rclpy's destroy_node forgets action servers and clients and a managed node's state machine;
    each holds the C++ node, and with it the participant, until it goes itself.
    """
    for waitable in tuple(node.waitables):
        if hasattr(waitable, "destroy"):
            _attempt(waitable.destroy)
    _attempt(node.destroy_node)
    vars(node).clear()


def _attempt(step: Callable[[], None]) -> None:
    try:
        step()
    except Exception:
        # The others must still be destroyed; the process ends in any case.
        _logger.exception("cannot destroy %r while leaving", step)
