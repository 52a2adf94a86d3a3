"""Who is to be told of which event.

Owns: the callbacks by what they ask for, so that telling costs as much as there are who asked, and
that an exception of one spoils nothing for the others. Pure.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Iterator

from lifecycle.graph.endpoints import names_of
from lifecycle.graph.event import EventKind, GraphEvent
from lifecycle.graph.transport import Remove
from lifecycle.manifest.model import EndpointKind

_logger = logging.getLogger(__name__)

About = str | tuple[EndpointKind, str] | None
"""A node, an endpoint's kind and name, or anything."""

Callback = Callable[[GraphEvent], None]


class Subscribers:
    """Callbacks of one graph. `add` from any thread; the rest from the scheduler."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._callbacks: dict[tuple[EventKind, About], tuple[tuple[object, Callback], ...]] = {}
        self._outbox: list[GraphEvent] = []
        self._telling = False

    def add(self, wanted: Iterable[tuple[EventKind, About]], callback: Callback) -> Remove:
        """Have `callback` called with what is wanted; return what takes it away."""
        token = object()
        places = tuple(wanted)
        with self._lock:
            for place in places:
                self._callbacks[place] = (*self._callbacks.get(place, ()), (token, callback))

        def remove() -> None:
            with self._lock:
                for place in places:
                    left = tuple(
                        each for each in self._callbacks.get(place, ()) if each[0] is not token
                    )
                    if left:
                        self._callbacks[place] = left
                    else:
                        self._callbacks.pop(place, None)

        return remove

    def tell(self, events: Iterable[GraphEvent]) -> None:
        """Tell each event to all who asked for it, before the next event.

        What a callback makes happen meanwhile is told after that.
        """
        self._outbox += events
        if self._telling:
            return
        self._telling = True
        try:
            while self._outbox:
                event = self._outbox.pop(0)
                for place in _places(event):
                    for _, callback in self._callbacks.get(place, ()):
                        call(callback, event)
        finally:
            self._telling = False


def call(callback: Callback, event: GraphEvent) -> None:
    """Call back; an exception is logged, and ends nothing."""
    try:
        callback(event)
    except Exception:
        _logger.exception("cannot handle %s of %s", event.kind.value, event.node)


def _places(event: GraphEvent) -> Iterator[tuple[EventKind, About]]:
    yield event.kind, None
    yield event.kind, event.node
    if event.endpoint is not None:
        for name in names_of(event.endpoint):
            yield event.kind, (event.endpoint.kind, name)
