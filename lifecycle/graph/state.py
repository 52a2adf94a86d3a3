"""Layer 3 of the graph interface: the state of the graph; its queries are in queries.py.

Owns: what is known of every node, kept true by events, and re-read from a node only when the
checksum that it announces is not the one that is held, or when messages of it were lost. One change
costs work in proportion to the node that changed.

Threads: the state changes in the scheduler of its events, and subscribers are called there. Every
public method may be called from any thread, and what it returns does not change afterwards.
"""

from __future__ import annotations

import functools
import logging
import typing
from collections.abc import Callable

from lifecycle.graph.endpoints import EndpointChange
from lifecycle.graph.event import EventKind, GraphEvent, Member
from lifecycle.graph.events import GraphEvents
from lifecycle.graph.messages import Heartbeat, Joined
from lifecycle.graph.queries import GraphQueries
from lifecycle.graph.record import Record
from lifecycle.graph.transport import Remove
from lifecycle.graph.view import GraphChange, NodeView, change
from lifecycle.verify.observation import NodeConfiguration

_logger = logging.getLogger(__name__)

Fetch = Callable[[str, Callable[[NodeConfiguration | None], None]], None]
"""Reads the configuration of a node (fully qualified) and calls back once, from any thread, at once
or later; with None if it could not be read."""

_ENDPOINT_KINDS = frozenset(
    {EventKind.ENDPOINT_ADDED, EventKind.ENDPOINT_REMOVED, EventKind.ENDPOINT_CHANGED}
)


@typing.final
class GraphState(GraphQueries):
    """The state of one graph.

    Args:
        events: layer 2; the state learns of the members that they know already. It may be shared.
        fetch: how configurations are read.
    """

    def __init__(self, events: GraphEvents, fetch: Fetch) -> None:
        super().__init__(events)
        self._fetch = fetch
        self._callbacks: tuple[Callable[[GraphChange], None], ...] = ()
        self._unread: set[str] = set()
        self._reads = 0
        self._stop: tuple[Remove, ...] = ()
        self._closed = False
        events.scheduler.post(self._begin)

    # -- changes

    @property
    def reads(self) -> int:
        """How many configurations were asked for so far."""
        return self._reads

    def on_change(self, callback: Callable[[GraphChange], None]) -> Remove:
        """Have `callback` called in the scheduler with each change, after it is in force."""
        with self._lock:
            self._callbacks += (callback,)

        def remove() -> None:
            with self._lock:
                self._callbacks = tuple(each for each in self._callbacks if each is not callback)

        return remove

    def put_configuration(self, configuration: NodeConfiguration) -> None:
        """Give what was learnt of a node in another way, over a control channel say.

        A node that sends no messages becomes a member by it.
        """
        self.events.report_seen(configuration.name)
        self.events.scheduler.post(functools.partial(self._put, configuration))

    def reread(self, node: str) -> None:
        """Have a node's configuration read again, whatever its checksum."""

        def doubt() -> None:
            record = self._records.get(node)
            if record is not None:
                record.doubt()
                self._read_if_needed(record)

        self.events.scheduler.post(doubt)

    def retry(self) -> None:
        """Read now what could not be read before: services appear later than messages arrive."""

        def again() -> None:
            for node in tuple(self._unread):
                record = self._records.get(node)
                if record is not None:
                    self._read_if_needed(record)

        self.events.scheduler.post(again)

    def close(self) -> None:
        """Follow events no longer; what is known stays as it is. Again is harmless."""
        self._closed = True
        for stop in self._stop:
            stop()

    # -- what happens in the scheduler

    def _begin(self) -> None:
        if self._closed:
            return
        kinds = [each for each in EventKind if each not in _ENDPOINT_KINDS]
        self._stop = (self.events.on(kinds, self._happened),)
        for member in self.events.members():
            self._join(member)

    def _happened(self, event: GraphEvent) -> None:
        if event.kind is EventKind.JOINED:
            self._join(_member(event))
            return
        if event.kind is EventKind.LEFT:
            self._leave(event.node)
            return
        record = self._records.get(event.node)
        if record is None:
            return
        before = record.view
        with self._lock:
            record.apply(event)
        self._tell(before, record)
        self._read_if_needed(record)

    def _join(self, member: Member) -> None:
        record = Record(member)
        with self._lock:
            self._records[member.node] = record
        self._tell(None, record)
        self._read_if_needed(record)

    def _leave(self, node: str) -> None:
        with self._lock:
            record = self._records.pop(node, None)
            self._unread.discard(node)
        if record is not None:
            gone = EndpointChange(removed=record.view.endpoints)
            self._call(change(record.view, None, gone))

    def _put(self, configuration: NodeConfiguration) -> None:
        record = self._records.get(configuration.name)
        if record is not None:
            self._take(record, configuration)

    def _read_if_needed(self, record: Record) -> None:
        if not record.must_read or self._closed:
            return
        token = record.begin()
        self._reads += 1
        node = record.view.name

        def done(configuration: NodeConfiguration | None) -> None:
            self.events.scheduler.post(
                functools.partial(self._answered, node, token, configuration)
            )

        self._fetch(node, done)

    def _answered(self, node: str, token: object, configuration: NodeConfiguration | None) -> None:
        record = self._records.get(node)
        if record is None or record.reading is not token:
            return  # of an instance that is gone
        if configuration is None:
            record.failed()
            self._unread.add(node)
        else:
            self._take(record, configuration)

    def _take(self, record: Record, configuration: NodeConfiguration) -> None:
        self._unread.discard(record.view.name)
        before = record.view
        with self._lock:
            record.take(configuration)
        self._tell(before, record)
        self._read_if_needed(record)

    def _tell(self, before: NodeView | None, record: Record) -> None:
        after = record.view
        if after is before:
            return
        endpoints = EndpointChange()
        if before is None or after.endpoints is not before.endpoints:
            endpoints = self.events.configuration_read(after.name, after.endpoints)
        if after != before:
            self._call(change(before, after, endpoints))

    def _call(self, what: GraphChange) -> None:
        for callback in self._callbacks:
            _logged(callback, what)


def _logged(callback: Callable[[GraphChange], None], what: GraphChange) -> None:
    try:
        callback(what)
    except Exception:
        _logger.exception("cannot handle a change of %s", what.node)


def _member(event: GraphEvent) -> Member:
    message = event.message
    if isinstance(message, Joined | Heartbeat):
        return Member(
            node=event.node,
            incarnation=event.incarnation,
            state=message.state,
            connected=message.connected,
            checksum=message.checksum,
        )
    return Member(node=event.node, incarnation=event.incarnation)
