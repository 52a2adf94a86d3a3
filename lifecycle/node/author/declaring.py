"""The interface of a node without a manifest, built from its `declare_…` calls.

Owns: turning `declare_publisher("count", Int32, 10)` into the same PlannedEndpoint that a manifest
gives, so that everything after it is one path; when that is allowed; and what only code can say of
an endpoint: its handler and hints.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from msgspec.structs import replace
from rclpy.node import Node
from rclpy.qos import QoSProfile

from lifecycle.errors import LifecycleError
from lifecycle.manifest.model import EndpointKind, EndpointPolicy
from lifecycle.manifest.qos import QosProfile
from lifecycle.middleware.rcl.qos import from_rclpy
from lifecycle.node.author.handlers import Handlers, match, needs_handler
from lifecycle.node.endpoints.data_layer import CONFIGURED, DataLayer
from lifecycle.node.endpoints.endpoint import EndpointOptions, Key, find_endpoint
from lifecycle.node.lifecycle.machine import NodeState
from lifecycle.plan.model import PlannedEndpoint, PlannedNode

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


class DeclaredInCode:
    """What one node's manifest or plan and its own code declare, taken together.

    Args:
        node: whose code it is.
        spec: what the node was planned to be.
        data_layer: has the endpoints from configure on.
        state: of the node, now.

    Attributes:
        spec: with the endpoints that code declared before configure.
    """

    def __init__(
        self,
        node: Node,
        spec: PlannedNode,
        data_layer: DataLayer,
        state: Callable[[], NodeState],
    ) -> None:
        self.spec = spec
        self._node = node
        self._name = str(node.get_fully_qualified_name())
        self._data_layer = data_layer
        self._state = state
        self._callbacks: dict[Key, Callable[..., Any]] = {}
        self._hints: dict[Key, tuple[bool | None, int | None]] = {}
        self._options: dict[Key, EndpointOptions] = {}

    def declare(
        self,
        endpoint: PlannedEndpoint,
        *,
        callback: Callable[..., Any] | None,
        hints: tuple[bool | None, int | None],
    ) -> None:
        """Have one more endpoint, made at once where the others are.

        What a manifest says of the same name is kept. The same line may declare the same again:
        on_activate runs more than once.

        Args:
            endpoint: with the place where it is declared.
            callback: its handler, beside the decorated methods.
            hints: lossy and size in bytes.

        Raises:
            LifecycleError: not in this state, the manifest fixes the endpoints at configure, it is
                declared already, it needs a handler, or it cannot be made.
        """
        self._refuse(endpoint)
        key, is_new = (endpoint.kind, endpoint.name), self._is_new(endpoint)
        if self._state() is NodeState.UNCONFIGURED:
            if is_new:
                self.spec = replace(self.spec, endpoints=(*self.spec.endpoints, endpoint))
            if callback is not None:
                self._callbacks[key] = callback
            self._hints[key] = hints
            return
        if is_new:
            if callback is None and needs_handler(endpoint.kind):
                raise LifecycleError(
                    f"cannot serve {endpoint.kind.noun} {endpoint.name!r} of {self._name} that is "
                    "declared after configure: it has no handler",
                    hint=f"give one, {_METHODS[endpoint.kind]}({endpoint.name!r}, …, callback=…)",
                )
            self._data_layer.add_now(endpoint, callback)
        self._data_layer.hint(key, *hints)

    def _refuse(self, endpoint: PlannedEndpoint) -> None:
        state = self._state()
        if state is NodeState.UNCONFIGURED:
            return
        what = (
            f"cannot declare {endpoint.kind.noun} {endpoint.name!r} while {self._name} is "
            f"{state.value!r}"
        )
        if state not in CONFIGURED:
            raise LifecycleError(
                what, hint="declare endpoints in __init__, or from on_configure until cleanup"
            )
        if self.spec.endpoint_policy is EndpointPolicy.DECLARED:
            raise LifecycleError(
                f"{what}: nodes.{self.spec.key}.endpoints is 'declared' in its manifest, which "
                "fixes them at configure",
                hint=f"write nodes.{self.spec.key}.endpoints: open, or declare it in the manifest",
            )

    def _is_new(self, endpoint: PlannedEndpoint) -> bool:
        at = endpoint.at
        later = (each.planned for each in self._data_layer.endpoints.values())
        for each in (*self.spec.endpoints, *later):
            if (each.kind, each.name) != (endpoint.kind, endpoint.name):
                continue
            again = (each.at.file, each.at.line) == (at.file, at.line)
            if each.type == endpoint.type and (each.at.path or again):
                return False
            raise LifecycleError(
                f"{at.file}:{at.line}: cannot declare {endpoint.name!r} in {endpoint.kind.value} "
                f"as {endpoint.type}: {each.at.file}:{each.at.line} declares it as {each.type} "
                "already"
            )
        return True

    def hint(self, spelling: str, *, lossy: bool | None, size_bytes: int | None) -> None:
        """Keep a hint for negotiation; raises UnknownEndpointError."""
        if self._state() is NodeState.UNCONFIGURED:
            self._hints[self._find(spelling)] = (lossy, size_bytes)
        else:
            self._data_layer.hint(self._data_layer.find(spelling).key, lossy, size_bytes)

    def set_options(self, spelling: str, options: EndpointOptions) -> None:
        """Keep how an endpoint is to be made.

        Raises:
            UnknownEndpointError: nothing, or more than one thing, is declared so.
            LifecycleError: it exists already, or its kind cannot have them.
        """
        if self._state() is NodeState.UNCONFIGURED:
            key = self._find(spelling)
            options.refuse_unfit(key[0])
            self._options[key] = options
            return
        endpoint = self._data_layer.find(spelling)
        options.refuse_unfit(endpoint.kind)
        if endpoint.placement is not None:
            raise LifecycleError(
                f"cannot set options of {endpoint.spelling} of {self._name}: it exists already",
                hint="call set_options in __init__ or in on_configure",
            )
        endpoint.options = options

    def _find(self, spelling: str) -> Key:
        declared = [(each.kind, each.name) for each in self.spec.endpoints]
        return find_endpoint(spelling, declared, node=self._name)

    def match(self) -> Handlers:
        """Return the decorated methods of the node's class for the endpoints that need one.

        Raises:
            LifecycleError: an endpoint has no handler, or a handler no endpoint.
        """
        given = self._callbacks
        endpoints = [e for e in self.spec.endpoints if (e.kind, e.name) not in given]
        return match(type(self._node), endpoints, node=self._name)

    def enact(self, matched: Handlers) -> None:
        """Declare all of it in the data layer; raises LifecycleError."""

        def handler(endpoint: PlannedEndpoint) -> Callable[..., Any] | None:
            given = self._callbacks.get((endpoint.kind, endpoint.name))
            if given is not None or not needs_handler(endpoint.kind):
                return given
            return matched.bound(self._node, endpoint)

        self._data_layer.declare(self.spec, handler)
        for key, hints in self._hints.items():
            self._data_layer.hint(key, *hints)
        for key, options in self._options.items():
            self._data_layer.endpoints[key].options = options
