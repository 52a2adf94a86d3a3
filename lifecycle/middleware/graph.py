"""The ROS graph as discovery shows it, read in one go and watched without polling.

Owns: the observer's participant, and the translation of rclpy's graph queries into observation
types. What tools bring along is left out by `lifecycle.verify.noise`.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
import typing
from collections.abc import Callable, Collection, Iterable, Iterator

from rclpy.node import NodeNameNonExistentError

from lifecycle.manifest.model import EndpointKind
from lifecycle.middleware.census import Census
from lifecycle.middleware.dead_connections import give_up_dead_connections
from lifecycle.middleware.doors import knock_for
from lifecycle.middleware.graph_guard import GraphGuard
from lifecycle.middleware.hidden_node import quiet_node
from lifecycle.middleware.participant_profile import ParticipantSettings
from lifecycle.middleware.qos import from_rclpy
from lifecycle.plan.model import ParticipantConnections
from lifecycle.verify.noise import (
    fold_actions,
    is_noise_endpoint,
    is_noise_node,
    known_node,
    without_noise,
)
from lifecycle.verify.observation import ObservedEndpoint, ObservedNode

ANSWER_S = 0.15
"""Who hears a knock on this host or the next one answers within so long."""

PATIENCE_S = 3.5
"""What Fast DDS lost on the way it sends again every 3 s."""

_UNASKED_S = 1.5
"""Within so long everybody is seen where nobody can be asked, over shared memory or TCP.

They announce themselves each 0.5 s, and TCP may lose the first of it (measured: up to 1.2 s).
"""

_UNCOUNTED_S = 0.6
"""Within so long who is asked is seen, if its answer may not come to us (measured: up to 0.3 s)."""

_TOLD_S = 2.5
"""Within so long a discovery server has told of everybody (measured: up to 1.6 s)."""

_PREFIX_DIGITS = 24
_UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"
_CHANGE_STATE = "lifecycle_msgs/srv/ChangeState"
_GET_STATE = "lifecycle_msgs/srv/GetState"
_Names = typing.Callable[[str, str], list[tuple[str, list[str]]]]

Snapshot = tuple[tuple[ObservedNode, ...], tuple[ObservedEndpoint, ...]]


@typing.final
class GraphObserver:
    """A hidden node that sees the whole graph of one domain.

    Make it before starting what it is to see: a participant that is there already is found at
    once. `destroy` it, or use it in a `with`. Every method may be called from any thread.

    Args:
        domain_id: 0–232.
        connections: how it is connected; as a client of a discovery server it is a super client,
            which is told of everything.

    Raises:
        ConnectionUrlError: a URL that is none.
        MiddlewareError: no participant could be made.
    """

    def __init__(self, domain_id: int, connections: ParticipantConnections | None = None) -> None:
        self.domain_id = domain_id
        settings = ParticipantSettings.of(
            connections or ParticipantConnections(), super_client=True
        )
        self._context, self.node = quiet_node(
            f"_lifecycle_observer_{os.getpid()}", "/", domain_id, settings=settings
        )
        self._census = Census(self.node)
        self._lock = threading.Lock()
        self._callbacks: tuple[Callable[[], None], ...] = ()
        self._destroyed = False
        self._known: frozenset[str] = frozenset()
        self._guard = GraphGuard(self.node, self._changed)
        self._knocks = knock_for(domain_id, settings.urls, os.environ)
        self._limit_s = _TOLD_S if any(url.server for url in settings.urls) else _UNASKED_S
        self._made_s = time.monotonic()

    def on_change(self, callback: Callable[[], None]) -> Callable[[], None]:
        """Have `callback` called in the guard's thread after each change of the graph.

        It says that something changed, not what; changes that come together come as one. It must
        be quick and must not destroy the observer.

        Returns:
            A function that takes the callback away again.
        """
        with self._lock:
            self._callbacks += (callback,)

        def remove() -> None:
            with self._lock:
                self._callbacks = tuple(each for each in self._callbacks if each is not callback)

        return remove

    def snapshot(self, *, keep: Collection[str] = ()) -> Snapshot:
        """Return the nodes and the endpoints that discovery shows now, in a stable order.

        Args:
            keep: fully qualified names of nodes to show although they are named as a tool's.

        Raises:
            MiddlewareError: the graph is no longer watched; the message says why.
        """
        if self._guard.failure is not None:
            raise self._guard.failure
        self._known = frozenset()
        counts = self._census.count()
        names = sorted(
            name
            for name in counts
            if name in keep or (known_node(name) and not is_noise_node(name))
        )
        endpoints = [
            endpoint
            for endpoint in self._topic_endpoints()
            if not endpoint.node or endpoint.node in keep or not is_noise_node(endpoint.node)
        ]
        nodes = []
        for name in names:
            services = self._services(name)
            nodes.append(
                ObservedNode(full_name=name, count=counts[name], managed=_managed(name, services))
            )
            endpoints += services or ()
        kept = fold_actions(without_noise(endpoints))
        return tuple(nodes), tuple(sorted(kept, key=_order))

    def settling_s(self) -> float:
        """Return for how many seconds a look may still miss who is there; 0 once it cannot.

        A participant that answered our knock and whose node is not known is on its way into the
        graph. Fast DDS needs 3 s at most for what it lost; who then still has no node has none.
        Judged by the last `snapshot`. Where nobody can be asked, it is a time.
        """
        age_s = time.monotonic() - self._made_s
        if not self._knocks:
            return max(0.0, self._limit_s - age_s)
        if not all(knock.counts for knock in self._knocks):
            return max(0.0, _UNCOUNTED_S - age_s)
        if age_s < ANSWER_S:
            return ANSWER_S - age_s
        if all(knock.answered() <= self._known for knock in self._knocks):
            return 0.0
        return max(0.0, PATIENCE_S - age_s)

    def offers(self, node: str, service: str) -> bool:
        """Tell whether discovery shows `service` (a fully qualified name) on `node`."""
        return any(
            each.kind is EndpointKind.SERVICE_SERVER and each.name == service
            for each in self._services(node) or ()
        )

    def destroy(self) -> None:
        """Stop watching and leave the graph; again is harmless."""
        if self._destroyed:
            return
        self._destroyed = True
        for knock in self._knocks:
            knock.close()
        self._guard.stop()
        give_up_dead_connections()
        self.node.destroy_node()
        self._context.try_shutdown()
        self._context.destroy()

    def __enter__(self) -> GraphObserver:
        return self

    def __exit__(self, *_: object) -> None:
        self.destroy()

    def _changed(self) -> None:
        for callback in self._callbacks:
            callback()

    def _topic_endpoints(self) -> Iterator[ObservedEndpoint]:
        for topic, _ in self.node.get_topic_names_and_types():
            for kind, query in (
                (EndpointKind.PUBLISHER, self.node.get_publishers_info_by_topic),
                (EndpointKind.SUBSCRIPTION, self.node.get_subscriptions_info_by_topic),
            ):
                for info in query(topic):
                    node = _full_name(info.node_name, info.node_namespace)
                    gid = bytes(info.endpoint_gid).hex()
                    if node:
                        self._known |= {gid[:_PREFIX_DIGITS]}
                    if is_noise_endpoint(kind, node, topic, info.topic_type, ours=False):
                        continue
                    yield ObservedEndpoint(
                        kind=kind,
                        node=node,
                        name=topic,
                        type=info.topic_type,
                        qos=from_rclpy(info.qos_profile),
                        gid=gid,
                    )

    def _services(self, full_name: str) -> tuple[ObservedEndpoint, ...] | None:
        """Return the service endpoints of a node; None when it has left meanwhile."""
        namespace, _, name = full_name.rpartition("/")
        queries: tuple[tuple[EndpointKind, _Names], ...] = (
            (EndpointKind.SERVICE_SERVER, self.node.get_service_names_and_types_by_node),
            (EndpointKind.SERVICE_CLIENT, self.node.get_client_names_and_types_by_node),
        )
        found: list[ObservedEndpoint] = []
        with contextlib.suppress(NodeNameNonExistentError):
            for kind, query in queries:
                found += (
                    ObservedEndpoint(kind=kind, node=full_name, name=service, type=type_)
                    for service, types in query(name, namespace or "/")
                    for type_ in types
                )
            return tuple(found)
        return None


def _managed(node: str, services: Iterable[ObservedEndpoint] | None) -> bool | None:
    """Tell whether a node offers the services by which a managed node is driven."""
    if services is None:
        return None
    offered = {
        (each.name, each.type) for each in services if each.kind is EndpointKind.SERVICE_SERVER
    }
    return {(f"{node}/change_state", _CHANGE_STATE), (f"{node}/get_state", _GET_STATE)} <= offered


def _full_name(name: str, namespace: str) -> str:
    return "" if name == _UNKNOWN_NODE else f"{namespace.rstrip('/')}/{name}"


def _order(endpoint: ObservedEndpoint) -> tuple[str, ...]:
    return (endpoint.node, endpoint.kind.value, endpoint.name, endpoint.type, endpoint.gid)
