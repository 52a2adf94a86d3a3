"""Hidden nodes: a DDS participant with nothing on it but what was requested.

Owns: how such a node and its context are made, and which of them this process has; showing an
endpoint that was made there to the node that it serves, whose executor and callback groups run it.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import typing
import weakref
from collections.abc import Iterable, Iterator
from typing import Any

import rclpy
from rclpy.client import Client
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.waitable import Waitable

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.factory import discovery_by_profile, participant_settings
from lifecycle.middleware.fastdds.profiles import ParticipantSettings
from lifecycle.middleware.fastdds.sockets import widen_discovery_buffers
from lifecycle.middleware.versions import installed, private

_QUIET: dict[str, Any] = {
    "enable_rosout": False,
    "start_parameter_services": False,
    "parameter_overrides": [Parameter("start_type_description_service", value=False)],
}
"""Arguments of a node that has nothing but parameter events."""

_hidden: weakref.WeakSet[Node] = weakref.WeakSet()


def quiet_node(
    name: str, namespace: str, domain_id: int, *, settings: ParticipantSettings | None = None
) -> tuple[rclpy.Context, Node]:
    """Return a new context and on it a node with nothing of its own but parameter events.

    Raises:
        MiddlewareError: rcl refused; nothing is left.
    """
    settings = settings or ParticipantSettings()
    static_name = settings.connections.static_name
    enclave = ("--ros-args", "--enclave", static_name) if static_name else ()
    context = rclpy.Context()
    node: Node | None = None
    try:
        with discovery_by_profile(settings):
            context.init(args=[*enclave], domain_id=domain_id, initialize_logging=False)
        with participant_settings(context, settings):
            node = Node(name, namespace=namespace, context=context, **_QUIET)
    except Exception as error:
        if node is not None:
            node.destroy_node()
        context.try_shutdown()
        context.destroy()
        known = error if isinstance(error, MiddlewareError) else None
        raise MiddlewareError(
            f"cannot make a participant for {namespace.rstrip('/')}/{name} in domain {domain_id}: "
            + (known.message if known else " ".join(str(error).split())),
            hint=known.hint if known else _security_hint(),
        ) from error
    _hidden.add(node)
    return context, node


def bare_node(context: rclpy.Context) -> Any:
    """Return rclpy's handle of a hidden node without endpoints; the first makes a participant."""
    name = f"_lifecycle_names_{os.getpid()}_{next(_numbers)}"
    more = (QoSProfile(depth=1).get_c_qos_profile(),) if installed().node_takes_rosout else ()
    try:
        with context.handle:
            return _rclpy.Node(name, "", context.handle, None, False, False, *more)
    except TypeError:  # of another rclpy: with what a public node has
        return Node(name, context=context, use_global_arguments=False, **_QUIET).handle


_numbers = itertools.count()


def republish_names(nodes: Iterable[Node]) -> None:
    """Make the participants of `nodes`, one of each, publish their nodes and endpoints anew.

    After an outage rmw_dds_common keeps the name of a node whose participant was dropped, and found
    again, out of the graph until then. rmw_fastrtps publishes it whenever a node is made. It has no
    endpoints: when one ends, a discovery server of Fast DDS 2.14 drops for good what it has not
    relayed yet of that participant's others.
    """
    for node in nodes:
        bare_node(node.context).destroy_when_not_in_use()


@contextlib.contextmanager
def made_participant(context: rclpy.Context, settings: ParticipantSettings) -> Iterator[None]:
    """Make the participant of a context with these settings; construct its first node in the block.

    Settings have no effect where it has a participant already. Raises as `participant_settings`.
    """
    with participant_settings(context, settings):
        first = bare_node(context)
    try:
        widen_discovery_buffers(context.get_domain_id())
        yield
    finally:
        first.destroy_when_not_in_use()


def _security_hint() -> str:
    """Return where to look if ROS 2 security is on: rcl's reason may be `error not set`."""
    if os.environ.get("ROS_SECURITY_ENABLE") != "true":
        return ""
    return (
        "ROS_SECURITY_ENABLE is set: look at ROS_SECURITY_KEYSTORE and the enclave, and whether "
        "the installed RMW has security at all (docs/security.md), or unset it"
    )


def hidden_nodes() -> tuple[Node, ...]:
    """Return the hidden nodes of this process, each on a participant of its own."""
    return tuple(node for node in _hidden if node.context.ok())


Action: typing.TypeAlias = Waitable
"""An action server or client; importing their classes takes 100 ms."""

MovedEndpoint: typing.TypeAlias = Subscription | Service | Client | Action

_KINDS = {Subscription: "subscription", Service: "service", Client: "client"}
"""What rclpy's methods and lists of a node are called after."""


def move(entity: MovedEndpoint, maker: Node, host: Node) -> None:
    """Have `host`'s executor run the callbacks of an endpoint that `maker` has just made.

    Its callback group must be one of `host`'s.
    """
    if isinstance(entity, Waitable):
        maker.remove_waitable(entity)
        private(entity, "_node", "carry an action by a connection")
        entity._node = host  # noqa: SLF001 - whose executor works on goals, and which removes it
        host.add_waitable(entity)
        return
    name, why = f"_{_KINDS[type(entity)]}s", "carry an endpoint by a connection"
    private(maker, name, why).remove(entity)
    private(host, name, why).append(entity)
    for handler in entity.event_handlers if isinstance(entity, Subscription) else ():
        maker.remove_waitable(handler)
        host.add_waitable(handler)
    if host.executor is not None:
        host.executor.wake()


def dismiss(entity: MovedEndpoint, host: Node) -> None:
    """Destroy a moved endpoint; harmless if `host` did, or was destroyed itself."""
    if isinstance(entity, Waitable):
        entity.destroy()
        return
    getattr(host, f"destroy_{_KINDS[type(entity)]}")(entity)
