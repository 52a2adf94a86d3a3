"""Types of a graph's state: node views, what changes about them, ends and links.

Whether two are matched is judged as `lifecycle.verify` judges it (`verify/rules/matching.py`).
Pure.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence

import msgspec

from lifecycle.graph.status import NodeStatus
from lifecycle.manifest.model import EndpointKind
from lifecycle.network.medium import NETWORK_MEDIA
from lifecycle.network.nfe import FlowTuple, flow_tuples
from lifecycle.verify.network_flows import NONE, carrier
from lifecycle.verify.observation import EndpointReport, Identity, NodeConfiguration
from lifecycle.verify.outcome import ConnectionReport, Outcome
from lifecycle.verify.rules.matching import match, obstacle
from lifecycle.verify.view import SeenEndpoint


class NodeView(msgspec.Struct, frozen=True, kw_only=True):
    """A node as it is known now.

    Attributes:
        name: fully qualified.
        status: what it said last of itself; None if it sends no statuses.
        silent: why it is not reached although it sent statuses; empty if it is.
        configuration: as it was read or given last; None until then.
    """

    name: str
    status: NodeStatus | None = None
    silent: str = ""
    configuration: NodeConfiguration | None = None

    @property
    def state(self) -> str | None:
        """lifecycle_msgs/State label, empty for a node that is not managed; None while unknown."""
        said = self.status or self.configuration
        return None if said is None else said.state

    @property
    def connected(self) -> bool | None:
        """Its data layer is made; None while unknown."""
        said = self.status or self.configuration
        return None if said is None else said.connected

    @property
    def endpoints(self) -> tuple[EndpointReport, ...]:
        """Its endpoints; none while its configuration is not known."""
        return () if self.configuration is None else self.configuration.endpoints

    @property
    def connections(self) -> tuple[ConnectionReport, ...]:
        """Its connections; none while its configuration is not known."""
        return () if self.configuration is None else self.configuration.connections


class GraphChange(msgspec.Struct, frozen=True, kw_only=True):
    """What is different about one node.

    Attributes:
        before: the node before; None if it joined, or was restarted.
        after: the node now; None if it left.
        reason: why it left, for people.
    """

    before: NodeView | None
    after: NodeView | None
    reason: str = ""

    @property
    def node(self) -> str:
        """Fully qualified name of the node."""
        view = self.after or self.before
        assert view is not None
        return view.name

    @property
    def status_changed(self) -> bool:
        """It says something else of itself."""
        before, after = (view and view.status for view in (self.before, self.after))
        return before != after

    def endpoints(self) -> Iterator[tuple[EndpointReport | None, EndpointReport | None]]:
        """Yield each endpoint that is different, as it was and as it is; None: it was, is not."""
        before, after = (view.endpoints if view else () for view in (self.before, self.after))
        if before == after:
            return
        old, new = _by_key(before), _by_key(after)
        for key in {**old, **new}:
            if old.get(key) != new.get(key):
                yield old.get(key), new.get(key)


_Key = tuple[EndpointKind, str, str, str]


def _by_key(endpoints: Iterable[EndpointReport]) -> dict[tuple[_Key, int], EndpointReport]:
    """Return endpoints by kind, resolved name, type and declared name; equal ones are numbered."""
    found: dict[tuple[_Key, int], EndpointReport] = {}
    numbers: Counter[_Key] = Counter()
    for each in endpoints:
        key = (each.kind, each.resolved, each.type, each.name)
        found[key, numbers[key]] = each
        numbers[key] += 1
    return found


class End(msgspec.Struct, frozen=True, kw_only=True):
    """An endpoint and the node that has it."""

    node: NodeView
    endpoint: EndpointReport


class Link(msgspec.Struct, frozen=True, kw_only=True):
    """A publisher and a subscription of one topic.

    Attributes:
        topic: the name by which they meet.
        connected: OK: data can go from one to the other; VIOLATED: they cannot; UNVERIFIABLE:
            that is not known.
        reason: why it is not OK; empty if it is.
        transport: what carries the data: "intraprocess", "shm", "udpv4", "udpv6", "tcpv4", "tcpv6";
            "none" if the two have nothing in common, "unknown" where that is not known.
        flows: the network flows that the data can take; empty if no network carries them.
    """

    topic: str
    publisher: End
    subscription: End
    connected: Outcome
    reason: str
    transport: str
    flows: tuple[FlowTuple, ...] = ()


def links(topic: str, publishers: Sequence[End], subscriptions: Sequence[End]) -> Iterator[Link]:
    """Judge each pair of all publishers and subscriptions of a topic."""
    ends = {id(each): _seen(each) for each in (*publishers, *subscriptions)}
    # DDS forgets a silent one in time.
    sources = [ends[id(each)] for each in publishers if not each.node.silent]
    targets = [ends[id(each)] for each in subscriptions if not each.node.silent]
    for one, other in itertools.product(publishers, subscriptions):
        nfes = one.endpoint.nfes or (), other.endpoint.nfes or ()
        transport = carrier(*nfes, _identity(one), _identity(other))
        source, target = ends[id(one)], ends[id(other)]
        connected = Outcome.VIOLATED
        reason = _missing(one) or _missing(other) or obstacle(source, target)
        if not reason and transport == NONE:
            reason = "they have no transport in common"
        if not reason:
            connected, reason = match(source, target, sources, targets) or (
                Outcome.UNVERIFIABLE,
                "neither end reports whom it is matched with",
            )
        yield Link(
            topic=topic,
            publisher=one,
            subscription=other,
            connected=connected,
            reason=reason,
            transport=transport,
            flows=flow_tuples(*nfes) if transport in NETWORK_MEDIA else (),
        )


def _seen(end: End) -> SeenEndpoint:
    """Return an end as the rules of matching take it; the state holds no tools."""
    endpoint = end.endpoint
    return SeenEndpoint(
        kind=endpoint.kind,
        node=end.node.name,
        name=endpoint.resolved,
        type=endpoint.type,
        qos=endpoint.qos,
        report=endpoint,
    )


def _missing(end: End) -> str:
    """Return why an end cannot be connected at all; empty if it can."""
    if end.node.silent:
        return f"{end.node.name} is silent"
    if end.endpoint.error:
        return f"{end.node.name}: {end.endpoint.error}"
    if not end.endpoint.mapped and not end.endpoint.gid:
        return f"{end.node.name} has not mapped it onto a connection"
    return ""


def _identity(end: End) -> Identity | None:
    said = end.node.configuration
    return said.identity if said is not None and said.identity.machine_id else None
