"""Network flow endpoints (NFEs) of publishers and subscriptions; subscriptions with unique ones.

Owns: reading NFEs, which rclpy cannot, and the creation option that it cannot set, rcl's
`require_unique_network_flow_endpoints`: the subscription is made by rclpy, made again in place with
the option, and only then given event handlers and shown to the node, so that neither an executor
nor an event ever sees the handle while it changes. See *Unique Network Flows*
(rmw_unique_network_flow_endpoints_requirement_t).

An NFE list says which network resources an endpoint may use, not which transport carried a message;
`dscp` and `flow_label` in it are always 0 with Fast DDS (`sockets` reads what the kernel uses).
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any

from msgspec.structs import replace
from rclpy.context import Context
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from rclpy.type_support import check_is_valid_msg_type
from rclpy.validate_topic_name import validate_topic_name

from lifecycle.errors import MiddlewareError
from lifecycle.manifest.qos import QosProfile
from lifecycle.middleware.rcl import abi
from lifecycle.middleware.rcl.conversions import to_rclpy
from lifecycle.middleware.versions import INSTALL, private
from lifecycle.network.medium import DEFAULT_RMW
from lifecycle.network.nfe import (
    InternetProtocol,
    NetworkFlowEndpoint,
    TransportProtocol,
    UniqueRequirement,
    is_ip,
)

_TRANSPORTS = (TransportProtocol.UNKNOWN, TransportProtocol.UDP, TransportProtocol.TCP)
_INTERNETS = (InternetProtocol.UNKNOWN, InternetProtocol.IPV4, InternetProtocol.IPV6)


SHARED_MEMORY = NetworkFlowEndpoint(
    transport_protocol=TransportProtocol.UNKNOWN,
    internet_protocol=InternetProtocol.UNKNOWN,
    transport_port=0,
)
"""The NFE of shared memory; a subscription's has the number of a Fast DDS port on top."""


def get_network_flow_endpoints(entity: Publisher | Subscription) -> tuple[NetworkFlowEndpoint, ...]:
    """Return the NFEs of a publisher or subscription, as rmw lists them.

    With Fast DDS a publisher's are its participant's sender sockets (`senders_of`), and a
    subscription's the locators it listens on, shared memory among them with protocol UNKNOWN and
    without an address.

    Raises:
        MiddlewareError: this RMW has no such function, or the installed rcl is not known.
        rclpy.exceptions.InvalidHandle: the entity was destroyed.
    """
    kind = "publisher" if isinstance(entity, Publisher) else "subscription"
    rcl = abi.load()
    with entity.handle:
        code, found = rcl.flow_endpoints(kind, entity.handle.pointer)
    if code != abi.RCL_RET_OK:
        unsupported = code == abi.RCL_RET_UNSUPPORTED
        raise MiddlewareError(
            f"cannot read the network flow endpoints of a {kind}: {rcl.take_error()}",
            hint=f"set RMW_IMPLEMENTATION={DEFAULT_RMW}" if unsupported else "",
        )
    return tuple(map(_convert, found))


_SENDERS: weakref.WeakKeyDictionary[Context, tuple[NetworkFlowEndpoint, ...]] = (
    weakref.WeakKeyDictionary()
)


def senders_of(node: Node) -> tuple[NetworkFlowEndpoint, ...]:
    """Return the sender sockets of a node's participant, which all its publishers have.

    They are asked for once: do so before it has peers. Fast DDS 2.14 lists them without the lock
    under which discovery extends the list for the first peer by shared memory or TCP
    (RTPSParticipantImpl::get_sending_locators).

    Raises:
        MiddlewareError: as `get_network_flow_endpoints`, or the node has no publisher.
    """
    known = _SENDERS.get(node.context)
    if known is None:
        publisher = next(iter(node.publishers), None)
        if publisher is None:
            raise MiddlewareError(f"cannot find a publisher of {node.get_name()!r} to ask")
        known = _SENDERS[node.context] = get_network_flow_endpoints(publisher)
    return known


def _convert(nfe: abi.Nfe) -> NetworkFlowEndpoint:
    if not nfe.internet_address:
        # Shared memory, of which Kilted's RMW says that it is UDPv4: it looks at single bits of the
        # kind, and LOCATOR_KIND_SHM of Fast DDS 3 is 19, which has that of LOCATOR_KIND_UDPv4.
        return replace(SHARED_MEMORY, transport_port=nfe.transport_port)
    return NetworkFlowEndpoint(
        transport_protocol=_TRANSPORTS[nfe.transport_protocol],
        internet_protocol=_INTERNETS[nfe.internet_protocol],
        transport_port=nfe.transport_port,
        flow_label=nfe.flow_label,
        dscp=nfe.dscp,
        internet_address=nfe.internet_address.decode("ascii", errors="replace"),
    )


def create_subscription(
    node: Node,
    type_: type[Any],
    topic: str,
    callback: Callable[..., Any],
    qos: QosProfile | QoSProfile,
    *,
    unique: UniqueRequirement = UniqueRequirement.NOT_REQUIRED,
    **options: Any,
) -> Subscription:
    """Create a subscription on `node`, with network flow endpoints of its own where asked.

    NOT_REQUIRED is plain rclpy, and so is OPTIONALLY_REQUIRED with an rcl that is not known.
    STRICTLY_REQUIRED also demands proof, because some RMWs accept the option and ignore it. Fast
    DDS takes the first free UDP port of 7000–7399, and gives it back only when the participant
    ends: whatever re-creates unique subscriptions does better on a `FlowParticipant`.

    Args:
        node: created by rclpy; spun by any executor.
        type_: message class.
        topic: relative, absolute or private; remapped as rclpy does.
        callback: takes the message, or the message and its info.
        qos: the manifest's profile or rclpy's.
        unique: the requirement.
        **options: of rclpy's `create_subscription`: callback_group, event_callbacks, raw.

    Raises:
        MiddlewareError: not possible here; no endpoint is left.
    """
    profile, refusal = to_rclpy(qos), abi.refusal()
    strictly = unique is UniqueRequirement.STRICTLY_REQUIRED
    if unique is UniqueRequirement.NOT_REQUIRED or (refusal and not strictly):
        # Not by its class, which may do more with what its own code makes.
        return Node.create_subscription(node, type_, topic, callback, profile, **options)
    validate_topic_name(topic)  # names the character at fault, which resolving does not
    resolved = node.resolve_topic_name(topic)  # unreadable while it is made again
    what = f"cannot create subscription {resolved!r} with network flow endpoints {unique.value}"
    if refusal:
        hint = f"ask for optionally_required, or {INSTALL}"
        raise MiddlewareError(f"{what}: {refusal}", hint=hint)
    listed = private(node, "_subscriptions", f"make a flow of its own for {topic!r}")
    group = options.get("callback_group") or node.default_callback_group
    raw = options.get("raw", False)
    events = options.get("event_callbacks") or SubscriptionEventCallbacks()
    check_is_valid_msg_type(type_)  # also loads the type support
    with node.handle:
        handle = rclpy_implementation.Subscription(
            node.handle, type_, topic, profile.get_c_qos_profile()
        )
    try:
        if refusal := _made_unique(handle, node, type_, topic, unique):
            raise MiddlewareError(  # noqa: TRY301 - after which nothing is left
                f"{what}: {refusal}",
                hint=f"ask for optionally_required, or set RMW_IMPLEMENTATION={DEFAULT_RMW}",
            )
        subscription = Subscription(
            *(handle, type_, topic, callback, group, profile, raw), event_callbacks=events
        )
    except BaseException:
        # A handle whose init failed is zero inside; rcl's fini accepts that.
        handle.destroy_when_not_in_use()
        raise
    group.add_entity(subscription)
    listed.append(subscription)  # as Node.create_subscription does
    for handler in subscription.event_handlers:
        node.add_waitable(handler)
    if node.executor is not None:
        node.executor.wake()
    return subscription


def _made_unique(
    handle: Any, node: Node, type_: type[Any], topic: str, unique: UniqueRequirement
) -> str:
    """Make a subscription again with the option; return why that does not do, empty if it does."""
    rcl = abi.load()
    with handle, node.handle:
        owner = node.handle.pointer
        code = rcl.remake_unique(handle.pointer, owner, type_, topic, unique.rmw_value)
        if code == abi.RCL_RET_OK and unique is not UniqueRequirement.STRICTLY_REQUIRED:
            return ""
        if code == abi.RCL_RET_OK:
            code, nfes = rcl.flow_endpoints("subscription", handle.pointer)
        if code != abi.RCL_RET_OK:
            return rcl.take_error()
    if not nfes:
        return "the RMW lists no network flow endpoint for it"
    if not any(is_ip(_convert(each)) for each in nfes):
        # The article defines network flows for UDP and TCP over IP only.
        return "the RMW lists only shared memory for it, which is no network flow"
    return ""
