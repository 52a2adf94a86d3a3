"""What /diagnostics says of nodes.

Owns: which entries count for which node, for how long, and what they mean together.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from lifecycle.verify.observation import HealthReport
from lifecycle.verify.tool_filter import matches

if TYPE_CHECKING:  # it imports rclpy
    from lifecycle.middleware.services.clients import NodeClients

Diagnostic = tuple[str, int, str]
"""Name, level and message of a diagnostic_msgs/DiagnosticStatus."""

_OF_WARN, _OF_ERROR, _OF_STALE = 1, 2, 3
"""Levels of that."""

STALE_S = 5.0
"""An entry that was not published for so long says nothing any more, as diagnostic_aggregator has
it by default."""

_LONGEST_MESSAGE = 200
_MOST_ENTRIES = 1000


class DiagnosticReadings:
    """What /diagnostics says of some nodes.

    Args:
        clients: where it is subscribed to, once there is such a node.
        wake: called, in any thread, when it says something else.
        clock: seconds.
    """

    def __init__(
        self,
        clients: NodeClients,
        wake: Callable[[], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clients = clients
        self._wake = wake
        self._clock = clock
        self._lock = threading.Lock()
        self._patterns: dict[str, tuple[str, ...]] = {}
        self._entries: dict[str, tuple[int, str, float]] = {}
        self._said: dict[str, HealthReport] = {}

    def listen(self, patterns: Mapping[str, tuple[str, ...]]) -> None:
        """Follow the entries of nodes from now on, by patterns of their names."""
        with self._lock:
            # Looks at a part of the system go on beside those at all of it.
            self._patterns.update(patterns)
        if patterns:
            self._clients.on_diagnostics(self._arrived)

    def forget(self, node: str) -> None:
        """Forget what was said of a node: what comes in its place has said nothing yet."""
        with self._lock:
            patterns = self._patterns.get(node, ())
            for name in [one for one in self._entries if any(matches(one, p) for p in patterns)]:
                del self._entries[name]

    def reports(self) -> dict[str, HealthReport]:
        """Return what is known now, by full node name."""
        with self._lock:
            self._said = self._reports()
            return self._said

    def _arrived(self, entries: Sequence[Diagnostic]) -> None:
        with self._lock:
            wanted = {each for patterns in self._patterns.values() for each in patterns}
            for name, level, message in entries:
                known = name in self._entries or len(self._entries) < _MOST_ENTRIES
                if known and any(matches(name, each) for each in wanted):
                    self._entries[name] = level, message[:_LONGEST_MESSAGE], self._clock()
            changed = self._reports() != self._said
        if changed:
            self._wake()

    def _reports(self) -> dict[str, HealthReport]:
        found = {node: self._report(patterns) for node, patterns in self._patterns.items()}
        return {node: each for node, each in found.items() if each is not None}

    def _report(self, patterns: tuple[str, ...]) -> HealthReport | None:
        wrong, unknown, ok = [], [], False
        for name, (level, message, at_s) in sorted(self._entries.items()):
            if not any(matches(name, each) for each in patterns):
                continue
            said = f": {message}" if message else ""
            if self._clock() - at_s > STALE_S:
                unknown.append(f"{name!r} was not published for {STALE_S:g} s")
            elif level == _OF_STALE:
                unknown.append(f"{name!r} is stale{said}")
            elif level == _OF_ERROR:
                wrong.append(f"{name!r}{said or ' has level ERROR'}")
            elif level > _OF_WARN:
                unknown.append(f"{name!r} has level {level}, which has no meaning{said}")
            else:
                ok = True
        if wrong or unknown:
            said = "; ".join(wrong or unknown)[:_LONGEST_MESSAGE]
            return HealthReport(ok=False if wrong else None, message=said)
        return HealthReport(ok=True) if ok else None
