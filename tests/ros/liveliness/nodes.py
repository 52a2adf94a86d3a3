"""Nodes of these tests that the benchmark has no use for."""

from __future__ import annotations

import ctypes
import socket
import threading
import time
from pathlib import Path

from lifecycle import LifecycleNode

TAKES_S = 1.2
"""Longer than a callback may take that belongs to no transition."""

WORKS_S = 0.02


class Slow(LifecycleNode):
    """Blocks in each step, longer than any other callback may."""

    def on_configure(self, state):
        time.sleep(TAKES_S)

    def on_activate(self, state):
        time.sleep(TAKES_S)


class Working(LifecycleNode):
    """Has something to do ten times a second; each time a fiftieth of a second of one processor."""

    def on_configure(self, state):
        self.create_timer(0.1, self._work)

    def _work(self) -> None:
        end = time.thread_time() + WORKS_S
        while time.thread_time() < end:
            pass


class Deadlocked(LifecycleNode):
    """Once it is active for the first time, a thread like those of Fast DDS reads nothing more.

    When Fast DDS deadlocks cannot be chosen; what the kernel then says of it can be played.
    """

    def on_activate(self, state):
        mark = Path("deadlocked")
        if not mark.exists():
            mark.touch()
            self._receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._receiver.bind(("127.0.0.1", 0))
            self._receiver.sendto(b"unread", self._receiver.getsockname())
            threading.Thread(target=self._read_nothing, daemon=True).start()

    def _read_nothing(self) -> None:
        name = f"dds.udp.{self._receiver.getsockname()[1]}"
        ctypes.CDLL(None).prctl(15, name.encode(), 0, 0, 0)  # PR_SET_NAME
        threading.Event().wait()
