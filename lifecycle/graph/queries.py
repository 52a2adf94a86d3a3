"""What may be asked of the state of the graph.

Owns: the queries; a query costs work in proportion to its answer. How the state is kept true is
state.py's.

Threads: may be asked from any thread, and an answer does not change afterwards.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from lifecycle.graph.endpoints import Owned
from lifecycle.graph.events import GraphEvents
from lifecycle.graph.links import End, Link, link, match_ends
from lifecycle.graph.record import Record
from lifecycle.graph.running import Running, up_and_running
from lifecycle.graph.view import NodeView
from lifecycle.manifest.model import EndpointKind
from lifecycle.plan.model import Plan
from lifecycle.verify.observation import ConnectionReport


class GraphQueries:
    """The queries of one graph; `GraphState` is one that follows events.

    Args:
        events: layer 2; it has the index of endpoints.
    """

    def __init__(self, events: GraphEvents) -> None:
        self.events = events
        self._lock = threading.RLock()
        self._records: dict[str, Record] = {}

    def nodes(self) -> tuple[NodeView, ...]:
        """Return every node of the graph, silent ones included, by name."""
        with self._lock:
            views = [each.view for each in self._records.values()]
        return tuple(sorted(views, key=lambda each: each.name))

    def node(self, name: str) -> NodeView | None:
        """Return what is known of a node (fully qualified); None if it is not in the graph."""
        with self._lock:
            record = self._records.get(name)
            return None if record is None else record.view

    def connections_of(self, node: str) -> tuple[ConnectionReport, ...]:
        """Return the connections of a node; none if it is not known."""
        view = self.node(node)
        return () if view is None else view.connections

    def publishers_of(self, topic: str) -> tuple[End, ...]:
        """Return who publishes a topic (fully qualified), aliases included."""
        return self.endpoints(EndpointKind.PUBLISHER, topic)

    def subscriptions_of(self, topic: str) -> tuple[End, ...]:
        """Return who subscribes to a topic."""
        return self.endpoints(EndpointKind.SUBSCRIPTION, topic)

    def servers_of(self, service: str) -> tuple[End, ...]:
        """Return who offers a service."""
        return self.endpoints(EndpointKind.SERVICE_SERVER, service)

    def clients_of(self, service: str) -> tuple[End, ...]:
        """Return who uses a service."""
        return self.endpoints(EndpointKind.SERVICE_CLIENT, service)

    def endpoints(self, kind: EndpointKind, name: str) -> tuple[End, ...]:
        """Return the endpoints of a kind and name (fully qualified), by node name."""
        with self.events.lock:
            owned = self.events.endpoints.named(kind, name)
        return self._ends(owned)

    def topics(self) -> tuple[str, ...]:
        """Return every topic that somebody publishes or subscribes to, sorted."""
        with self.events.lock:
            names = {
                *self.events.endpoints.names(EndpointKind.PUBLISHER),
                *self.events.endpoints.names(EndpointKind.SUBSCRIPTION),
            }
        return tuple(sorted(names))

    def connected(self, topic: str, publisher: str, subscription: str) -> tuple[Link, ...]:
        """Return how two nodes are connected by a topic.

        Args:
            topic: fully qualified.
            publisher: fully qualified name of the publishing node.
            subscription: of the subscribing node.

        Returns:
            One link for each pair of their endpoints, usually one; none if either has no endpoint.
        """
        return self._links(
            topic,
            lambda end: end.node.name == publisher,
            lambda end: end.node.name == subscription,
        )

    def flows(self, topic: str | None = None) -> tuple[Link, ...]:
        """Return every publisher → subscription pair, connected or not, of one topic or of all."""
        topics = self.topics() if topic is None else (topic,)
        return tuple(each for name in topics for each in self._links(name, _any, _any))

    def is_up_and_running(self, plan: Plan) -> Running:
        """Tell whether every node of `plan` is there, active, mapped and connected.

        Three-valued, with what is missing. It proves less than the gate does: undeclared nodes,
        uniqueness and QoS are `lifecycle.verify`'s.
        """
        return up_and_running(plan, self.node, self.connected)

    def _links(
        self, topic: str, publishes: Callable[[End], bool], subscribes: Callable[[End], bool]
    ) -> tuple[Link, ...]:
        publishers, subscriptions = self.publishers_of(topic), self.subscriptions_of(topic)
        publishing, subscribing = match_ends(publishers), match_ends(subscriptions)
        return tuple(
            link(
                topic,
                publisher,
                subscription,
                publishers=publishing,
                subscriptions=subscribing,
            )
            for publisher in publishers
            if publishes(publisher)
            for subscription in subscriptions
            if subscribes(subscription)
        )

    def _ends(self, owned: tuple[Owned, ...]) -> tuple[End, ...]:
        found: list[End] = []
        for each in owned:
            view = self.node(each.node)
            if view is not None:
                found.append(End(node=view, endpoint=each.endpoint))
        return tuple(sorted(found, key=lambda each: each.node.name))


def _any(_: End) -> bool:
    return True
