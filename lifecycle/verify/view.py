"""The view that every verification rule reads: declared beside observed endpoints and flows.

Owns: the types of the view and the one way to combine announced and reported QoS. `matcher.lay_out`
fills it, anew for each verdict. Pure.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping

import msgspec
from msgspec.structs import replace

from lifecycle.manifest.diagnostics import Position
from lifecycle.manifest.model import EndpointKind, RunKind
from lifecycle.manifest.qos import QosProfile
from lifecycle.measure.clock import ClockOffset
from lifecycle.measure.sample import Measured
from lifecycle.network.medium import Medium
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.plan.model import (
    ParticipantConnections,
    Plan,
    PlannedEndpoint,
    PlannedFlow,
    PlannedNode,
    PlannedParticipant,
)
from lifecycle.verify.network_flows import Uniqueness
from lifecycle.verify.observation import (
    EndpointReport,
    NodeConfiguration,
    NodeParameters,
    ObservedEndpoint,
    ObservedNode,
)
from lifecycle.verify.tool_filter import DeclaredNames
from lifecycle.verify.verdict import Stage


class Whose(enum.Enum):
    """Whose an endpoint is."""

    DECLARED = "declared"
    UNDECLARED = "a declared node's, and no declaration covers it"
    TWIN = "a second node's of a declared name, or one of the two"
    FOREIGN = "a node's that is not declared, and no tool"
    TOOL = "a tool's that the policy tolerates"
    UNKNOWN = "a node's that is not known"
    DEPARTED = "a process's that has ended: others may count it as a peer until its lease ends"


class SeenEndpoint(msgspec.Struct, frozen=True, kw_only=True):
    """An endpoint of the graph, declared or not: what others can match with.

    Attributes:
        node: fully qualified name of the node it belongs to, hidden participants resolved to
            their node; empty while unknown.
        type: as discovery shows it, else as it is declared.
        qos: as announced or reported; None where neither is known.
        whose: whose it is.
        observed: what discovery shows; None if it does not show the endpoint.
        report: what its node says; None if it says nothing.
        planned: its declaration; None if there is none.
        type_hash: as `ObservedEndpoint` has it; as its node reports it where discovery does not.
    """

    kind: EndpointKind
    node: str
    name: str
    type: str
    qos: QosProfile | None
    whose: Whose = Whose.DECLARED
    observed: ObservedEndpoint | None = None
    report: EndpointReport | None = None
    planned: PlannedEndpoint | None = None
    type_hash: str | None = None

    @property
    def is_shown(self) -> bool:
        """Whether discovery or its node shows it; else it is known from its declaration alone."""
        return self.observed is not None or self.report is not None

    @property
    def is_passing(self) -> bool:
        """Whether it is a tool's, or has ended: no rule is about it."""
        return self.whose in (Whose.TOOL, Whose.DEPARTED)

    @property
    def where(self) -> str:
        """How messages name it: `the publisher of /video in /camera`."""
        return f"the {self.kind.noun} of {self.name} in {self.node or 'an unknown node'}"

    @classmethod
    def of(cls, endpoint: ObservedEndpoint, whose: Whose) -> SeenEndpoint:
        """Return one that is not declared."""
        return SeenEndpoint(
            kind=endpoint.kind,
            node=endpoint.node,
            name=endpoint.name,
            type=endpoint.type,
            qos=endpoint.qos,
            whose=whose,
            observed=endpoint,
            type_hash=endpoint.type_hash,
        )


class Actual(SeenEndpoint, frozen=True, kw_only=True):
    """A declared endpoint and what was seen of it.

    Attributes:
        owner: the node it belongs to.
        unseen: discovery cannot be expected to show it to this observer; `observed` is what its
            node says then.
        beyond: its whole node is out of this observer's reach, and so is its report.
    """

    owner: PlannedNode
    planned: PlannedEndpoint
    unseen: bool = False
    beyond: bool = False

    @property
    def at(self) -> Position:
        """Where it is declared."""
        return self.planned.at


class NodeFacts(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """A declared node and all that is known of it.

    Attributes:
        observed: its name in the graph; None if it is not there.
        configuration: what it reports; None if it reports nothing.
        parameters: what its parameter services returned; None if they were not asked.
        actual: its declared endpoints.
        absent: nothing at all is seen of it: then one finding says it all.
    """

    node: PlannedNode
    observed: ObservedNode | None
    configuration: NodeConfiguration | None
    parameters: NodeParameters | None
    actual: tuple[Actual, ...]
    absent: bool

    @property
    def name(self) -> str:
        """Fully qualified."""
        return self.node.full_name

    @property
    def is_ours(self) -> bool:
        """Whether it runs in our host, and so must report its configuration."""
        return self.node.run.kind is RunKind.PYTHON


def flow_subject(topic: str, publisher: str, subscription: str) -> str:
    """Return what findings call the flow on `topic` from one node to another."""
    return f"{topic}: {publisher} → {subscription}"


class FlowView(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """A planned flow and what was seen of its two ends.

    Attributes:
        publisher: fully qualified name of the publishing node.
        subscription: fully qualified name of the subscribing node.
        writer: the declared publisher; None where the node that a link names declares none.
        reader: the declared subscription, likewise.
        nodes: what is known of the two nodes.
    """

    planned: PlannedFlow
    publisher: str
    subscription: str
    writer: Actual | None
    reader: Actual | None
    nodes: tuple[NodeFacts, NodeFacts]

    @property
    def subject(self) -> str:
        """What findings call this flow."""
        return flow_subject(self.planned.topic, self.publisher, self.subscription)

    @property
    def where(self) -> str:
        """How messages name it."""
        return f"the flow {self.publisher} → {self.subscription} on {self.planned.topic}"

    @property
    def ends(self) -> tuple[str, str]:
        """Fully qualified names of the two nodes."""
        return self.publisher, self.subscription

    @property
    def endpoints(self) -> tuple[Actual, ...]:
        """The declared publisher and subscription."""
        return tuple(each for each in (self.writer, self.reader) if each is not None)

    @property
    def at(self) -> Position | None:
        """Where its subscription is declared, else its publisher."""
        end = self.reader or self.writer
        return None if end is None else end.at

    @property
    def requirement(self) -> tuple[UniqueRequirement, UniqueRequirement]:
        """What each end requires."""
        none = UniqueRequirement.NOT_REQUIRED
        return (
            self.writer.planned.unique if self.writer else none,
            self.reader.planned.unique if self.reader else none,
        )

    @property
    def five_qi(self) -> int | None:
        """The planned 5QI; None if none is."""
        return self.writer.planned.five_qi if self.writer else None


TopicEnds = tuple[list[SeenEndpoint], list[SeenEndpoint]]
"""Publishers and subscriptions of a topic."""


class View(msgspec.Struct, frozen=True, kw_only=True):
    """The input of every rule.

    Attributes:
        machines: names of the machines whose nodes the caller brings up; None: all.
        ahead: full names of the nodes that an earlier gate let through.
        over: how they ended, of the nodes whose process has ended as it may, by full name; empty
            where it may have.
        planned: nodes of the plan by full name, in plan order.
        names: what the plan declares, by name.
        observed: nodes of the graph by full name, tools and hidden participants left out, sorted.
        reported: every report, sorted by name.
        configurations: reports by full node name; the first of several.
        nodes: what is known of every declared node, by full name, in plan order.
        actual: every declared endpoint, in plan order.
        others: all other endpoints that are judged, sorted.
        topics: publishers and subscriptions by topic: declared ones that are seen or beyond reach,
            and others.
        tools: undeclared nodes that the policy tolerates, and the pattern that says so, sorted.
        flows: every planned flow, in plan order.
        uniqueness: which of the reported endpoints have a flow of their own.
        measured: what subscriptions of the observer have counted; None where it has none.
        active_s: for how long nodes are seen to be active that do not report it, by full name.
        clocks: of the hosts of other machines, by the machine's name, as far as they are known;
            None where that is not the question yet.
        marks: with what DSCP arrives what supervisors of other machines send, by the machine's name
            and the DSCP with which it is sent; None for what should have arrived, and did not.
    """

    plan: Plan
    stage: Stage
    machines: frozenset[str] | None
    ahead: frozenset[str]
    over: Mapping[str, str]
    planned: dict[str, PlannedNode]
    names: DeclaredNames
    observed: dict[str, ObservedNode]
    reported: tuple[NodeConfiguration, ...]
    configurations: dict[str, NodeConfiguration]
    nodes: dict[str, NodeFacts]
    actual: tuple[Actual, ...]
    others: tuple[SeenEndpoint, ...]
    topics: dict[str, TopicEnds]
    tools: dict[str, str]
    flows: tuple[FlowView, ...]
    uniqueness: Uniqueness
    measured: Measured | None
    active_s: Mapping[str, float]
    clocks: Mapping[str, ClockOffset] | None
    marks: Mapping[tuple[str, int], int | None]

    def of(self, *whose: Whose) -> list[SeenEndpoint]:
        """Return the endpoints of these that are not declared, sorted."""
        return [each for each in self.others if each.whose in whose]


def brings_up(node: PlannedNode, machines: frozenset[str] | None) -> bool:
    """Return whether a node is on one of the machines whose nodes the caller brings up."""
    return machines is None or node.machine in machines


def is_beyond(node: PlannedNode, machines: frozenset[str] | None) -> bool:
    """Return whether a node is out of reach: it uses the memory of a host that is not ours."""
    return not brings_up(node, machines) and only_shared_memory(node.connections)


def only_shared_memory(connections: ParticipantConnections) -> bool:
    """Return whether a participant is known to have nothing but shared memory."""
    scheme = f"{Medium.SHM}:"
    return bool(connections.urls) and all(url.startswith(scheme) for url in connections.urls)


def may_hide(node: PlannedNode, endpoint: PlannedEndpoint) -> bool:
    """Return whether discovery need not show an endpoint to an observer.

    That is so on every participant that was given connection URLs: it announces itself to its peers
    alone, or on a host or group that the observer is not part of; and with static endpoint
    discovery it announces no endpoint at all.
    """
    on = _participant_of(node, endpoint)
    connections = node.connections if on is None else on.connections
    return bool(connections.urls or connections.static_participants)


def connection_of(node: PlannedNode, endpoint: PlannedEndpoint) -> str:
    """Return the name of the connection that an endpoint is planned on; empty for none."""
    on = _participant_of(node, endpoint)
    return "" if on is None else on.connection


def _participant_of(node: PlannedNode, endpoint: PlannedEndpoint) -> PlannedParticipant | None:
    return next((each for each in node.participants if each.name == endpoint.participant), None)


def actual_qos(observed: QosProfile | None, reported: QosProfile | None) -> QosProfile | None:
    """Combine what discovery announces with what the node reports of itself.

    Discovery wins where it knows a policy: it is what the other side acts on. Fast DDS does not
    announce history and depth, so those come from the node.
    """
    if observed is None or reported is None:
        return observed or reported
    known: dict[str, object] = {
        policy: getattr(reported, policy)
        for policy in ("history", "reliability", "durability", "liveliness")
        if getattr(observed, policy).value == "UNKNOWN"
    }
    if "history" in known:
        known["depth"] = reported.depth
    return replace(observed, **known)
