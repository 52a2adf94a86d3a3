"""A node that nobody supervises is heard all the same by a supervisor that attaches to it.

Owns: what such a node tells of its liveliness. DDS asserts that its process runs; that its executor
hangs is noticed by a thread of its own, which sleeps until then. A callback that also holds the
lock of the interpreter keeps that thread from telling, and only a supervisor of its own would see.
"""

from __future__ import annotations

import os
import select
import threading
import typing
from collections.abc import Callable

from lifecycle.middleware.discovery.liveliness import AlivePublisher, node_topic
from lifecycle.middleware.process.busy_timer import BusySign, Overdue
from lifecycle.node.author.node import LifecycleNode
from lifecycle.node.host.watchdog import Watchdog

_SAID_AGAIN_S = (0.1, 0.3)
"""Fast DDS repeats what was lost after up to 3 s: too late for a silence."""


@typing.final
class Heard:
    """The liveliness of one process without a supervisor.

    Args:
        limit_s: seconds, > 0, that a callback may take.

    Attributes:
        watchdog: for the loop that spins the node.
    """

    def __init__(self, limit_s: float) -> None:
        self._sign = BusySign.make(limit_s)
        self._lock = threading.Lock()
        self._silent: dict[str, str] = {}
        self._publisher: AlivePublisher | None = None
        self._name = ""
        self.watchdog = Watchdog(self._sign, lambda _: self._tell(""))

    def open(self, node: LifecycleNode, tell_names: Callable[[], None]) -> None:
        """Be heard from now on.

        Args:
            node: whose name it has.
            tell_names: called when somebody begins to listen, who may have forgotten the names.
        """
        self._name = node.lifecycle.full_name
        self._publisher = AlivePublisher(node, node_topic(self._name), on_listener=tell_names)
        threading.Thread(target=self._watch, name="watchdog", daemon=True).start()

    def _watch(self) -> None:
        while select.select([self._sign], [], []):
            why = self._sign.overdue()
            if why is Overdue.HANGS:
                self._tell(
                    f"a callback in its process (pid {os.getpid()}) has been running for "
                    f"{self._sign.limit_s:g} s"
                )
            elif why is Overdue.UNSERVED and not self._silent:
                self._tell(
                    f"its process (pid {os.getpid()}) gets no processor for its callback: the "
                    "machine is overloaded"
                )

    def _tell(self, why: str) -> None:
        with self._lock:
            silent = self._silent = {self._name: why} if why else {}
        self._say(silent)
        for again_s in _SAID_AGAIN_S:
            timer = threading.Timer(again_s, self._say, (silent,))
            timer.daemon = True
            timer.start()

    def _say(self, silent: dict[str, str]) -> None:
        with self._lock:
            # Only what still holds is said again.
            if silent is self._silent and self._publisher is not None:
                self._publisher.tell(silent)
