"""For how long nodes that are asked for a step had no processor: that counts in no deadline."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec
from msgspec.structs import replace

from lifecycle.supervisor.core.advance import late_at_s
from lifecycle.supervisor.core.state import NEVER_S, Request

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from lifecycle.supervisor.nodes.system import System

SLICE_S = 1.0
"""How often is looked whether a process could run, while it is waited for.

What is done within this, or a tenth of its limit, is not worth looking, which takes a file of each
thread: most steps are, of many nodes at once, too."""


class _Measured(msgspec.Struct):
    number: int
    at_s: float
    delay_s: float
    waited_s: float = 0.0


class Load:
    """Measures the run delay of the processes of one system while steps take long.

    Args:
        system: whose nodes are asked.
    """

    def __init__(self, system: System) -> None:
        self._system = system
        self._measured: dict[str, _Measured] = {}

    def next_s(self, now_s: float) -> float:
        """Return when to measure next, by the run's time; infinity while nothing is asked."""
        times = [self._due_s(key, each) for key, each in self._requests()]
        return max(now_s, min(times, default=NEVER_S))

    def _requests(self) -> Iterator[tuple[str, Request]]:
        for key, node in self._system.run.nodes.items():
            request, known = node.request, self._measured.get(key)
            if known is not None and (request is None or known.number != request.number):
                del self._measured[key]
            if request is not None and request.limit_s != NEVER_S:
                yield key, request

    def _due_s(self, key: str, request: Request) -> float:
        known = self._measured.get(key)
        first_s = request.since_s + min(SLICE_S, request.limit_s / 10)
        return first_s if known is None else known.at_s + SLICE_S

    def measure(self, now_s: float) -> tuple[Mapping[str, float], Mapping[str, str]]:
        """Return by node how long its process had no CPU, and what late ones are doing."""
        waited_s: dict[str, float] = {}
        where: dict[str, str] = {}
        for key, request in self._requests():
            known, due_s = self._measured.get(key), self._due_s(key, request)
            if known is None and now_s < due_s:
                continue
            delay_s = self._system.nodes[key].run_delay_s()
            if known is None:
                # That it is looked at late is the machine's fault, too.
                known = _Measured(request.number, now_s, delay_s, now_s - due_s)
                self._measured[key] = known
            # Threads that wait at once have waited no longer for it, and one that ends takes
            # its own along.
            known.waited_s += min(max(delay_s - known.delay_s, 0.0), now_s - known.at_s)
            known.at_s, known.delay_s, waited_s[key] = now_s, delay_s, known.waited_s
            if now_s >= late_at_s(replace(request, waited_s=known.waited_s)):
                where[key] = self._where(key)
        return waited_s, {key: text for key, text in where.items() if text}

    def _where(self, key: str) -> str:
        node = self._system.nodes[key]
        if node.wiring:
            return f"its step {node.wiring}"
        return "" if node.process is None else node.process.where()
