"""Wait for what an engine does."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any


def within(timeout_s: float, what: Callable[[], Any]) -> Any:
    """Wait until something is so, and return it."""
    ends_s = time.monotonic() + timeout_s
    while not (found := what()):
        assert time.monotonic() < ends_s, "it did not become so"
        time.sleep(0.3)
    return found
