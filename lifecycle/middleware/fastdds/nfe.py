"""Network flow endpoints of rclpy publishers and subscriptions.

Owns: the call into rmw that rclpy lacks. An NFE list says which network resources an endpoint may
use, not which transport carried a message; `dscp` and `flow_label` in it are always 0 with
Fast DDS (see `lifecycle.middleware.fastdds.dscp` for the value the kernel really uses).
"""

from __future__ import annotations

import ctypes
import dataclasses
from typing import Any

from rcl_interfaces.msg import ParameterEvent
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import qos_profile_parameter_events
from rclpy.subscription import Subscription

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.shared_executor import is_guest
from lifecycle.middleware.rcl import abi
from lifecycle.network import InternetProtocol, NetworkFlowEndpoint, TransportProtocol

_TRANSPORTS = (TransportProtocol.UNKNOWN, TransportProtocol.UDP, TransportProtocol.TCP)
_INTERNETS = (InternetProtocol.UNKNOWN, InternetProtocol.IPV4, InternetProtocol.IPV6)


SHARED_MEMORY = NetworkFlowEndpoint(
    transport_protocol=TransportProtocol.UNKNOWN,
    internet_protocol=InternetProtocol.UNKNOWN,
    transport_port=0,
)
"""The NFE of shared memory; a subscription's has the number of a Fast DDS port on top."""


class NetworkFlowEndpointsUnsupported(MiddlewareError):  # noqa: N818 - states a fact, not a fault
    """The RMW cannot report network flow endpoints.

    Attributes:
        reason: the RMW's own message.
    """

    def __init__(self, message: str, *, reason: str, hint: str = "") -> None:
        super().__init__(message, hint=hint)
        self.reason = reason


def get_network_flow_endpoints(
    entity: Publisher | Subscription,
) -> tuple[NetworkFlowEndpoint, ...]:
    """Return the NFEs of a publisher or subscription, as rmw lists them.

    With Fast DDS a publisher's are its participant's sender sockets and a subscription's the
    locators it listens on. Shared memory appears with protocol UNKNOWN and without an address, but
    only among a subscription's: ask `has_shared_memory` for a publisher. An empty tuple means that
    the endpoint cannot be reached over any network.

    Raises:
        NetworkFlowEndpointsUnsupported: this RMW has no such function.
        MiddlewareError: the call failed, or the installed rcl is not known.
        rclpy.exceptions.InvalidHandle: the entity was destroyed.
    """
    return read_handle(
        entity.handle, "publisher" if isinstance(entity, Publisher) else "subscription"
    )


def has_shared_memory(node: Node) -> bool:
    """Return whether the participant of `node` has a shared memory transport.

    Every subscription of a participant listens on all its transports, so one shows it for the
    publishers as well. Where the node has none, one is made for a moment, on /parameter_events.

    Raises:
        MiddlewareError: as `get_network_flow_endpoints`.
    """
    existing = next((each for each in node.subscriptions if not is_guest(each)), None)
    if existing is not None:
        return _listens_on_shared_memory(existing)
    probe = node.create_subscription(
        ParameterEvent,
        "/parameter_events",
        _ignore,
        qos_profile_parameter_events,
        event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
    )
    try:
        return _listens_on_shared_memory(probe)
    finally:
        node.destroy_subscription(probe)


def read_handle(handle: Any, kind: str) -> tuple[NetworkFlowEndpoint, ...]:
    """As `get_network_flow_endpoints`, for rclpy's bare handle of a `kind`."""
    rcl = abi.load()
    array = abi.NfeArray()
    with handle:
        result = rcl.by_kind[kind]["nfes"](
            handle.pointer, ctypes.byref(rcl.default_allocator), ctypes.byref(array)
        )
    if result != abi.RCL_RET_OK:
        raise _failure(result, kind, rcl.take_error())
    try:
        return tuple(_convert(array.items[index]) for index in range(array.size))
    finally:
        if array.allocator:  # an empty list was never initialised, and fini would complain of it
            rcl.nfe_array_fini(ctypes.byref(array))


def _listens_on_shared_memory(subscription: Subscription) -> bool:
    return SHARED_MEMORY in (
        dataclasses.replace(each, transport_port=0)
        for each in get_network_flow_endpoints(subscription)
    )


def _ignore(_: ParameterEvent) -> None:
    """Take nothing: the probe is never spun."""


def _convert(nfe: abi.Nfe) -> NetworkFlowEndpoint:
    return NetworkFlowEndpoint(
        transport_protocol=_TRANSPORTS[nfe.transport_protocol],
        internet_protocol=_INTERNETS[nfe.internet_protocol],
        transport_port=nfe.transport_port,
        flow_label=nfe.flow_label,
        dscp=nfe.dscp,
        internet_address=nfe.internet_address.decode("ascii", errors="replace"),
    )


def _failure(result: int, kind: str, reason: str) -> MiddlewareError:
    message = f"cannot read the network flow endpoints of a {kind}: {reason}"
    if result == abi.RCL_RET_UNSUPPORTED:
        return NetworkFlowEndpointsUnsupported(
            message, reason=reason, hint="set RMW_IMPLEMENTATION=rmw_fastrtps_cpp"
        )
    return MiddlewareError(message)
