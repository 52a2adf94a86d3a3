"""Nodes of these tests that the benchmark has no use for."""

from __future__ import annotations

import time

from lifecycle import LifecycleNode

TAKES_S = 1.2
"""Longer than a callback may take that belongs to no transition."""


class Slow(LifecycleNode):
    """Blocks in each step, longer than any other callback may."""

    def on_configure(self, state):
        time.sleep(TAKES_S)

    def on_activate(self, state):
        time.sleep(TAKES_S)
