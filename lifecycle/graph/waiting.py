"""Waiting for an event with a deadline, so that a cancellation is never lost.

Owns: `set_within`. asyncio.wait_for of Python 3.10 and 3.11 returns normally when it is cancelled
in the moment in which what it waits for comes true (python/cpython#86296): a task that waits in a
loop then outlives its cancellation, and whoever waits for its end waits for ever. Pure.
"""

from __future__ import annotations

import asyncio


async def set_within(event: asyncio.Event, timeout_s: float | None) -> bool:
    """Wait until `event` is set; False if it was not within `timeout_s` (None: no limit)."""
    waiting = asyncio.ensure_future(event.wait())
    try:
        done, _ = await asyncio.wait({waiting}, timeout=timeout_s)
    finally:
        waiting.cancel()
    return bool(done)
