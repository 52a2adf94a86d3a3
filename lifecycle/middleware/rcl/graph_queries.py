"""The graph queries of rclpy in our types, and changes of the graph without polling.

Owns: the thread of each participant that sleeps on rcl's graph guard condition, which rclpy does
not expose, while anybody follows the graph.

Names of DDS are neither expanded nor validated by rclpy (`no_mangle`, `no_demangle`). Any
participant may announce names that are no UTF-8, at which rclpy's queries raise. Such a name is
shown escaped, and a topic of which nothing can be read as one of an unknown node: neither is ever
verified.

rmw_fastrtps counts a client's server only while both its ends are matched, and as many as the graph
knows of (rmw_service_server_is_available.cpp, rcl_action_server_is_available).
"""

from __future__ import annotations

import atexit
import functools
import logging
import threading
import typing
import weakref
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import TYPE_CHECKING, TypeAlias

from msgspec.structs import replace
from rclpy.client import Client
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rclpy.utilities import get_rmw_implementation_identifier

from lifecycle.errors import MiddlewareError
from lifecycle.manifest.installed_types import join
from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.qos import UNKNOWN_QOS
from lifecycle.middleware.rcl import abi
from lifecycle.middleware.rcl.conversions import from_rclpy
from lifecycle.verify.observation import ObservedEndpoint
from lifecycle.verify.tool_filter import PREFIX_DIGITS, known_node

if TYPE_CHECKING:
    from rclpy.action import ActionClient

    AnyClient: TypeAlias = Client | ActionClient


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


Callback = Callable[[], object]

_logger = logging.getLogger(__name__)
_SOON_S, _AGAIN_S = 0.002, 0.2
"""Pauses, ever longer, while a callback says that what it waits for may follow a change: discovery
shows an endpoint a moment before it is matched, and no event reports the match."""
_UNKNOWN_S = 0.5
"""An rcl whose layouts are not known gives no event: the graph may have changed after so long."""


@typing.final
class GraphGuard:
    """Calls back when discovery changes the graph that a participant sees; get it by `of`.

    Changes during callbacks are folded into one further call.

    Attributes:
        failure: why the thread gave up; None while it works.
    """

    def __init__(self) -> None:
        self.failure: MiddlewareError | None = None
        self._lock = threading.Lock()
        self._callbacks: dict[object, tuple[Node, Callback]] = {}
        self._node: Node | None = None  # through which it watches
        self._wake: GuardCondition | None = None
        self._stopped = threading.Event()
        self._thread = threading.Thread()

    @classmethod
    def of(cls, node: Node) -> GraphGuard:
        """Return that of a node's participant: two would take the changes from each other."""
        with _lock:
            guard = _guards.get(node.context)
            if guard is None:
                guard = _guards[node.context] = cls()
                node.context.on_shutdown(guard.close)
        return guard

    def follow(self, node: Node, callback: Callback) -> Callable[[], None]:
        """Have `callback` called in the thread soon, and after each change.

        Args:
            node: of the participant; take the callback away before it is destroyed.
            callback: quick; an exception it raises is logged and ends nothing. While it returns
                True it is called again without a change, at last each 0.2 s.

        Returns:
            A function that takes the callback away again; not to be called by a callback.

        Raises:
            MiddlewareError: rcl's graph guard condition could not be waited on.
        """
        key = object()
        with self._lock:
            self._watch(self._node or node)
            self._callbacks = {**self._callbacks, key: (node, callback)}
            if self._wake is not None:
                self._wake.trigger()
        return lambda: self._remove(key)

    def close(self) -> None:
        """Let go of the participant: its context is shut down, or the program ends."""
        with self._lock:
            self._callbacks = {}
            self._watch(None)

    def _remove(self, key: object) -> None:
        with self._lock:
            self._callbacks = {other: it for other, it in self._callbacks.items() if other != key}
            nodes = [node for node, _ in self._callbacks.values()]
            if self._node not in nodes:
                self._watch(nodes[0] if nodes else None)

    def _watch(self, node: Node | None) -> None:
        """Watch through another node, or none."""
        if node is self._node:
            return
        if self._node is not None:
            self._node = None
            self._stopped.set()
            if self._wake is not None:
                self._wake.trigger()
            self._thread.join()
            if self._wake is not None:
                self._wake.destroy()
        if node is None:
            return
        self.failure, self._stopped, self._wake = None, threading.Event(), None
        watch = functools.partial(self._look_often, self._stopped)
        if not abi.refusal():
            self._wake = GuardCondition(None, None, context=node.context)
            guards = abi.GuardWait(node.context.handle.pointer, 2)
            watch = functools.partial(self._wait, node, guards, self._wake, self._stopped)
            self._wake.trigger()  # changes in between are reported by nobody else
        self._thread = threading.Thread(target=watch, name="graph-guard", daemon=True)
        self._thread.start()
        self._node = node

    def _look_often(self, stopped: threading.Event) -> None:
        while not stopped.wait(_UNKNOWN_S):
            self.notify()

    def _wait(
        self, node: Node, guards: abi.GuardWait, wake: GuardCondition, stopped: threading.Event
    ) -> None:
        """Notify after each change, and while a callback returns True after ever longer pauses."""
        graph = abi.load().call["rcl_node_get_graph_guard_condition"](node.handle.pointer)
        pause_s: float | None = None
        try:
            # Meanwhile rclpy frees nothing of what is waited for.
            with node.context.handle, node.handle, wake.handle:
                while True:
                    changed = guards.wait((graph, wake.handle.pointer), pause_s)
                    if stopped.is_set():
                        return
                    if not self.notify():
                        pause_s = None
                    elif changed or pause_s is None:
                        pause_s = _SOON_S
                    else:
                        pause_s = min(2 * pause_s, _AGAIN_S)
        except MiddlewareError as error:
            _logger.exception("the graph is no longer watched")
            self.failure = error
            self.notify()
        finally:
            guards.close()

    def notify(self) -> bool:
        """Call all back, in this thread; return whether any is to be called again."""
        wanted = [_call(callback) for _, callback in self._callbacks.values()]
        return any(wanted)


def _call(callback: Callback) -> bool:
    try:
        return callback() is True
    except Exception:
        _logger.exception("cannot handle a graph change")
        return False


_lock = threading.Lock()
_guards: weakref.WeakKeyDictionary[Context, GraphGuard] = weakref.WeakKeyDictionary()


@atexit.register
def _let_go() -> None:
    """Leave no thread in rcl when the interpreter ends: it would keep the participant alive."""
    for guard in tuple(_guards.values()):
        guard.close()


_COUNTING_BOTH_WAYS = ("rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp")
"""Others answer from the graph alone, or were not looked at."""


def is_server_matched(client: AnyClient) -> bool | None:
    """Return whether a server is matched with a client both ways; None if the RMW cannot say."""
    return _is_ready(client) if get_rmw_implementation_identifier() in _COUNTING_BOTH_WAYS else None


def watch_server(
    node: Node, client: AnyClient, changed: Callable[[], object]
) -> Callable[[], None]:
    """Have `changed` called in a thread of the graph when a server of a client's is matched or not.

    No event reports that, but each match follows a change of the graph.

    Args:
        node: of the client.
        client: to watch until the returned function is called; then it may be destroyed.
        changed: quick; also called if a server is matched already.
    """
    matched = False

    def look() -> bool:
        """Look; return whether a match may follow what is in the graph already."""
        nonlocal matched
        before = matched
        try:
            matched = _is_ready(client)
            if isinstance(client, Client):
                service = client.service_name
            else:
                service = f"{client.action_name}/_action/send_goal"
            is_there = bool(node.count_services(service))
        except (InvalidHandle, *_REFUSED):
            return False  # it was destroyed meanwhile
        if matched != before:
            changed()
        return is_there and not matched

    return GraphGuard.of(node).follow(node, look)


def _is_ready(client: AnyClient) -> bool:
    if isinstance(client, Client):
        return bool(client.service_is_ready())
    return bool(client.server_is_ready())
