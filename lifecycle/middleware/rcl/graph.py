"""ROS graph observer: snapshots of nodes and endpoints as discovery shows them, without polling.

Owns: the observer's participant, and the translation of graph queries into observation types.
Entities that tools add are left out by `lifecycle.verify.tool_filter`. The type hashes (REP-2016)
of services are found at their request and reply endpoints, by their DDS names; rmw_fastrtps and
rmw_cyclonedds announce hashes since Iron.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import threading
import time
import typing
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping

import rclpy
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock

from lifecycle import dataclasses
from lifecycle.export.programs import CapturedProgram
from lifecycle.manifest.installed_types import join
from lifecycle.manifest.model import EndpointKind
from lifecycle.middleware.discovery.environment import is_served, missing_port, reach, settle_s
from lifecycle.middleware.discovery.prefixes import PROCESS_DIGITS, is_of_host, is_of_process
from lifecycle.middleware.discovery.prober import Settling
from lifecycle.middleware.discovery.tcp import give_up_dead_connections, is_used
from lifecycle.middleware.fastdds.participant_profile import (
    DISCOVERY_SERVER_VARIABLE,
    ParticipantSettings,
)
from lifecycle.middleware.fastdds.settings import observer_settings
from lifecycle.middleware.process.hosted import is_vouched_for
from lifecycle.middleware.process.process_table import programs_of
from lifecycle.middleware.rcl.graph_changes import GraphGuard, on_graph_change
from lifecycle.middleware.rcl.graph_queries import (
    RAW,
    EndpointInfo,
    endpoints_of,
    endpoints_of_node,
    topic_endpoints,
)
from lifecycle.middleware.rcl.hidden_node import quiet_node
from lifecycle.middleware.rcl.stale_node_filter import StaleNodeFilter
from lifecycle.plan.model import ParticipantConnections
from lifecycle.verify.observation import ObservedEndpoint, ObservedNode
from lifecycle.verify.tool_filter import (
    CLOCK,
    NO_NAMES,
    DeclaredNames,
    fold_actions,
    is_noise_endpoint,
    known_node,
    our_nodes,
    without_noise,
)


@dataclasses.dataclass(frozen=True, slots=True)
class _Service:
    """Endpoints of one service: writers and readers of its requests, then of its replies."""

    clients: tuple[list[EndpointInfo], list[EndpointInfo]]
    servers: tuple[list[EndpointInfo], list[EndpointInfo]]

    @classmethod
    def of(cls, node: Node, name: str) -> _Service:
        requests, replies = f"rq{name}Request", f"rr{name}Reply"

        def publishers(topic: str) -> list[EndpointInfo]:
            return endpoints_of(node, EndpointKind.PUBLISHER, topic, no_mangle=True)

        def subscriptions(topic: str) -> list[EndpointInfo]:
            return endpoints_of(node, EndpointKind.SUBSCRIPTION, topic, no_mangle=True)

        return cls(
            clients=(publishers(requests), subscriptions(replies)),
            servers=(subscriptions(requests), publishers(replies)),
        )

    def hash_of(self, endpoint: ObservedEndpoint) -> str | None:
        """Return the joined hashes of a node's end, empty while only half of it is seen; else None.

        None means that the RMW has no such topics, or that nothing of them is seen.
        """
        sides = self.servers if endpoint.kind is EndpointKind.SERVICE_SERVER else self.clients
        hashes, seen = [], False
        for side in sides:
            own = {info.type_hash for info in side if info.node == endpoint.node}
            seen = seen or bool(own)
            # A node with several servers or clients of one name is one end: all of them count.
            hashes.append("" if "" in own else "|".join(sorted(own)))
        return join(hashes) if seen else None

    def servers_of(
        self, endpoint: ObservedEndpoint, ignores: Callable[[str], bool]
    ) -> tuple[str, ...]:
        """Return the GID of each server of a node's end, of what reads its requests.

        A client has one, which may be empty: whoever asks may ask with several.
        """
        if endpoint.gid or endpoint.kind is not EndpointKind.SERVICE_SERVER:
            return (endpoint.gid,)
        found = {
            info.gid
            for info in self.servers[0]
            if info.node == endpoint.node
            and _service_type(info.type) == endpoint.type
            and not ignores(info.gid)
        }
        return tuple(sorted(found)) or ("",)


_Listed = tuple[tuple[EndpointKind, tuple[tuple[str, str], ...]], ...]
"""Name and type of what rcl lists of a node, by kind."""


_AGREED_S = 5.0
"""A server that listens agrees within so long, on a busy machine too."""

_NAMED_S = 0.2
"""Of a new participant endpoints are known first, and within so long of which nodes they are."""
_LOOK_S = 0.005
_PREFIX_DIGITS = 24

_REQUEST = re.compile(r"rq/.*Request")
"""DDS names of the topics that carry the requests of services."""
_CHANGE_STATE = "lifecycle_msgs/srv/ChangeState"
_GET_STATE = "lifecycle_msgs/srv/GetState"

Snapshot = tuple[tuple[ObservedNode, ...], tuple[ObservedEndpoint, ...]]


@typing.final
class GraphObserver:
    """What discovery shows of the graph of one domain, to a hidden node of its own.

    Make it before starting what it is to see: a participant that is there already is found at
    once. `destroy` it, or use it in a `with`. Every method may be called from any thread.
    `GraphObserver.on` looks through a node that is there already.

    Args:
        domain_id: 0–232.
        connections: how it is connected; as a client of a discovery server it is a super client,
            to which everything is announced.
        node: looked through instead of a hidden one, see `on`.

    Attributes:
        urls: of its connections; none where the RMW chooses.
        settling: for how long it may still miss somebody.
        owns_node: the node is its own, and is spun and destroyed by nothing else.

    Raises:
        ConnectionUrlError: a URL that is none.
        MiddlewareError: no participant could be made.
    """

    def __init__(
        self,
        domain_id: int,
        connections: ParticipantConnections | None = None,
        *,
        node: Node | None = None,
    ) -> None:
        self.domain_id = domain_id
        settings = ParticipantSettings.of(connections or ParticipantConnections())
        self.urls = settings.urls
        self.owns_node = node is None
        self._lock = threading.Lock()
        self._callbacks: tuple[Callable[[], None], ...] = ()
        self._destroyed = False
        self._ours: frozenset[str] = frozenset()
        self._asked_for: set[str] = set()
        self._nameless_since_s: dict[str, float] = {}
        self._clock: Subscription[Clock] | None = None
        self._time_came = self._clock_closed = False
        self._context: rclpy.Context | None = None
        self._guard: GraphGuard | None = None
        if node is None:
            self._context, node = _observing_node(domain_id, settings)
            self._guard = GraphGuard(node, self._changed)
            self._unwatch = self._guard.stop
            self.settling = Settling(
                reach(domain_id, settings.urls, os.environ), settle_s(settings.urls, os.environ)
            )
        else:
            self._unwatch = on_graph_change(node, self._changed)
            self.settling = Settling(())
        self.node = node
        self._name = self.node.get_fully_qualified_name()
        self._stale_node_filter = StaleNodeFilter(self.node)
        self._named: frozenset[str] = frozenset()

    @classmethod
    def on(cls, node: Node) -> GraphObserver:
        """Look through a node that others spin, and destroy after this.

        How its participant is connected is not known here, so that no participant can be asked to
        announce itself: for the first 3.5 s a snapshot may miss some (`settling_s`).

        Raises:
            MiddlewareError: rcl's graph guard condition could not be waited on.
        """
        return cls(node.context.get_domain_id(), node=node)

    def on_change(self, callback: Callable[[], None]) -> Callable[[], None]:
        """Have `callback` called in the guard's thread after each change of the graph.

        It says that something changed, not what; simultaneous changes are reported as one. It must
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

    def snapshot(
        self, *, declared: Collection[str] = (), names: DeclaredNames = NO_NAMES
    ) -> Snapshot:
        """Return the nodes and the endpoints that discovery shows now, in a stable order.

        All but its own node, of which there is only what it publishes under `names`. The
        housekeeping of client libraries is left out. Services are known by their nodes, so those
        of no known node are looked for by name.

        Args:
            declared: fully qualified names of nodes that are looked for.
            names: of topics, services and actions that are looked for: a node that offers one of
                them and is not `declared` is shown, whatever it looks like.

        Raises:
            MiddlewareError: the graph is no longer watched; the message says why.
        """
        if self._guard is not None and self._guard.failure is not None:
            raise self._guard.failure
        if names.simulated and self.owns_node:
            self._watch_clock()
        counts = self._stale_node_filter.count()
        ourselves = self._name if self.owns_node and counts[self._name] == 1 else None
        shown: dict[str, list[ObservedEndpoint]] = {}
        for each in self._topic_endpoints(declared, names):
            shown.setdefault(each.node, []).append(each)
        if ourselves is not None:
            # Others match what a supervisor offers under names that are looked for.
            own = shown.pop(ourselves, [])
            if own := [each for each in own if names.looks_for(each.kind, each.name)]:
                shown[ourselves] = own
        unreported = {""}
        nodes: list[ObservedNode] = []
        for name in sorted(name for name in counts if known_node(name) and name != ourselves):
            services = self._services_of(name)
            managed = None if services is None else _managed(name, services)
            nodes.append(ObservedNode(full_name=name, count=counts[name], managed=managed))
            if services is None:
                unreported.add(name)
            elif services:
                shown.setdefault(name, []).extend(services)
        for each in self._services_of_others(names, unreported):
            shown.setdefault(each.node, []).append(each)
        # One that leaves, endpoint by endpoint, stays ours.
        self._ours = self._ours.intersection(shown).union(
            *(our_nodes(endpoints) for endpoints in shown.values())
        )
        queried: dict[str, _Service] = {}
        endpoints: list[ObservedEndpoint] = []
        for name in sorted(shown):
            but = NO_NAMES if name in declared else names
            endpoints += self._hashed(name, shown[name], but, queried)
        return tuple(nodes), tuple(endpoints)

    def settling_s(self) -> float:
        """Return for how many seconds a snapshot may still miss nodes; 0 once it cannot.

        Judged by the last `snapshot`, see `Settling`.
        """
        return self.settling.left_s(self._named)

    def expect_newcomers(self, *, everybody: bool = False) -> bool:
        """Have `settling_s` wait for who came since; return whether there may be anybody.

        Args:
            everybody: wait also for what those have to say that are known: this process did not
                run for a while.
        """
        return self.settling.expect_newcomers(self._named, self.prefix, everybody=everybody)

    @property
    def prefix(self) -> str:
        """GUID prefix of its own participant, 24 hex digits; empty where that is not known."""
        homes = self._stale_node_filter.homes()
        return next(iter(homes.get(self._name, ())), "")

    def hosted(self, nodes: Iterable[str]) -> dict[str, bool]:
        """Return which nodes of this machine are in hosts of ours, see `process/hosted.py`.

        Args:
            nodes: fully qualified names; those on other machines are not in the result.
        """
        homes, found = self._stale_node_filter.homes(), {}
        own = next(iter(homes.get(self._name, ())), "")
        for name in nodes:
            here = [each for each in homes.get(name, ()) if own and is_of_host(each, own)]
            if here:
                found[name] = all(map(is_vouched_for, here))
        return found

    def offers(self, node: str, service: str) -> bool:
        """Return whether discovery shows `service` (a fully qualified name) on `node`."""
        return service in self.services_of(node)

    def services_of(self, node: str) -> frozenset[str]:
        """Return the fully qualified names of the services that discovery shows on `node`."""
        return frozenset(
            name
            for kind, listed in self._services(node) or ()
            if kind is EndpointKind.SERVICE_SERVER
            for name, _ in listed
        )

    def missing_port(self) -> int | None:
        """Return the UDP port that another process keeps from all participants of this host."""
        return missing_port(self.domain_id, self.urls, os.environ)

    def reaches_servers(self) -> bool:
        """Wait, bounded, until the TCP discovery servers of its URLs can be asked; False if not.

        What Fast DDS has not agreed on with a server by then it never will: make another observer,
        on another port. Without such servers there is nothing to wait for.
        """
        deadline = time.monotonic() + _AGREED_S
        servers = [
            (server.address, server.port)
            for url in self.urls
            if url.transport.is_tcp
            for server in url.server
            if server.port is not None
        ]
        for address, port in servers:
            while not (used := is_used(address, port)):
                if used is False or time.monotonic() > deadline:
                    return False
                time.sleep(_LOOK_S)  # the kernel gives no event
        return True

    def ended(self, pid: int, *, nodes: Iterable[str], reported: Iterable[str]) -> None:
        """Count the participants of a process no more, although discovery shows them still.

        Args:
            pid: of a process on this host that has ended.
            nodes: fully qualified names of nodes that it ran.
            reported: GUID prefixes that these nodes said are theirs. Of both only those count
                that bear this host and this pid.
        """
        homes, own = self._stale_node_filter.homes(), self.prefix
        claimed = {*reported, *(prefix for name in nodes for prefix in homes.get(name, ()))}
        theirs = [each for each in claimed if own and is_of_process(each, pid, own)]
        self._stale_node_filter.was_on(nodes, frozenset(theirs))
        for each in theirs:
            self.ended_participant(each)

    def ended_participant(self, prefix: str) -> None:
        """Count participants of an ended process no more.

        Args:
            prefix: of the GUID of one of them, 24 hex digits.
        """
        own = self.prefix
        if prefix[:PROCESS_DIGITS] != own[:PROCESS_DIGITS]:
            self._stale_node_filter.ignore(prefix[:PROCESS_DIGITS])
            self._changed()

    def programs(self, environment: Mapping[str, str]) -> dict[str, dict[str, CapturedProgram]]:
        """Return how the processes of this host's nodes were started.

        Args:
            environment: variables that differ from these are reported.

        Returns:
            By full node name, for each of its participants by GUID prefix (24 hex digits).
        """
        homes = self._stale_node_filter.homes()
        own = next(iter(homes.get(self._name, ())), "")
        if not own:
            return {}
        known = programs_of((each for home in homes.values() for each in home), own, environment)
        return {
            name: {each: known[each] for each in home if each in known}
            for name, home in homes.items()
        }

    def destroy(self) -> None:
        """Stop watching and leave the graph; again is harmless."""
        if self._destroyed:
            return
        self._destroyed = True
        self.settling.close()
        self._unwatch()
        if self._context is not None:
            give_up_dead_connections()
            self.node.destroy_node()
            self._context.try_shutdown()
            self._context.destroy()

    def __enter__(self) -> GraphObserver:
        return self

    def __exit__(self, *_: object) -> None:
        self.destroy()

    @property
    def _is_silent(self) -> bool:
        return self._clock is not None and not self._time_came

    def _watch_clock(self) -> None:
        """Receive /clock until time has come once."""
        if self._clock is None:
            self._clock = self.node.create_subscription(
                Clock, CLOCK[0], self._take_time, qos_profile_sensor_data
            )
        elif self._time_came and not self._clock_closed:
            self._clock_closed = True
            self.node.destroy_subscription(self._clock)

    def _take_time(self, _: Clock) -> None:
        if not self._time_came:
            self._time_came = True
            self._changed()

    def _changed(self) -> None:
        for callback in self._callbacks:
            callback()

    def _topic_endpoints(
        self, declared: Collection[str], names: DeclaredNames
    ) -> Iterator[ObservedEndpoint]:
        known: set[str] = set()
        for kind, topic, info in topic_endpoints(self.node):
            if self._stale_node_filter.ignores(info.gid):
                continue
            if info.node:
                known.add(info.gid[:_PREFIX_DIGITS])
            endpoint = _topic_endpoint(kind, topic, info, declared, names)
            if endpoint is None:
                continue
            if kind is EndpointKind.PUBLISHER and topic == CLOCK[0] and self._is_silent:
                endpoint = dataclasses.replace(endpoint, silent=True)
            yield endpoint
        self._named = frozenset(known)

    def _hashed(
        self,
        name: str,
        shown: Iterable[ObservedEndpoint],
        but: DeclaredNames,
        queried: dict[str, _Service],
    ) -> Iterable[ObservedEndpoint]:
        """Return what is judged of one node's endpoints; `queried` are services asked for so far.

        The graph lists services by name and type only; their requests and replies are DDS topics
        like all others, `rq/NAMERequest` and `rr/NAMEReply`, whose endpoints announce the hashes.
        """
        hashed: list[ObservedEndpoint] = []
        ignores = self._stale_node_filter.ignores
        for each in without_noise(shown, but=but, ours=self._ours):
            if each.kind not in (EndpointKind.SERVICE_SERVER, EndpointKind.SERVICE_CLIENT):
                hashed.append(each)
                continue
            if each.name not in queried:
                queried[each.name] = _Service.of(self.node, each.name)
            service = queried[each.name]
            type_hash = service.hash_of(each)
            hashed += (
                dataclasses.replace(each, type_hash=type_hash, gid=gid)
                for gid in service.servers_of(each, ignores)
            )
        folded = fold_actions(hashed)
        return sorted(folded if name else self._located(folded), key=_order)

    def _services_of_others(
        self, names: DeclaredNames, unreported: Collection[str]
    ) -> Iterator[ObservedEndpoint]:
        """Yield the endpoints of declared services on nodes that rcl does not show.

        A node that is about to be known has them too; a plain DDS program never is one, and no rcl
        shows a node whose name it would not give.
        """
        services = [
            *names.of_kind(EndpointKind.SERVICE_SERVER),
            *(
                f"{action}/_action/{part}"
                for action in names.of_kind(EndpointKind.ACTION_SERVER)
                for part in ("send_goal", "cancel_goal", "get_result")
            ),
        ]
        for service in services:
            found = _Service.of(self.node, service)
            for kind, sides in (
                (EndpointKind.SERVICE_SERVER, found.servers),
                (EndpointKind.SERVICE_CLIENT, found.clients),
            ):
                shown: set[str] = set()
                for info in itertools.chain(*sides):
                    node, prefix = known_node(info.node), info.gid[:_PREFIX_DIGITS]
                    if node not in unreported or prefix in shown:
                        continue
                    if self._stale_node_filter.ignores(info.gid):
                        continue
                    shown.add(prefix)
                    yield ObservedEndpoint(
                        kind=kind,
                        node=node,
                        name=service,
                        type=_service_type(info.type),
                        gid=info.gid,
                    )

    def _located(self, endpoints: Iterable[ObservedEndpoint]) -> Iterator[ObservedEndpoint]:
        """Add their participants' addresses to endpoints of no known node.

        One whose address is not known is asked for it: it answers within a moment, and the next
        look has it.
        """
        known = self.settling.addresses()
        for endpoint in endpoints:
            prefix = endpoint.gid[:_PREFIX_DIGITS]
            if not prefix:
                yield endpoint
                continue
            since_s = self._nameless_since_s.setdefault(prefix, time.monotonic())
            is_coming = time.monotonic() - since_s < _NAMED_S
            if prefix not in known and prefix not in self._asked_for and not is_coming:
                self._asked_for.add(prefix)
                self.settling.ask()
            yield dataclasses.replace(endpoint, address=known.get(prefix, ""))

    def _services(self, full_name: str) -> _Listed | None:
        """Return the services and clients of a node; None if rcl does not show them."""
        if full_name in self._stale_node_filter.ghosts:
            return self._services_by_topic(full_name)
        found = []
        for kind in (EndpointKind.SERVICE_SERVER, EndpointKind.SERVICE_CLIENT):
            listed = endpoints_of_node(self.node, kind, full_name)
            if listed is None:
                return None
            found.append((kind, listed))
        return tuple(found)

    def _services_by_topic(self, full_name: str) -> _Listed:
        """Return what `_services` does of a node whose name a stale one has, too.

        rcl takes the first of a name: its services would be those of a node that is gone.
        """
        servers, clients = EndpointKind.SUBSCRIPTION, EndpointKind.PUBLISHER
        sides = ((EndpointKind.SERVICE_SERVER, servers), (EndpointKind.SERVICE_CLIENT, clients))
        topics = [name for name, _ in self.node.get_topic_names_and_types(no_demangle=True)]
        requests = sorted(each for each in topics if _REQUEST.fullmatch(each))
        found: dict[EndpointKind, list[tuple[str, str]]] = {kind: [] for kind, _ in sides}
        for topic in requests:
            for kind, side in sides:
                types = {
                    _service_type(each.type)
                    for each in endpoints_of(self.node, side, topic, no_mangle=True)
                    if each.node == full_name and not self._stale_node_filter.ignores(each.gid)
                }
                service = topic.removeprefix("rq").removesuffix("Request")
                found[kind] += [(service, each) for each in sorted(types)]
        return tuple((kind, tuple(found[kind])) for kind, _ in sides)

    def _services_of(self, full_name: str) -> tuple[ObservedEndpoint, ...] | None:
        """Return the service endpoints of a node; None if rcl does not show them."""
        listed = self._services(full_name)
        if listed is None:
            return None
        return tuple(
            ObservedEndpoint(kind=kind, node=full_name, name=service, type=type_)
            for kind, services in listed
            for service, type_ in services
        )


def _observing_node(domain_id: int, settings: ParticipantSettings) -> tuple[rclpy.Context, Node]:
    """Return a new context and its node; raises MiddlewareError if no participant can be made."""
    served = is_served(settings.urls, os.environ)
    chosen = observer_settings(settings, super_client=served)
    with _as_super_client():
        return quiet_node(f"_lifecycle_observer_{os.getpid()}", "/", domain_id, settings=chosen)


_SUPER_CLIENT_VARIABLE = "ROS_SUPER_CLIENT"


@contextlib.contextmanager
def _as_super_client() -> Iterator[None]:
    """Have a participant that is a client of the user's discovery server receive everything.

    A client is announced what matches its own endpoints, and nothing else. Fast DDS 2.14 looks at
    the variable when a participant is made.
    """
    if not os.environ.get(DISCOVERY_SERVER_VARIABLE) or _SUPER_CLIENT_VARIABLE in os.environ:
        yield
        return
    os.environ[_SUPER_CLIENT_VARIABLE] = "TRUE"
    try:
        yield
    finally:
        del os.environ[_SUPER_CLIENT_VARIABLE]


def _topic_endpoint(
    kind: EndpointKind,
    topic: str,
    info: EndpointInfo,
    declared: Collection[str],
    names: DeclaredNames,
) -> ObservedEndpoint | None:
    """Return a publisher or subscription; None if it is the housekeeping of a client library.

    One on a topic of DDS that no ROS name has is shown if it is a node's; of plain DDS programs
    only what has the names of ROS concerns a system of ROS.
    """
    node = known_node(info.node)
    if topic.startswith(RAW):
        if not node:
            return None
        package, _, base = info.type.replace("::dds_::", "::").replace("::", "/").rpartition("/")
        type_ = f"{package}/{base.removesuffix('_')}" if package else base
    else:
        type_ = info.type
        wanted = node not in declared and names.looks_for(kind, topic)
        if not wanted and is_noise_endpoint(kind, node, topic, type_, ours=False):
            return None
    return ObservedEndpoint(
        kind=kind,
        node=node,
        name=topic,
        type=type_,
        qos=info.qos,
        gid=info.gid,
        type_hash=info.type_hash,
    )


def _managed(node: str, services: Iterable[ObservedEndpoint]) -> bool:
    """Return whether a node offers the services by which a managed node is driven."""
    offered = {
        (each.name, each.type) for each in services if each.kind is EndpointKind.SERVICE_SERVER
    }
    return {(f"{node}/change_state", _CHANGE_STATE), (f"{node}/get_state", _GET_STATE)} <= offered


def _service_type(dds_type: str) -> str:
    """Return `std_srvs/srv/Trigger` for `std_srvs::srv::dds_::Trigger_Request_`."""
    package, _, name = dds_type.replace("::dds_::", "::").replace("::", "/").rpartition("/")
    return f"{package}/{name.removesuffix('_Request_').removesuffix('_Response_')}"


def _order(endpoint: ObservedEndpoint) -> tuple[str, ...]:
    return (endpoint.node, endpoint.kind.value, endpoint.name, endpoint.type, endpoint.gid)
