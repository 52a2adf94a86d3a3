"""The declared endpoints of one node, by kind and name.

Owns: what is declared, the handles that authors publish by, and finding an endpoint by the name it
is requested with. Where an endpoint is mapped is not its business.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rclpy.node import Node

from lifecycle.errors import LifecycleError
from lifecycle.manifest.model import EndpointKind
from lifecycle.middleware.rcl.qos import import_interface
from lifecycle.node.author.handlers import alternatives
from lifecycle.node.endpoints.mapping import Key, Mapping, UnknownEndpointError, find_endpoint
from lifecycle.node.endpoints.publisher import DeclaredPublisher, Kept
from lifecycle.plan.model import PlannedEndpoint

if TYPE_CHECKING:
    from lifecycle.node.lifecycle.gate import NodeGate


class EndpointTable:
    """What one node declares.

    Args:
        node: whose endpoints these are.
        gate: holds back its publishers.
        changed: called when the node configuration has changed.

    Attributes:
        changed: called when the node configuration has changed.
        mappings: every declared endpoint, in the order of declaration.
    """

    def __init__(self, node: Node, gate: NodeGate, changed: Callable[[], None]) -> None:
        self._node = node
        self._name = node.get_fully_qualified_name()
        self._gate = gate
        self.changed = changed
        self.mappings: dict[Key, Mapping] = {}

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
            mapping.handle = DeclaredPublisher(endpoint.name, warn, Kept.of(endpoint.qos))
            self._gate.add(mapping.handle, mapping.handle)
        self.changed()
        return mapping

    def remove(self, mapping: Mapping) -> None:
        """Forget one endpoint, which is mapped nowhere."""
        del self.mappings[mapping.key]
        if mapping.handle is not None:
            self._gate.remove(mapping.handle)

    def hint(self, key: Key, lossy: bool | None, size_bytes: int | None) -> None:
        """Keep the author's hints on an endpoint; None leaves what was said before."""
        mapping = self.mappings[key]
        mapping.lossy = mapping.lossy if lossy is None else lossy
        mapping.size_bytes = mapping.size_bytes if size_bytes is None else size_bytes
        self.changed()

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
        handle = self._declared(EndpointKind.PUBLISHER, name).handle
        assert handle is not None
        return handle

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
