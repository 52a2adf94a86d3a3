"""The node of the liveliness benchmark: it hangs when it is told to, by a file."""

from __future__ import annotations

import ctypes
import os
import time
from pathlib import Path

from lifecycle import LifecycleNode, on_timer

PERIOD_S = 0.02


def hang(way: str, seconds: float) -> None:
    """Keep the executor busy: `sleep`, `busy`, or `locked`, with the interpreter's lock held."""
    if way == "sleep":
        time.sleep(seconds)
    elif way == "busy":
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            pass
    elif way == "locked":
        ctypes.PyDLL(None).usleep(round(seconds * 1e6))
    else:
        raise ValueError(f"cannot hang {way!r}; allowed: sleep, busy, locked")


class Hanging(LifecycleNode):
    """Looks for a file `HANG_FILE` with a way and seconds, removes it, and hangs."""

    @on_timer(period_s=PERIOD_S)
    def tick(self) -> None:
        """Hang if told to."""
        file = Path(os.environ["HANG_FILE"])
        if file.exists():
            way, seconds = file.read_text(encoding="ascii").split()
            file.unlink()
            print(f"hangs {time.monotonic()}", flush=True)
            hang(way, float(seconds))
            print(f"is back {time.monotonic()}", flush=True)


class Quiet(LifecycleNode):
    """Does nothing."""
