"""The guard against blocking calls that would wait for ever.

rclpy's blocking `Client.call` and its like, called from a callback, wait for an answer that only
the executor can bring, and the executor waits for the callback (rclcpp#2213 and its like are the
oldest trap of lifecycle callbacks).
"""

from __future__ import annotations

import functools
import inspect
from typing import Any

from rclpy.client import Client

from lifecycle.errors import LifecycleError

_SPINNING = {
    ("rclpy.executors", "spin_once"),
    ("rclpy.executors", "spin_once_until_future_complete"),
    ("lifecycle.node.host.loop", "turn"),
    ("lifecycle.node.host.loop", "_spin"),
}
"""Where a single-threaded executor calls back: rclpy's, and those of our own processes."""


class DeadlockError(LifecycleError):
    """A blocking call was made in the thread that would have to bring its answer."""


def refuse_to_deadlock(client: Client) -> None:
    """Make `client.call` raise DeadlockError inside the executor; elsewhere it is rclpy's own."""
    blocking = client.call

    @functools.wraps(blocking)
    def call(*arguments: Any, **options: Any) -> Any:
        refuse_to_block(f"service {client.srv_name!r}", "client.call_async(request)")
        return blocking(*arguments, **options)

    client.call = call


def refuse_to_block(what: str, instead: str) -> None:
    """Raise DeadlockError inside the executor, where waiting for `what` would never end.

    Args:
        what: that an answer is awaited of.
        instead: what can be awaited.
    """
    # A multi-threaded executor runs callbacks in other threads than the one that spins.
    frame = inspect.currentframe()
    while frame is not None:
        if (frame.f_globals.get("__name__"), frame.f_code.co_name) in _SPINNING:
            raise DeadlockError(
                f"cannot wait for {what} in a callback: the answer comes by the executor that "
                "waits for this callback",
                hint=f"write `async def` and `await {instead}`",
            )
        frame = frame.f_back
