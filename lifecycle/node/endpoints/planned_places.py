"""Where the plan wants the endpoints of a node.

Owns: which connection a planned endpoint belongs on, and mapping all of them there, or none.
"""

from __future__ import annotations

from collections.abc import Mapping as AbstractMapping

from lifecycle.manifest.model import Authority
from lifecycle.node.connections.connection_status import Standing
from lifecycle.node.connections.connections import ConnectError, Connection, Connections
from lifecycle.node.endpoints.endpoint_names import Key
from lifecycle.node.endpoints.mapper import Mapper
from lifecycle.node.endpoints.mapping import Mapping
from lifecycle.plan.model import PlannedEndpoint, PlannedNode, PlannedParticipant


class PlannedPlaces:
    """The places of one node's endpoints.

    Args:
        node: fully qualified name, for messages.
        mappings: every declared endpoint, as it is at any time.
        connections: of the node.
        mapper: maps single endpoints.
        standing: is told of connections.

    Attributes:
        spec: what the node was planned to be; None before anything is declared.
    """

    def __init__(
        self,
        node: str,
        *,
        mappings: AbstractMapping[Key, Mapping],
        connections: Connections,
        mapper: Mapper,
        standing: Standing,
    ) -> None:
        self._name = node
        self._mappings = mappings
        self._connections = connections
        self._mapper = mapper
        self._standing = standing
        self.spec: PlannedNode | None = None

    @property
    def mapped_by_others(self) -> bool:
        """Whether a supervisor says where endpoints are."""
        return self.spec is not None and self.spec.authority is Authority.SUPERVISOR

    def planned(self, connection: str) -> PlannedParticipant | None:
        """Return what is planned for a connection of that name; None for the empty one."""
        if self.spec is None or not connection:
            return None
        return next((p for p in self.spec.participants if p.connection == connection), None)

    def map_all(self, spec: PlannedNode) -> None:
        """Map every endpoint that is mapped nowhere onto what the plan says, or none.

        Raises:
            ConnectError: the first endpoint that could not be made, with the RMW's reason.
        """
        before = {mapping.key for mapping in self._mappings.values() if mapping.placement}
        names_before = {each.name for each in self._connections.named}
        current: Mapping | None = None
        try:
            for planned in spec.participants:
                if planned.connection:
                    self._standing.opened(self._connections.carrier(planned))
            for current in self._mappings.values():
                if current.placement is None:
                    self._mapper.map(current, self.default(current.endpoint))
        except Exception as error:
            for each in reversed(tuple(self._mappings.values())):
                if each.placement is not None and each.key not in before:
                    self._mapper.unmap(each)
            for connection in self._connections.named:
                if connection.name not in names_before:
                    self._mapper.close(connection)
            if current is None:
                raise ConnectError(str(error)) from error
            endpoint = current.endpoint
            current.error = str(error)
            raise ConnectError(
                f"cannot connect {endpoint.kind.noun} {endpoint.name!r} of {spec.full_name}: "
                f"{error}"
            ) from error

    def default(self, endpoint: PlannedEndpoint) -> Connection:
        """Return the connection that the plan says; make its participant at first use."""
        if not endpoint.participant or self.spec is None:
            return self._connections.own
        for planned in self.spec.participants:
            if planned.name == endpoint.participant:
                connection = self._connections.carrier(planned)
                if connection.warning and endpoint.enforce_dscp:
                    self._mappings[endpoint.kind, endpoint.name].error = connection.warning
                return connection
        raise ConnectError(
            f"cannot find participant {endpoint.participant!r} in the plan of {self._name}"
        )

    def own_flow(self, endpoint: PlannedEndpoint) -> Connection | None:
        """Return the participant that gives a publisher its own flow; None if it needs none."""
        named = {
            each.name for each in (self.spec.participants if self.spec else ()) if each.connection
        }
        if not endpoint.participant or endpoint.participant in named:
            return None
        return self.default(endpoint)

    def refuse_unmapped(self) -> None:
        """Raise ConnectError if anything is mapped nowhere."""
        missing = [each.spelling for each in self._mappings.values() if each.placement is None]
        if missing:
            names = [repr(each.name) for each in self._connections.named]
            raise ConnectError(
                f"cannot connect {self._name}: nobody has mapped "
                f"{', '.join(map(repr, missing))}; its authority is the supervisor, which "
                f"connected it to {', '.join(names) or 'nothing'}",
                hint=f"call {self._name}/map_to for each, or write data_layer.authority: nodes",
            )
