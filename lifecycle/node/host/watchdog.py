"""Says when the executor of this process hangs in a callback.

Owns: what counts as hanging. An executor that waits is idle, whatever it waits for; a callback of a
transition has a deadline of its own; everything else may take as long as the nodes' `silent_s`.
Who notices is at the other end of the busy sign (middleware/process/busy_timer.py): it need not be
this process, whose interpreter may be locked by the very callback that hangs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from lifecycle.middleware.process.busy_timer import BusySign

if TYPE_CHECKING:
    from lifecycle.node.author.node import LifecycleNode


class Watchdog:
    """Keeps the busy sign of one executor; called in its thread only.

    Args:
        sign: this process's side.
        on_overlong: told how many seconds a callback took that came back after all.
    """

    def __init__(self, sign: BusySign, on_overlong: Callable[[float], None]) -> None:
        self._sign = sign
        self._on_overlong = on_overlong
        self._running = False
        self._changing: set[str] = set()

    def add(self, node: LifecycleNode) -> None:
        """Leave the transitions of `node` to their own deadlines."""
        node.lifecycle.add_listener(self._follow)

    def begin(self) -> None:
        """Note that a callback begins."""
        self._running = True
        if not self._changing:
            self._sign.begin()

    def end(self) -> None:
        """Note that it has ended."""
        self._running = False
        self._idle()

    def _follow(self, node: LifecycleNode) -> None:
        """A transition begins or ends, inside a callback as everything does."""
        name = node.lifecycle.full_name
        if not node.lifecycle.state.steady:
            self._changing.add(name)
            self._idle()
            return
        self._changing.discard(name)
        if self._running and not self._changing:
            self._sign.begin()

    def _idle(self) -> None:
        busy_s = self._sign.end()
        if busy_s is not None:
            self._on_overlong(busy_s)
