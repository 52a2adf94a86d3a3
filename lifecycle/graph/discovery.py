"""Nodes that send no graph messages, as DDS discovery shows them.

Owns: which of discovery's nodes are told of as members, and what is taken for their configuration:
their endpoints by name and type, without QoS, GIDs or matches. Nodes that report for themselves are
left alone: they know better. A look costs as much as there are names in the graph and endpoints on
the nodes that do not report; it is taken when the graph changed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

from lifecycle_msgs.msg import TransitionEvent
from rclpy.node import Node
from rclpy.subscription import Subscription

from lifecycle.graph.asking import Asker
from lifecycle.graph.events import GraphEvents
from lifecycle.graph.scheduler import Remove
from lifecycle.manifest.model import EndpointKind
from lifecycle.middleware.rcl.graph_queries import endpoints_of_node
from lifecycle.middleware.rcl.stale_node_filter import StaleNodeFilter
from lifecycle.verify.noise import fold_actions, is_noise_node, known_node, without_noise
from lifecycle.verify.observation import (
    EndpointReport,
    Identity,
    NodeConfiguration,
    ObservedEndpoint,
)

_TOGETHER_S = 0.05
"""Changes of the graph come in bursts; one look is enough for all that come within so long."""

_EVENT_DEPTH = 10
_KINDS = (
    EndpointKind.PUBLISHER,
    EndpointKind.SUBSCRIPTION,
    EndpointKind.SERVICE_SERVER,
    EndpointKind.SERVICE_CLIENT,
)
_MANAGED = frozenset({"change_state", "get_state"})


@dataclasses.dataclass(slots=True)
class _Foreign:
    """A node that sends no messages."""

    endpoints: tuple[ObservedEndpoint, ...] = ()
    beside: tuple[tuple[str, tuple[ObservedEndpoint, ...]], ...] = ()
    services: frozenset[str] = frozenset()
    state: str = ""
    transitions: Subscription | None = None


class Discovery:
    """Looks at the graph when told to; to be used in the scheduler.

    Args:
        node: through which to look.
        events: told of who appears and who is gone.
        asker: for the states and configurations of nodes that serve them.
        reread: called with a node whose configuration is another one now.
    """

    def __init__(
        self, node: Node, events: GraphEvents, asker: Asker, reread: Callable[[str], None]
    ) -> None:
        self._node = node
        self._stale_node_filter = StaleNodeFilter(node)
        self._events = events
        self._asker = asker
        self._reread = reread
        self._names: frozenset[str] = frozenset()
        self._foreign: dict[str, _Foreign] = {}
        self._due: Remove | None = None
        self._closed = False

    def changed(self) -> None:
        """Look soon, once for all changes of a burst."""
        if self._due is None and not self._closed:
            scheduler = self._events.scheduler
            self._due = scheduler.call_at(scheduler.now_s() + _TOGETHER_S, self.look)

    def look(self) -> None:
        """Compare who is there with who was, and tell."""
        self._due = None
        if self._closed:
            return
        everybody = tuple(self._stale_node_filter.count())
        names = frozenset(filter(_counts, everybody))
        hidden = sorted(each for each in everybody if each.rpartition("/")[2].startswith("_"))
        reporting = {each.node for each in self._events.members() if each.incarnation}
        for name in names - self._names - reporting:
            self._foreign[name] = _Foreign()
            self._events.report_seen(name)
        for name in self._names - names:
            self._events.report_gone(name, "discovery does not show it any more")
            self._asker.forget(name)
        for name in tuple(self._foreign):
            if name in reporting or name not in names:
                self._drop(name)
            else:
                self._compare(name, hidden)
        self._names = names

    def fetch(self, name: str, done: Callable[[NodeConfiguration | None], None]) -> None:
        """Give the configuration of a node: its own if it serves one, else what is seen of it.

        Who sends messages serves one, even if the next look has yet to show it: messages and
        services come by different ways.
        """
        foreign = self._foreign.get(name)
        if foreign is None or "get_configuration" in foreign.services or self._events.reports(name):
            self._asker.get_configuration(name, done)
        else:
            done(_seen_configuration(name, foreign))

    def close(self) -> None:
        """Look no more; again is harmless."""
        self._closed = True
        if self._due is not None:
            self._due()
        for name in tuple(self._foreign):
            self._drop(name)

    def _compare(self, name: str, hidden: Sequence[str]) -> None:
        foreign = self._foreign[name]
        found = self._endpoints(name)
        services = frozenset(
            each.name.rpartition("/")[2]
            for each in found
            if each.kind is EndpointKind.SERVICE_SERVER and each.name.startswith(f"{name}/")
        )
        endpoints = fold_actions(without_noise(found))
        beside: tuple[tuple[str, tuple[ObservedEndpoint, ...]], ...] = ()
        if "get_configuration" in services:
            # Of its connections only the participants can be seen; it knows what they mean.
            space, _, base = name.rpartition("/")
            own = f"{space}/_{base}_"
            beside = tuple(
                (one, tuple(self._endpoints(one))) for one in hidden if one.startswith(own)
            )
        now = (endpoints, services, beside)
        if now == (foreign.endpoints, foreign.services, foreign.beside):
            return
        foreign.endpoints, foreign.services, foreign.beside = now
        if services >= _MANAGED and foreign.transitions is None:
            self._follow(name, foreign)
        self._reread(name)

    def _follow(self, name: str, foreign: _Foreign) -> None:
        """Learn the state of a managed node that tells it by its own topic only."""

        def learn(state: str | None) -> None:
            if state is not None and self._foreign.get(name) is foreign and state != foreign.state:
                foreign.state = state
                self._reread(name)

        def moved(event: TransitionEvent) -> None:
            # In the executor's thread.
            self._events.scheduler.post(lambda: learn(event.goal_state.label))

        foreign.transitions = self._node.create_subscription(
            TransitionEvent, f"{name}/transition_event", moved, _EVENT_DEPTH
        )
        self._asker.get_state(name, learn)

    def _drop(self, name: str) -> None:
        foreign = self._foreign.pop(name)
        if foreign.transitions is not None:
            self._node.destroy_subscription(foreign.transitions)

    def _endpoints(self, full_name: str) -> list[ObservedEndpoint]:
        """Return what a node has by name and type; nothing once it left, or of an illegal name."""
        return [
            ObservedEndpoint(kind=kind, node=full_name, name=topic, type=type_)
            for kind in _KINDS
            for topic, type_ in endpoints_of_node(self._node, kind, full_name) or ()
        ]


def _counts(name: str) -> bool:
    """Tell whether a node is part of a system: no tool's, no hidden one, and its name is known."""
    hidden = name.rpartition("/")[2].startswith("_")
    return bool(known_node(name)) and not hidden and not is_noise_node(name)


def _seen_configuration(name: str, foreign: _Foreign) -> NodeConfiguration:
    return NodeConfiguration(
        identity=Identity(machine_id="", process_id=0, node_id=""),
        name=name,
        state=foreign.state,
        connected=True,
        rmw="",
        transports=(),
        serializations=(),
        paradigms=(),
        endpoints=tuple(
            EndpointReport(kind=each.kind, name="", resolved=each.name, type=each.type, mapped=True)
            for each in foreign.endpoints
        ),
    )
