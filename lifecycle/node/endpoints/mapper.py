"""Map, unmap, hand over and rename the endpoints of a node between its connections.

Owns: these changes of single endpoints, and the handovers that are under way. Where an endpoint
belongs is up to data_layer.py.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Mapping as AbstractMapping
from typing import TYPE_CHECKING, Any

from rclpy.task import Future

from lifecycle.manifest import EndpointKind
from lifecycle.node.connections.connection_status import ConnectionStatus
from lifecycle.node.connections.connections import Connection, Connections
from lifecycle.node.endpoints.making import CLIENTS
from lifecycle.node.endpoints.mapping import Key, Mapping, Placement
from lifecycle.node.endpoints.placing import After, Handover, Overlap, Placer

if TYPE_CHECKING:
    from rclpy.node import Node

    from lifecycle.node.endpoints.publisher import DeclaredPublisher


class Mapper:
    """Maps the endpoints of one node.

    Args:
        node: whose endpoints they are.
        placer: makes and destroys their entities.
        mappings: every declared endpoint, as it is at any time.
        handles: of its publishers, likewise.
        connections: of the node.
        status: notified of each change.
        after: calls back once in the node's executor.
        changed: called when the node configuration has changed.
    """

    def __init__(
        self,
        node: Node,
        placer: Placer,
        *,
        mappings: AbstractMapping[Key, Mapping],
        handles: AbstractMapping[str, DeclaredPublisher],
        connections: Connections,
        status: ConnectionStatus,
        after: After,
        changed: Callable[[], None],
    ) -> None:
        self._node = node
        self._placer = placer
        self._mappings = mappings
        self._handles = handles
        self._connections = connections
        self._status = status
        self._after = after
        self._changed = changed
        self._handovers: dict[Key, tuple[Handover, Placement]] = {}

    @property
    def entities(self) -> tuple[Any, ...]:
        """Every rclpy object of a declared endpoint."""
        placements = [each.placement for each in self._mappings.values()]
        placements += [old for _, old in self._handovers.values()]
        return tuple(entity for each in placements if each for entity in each.entities)

    def map(self, mapping: Mapping, connection: Connection) -> None:
        """Map an endpoint that is mapped nowhere; raises LifecycleError."""
        placement = mapping.placement = self._place(mapping, connection)
        self._attach(mapping, placement)
        self._status.mapped(mapping)
        self._changed()

    def unmap(self, mapping: Mapping) -> None:
        """Take an endpoint off where it is; harmless if it is nowhere."""
        self._end_handover(mapping)
        placement = mapping.placement
        if placement is None:
            return
        handle = self._handle(mapping)
        if handle is not None:
            handle.detach()
        mapping.placement = mapping.peers = None
        self._placer.unplace(mapping, placement)
        self._status.unmapped(mapping, placement.connection)

    def take_off(self, mapping: Mapping, connection: Connection) -> None:
        """Take an endpoint off a connection, on which it may be no longer alone."""
        running = self._handovers.get(mapping.key)
        if running is not None and connection in (running[1].connection, mapping.connection):
            self._end_handover(mapping)
        if mapping.connection is connection:
            self.unmap(mapping)

    def move(self, mapping: Mapping, connection: Connection) -> Future:
        """Map an endpoint onto another connection, make before break; raises LifecycleError.

        Returns:
            Done once it is on that connection alone.
        """
        running = self._handovers.get(mapping.key)
        if mapping.connection is connection:
            return running[0].done if running is not None else _done()
        self._end_handover(mapping)
        if mapping.placement is not None:
            return self._hand_over(mapping, mapping.placement, connection)
        self.map(mapping, connection)
        mapping.error = ""
        return _done()

    def rename(self, mapping: Mapping, name: str) -> None:
        """Make an endpoint anew under another name, where it is; raises LifecycleError."""
        before = mapping.name
        if name == before:
            return
        self._end_handover(mapping)
        mapping.name = name
        old = mapping.placement
        if old is not None:
            try:
                new = self._place(mapping, old.connection)
            except BaseException:
                mapping.name = before
                raise
            overlap = self._placer.overlap(mapping, old, new)
            mapping.placement = new
            self._take_over(mapping, old, new, overlap)
            self._status.mapped(mapping)
        self._changed()

    def realias(self, mapping: Mapping, aliases: tuple[str, ...]) -> None:
        """Give an endpoint these further names and no others; raises LifecycleError."""
        self._end_handover(mapping)
        if mapping.placement is not None:
            self._placer.realias(mapping, mapping.placement, aliases, matched=self._match)
            mapping.aliases = aliases
            self._attach(mapping, mapping.placement)
            self._status.matched(mapping)
        mapping.aliases = aliases
        self._changed()

    def close(self, connection: Connection) -> None:
        """Unmake a connection that nothing is mapped onto."""
        self._connections.close(connection)
        self._status.closed(connection)

    def tidy(self) -> None:
        """Unmake participants of single flows that carry nothing any more."""
        used = [each.connection for each in self._mappings.values()]
        used += [old.connection for _, old in self._handovers.values()]
        for connection in self._connections.unnamed:
            if connection not in used:
                self._connections.close(connection)

    def _place(self, mapping: Mapping, connection: Connection) -> Placement:
        beside = self._mappings.values()
        return self._placer.place(mapping, connection, beside=beside, matched=self._match)

    def _handle(self, mapping: Mapping) -> DeclaredPublisher | None:
        publishes = mapping.endpoint.kind is EndpointKind.PUBLISHER
        return self._handles[mapping.endpoint.name] if publishes else None

    def _attach(self, mapping: Mapping, placement: Placement) -> None:
        handle = self._handle(mapping)
        if handle is not None:
            handle.attach(placement.entity, placement.entities[1:])

    def _end_handover(self, mapping: Mapping) -> None:
        running = self._handovers.get(mapping.key)
        if running is not None:
            running[0].end()

    def _hand_over(self, mapping: Mapping, old: Placement, connection: Connection) -> Future:
        """Make an endpoint anew, live on both sides for a while, then destroy the old one."""
        peers = mapping.peers
        new = self._place(mapping, connection)
        handle = self._handle(mapping)
        if handle is not None:
            handle.prepare(new.entities)
        mapping.placement = new
        mapping.error = ""
        overlap = self._placer.overlap(mapping, old, new)

        def finish() -> None:
            del self._handovers[mapping.key]
            self._take_over(mapping, old, new, overlap)
            self.tidy()
            self._changed()

        # Two servers would both answer; and a client's answers may still be under way.
        kind = mapping.endpoint.kind
        lives_on = bool(peers) if kind.is_topic else kind in CLIENTS
        handover = Handover(peers_before=peers or 1, after=self._after, finish=finish)
        self._handovers[mapping.key] = (handover, old)
        self._status.mapped(mapping)
        if not lives_on or self._node.executor is None:
            handover.end()
        else:
            handover.peers_changed(mapping.peers or 0)
        return handover.done

    def _take_over(
        self, mapping: Mapping, old: Placement, new: Placement, overlap: Overlap | None
    ) -> None:
        self._placer.switch(mapping, old, new, overlap)
        self._attach(mapping, new)
        self._placer.unplace(mapping, old)
        self._status.unmapped(mapping, old.connection)

    def _match(self, mapping: Mapping) -> None:
        """Some entity of a mapping has been matched or unmatched."""
        if mapping.endpoint.kind in CLIENTS:
            self._changed()  # their peers are not counted
            return
        self._status.matched(mapping)
        running = self._handovers.get(mapping.key)
        if running is not None:
            running[0].peers_changed(mapping.peers or 0)
        self._changed()  # as many peers as before may be others


def _done() -> Future:
    future: Future = Future()
    future.set_result(None)
    return future
