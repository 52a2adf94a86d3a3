"""The interface of a node without a manifest, built from its `declare_…` calls.

Owns: turning `declare_publisher("count", Int32, 10)` into the same PlannedEndpoint that a manifest
gives, so that everything after it is one path; when that is allowed; and what only code can say of
an endpoint: its handler and hints.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile

from lifecycle import dataclasses
from lifecycle.errors import LifecycleError
from lifecycle.manifest import EndpointKind, EndpointPolicy, Position, QosProfile
from lifecycle.middleware import from_rclpy
from lifecycle.node.author.handlers import Handlers, match, needs_handler
from lifecycle.node.connections.data_layer import CONFIGURED, NodeDataLayer
from lifecycle.node.endpoints.mapping import EndpointOptions, Key, find_endpoint
from lifecycle.node.lifecycle.machine import NodeState
from lifecycle.plan import PlannedEndpoint, PlannedNode

_METHODS = {
    EndpointKind.SUBSCRIPTION: "declare_subscription",
    EndpointKind.SERVICE_SERVER: "declare_service",
    EndpointKind.ACTION_SERVER: "declare_action",
}
"""Those that take a handler."""


def interface_name(interface: type[Any]) -> str:
    """Return `package/msg/Type` of a generated class.

    Raises:
        LifecycleError: not a generated message, service or action class.
    """
    package, _, rest = interface.__module__.partition(".")
    kind = rest.partition(".")[0]
    if kind not in {"msg", "srv", "action"}:
        raise LifecycleError(
            f"cannot declare an endpoint of type {interface!r}; "
            "give a message, service or action class such as std_msgs.msg.String"
        )
    return f"{package}/{kind}/{interface.__name__}"


def profile(qos: QosProfile | QoSProfile | int) -> QosProfile:
    """Return our profile for what rclpy's factories take; a number is a history depth."""
    if isinstance(qos, QosProfile):
        return qos
    return QosProfile(depth=qos) if isinstance(qos, int) else from_rclpy(qos)


def add(
    spec: PlannedNode,
    *,
    kind: EndpointKind,
    name: str,
    interface: type[Any],
    resolved: str,
    qos: QosProfile | None,
    at: Position,
) -> PlannedNode:
    """Return `spec` with one more endpoint; what a manifest says of the same name is kept.

    The same line may declare the same again: on_activate runs more than once.

    Raises:
        LifecycleError: the name is declared already, in code, or in the manifest as another type.
    """
    type_ = interface_name(interface)
    for endpoint in spec.endpoints:
        if endpoint.kind is not kind or endpoint.name != name:
            continue
        again = (endpoint.at.file, endpoint.at.line) == (at.file, at.line)
        if endpoint.type == type_ and (endpoint.at.path or again):
            return spec
        there = f"{endpoint.at.file}:{endpoint.at.line}"
        raise LifecycleError(
            f"{at.file}:{at.line}: cannot declare {name!r} in {kind.value} as {type_}: {there} "
            f"declares it as {endpoint.type} already"
        )
    endpoint = PlannedEndpoint(kind=kind, name=name, resolved=resolved, type=type_, qos=qos, at=at)
    return dataclasses.replace(spec, endpoints=(*spec.endpoints, endpoint))


class DeclaredInCode:
    """What one node's manifest or plan and its own code declare, taken together.

    Args:
        spec: what the node was planned to be.
        data_layer: has the endpoints from configure on.
        node: fully qualified name, for messages.
        state: of the node, now.

    Attributes:
        spec: with the endpoints that code declared before configure.
    """

    def __init__(
        self,
        spec: PlannedNode,
        data_layer: NodeDataLayer,
        *,
        node: str,
        state: Callable[[], NodeState],
    ) -> None:
        self.spec = spec
        self._data_layer = data_layer
        self._node = node
        self._state = state
        self._callbacks: dict[Key, Callable[..., Any]] = {}
        self._hints: dict[Key, tuple[bool | None, int | None]] = {}
        self._options: dict[Key, EndpointOptions] = {}

    def refuse(self, kind: EndpointKind, name: str) -> None:
        """Raise unless one more endpoint may be declared now.

        Raises:
            LifecycleError: not in this state, or the manifest fixes the endpoints at configure.
        """
        if self._state() is NodeState.UNCONFIGURED:
            return
        what = f"cannot declare {kind.noun} {name!r} while {self._node} is"
        if self._state() not in CONFIGURED:
            raise LifecycleError(
                f"{what} {self._state().value!r}",
                hint="declare endpoints in __init__, or from on_configure until cleanup",
            )
        if self.spec.endpoint_policy is EndpointPolicy.DECLARED:
            raise LifecycleError(
                f"{what} {self._state().value!r}: nodes.{self.spec.key}.endpoints is 'declared' in "
                "its manifest, which fixes them at configure",
                hint=f"write nodes.{self.spec.key}.endpoints: open, or declare it in the manifest",
            )

    def declare(
        self,
        spec: PlannedNode,
        key: Key,
        *,
        callback: Callable[..., Any] | None,
        hints: tuple[bool | None, int | None],
    ) -> None:
        """Have one more endpoint, made at once where the others are.

        Args:
            spec: the present one with the endpoint added, or as it is if the manifest has it.
            key: of the endpoint.
            callback: its handler, beside the decorated methods.
            hints: lossy and size in bytes.

        Raises:
            LifecycleError: it needs a handler, or cannot be made.
        """
        if self._state() is NodeState.UNCONFIGURED:
            self.spec = spec
            if callback is not None:
                self._callbacks[key] = callback
            self._hints[key] = hints
            return
        (endpoint,) = (each for each in spec.endpoints if (each.kind, each.name) == key)
        if key in self._data_layer.endpoints.mappings:
            # The manifest has it, or it was said before.
            self._data_layer.endpoints.hint(key, *hints)
            return
        if callback is None and needs_handler(endpoint.kind):
            raise LifecycleError(
                f"cannot serve {endpoint.kind.noun} {endpoint.name!r} of {self._node} that is "
                "declared after configure: it has no handler",
                hint=f"give one, {_METHODS[endpoint.kind]}({endpoint.name!r}, …, callback=…)",
            )
        self._data_layer.add_now(endpoint, callback)
        self._data_layer.endpoints.hint(key, *hints)

    def hint(self, spelling: str, *, lossy: bool | None, size_bytes: int | None) -> None:
        """Keep a hint for negotiation; raises UnknownEndpointError."""
        if self._state() is NodeState.UNCONFIGURED:
            declared = [(each.kind, each.name) for each in self.spec.endpoints]
            self._hints[find_endpoint(spelling, declared, node=self._node)] = (lossy, size_bytes)
        else:
            self._data_layer.endpoints.hint(
                self._data_layer.endpoints.find(spelling).key, lossy, size_bytes
            )

    def set_options(self, spelling: str, options: EndpointOptions) -> None:
        """Keep how an endpoint is to be made.

        Raises:
            UnknownEndpointError: nothing, or more than one thing, is declared so.
            LifecycleError: it exists already, or its kind cannot have them.
        """
        if self._state() is NodeState.UNCONFIGURED:
            declared = [(each.kind, each.name) for each in self.spec.endpoints]
            key = find_endpoint(spelling, declared, node=self._node)
            options.refuse_unfit(key[0])
            self._options[key] = options
            return
        mapping = self._data_layer.endpoints.find(spelling)
        options.refuse_unfit(mapping.endpoint.kind)
        if mapping.placement is not None:
            raise LifecycleError(
                f"cannot set options of {mapping.spelling} of {self._node}: it exists already",
                hint="call set_options in __init__ or in on_configure",
            )
        mapping.options = options

    @property
    def now(self) -> PlannedNode:
        """The plan with those endpoints that were declared since configure."""
        known = {(each.kind, each.name) for each in self.spec.endpoints}
        later = tuple(each.endpoint for each in self._data_layer.mappings if each.key not in known)
        return dataclasses.replace(self.spec, endpoints=(*self.spec.endpoints, *later))

    def match(self, node_class: type) -> Handlers:
        """Return the decorated methods of a class for the endpoints that need one.

        Raises:
            LifecycleError: an endpoint has no handler, or a handler no endpoint.
        """
        given = self._callbacks
        endpoints = [e for e in self.spec.endpoints if (e.kind, e.name) not in given]
        return match(node_class, endpoints, node=self._node)

    def enact(self, node: Node, matched: Handlers) -> None:
        """Declare all of it in the data layer; raises LifecycleError."""
        self._data_layer.declare(self.spec, lambda each: self._handler(node, each, matched))
        for key, hints in self._hints.items():
            self._data_layer.endpoints.hint(key, *hints)
        for key, options in self._options.items():
            self._data_layer.endpoints.mappings[key].options = options

    def _handler(
        self, node: Node, endpoint: PlannedEndpoint, matched: Handlers
    ) -> Callable[..., Any] | None:
        given = self._callbacks.get((endpoint.kind, endpoint.name))
        if given is not None or not needs_handler(endpoint.kind):
            return given
        return matched.bound(node, endpoint)
