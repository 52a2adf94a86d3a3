"""The graph queries of rclpy, put with the names that the RMW has, and answered in our types.

Names of DDS are neither expanded nor validated by rclpy (`no_mangle`, `no_demangle`). Any
participant may announce names that are no UTF-8, at which rclpy's queries raise. Such a name is
shown escaped, and a topic of which nothing can be read as one of an unknown node: neither is ever
verified.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Collection, Iterable, Iterator

from msgspec.structs import replace
from rclpy.context import Context
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rclpy.utilities import get_rmw_implementation_identifier

from lifecycle.errors import MiddlewareError
from lifecycle.manifest.installed_types import join
from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.qos import UNKNOWN_QOS
from lifecycle.middleware.rcl.conversions import from_rclpy
from lifecycle.verify.observation import ObservedEndpoint
from lifecycle.verify.tool_filter import PREFIX_DIGITS, known_node

RAW = "dds:"
"""What names of topics begin with here that are no names of ROS."""

OVER_DDS = not get_rmw_implementation_identifier().startswith("rmw_zenoh")
"""The RMW adds `rt`, `rq` or `rr` to names of ROS, as DDS has them (rmw_dds_common)."""

_TOPIC, _REQUEST, _REPLY = ("rt{}", "rq{}Request", "rr{}Reply") if OVER_DDS else ("{}",) * 3

_NODES = "ros_discovery_info"
"""Every participant of rmw_fastrtps and rmw_cyclonedds writes it, and no other."""

_OF_TOPICS = (EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION)
OF_SERVICES = (EndpointKind.SERVICE_SERVER, EndpointKind.SERVICE_CLIENT)

_GID_BYTES = 16

_REFUSED = (ValueError, rclpy_implementation.RCLError)
"""What rclpy's queries raise where a name or a value cannot be had: UnicodeDecodeError is one."""


def endpoints_of(node: Node, kind: EndpointKind, name: str) -> list[ObservedEndpoint]:
    """Return what `node` sees of the endpoints of a kind and name (fully qualified).

    Of a service a SERVICE_SERVER is what reads its requests, a SERVICE_CLIENT what writes them.
    """
    pattern = _TOPIC if kind.is_topic else _REQUEST
    return _read(node, kind, name, pattern.format(name))


def own_endpoint(node: Node, kind: EndpointKind, name: str) -> ObservedEndpoint | None:
    """Return the endpoint that `node` itself has of a kind and name; None if it has several.

    A participant knows its own at once: discovery has no part in it.
    """
    full_name = node.get_fully_qualified_name()
    own = [each for each in endpoints_of(node, kind, name) if each.node == full_name]
    return own[0] if len(own) == 1 else None


_PREFIXES: weakref.WeakKeyDictionary[Context, str] = weakref.WeakKeyDictionary()


def prefix_of(node: Node) -> str:
    """Return the GID prefix of a node's participant, 24 hex digits; empty if unknown.

    Ask for it first while its publisher of parameter events is there.
    """
    if node.context not in _PREFIXES:
        topic = node.resolve_topic_name("/parameter_events")
        own = own_endpoint(node, EndpointKind.PUBLISHER, topic)
        if own is None:
            return ""
        _PREFIXES[node.context] = own.gid[:PREFIX_DIGITS]
    return _PREFIXES[node.context]


def with_reply(node: Node, requests: list[ObservedEndpoint]) -> list[ObservedEndpoint]:
    """Return the ends of one node at the requests of a service with the hash of that service.

    It is joined (REP-2016) of what rmw_fastrtps and rmw_cyclonedds announce of both its topics,
    empty while only half of it is seen. Several servers or clients of a node are one end of it. A
    client has no GID: whoever asks may ask with several.
    """
    first = requests[0]
    asks = first.kind is EndpointKind.SERVICE_CLIENT
    topic = _REPLY.format(first.name)
    replies = _read(node, first.kind, first.name, topic, writes=not asks)
    sides = requests, [each for each in replies if each.node == first.node]
    hashes = [{each.type_hash or "" for each in side} for side in sides]
    type_hash = join(["" if "" in each else "|".join(sorted(each)) for each in hashes])
    ends = (
        replace(each, type_hash=type_hash, gid="" if asks and each.node else each.gid)
        for each in requests
    )
    return list(dict.fromkeys(ends))


def endpoints_in(node: Node, topics: Iterable[str]) -> Iterator[ObservedEndpoint]:
    """Yield the publishers and subscriptions of topics of the RMW, and what is at requests there.

    A topic of a node that avoids the naming conventions of ROS has its name of DDS behind `dds:`:
    `dds:/chatter` is not `/chatter`.
    """
    for topic in topics:
        if topic == _NODES or (OVER_DDS and topic.startswith("rr/")):
            continue
        name = _of_ros(topic)
        kinds, shown = _OF_TOPICS, f"{RAW}{topic}" if OVER_DDS and name == topic else name
        if OVER_DDS and topic.startswith("rq/") and topic.endswith("Request"):
            kinds, shown = OF_SERVICES, topic.removeprefix("rq").removesuffix("Request")
        for kind in kinds:
            yield from _read(node, kind, shown, topic)


def nameless_repliers(
    node: Node, topics: Iterable[str], wanted: Callable[[EndpointKind, str], bool]
) -> Iterator[ObservedEndpoint]:
    """Yield the endpoints at reply topics of wanted services that belong to no node, or none yet.

    Whoever writes replies may answer requests that it does not even read.
    """
    for topic in topics:
        if not (OVER_DDS and topic.startswith("rr/") and topic.endswith("Reply")):
            continue
        name = topic.removeprefix("rr").removesuffix("Reply")
        for kind in OF_SERVICES:
            if wanted(kind, name):
                writes = kind is EndpointKind.SERVICE_SERVER
                found = _read(node, kind, name, topic, writes=writes)
                yield from (each for each in found if not each.node)


def topic_names(node: Node, otherwise: Collection[str]) -> tuple[Collection[str], str]:
    """Return the topics that the RMW has, and one name that is no UTF-8, escaped; else empty.

    Where there is one rclpy says no other: then those that are looked for `otherwise` are returned.
    Raises MiddlewareError where they cannot be read.
    """
    try:
        found = node.get_topic_names_and_types(no_demangle=True)
    except UnicodeDecodeError as error:
        return otherwise, _of_ros(error.object.decode(errors="backslashreplace"))
    except _REFUSED as error:
        raise MiddlewareError(f"cannot read the topics of the graph: {error}") from error
    return frozenset(topic for topic, _ in found), ""


def rmw_topics(topics: Iterable[str], services: Iterable[str]) -> set[str]:
    """Return what the RMW calls topics of ROS, and the requests and replies of services."""
    names = tuple(services)
    return {*map(_TOPIC.format, topics), *map(_REQUEST.format, names), *map(_REPLY.format, names)}


def services_of_node(node: Node, full_name: str) -> list[ObservedEndpoint]:
    """Return the services and clients of a node, for an RMW that has no topics of them."""
    return [
        ObservedEndpoint(kind=kind, node=full_name, name=name, type=type_)
        for kind in OF_SERVICES
        for name, type_ in endpoints_of_node(node, kind, full_name) or ()
    ]


def endpoints_of_node(
    node: Node, kind: EndpointKind, full_name: str
) -> tuple[tuple[str, str], ...] | None:
    """Return name and type of a node's publishers, subscriptions, servers or clients.

    None where rcl shows no such node: it has left, or has a name that no rcl would give it.
    """
    query = {
        EndpointKind.PUBLISHER: node.get_publisher_names_and_types_by_node,
        EndpointKind.SUBSCRIPTION: node.get_subscriber_names_and_types_by_node,
        EndpointKind.SERVICE_SERVER: node.get_service_names_and_types_by_node,
        EndpointKind.SERVICE_CLIENT: node.get_client_names_and_types_by_node,
    }[kind]
    namespace, _, name = full_name.rpartition("/")
    try:
        return tuple(
            (each, type_) for each, types in query(name, namespace or "/") for type_ in types
        )
    except _REFUSED:
        return None


def unreadable(kind: EndpointKind, name: str) -> ObservedEndpoint:
    """Return what stands for all endpoints of a topic of which one has a name that is no UTF-8."""
    return ObservedEndpoint(
        kind=kind, node="", name=name, type="", qos=UNKNOWN_QOS, gid="", type_hash=""
    )


def _read(
    node: Node, kind: EndpointKind, name: str, topic: str, *, writes: bool | None = None
) -> list[ObservedEndpoint]:
    """Return who writes a topic of the RMW, or reads it; by default as the kind does requests."""
    if writes is None:
        writes = kind in (EndpointKind.PUBLISHER, EndpointKind.SERVICE_CLIENT)
    query = node.get_publishers_info_by_topic if writes else node.get_subscriptions_info_by_topic
    try:
        return [_observed(kind, name, info) for info in query(topic, no_mangle=True)]
    except _REFUSED:
        return [unreadable(kind, name)]


def _observed(kind: EndpointKind, name: str, info: TopicEndpointInfo) -> ObservedEndpoint:
    announced = info.topic_type_hash
    return ObservedEndpoint(
        kind=kind,
        node=known_node(f"{info.node_namespace.rstrip('/')}/{info.node_name}"),
        name=name,
        type=_ros_type(info.topic_type),
        gid=bytes(info.endpoint_gid[:_GID_BYTES]).hex(),
        qos=from_rclpy(info.qos_profile) if kind.is_topic else None,
        type_hash=str(announced) if announced.version > 0 else "",
    )


def _ros_type(dds_type: str) -> str:
    """Return `std_msgs/msg/String` for `std_msgs::msg::dds_::String_`; others as they are."""
    package, ours, name = dds_type.partition("dds_::")
    if not ours or not name.endswith("_"):
        return dds_type
    if not package.endswith("msg::"):  # one of a service
        name = name.removesuffix("_Request_").removesuffix("_Response_")
    return package.replace("::", "/") + name.removesuffix("_")


def _of_ros(topic: str) -> str:
    """Return the name that ROS has for a topic of the RMW; one that is none of ROS as it is."""
    return topic.removeprefix("rt") if OVER_DDS and topic.startswith("rt/") else topic
