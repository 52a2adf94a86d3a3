"""ROS graph observer: snapshots of nodes and endpoints as discovery shows them, without polling.

Entities that tools add are left out by `lifecycle.verify.tool_filter`. A node is there while an
endpoint is its own: rmw_dds_common may keep the names of nodes that have left.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import threading
import time
import typing
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import rclpy
from msgspec.structs import replace
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.subscription import Subscription

from lifecycle.manifest.model import EndpointKind
from lifecycle.middleware.fastdds.discovery import is_served, reach, settle_s
from lifecycle.middleware.fastdds.factory import observer_settings
from lifecycle.middleware.fastdds.participant import quiet_node
from lifecycle.middleware.fastdds.prober import Settling
from lifecycle.middleware.fastdds.profiles import (
    DISCOVERY_SERVER_VARIABLE,
    ParticipantSettings,
)
from lifecycle.middleware.fastdds.sockets import give_up_dead_connections
from lifecycle.middleware.process.process_table import (
    PROCESS_DIGITS,
    is_of_host,
    is_of_process,
    is_vouched_for,
)
from lifecycle.middleware.rcl.graph_queries import (
    OF_SERVICES,
    OVER_DDS,
    RAW,
    GraphGuard,
    endpoints_in,
    endpoints_of,
    endpoints_of_node,
    nameless_repliers,
    prefix_of,
    rmw_topics,
    services_of_node,
    topic_names,
    unreadable,
    with_reply,
)
from lifecycle.plan.model import ParticipantConnections
from lifecycle.verify.observation import ObservedEndpoint, ObservedNode
from lifecycle.verify.tool_filter import (
    CLOCK,
    NO_NAMES,
    PREFIX_DIGITS,
    DeclaredNames,
    fold_actions,
    our_nodes,
)

if TYPE_CHECKING:  # nodes ask what is in the graph as well, and capture nothing
    from lifecycle.export.programs import CapturedProgram

_PARAMETER_EVENTS = "/parameter_events"
"""rclcpp and rclpy give every node one publisher of it."""

_NAMED_S = 0.2
"""Of a new participant endpoints are known first, and within so long of which nodes they are."""
_CHANGE_STATE = "lifecycle_msgs/srv/ChangeState"
_GET_STATE = "lifecycle_msgs/srv/GetState"

Snapshot = tuple[tuple[ObservedNode, ...], tuple[ObservedEndpoint, ...]]


_COUNTED_S = 2.0
"""Others may find that a lease has ended so much later than this observer, and say so."""


@typing.final
class GraphObserver:
    """What discovery shows of the graph of one domain, to a hidden node of its own.

    Make it before starting what it is to see. `destroy` it, or use it in a `with`. Every method may
    be called from any thread.

    Args:
        domain_id: 0–232.
        connections: how it is connected; as a client of a discovery server it is a super client, to
            which everything is announced.
        node: looked through instead of a hidden one, see `on`.

    Attributes:
        urls: of its connections; none where the RMW chooses.
        settling: for how long the last `snapshot` may miss a participant.
        departed: publishers and subscriptions of ended processes that the last one left out.
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
        settings = ParticipantSettings(connections=connections or ParticipantConnections())
        self.urls = settings.urls
        self.owns_node = node is None
        self._lock = threading.Lock()
        self._destroyed = False
        self._ours: frozenset[str] = frozenset()
        self._asked_at_s: dict[str, float] = {}  # by prefix of a participant without a node
        self._clock: Subscription[Any] | None = None
        self._time_came = False
        self._context: rclpy.Context | None = None
        if node is None:
            name = f"_lifecycle_observer_{os.getpid()}"
            chosen = observer_settings(settings, super_client=is_served(self.urls, os.environ))
            with _as_super_client():
                self._context, node = quiet_node(name, "/", domain_id, settings=chosen)
            reached = reach(domain_id, self.urls, os.environ) if OVER_DDS else ()
            self.settling = Settling(reached, settle_s(self.urls, os.environ))
        else:
            self.settling = Settling(())
        self.node = node
        self._guard = GraphGuard.of(node)
        self._unwatch = self._guard.follow(node, lambda: None)  # it runs while one follows
        self._name = self.node.get_fully_qualified_name()
        self.departed: tuple[ObservedEndpoint, ...] = ()
        self._departed_s: dict[ObservedEndpoint, float] = {}  # when each was last shown
        self._dead: frozenset[str] = frozenset()
        self._topics_before: frozenset[str] = frozenset()

    @classmethod
    def on(cls, node: Node) -> GraphObserver:
        """Look through a node that others spin, and destroy after this.

        Nobody can be asked here: for the first 3.5 s a snapshot may miss some (`settling`).

        Raises:
            MiddlewareError: rcl's graph guard condition could not be waited on.
        """
        return cls(node.context.get_domain_id(), node=node)

    def on_change(self, callback: Callable[[], None]) -> Callable[[], None]:
        """Have `callback` called in the guard's thread after each change of the graph.

        It must be quick and must not destroy the observer. Returns what takes it away again.
        """
        return self._guard.follow(self.node, callback)

    def snapshot(self, *, names: DeclaredNames = NO_NAMES) -> Snapshot:
        """Return the nodes and the endpoints that discovery shows now, in a stable order.

        All but its own node, of which there is only what has one of these `names`. The housekeeping
        of client libraries is left out.

        Args:
            names: of topics, services and actions that are looked for: a node that offers one of
                them and is not declared is shown, whatever it looks like.

        Raises:
            MiddlewareError: the graph is no longer watched, or cannot be read.
        """
        if self._guard.failure is not None:
            raise self._guard.failure
        if names.simulated and self.owns_node:
            self._watch_clock()
        with self._lock:
            return self._look(names)

    def _look(self, names: DeclaredNames) -> Snapshot:
        topics, illegible = topic_names(self.node, self._topics_before | _declared_topics(names))
        shown: dict[str, list[ObservedEndpoint]] = {}
        if illegible:
            shown[""] = [unreadable(EndpointKind.PUBLISHER, illegible)]
        else:
            self._topics_before = frozenset(topics)
        homes: dict[str, Counter[str]] = {}
        for each in self._living(self._endpoints(topics, names)):
            if each.node:
                has_events = (each.kind, each.name) == (EndpointKind.PUBLISHER, _PARAMETER_EVENTS)
                homes.setdefault(each.node, Counter())[each.gid[:PREFIX_DIGITS]] += has_events
            # Of plain DDS programs only what has the names of ROS concerns a system of ROS; of what
            # is about to have a node, services that are looked for.
            if each.kind in OF_SERVICES:
                is_kept = bool(each.node) or names.has(each.kind, each.name)
            elif each.name.startswith(RAW):
                is_kept = bool(each.node)
            else:
                is_kept = names.keeps(each, each.node, ours=False)
            if is_kept:
                shown.setdefault(each.node, []).append(self._timed(each))
        for name in () if OVER_DDS else homes:
            shown.setdefault(name, []).extend(services_of_node(self.node, name))
        named = frozenset(itertools.chain.from_iterable(homes.values()))
        self.settling.saw(named, self.prefix)
        # A participant may have several nodes of one name.
        counts = {name: sum(max(1, each) for each in on.values()) for name, on in homes.items()}
        if self.owns_node and counts.get(self._name) == 1:
            # Others match what a supervisor offers under names that are looked for, and measures.
            del counts[self._name]
            shown[self._name] = [
                each
                for each in shown.pop(self._name, ())
                if each.kind not in OF_SERVICES
                and (names.fed_by(each.kind, each.name) or names.has(each.kind, each.name))
            ]
        nodes = (
            ObservedNode(full_name=name, count=count, managed=_managed(name, shown.get(name, ())))
            for name, count in sorted(counts.items())
        )
        # One that leaves, endpoint by endpoint, stays ours.
        self._ours = self._ours.intersection(shown).union(*map(our_nodes, shown.values()))
        endpoints: list[ObservedEndpoint] = []
        for name in sorted(shown):
            judged = tuple(
                each
                for each in shown[name]
                if names.keeps(each, each.node, ours=each.node in self._ours)
            )
            folded = fold_actions(self._hashed(judged))
            endpoints += sorted(folded if name else self._located(folded), key=_order)
        return tuple(nodes), tuple(endpoints)

    def _endpoints(self, topics: Iterable[str], names: DeclaredNames) -> Iterator[ObservedEndpoint]:
        """Yield the endpoints of topics; of services a nameless participant's ends once."""
        nameless: set[tuple[EndpointKind, str, str]] = set()
        replying = nameless_repliers(self.node, topics, names.has)
        for each in itertools.chain(endpoints_in(self.node, topics), replying):
            if each.kind in OF_SERVICES and not each.node:
                end = (each.kind, each.name, each.gid[:PREFIX_DIGITS])
                if end in nameless:
                    continue
                nameless.add(end)
            yield each

    def _living(self, endpoints: Iterable[ObservedEndpoint]) -> list[ObservedEndpoint]:
        """Return the endpoints whose processes have not ended; note the topics' ends of others."""
        living: list[ObservedEndpoint] = []
        departed: list[ObservedEndpoint] = []
        for each in endpoints:
            (departed if self._is_dead(each) else living).append(each)
        now_s = time.monotonic()
        self._departed_s |= {each: now_s for each in departed if each.kind.is_topic}
        self._departed_s = {
            each: at_s for each, at_s in self._departed_s.items() if now_s - at_s < _COUNTED_S
        }
        self.departed = tuple(sorted(self._departed_s, key=_order))
        return living

    @property
    def prefix(self) -> str:
        """GUID prefix of its own participant, 24 hex digits; empty where that is not known."""
        return prefix_of(self.node)

    def hosted(self, nodes: Iterable[str]) -> dict[str, bool]:
        """Return which of the nodes of this machine are in hosts of ours, see `prefixes`."""
        homes, own = self._homes(), self.prefix
        found = {}
        for name in nodes:
            here = [each for each in homes.get(name, ()) if is_of_host(each, own)]
            if here:
                found[name] = all(map(is_vouched_for, here))
        return found

    def offers(self, node: str, service: str) -> bool:
        """Return whether discovery shows `service` (a fully qualified name) on `node`."""
        return service in self.services_of(node) or any(
            each.node == node
            for each in endpoints_of(self.node, EndpointKind.SERVICE_SERVER, service)
        )

    def serves(self, service: str) -> bool:
        """Return whether a process that has not ended offers a service (fully qualified name)."""
        if not OVER_DDS:
            return bool(self.node.count_services(service))
        offered = endpoints_of(self.node, EndpointKind.SERVICE_SERVER, service)
        return not all(map(self._is_dead, offered))

    def services_of(self, node: str) -> frozenset[str]:
        """Return the fully qualified names of the services that discovery shows on `node`."""
        listed = endpoints_of_node(self.node, EndpointKind.SERVICE_SERVER, node)
        return frozenset(name for name, _ in listed or ())

    def ended(self, pid: int, *, nodes: Iterable[str], reported: Iterable[str]) -> None:
        """Count the participants of a process no more, although discovery shows them still.

        Args:
            pid: of a process on this host that has ended.
            nodes: fully qualified names of nodes that it ran.
            reported: GUID prefixes that these nodes said are theirs. Of both only those count that
                bear this host and this pid.
        """
        if self._destroyed:
            return
        homes, own = self._homes(), self.prefix
        claimed = {*reported, *(prefix for name in nodes for prefix in homes.get(name, ()))}
        self._count_no_more(each for each in claimed if is_of_process(each, pid, own))

    def ended_participant(self, prefix: str) -> None:
        """Count participants of an ended process no more, by the GUID prefix of one of them."""
        self._count_no_more((prefix,))

    def _count_no_more(self, prefixes: Iterable[str]) -> None:
        ended = {each[:PROCESS_DIGITS] for each in prefixes} - {self.prefix[:PROCESS_DIGITS]}
        if not ended <= self._dead:
            self._dead |= ended
            self._guard.notify()

    def _is_dead(self, endpoint: ObservedEndpoint) -> bool:
        return endpoint.gid[:PROCESS_DIGITS] in self._dead

    def _homes(self) -> dict[str, set[str]]:
        """Return by full name the prefixes of the participants that nodes are on."""
        homes: dict[str, set[str]] = {}
        for each in endpoints_of(self.node, EndpointKind.PUBLISHER, _PARAMETER_EVENTS):
            if each.node and not self._is_dead(each):
                homes.setdefault(each.node, set()).add(each.gid[:PREFIX_DIGITS])
        return homes

    def programs(self, environment: Mapping[str, str]) -> dict[str, dict[str, CapturedProgram]]:
        """Return how the processes of this host's nodes were started, by node and GUID prefix.

        Variables that differ from `environment` are reported.
        """
        from lifecycle.middleware.process.process_table import programs_of

        homes, own = self._homes(), self.prefix
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

    def _watch_clock(self) -> None:
        """Receive /clock until time has come once."""
        from rosgraph_msgs.msg import Clock

        if self._clock is None:
            self._clock = self.node.create_subscription(
                Clock, CLOCK[0], self._take_time, qos_profile_sensor_data
            )

    def _take_time(self, _: object) -> None:
        if not self._time_came:
            self._time_came = True
            self.node.destroy_subscription(self._clock)
            self._guard.notify()

    def _timed(self, endpoint: ObservedEndpoint) -> ObservedEndpoint:
        """Say of who publishes /clock that no time came from it, while that is so."""
        publishes = (endpoint.kind, endpoint.name) == (EndpointKind.PUBLISHER, CLOCK[0])
        if publishes and self._clock is not None and not self._time_came:
            return replace(endpoint, silent=True)
        return endpoint

    def _hashed(self, endpoints: Iterable[ObservedEndpoint]) -> Iterator[ObservedEndpoint]:
        """Yield one node's endpoints, its services with their hashes."""
        requests: dict[tuple[EndpointKind, str, str], list[ObservedEndpoint]] = {}
        for each in endpoints:
            if OVER_DDS and each.kind in OF_SERVICES:
                requests.setdefault((each.kind, each.name, each.type), []).append(each)
            else:
                yield each
        for found in requests.values():
            yield from with_reply(self.node, found)

    def _located(self, endpoints: Iterable[ObservedEndpoint]) -> Iterator[ObservedEndpoint]:
        """Add their participants' addresses to endpoints of no known node, as far as they answered.

        Others are asked, and the next look has it.
        """
        known, now_s = self.settling.prober.answers(), time.monotonic()
        for endpoint in endpoints:
            prefix = endpoint.gid[:PREFIX_DIGITS]
            asked_at_s = self._asked_at_s.setdefault(prefix, now_s + _NAMED_S)
            if prefix and prefix not in known and now_s >= asked_at_s:
                self._asked_at_s[prefix] = math.inf
                self.settling.prober.ask()
            yield replace(endpoint, address=known.get(prefix, ""))


_SUPER_CLIENT_VARIABLE = "ROS_SUPER_CLIENT"


@contextlib.contextmanager
def _as_super_client() -> Iterator[None]:
    """Have a client of the user's discovery server receive all, not what matches its endpoints.

    Fast DDS 2.14 looks at the variable when a participant is made.
    """
    if not os.environ.get(DISCOVERY_SERVER_VARIABLE) or _SUPER_CLIENT_VARIABLE in os.environ:
        yield
        return
    os.environ[_SUPER_CLIENT_VARIABLE] = "TRUE"
    try:
        yield
    finally:
        del os.environ[_SUPER_CLIENT_VARIABLE]


def _declared_topics(names: DeclaredNames) -> set[str]:
    """Return what the RMW calls the topics and services that are looked for."""
    services = {
        *names.of_kind(EndpointKind.SERVICE_SERVER),
        *(
            f"{action}/_action/{part}"
            for action in names.of_kind(EndpointKind.ACTION_SERVER)
            for part in ("send_goal", "cancel_goal", "get_result")
        ),
        *(f"{node}/{base}" for node in names.nodes for base in ("change_state", "get_state")),
    }
    return rmw_topics((_PARAMETER_EVENTS, *names.of_kind(EndpointKind.PUBLISHER)), services)


def _managed(node: str, endpoints: Iterable[ObservedEndpoint]) -> bool:
    """Return whether a node offers the services by which a managed node is driven."""
    offered = {
        (each.name, each.type) for each in endpoints if each.kind is EndpointKind.SERVICE_SERVER
    }
    return {(f"{node}/change_state", _CHANGE_STATE), (f"{node}/get_state", _GET_STATE)} <= offered


def _order(endpoint: ObservedEndpoint) -> tuple[str, ...]:
    return (endpoint.node, endpoint.kind.value, endpoint.name, endpoint.type, endpoint.gid)
