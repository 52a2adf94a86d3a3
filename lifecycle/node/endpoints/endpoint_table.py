"""The declared endpoints of one node, by kind and name, and where the plan maps them.

Owns: what is declared, the handles that authors publish by, and finding an endpoint by the name it
is requested with; which connection a planned endpoint belongs on, and mapping all of them there, or
none. Where an endpoint is mapped now is not its business.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Mapping as AbstractMapping
from typing import TYPE_CHECKING, Any

from rclpy.node import Node

from lifecycle.errors import LifecycleError
from lifecycle.manifest import Authority, EndpointKind
from lifecycle.middleware import import_interface
from lifecycle.node.author.handlers import alternatives
from lifecycle.node.connections.connection_status import ConnectionStatus
from lifecycle.node.connections.connections import ConnectError, Connection, Connections
from lifecycle.node.endpoints.mapper import Mapper
from lifecycle.node.endpoints.mapping import Key, Mapping, UnknownEndpointError, find_endpoint
from lifecycle.node.endpoints.publisher import DeclaredPublisher, Kept
from lifecycle.plan import PlannedEndpoint, PlannedNode, PlannedParticipant

if TYPE_CHECKING:
    from lifecycle.node.lifecycle.gate import NodeGate


class EndpointTable:
    """What one node declares.

    Args:
        node: whose endpoints these are.
        gate: holds back its publishers.
        changed: called when the node configuration has changed.

    Attributes:
        mappings: every declared endpoint, in the order of declaration.
        handles: of its publishers, by name.
    """

    def __init__(self, node: Node, gate: NodeGate, changed: Callable[[], None]) -> None:
        self._node = node
        self._name = node.get_fully_qualified_name()
        self._gate = gate
        self._changed = changed
        self.mappings: dict[Key, Mapping] = {}
        self.handles: dict[str, DeclaredPublisher] = {}

    def add(self, endpoint: PlannedEndpoint, handler: Callable[..., Any] | None) -> Mapping:
        """Declare one more endpoint; it does not exist yet.

        Raises:
            LifecycleError: declared already, or its type is not installed.
        """
        key = (endpoint.kind, endpoint.name)
        if key in self.mappings:
            raise LifecycleError(f"cannot declare {endpoint.kind.noun} {endpoint.name!r} twice")
        try:
            interface = import_interface(endpoint.type)
        except LifecycleError as error:
            noun = endpoint.kind.noun
            raise LifecycleError(f"{noun} {endpoint.name!r}: {error}") from error
        mapping = Mapping(endpoint=endpoint, interface=interface, handler=handler)
        self.mappings[key] = mapping
        if endpoint.kind is EndpointKind.PUBLISHER:
            warn = self._node.get_logger().warning
            handle = DeclaredPublisher(endpoint.name, warn, Kept.of(endpoint.qos))
            self.handles[endpoint.name] = handle
            self._gate.add(handle, handle)
        self._changed()
        return mapping

    def remove(self, mapping: Mapping) -> None:
        """Forget one endpoint, which is mapped nowhere."""
        del self.mappings[mapping.key]
        if mapping.endpoint.kind is EndpointKind.PUBLISHER:
            self._gate.remove(self.handles.pop(mapping.endpoint.name))

    def hint(self, key: Key, lossy: bool | None, size_bytes: int | None) -> None:
        """Keep the author's hints on an endpoint; None leaves what was said before."""
        mapping = self.mappings[key]
        mapping.lossy = mapping.lossy if lossy is None else lossy
        mapping.size_bytes = mapping.size_bytes if size_bytes is None else size_bytes
        self._changed()

    def find(self, spelling: str) -> Mapping:
        """Return the mapping of `video`, `publishers/video`, or `publishers//robot/video` in full.

        Raises:
            UnknownEndpointError: none, or more than one, is called so.
        """
        on_wire = {
            each.endpoint.kind.spell(each.wire_name): each.key for each in self.mappings.values()
        }
        if spelling in on_wire and spelling not in {m.spelling for m in self.mappings.values()}:
            return self.mappings[on_wire[spelling]]
        return self.mappings[find_endpoint(spelling, self.mappings, node=self._name)]

    def publisher(self, name: str) -> DeclaredPublisher:
        """Return the handle of a declared publisher.

        Raises:
            UnknownEndpointError: no such declaration.
        """
        self._declared(EndpointKind.PUBLISHER, name)
        return self.handles[name]

    def client(self, kind: EndpointKind, name: str) -> Any:
        """Return the rclpy object of a declared endpoint that has no handle, as clients have none.

        Raises:
            UnknownEndpointError: no such declaration.
            LifecycleError: the node is not connected.
        """
        mapping = self._declared(kind, name)
        if mapping.entity is None:
            raise LifecycleError(
                f"cannot use {kind.noun} {name!r}: {self._name} is not connected; "
                "endpoints exist from connect until disconnect"
            )
        return mapping.entity

    def _declared(self, kind: EndpointKind, name: str) -> Mapping:
        mapping = self.mappings.get((kind, name))
        if mapping is not None:
            return mapping
        if not self.mappings:
            hint = "endpoints are declared at configure; ask for it in on_configure or later"
        else:
            hint = alternatives(name, [n for k, n in self.mappings if k is kind])
        raise UnknownEndpointError(f"cannot find {kind.noun} {name!r} of {self._name}", hint=hint)


class PlannedPlaces:
    """The places of one node's endpoints.

    Args:
        node: fully qualified name, for messages.
        mappings: every declared endpoint, as it is at any time.
        connections: of the node.
        mapper: maps single endpoints.
        status: notified of connections.

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
        status: ConnectionStatus,
    ) -> None:
        self._name = node
        self._mappings = mappings
        self._connections = connections
        self._mapper = mapper
        self._status = status
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
                    self._status.opened(self._connections.carrier(planned))
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
