"""Make endpoints on connections: map, unmap, hand over (make before break) and rename.

Owns: these changes of single endpoints, how long an endpoint lives on two connections while it is
handed over, and that a strictly unique flow is not shared. Where an endpoint belongs is up to
data_layer.py.

Both ends of a flow learn of each other at different moments, so a match seen here does not prove
that the other side has seen it: the old one stays a little longer than that. Meanwhile a publisher
publishes by the old one, and a subscription receives by both: what reaches it both ways is
delivered twice.
"""

from __future__ import annotations

import typing
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rclpy.duration import Duration
from rclpy.task import Future

from lifecycle.manifest.model import EndpointKind
from lifecycle.middleware.rcl.graph_changes import ServerWatch
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.node.connections.connections import ConnectError, Connection, Connections
from lifecycle.node.endpoints.making import CLIENTS
from lifecycle.node.endpoints.mapping import Key, Mapping, MatchWatch, Placement

if TYPE_CHECKING:
    from rclpy.node import Node

    from lifecycle.node.connections.connection_status import ConnectionStatus
    from lifecycle.node.endpoints.endpoint_table import EndpointTable
    from lifecycle.node.endpoints.making import Maker
    from lifecycle.node.lifecycle.services import Turns

SETTLE_S = 0.25
"""The old one lives on after the new one has matched as many peers as it had."""

PATIENCE_S = 4.0
"""Both live at most so long, if the new one never matches as many.

A participant that others have not noticed at once is announced again after 3 s.
"""

_ACKNOWLEDGED = Duration(seconds=0.1)
"""How long a reliable publisher that is handed over is waited for; on one network a millisecond."""

After = Callable[[float, Callable[[], None]], Callable[[], None]]
"""Calls back once, so many seconds later, in the executor; returns what calls that off."""


@typing.final
class Handover:
    """The time in which an endpoint is on two connections.

    Args:
        peers_before: how many peers the old one had.
        after: the timer.
        finish: destroys the old one; called exactly once.
    """

    def __init__(self, *, peers_before: int, after: After, finish: Callable[[], None]) -> None:
        self.done: Future = Future()
        self._peers_before = peers_before
        self._after = after
        self._finish = finish
        self._settles = False
        self._call_off = after(PATIENCE_S, self.end)

    def peers_changed(self, peers: int) -> None:
        """The new one has so many peers now."""
        if peers >= self._peers_before and not self._settles and not self.done.done():
            self._settles = True
            self._call_off()
            self._call_off = self._after(SETTLE_S, self.end)

    def end(self) -> None:
        """Break now; again is harmless."""
        if self.done.done():
            return
        self._call_off()
        self.done.set_result(None)
        self._finish()


class Mapper:
    """Maps the endpoints of one node.

    Args:
        node: whose endpoints they are.
        maker: makes and destroys their rclpy objects.
        table: every declared endpoint, as it is at any time.
        connections: of the node.
        status: notified of each change.
        turns: of the node's executor.
    """

    def __init__(
        self,
        node: Node,
        maker: Maker,
        table: EndpointTable,
        *,
        connections: Connections,
        status: ConnectionStatus,
        turns: Turns,
    ) -> None:
        self._node = node
        self._maker = maker
        self._table = table
        self._connections = connections
        self._status = status
        self._turns = turns
        self._handovers: dict[Key, tuple[Handover, Placement]] = {}

    @property
    def _placements(self) -> tuple[Placement, ...]:
        placements = [each.placement for each in self._table.mappings.values()]
        placements += [old for _, old in self._handovers.values()]
        return tuple(each for each in placements if each is not None)

    @property
    def entities(self) -> tuple[Any, ...]:
        """Every rclpy object of a declared endpoint."""
        return tuple(each.entity for each in self._placements)

    def map(self, mapping: Mapping, connection: Connection) -> None:
        """Map an endpoint that is mapped nowhere; raises LifecycleError."""
        mapping.placement = self._place(mapping, connection)
        if mapping.handle is not None:
            mapping.handle.attach(mapping.entity)
        self._status.mapped(mapping)
        self._table.changed()

    def unmap(self, mapping: Mapping) -> None:
        """Take an endpoint off where it is; harmless if it is nowhere."""
        self._end_handover(mapping)
        placement = mapping.placement
        if placement is None:
            return
        if mapping.handle is not None:
            mapping.handle.detach()
        mapping.placement = mapping.peers = None
        self._unplace(mapping, placement)

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
                mapping.placement = self._place(mapping, old.connection)
            except BaseException:
                mapping.name = before
                raise
            self._take_over(mapping, old)
            self._status.mapped(mapping)
        self._table.changed()

    def tidy(self) -> None:
        """Unmake participants of single flows that carry nothing any more."""
        used = [each.connection for each in self._placements]
        for connection in self._connections.unnamed:
            if connection not in used:
                self._connections.close(connection)

    def _place(self, mapping: Mapping, connection: Connection) -> Placement:
        """Make an endpoint on a connection; where it is now is left alone."""
        self._refuse_shared_flow(mapping, connection)
        entity = self._maker.make(mapping, connection)
        return Placement(
            connection=connection, entity=entity, watch=self._watch(mapping, connection, entity)
        )

    def _unplace(self, mapping: Mapping, placement: Placement) -> None:
        if placement.watch is not None:
            placement.watch.stop()
        self._maker.unmake(mapping.endpoint, placement.entity, placement.connection)
        self._status.unmapped(mapping, placement.connection)

    def _watch(
        self, mapping: Mapping, connection: Connection, entity: Any
    ) -> MatchWatch | ServerWatch | None:
        kind = mapping.endpoint.kind
        if kind.is_topic:
            return MatchWatch(
                self._node, entity, self._turns.group, lambda _: self._matched(mapping)
            )
        if kind not in CLIENTS:
            return None

        hidden = connection.participant
        node = self._node if hidden is None else hidden.node
        return ServerWatch(node, entity, self._table.changed)  # their peers are not counted

    def _matched(self, mapping: Mapping) -> None:
        """Some entity of a mapping has been matched or unmatched."""
        self._status.matched(mapping)
        running = self._handovers.get(mapping.key)
        if running is not None:
            running[0].peers_changed(mapping.peers or 0)
        self._table.changed()  # as many peers as before may be others

    def _end_handover(self, mapping: Mapping) -> None:
        running = self._handovers.get(mapping.key)
        if running is not None:
            running[0].end()

    def _hand_over(self, mapping: Mapping, old: Placement, connection: Connection) -> Future:
        """Make an endpoint anew, live on both sides for a while, then destroy the old one."""
        peers = mapping.peers
        mapping.placement = self._place(mapping, connection)
        mapping.error = ""

        def finish() -> None:
            del self._handovers[mapping.key]
            self._take_over(mapping, old)
            self.tidy()
            self._table.changed()

        # Two servers would both answer; and a client's answers may still be under way.
        kind = mapping.endpoint.kind
        lives_on = bool(peers) if kind.is_topic else kind in CLIENTS
        handover = Handover(peers_before=peers or 1, after=self._turns.call_after, finish=finish)
        self._handovers[mapping.key] = (handover, old)
        self._status.mapped(mapping)
        if not lives_on or self._node.executor is None:
            handover.end()
        else:
            handover.peers_changed(mapping.peers or 0)
        return handover.done

    def _take_over(self, mapping: Mapping, old: Placement) -> None:
        """Let the new one do what the old one did until now, which is destroyed."""
        if mapping.handle is not None:
            qos = mapping.endpoint.qos
            if qos is None or qos.reliability.name != "BEST_EFFORT":
                old.entity.wait_for_all_acked(_ACKNOWLEDGED)
            mapping.handle.attach(mapping.entity)
        self._unplace(mapping, old)

    def _refuse_shared_flow(self, mapping: Mapping, connection: Connection) -> None:
        """Keep a strictly unique publisher alone: a participant's publishers share its sockets.

        On the node's own participant the RMW refuses such a publisher itself.
        """
        publisher, strict = EndpointKind.PUBLISHER, UniqueRequirement.STRICTLY_REQUIRED
        if connection.participant is None or mapping.endpoint.kind is not publisher:
            return
        for other in self._table.mappings.values():
            if other is mapping or other.endpoint.kind is not publisher:
                continue
            if other.connection is not connection:
                continue
            for one, two in ((mapping, other), (other, mapping)):
                if one.endpoint.unique is strict:
                    raise ConnectError(
                        f"publisher {one.endpoint.name!r} must have a network flow for itself "
                        f"(strictly_required), and would share it with publisher "
                        f"{two.endpoint.name!r}",
                        hint="give each a connection of its own",
                    )


def _done() -> Future:
    future: Future = Future()
    future.set_result(None)
    return future
