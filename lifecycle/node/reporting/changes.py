"""Tells that a node's configuration is another now, once however much changed.

Owns: making one notice of all changes within one turn of the executor, and nothing of it while
nobody listens: a configuration costs a millisecond to collect.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lifecycle.node.lifecycle.gate import Later
    from lifecycle.verify.observation import NodeConfiguration

Listener = Callable[["NodeConfiguration"], None]


class ConfigurationChanges:
    """The listeners of one node's configuration.

    Args:
        later: runs a function in the node's executor.
        collect: returns the configuration as it is now.
        failed: told with a traceback that it could not be collected; nobody is told then.
    """

    def __init__(
        self,
        later: Later,
        collect: Callable[[], NodeConfiguration],
        *,
        failed: Callable[[str], None],
    ) -> None:
        self._later = later
        self._collect = collect
        self._failed = failed
        self._listeners: list[Listener] = []
        self._scheduled = False

    def listen(self, listener: Listener) -> None:
        """Call `listener` with the configuration, in the executor, after each change."""
        self._listeners.append(listener)

    def touch(self) -> None:
        """Something of the configuration has changed, match counts included."""
        if self._listeners and not self._scheduled:
            self._scheduled = bool(self._later(self._tell))

    def _tell(self) -> None:
        self._scheduled = False
        configuration = self.collect()
        if configuration is None:
            return
        for listener in tuple(self._listeners):
            listener(configuration)

    def collect(self) -> NodeConfiguration | None:
        """Return the configuration as it is now; None, and a word in the log, if that fails."""
        try:
            return self._collect()
        except Exception:  # noqa: BLE001 - describing itself must not end the node
            self._failed(traceback.format_exc())
            return None
