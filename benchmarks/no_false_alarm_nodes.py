"""The nodes of no_false_alarm.py: a source that halts now and then, and a sink that notes delays.

Both read a clock that all hosts of this machine share, whatever the wall clock says.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

from std_msgs.msg import String

from lifecycle import on_message
from tests.net.systems import Sink, Stamped


class Halting(Stamped):
    """N1, which says nothing for half a second out of ten."""

    _ticks = 0

    def _tick(self) -> None:
        self._ticks += 1
        if self._ticks % 500 > 25:
            super()._tick()


class Noting(Sink):
    """N2, which appends to the file NOTES when each video arrived, and how long it took, ms."""

    def __init__(self, *arguments, **options) -> None:
        super().__init__(*arguments, **options)
        self._count = 0
        self._notes = Path(os.environ["NOTES"]).open("a", buffering=1)  # noqa: SIM115 - it stays

    @on_message("video")
    def see(self, message: String) -> None:
        """Note it, and be busy now and then."""
        now_ns = time.monotonic_ns()
        self._notes.write(f"{now_ns / 1e9:.4f} {(now_ns - int(message.data)) / 1e6:.3f}\n")
        self._count += 1
        if self._count % 10 == 0:
            time.sleep(float(os.environ.get("BUSY_S", "0")))
