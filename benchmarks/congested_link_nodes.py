"""The two nodes of the congested link: N1 publishes P1 and P2, N2 takes both.

P1 is one message of 1 kB each 10 ms, stamped with CLOCK_MONOTONIC: both hosts are on one kernel.
P2 is bulk, from the moment a file is there. What was sent and received is written when the nodes
are deactivated.
"""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

from std_msgs.msg import String

from lifecycle import LifecycleNode, on_message

PERIOD_S = 0.01
BULK_PERIOD_S = 0.0037
P1_BYTES = 1000
P2_BYTES = 1300
"""With its headers it fits an Ethernet frame: fragments would have no ports to match."""


def _directory() -> Path:
    return Path(os.environ["CONGESTED_LINK_DIRECTORY"])


class Source(LifecycleNode):
    """N1: P1 and P2."""

    def on_configure(self, _state: object) -> None:
        """Start the clock; it ticks while the node is active."""
        self._sent: list[int] = []
        self._bulk = 0.0
        self._began_s = 0.0
        self._go = _directory() / "go"
        self._bulk_per_s = float(os.environ["CONGESTED_LINK_BULK_PER_S"])
        self._block = String(data="2" * P2_BYTES)
        # Two clocks that beat against each other, so that P1 meets the queue at any filling.
        self.create_timer(PERIOD_S, self._tick)
        self.create_timer(BULK_PERIOD_S, self._tick_bulk)

    def on_deactivate(self, _state: object) -> None:
        """Write down when each message of P1 was sent."""
        (_directory() / "sent.json").write_text(json.dumps(self._sent))

    def _tick(self) -> None:
        stamp = time.monotonic_ns()
        self._sent.append(stamp)
        self.publisher("p1").publish(String(data=f"{stamp} ".ljust(P1_BYTES, "1")))

    def _tick_bulk(self) -> None:
        if not self._began_s:
            self._began_s = time.monotonic() if self._go.exists() else 0.0
            return
        # As many as are due by now: the load does not depend on how punctual the timer is.
        due = (time.monotonic() - self._began_s) * self._bulk_per_s
        while self._bulk < due:
            self.publisher("p2").publish(self._block)
            self._bulk += 1


class Sink(LifecycleNode):
    """N2: S1 and S2."""

    def on_configure(self, _state: object) -> None:
        """Forget everything."""
        self._received: list[tuple[int, int]] = []
        self._bulk = 0

    @on_message("p1")
    def take_p1(self, message: String) -> None:
        """Note when a message was sent and when it came."""
        now = time.monotonic_ns()
        self._received.append((int(message.data.partition(" ")[0]), now))

    @on_message("p2")
    def take_p2(self, _message: String) -> None:
        """Count."""
        self._bulk += 1

    def on_deactivate(self, _state: object) -> None:
        """Write down what came."""
        result = {"p1": self._received, "p2": self._bulk}
        (_directory() / "received.json").write_text(json.dumps(result))
