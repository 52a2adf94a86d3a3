"""Nodes of these tests that the benchmark has no use for."""

from __future__ import annotations

import time

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
