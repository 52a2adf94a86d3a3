"""The view that every verification rule reads: declared beside observed endpoints and flows.

Owns: the types of the view and the one way to combine announced and reported QoS. `matcher.lay_out`
fills it. Its parts, `NodeFacts`, `TopicFacts` and `FlowView`, stay the same objects from one
judgement to the next while all that they are made of does, and what was found of them is taken over
(`Parts`). So a change costs work in proportion to what changed. Pure.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping
from typing import Any, Generic, TypeVar

from lifecycle import dataclasses
from lifecycle.manifest import (
    Durability,
    EndpointKind,
    History,
    Liveliness,
    Position,
    QosProfile,
    Reliability,
    RunKind,
)
from lifecycle.network import Medium, UniqueRequirement
from lifecycle.plan import ParticipantConnections, Plan, PlannedEndpoint, PlannedFlow, PlannedNode
from lifecycle.verify.observation import (
    EndpointReport,
    Identity,
    NodeConfiguration,
    NodeParameters,
    ObservedEndpoint,
    ObservedNode,
)
from lifecycle.verify.tool_filter import DeclaredNames, Owner
from lifecycle.verify.uniqueness import Uniqueness
from lifecycle.verify.verdict import Stage

UNKNOWN_QOS = QosProfile(
    history=History.UNKNOWN,
    depth=0,
    reliability=Reliability.UNKNOWN,
    durability=Durability.UNKNOWN,
    liveliness=Liveliness.UNKNOWN,
)
"""Nothing is known; compatible with nothing for certain."""

_BY_STRENGTH = (
    UniqueRequirement.STRICTLY_REQUIRED,
    UniqueRequirement.OPTIONALLY_REQUIRED,
    UniqueRequirement.SYSTEM_DEFAULT,
    UniqueRequirement.NOT_REQUIRED,
)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Actual:
    """A declared endpoint and what was seen of it.

    Attributes:
        observed: what discovery shows; None if it does not show the endpoint.
        report: what the node itself says; None if it says nothing of it.
        unseen: discovery cannot be expected to show it to this observer; `observed` is what its
            node says then.
        beyond: its whole node is out of this observer's reach, and so is its report.
    """

    node: PlannedNode
    planned: PlannedEndpoint
    observed: ObservedEndpoint | None
    report: EndpointReport | None
    unseen: bool = False
    beyond: bool = False


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class SeenEndpoint:
    """An endpoint of the graph, declared or not, with all that is known of it.

    Attributes:
        node: fully qualified name of the node it belongs to, hidden participants resolved to
            their node; empty while unknown.
        planned: its declaration; None if there is none.
        type_hash: as `ObservedEndpoint` has it.
    """

    kind: EndpointKind
    node: str
    name: str
    type: str
    qos: QosProfile | None
    report: EndpointReport | None
    planned: PlannedEndpoint | None
    type_hash: str | None = None


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """What a system is judged against, which stays while it is watched.

    Attributes:
        machines: names of the machines whose nodes the caller brings up; None: all.
        ahead: full names of the nodes that an earlier gate let through.
        over: how they ended, of the nodes whose process has ended as it may, by full name; empty
            where it may have.
        planned: nodes of the plan by full name, in plan order.
        order: their places in it.
        by_key: full names of nodes by their keys.
        addresses: see `declared_addresses`.
        names: what the plan declares, by name.
        declared: node, kind and name of every declared endpoint.
        found: see `once`.
    """

    plan: Plan
    stage: Stage
    machines: frozenset[str] | None
    ahead: frozenset[str]
    over: Mapping[str, str]
    planned: dict[str, PlannedNode]
    order: dict[str, int]
    by_key: dict[str, str]
    addresses: dict[str, str]
    names: DeclaredNames
    declared: frozenset[tuple[str, EndpointKind, str]]
    found: dict[Any, Any] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(
        cls,
        plan: Plan,
        stage: Stage,
        machines: frozenset[str] | None,
        ahead: frozenset[str],
        over: Mapping[str, str],
    ) -> Frame:
        """Collect what a plan declares."""
        planned = {node.full_name: node for node in plan.nodes}
        return cls(
            plan=plan,
            stage=stage,
            machines=machines,
            ahead=ahead,
            over=dict(over),
            planned=planned,
            order={name: place for place, name in enumerate(planned)},
            by_key={node.key: node.full_name for node in reversed(plan.nodes)},
            addresses=declared_addresses(plan),
            names=DeclaredNames.of(plan),
            declared=frozenset(
                (name, each.kind, each.resolved)
                for name, node in planned.items()
                for each in node.endpoints
            ),
        )

    def is_of(
        self,
        plan: Plan,
        stage: Stage,
        machines: frozenset[str] | None,
        ahead: frozenset[str],
        over: Mapping[str, str],
    ) -> bool:
        """Return whether these make the same frame: then what was found in it still holds."""
        return (
            self.plan is plan
            and self.stage is stage
            and self.machines == machines
            and self.ahead == ahead
            and self.over == over
        )

    def is_beyond(self, node: PlannedNode) -> bool:
        """Return whether a node is out of reach: it uses the memory of a host that is not ours."""
        return not self.brings_up(node) and only_shared_memory(node.connections)

    def ours(self, node: PlannedNode) -> bool:
        """Return whether a node runs in our host, and so must report its configuration."""
        return node.run.kind is RunKind.PYTHON

    def brings_up(self, node: PlannedNode) -> bool:
        """Return whether the caller brings this node up, and so knows the state it must be in."""
        return self.machines is None or node.machine in self.machines


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NodeFacts:
    """A declared node and all that is known of it.

    Attributes:
        observed: its name in the graph; None if it is not there.
        configuration: what it reports; None if it reports nothing.
        parameters: what its parameter services returned; None if they were not asked.
        endpoints: its endpoints that discovery shows, sorted.
        actual: its declared endpoints.
        ends: the same by kind and name.
        rest: endpoints that no declaration covers.
        seen: its publishers and subscriptions as far as discovery shows them, in the order of
            `endpoints`.
        beyond: its declared ones, if it is out of reach.
        unseen: those that only its report shows.
        absent: nothing at all is seen of it: then one finding says it all.
        may_hide: some of its declared endpoints need not be shown by discovery, and are not.
    """

    frame: Frame
    node: PlannedNode
    observed: ObservedNode | None
    configuration: NodeConfiguration | None
    parameters: NodeParameters | None
    endpoints: tuple[ObservedEndpoint, ...]
    actual: tuple[Actual, ...]
    ends: Mapping[tuple[EndpointKind, str], tuple[Actual, ...]]
    rest: tuple[ObservedEndpoint, ...]
    seen: tuple[SeenEndpoint, ...]
    beyond: tuple[SeenEndpoint, ...]
    unseen: tuple[SeenEndpoint, ...]
    absent: bool
    may_hide: bool

    @property
    def name(self) -> str:
        """Fully qualified."""
        return self.node.full_name


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TopicFacts:
    """All publishers and subscriptions of one topic.

    Attributes:
        ends: all but those of tools, in the order of `View.seen`.
        of_tools: those of tools.
        found: see `once`.
    """

    frame: Frame
    ends: tuple[SeenEndpoint, ...]
    of_tools: tuple[SeenEndpoint, ...]
    found: dict[Any, Any] = dataclasses.field(default_factory=dict)


_Part = TypeVar("_Part", Frame, TopicFacts, "FlowView")
_Found = TypeVar("_Found")


def once(part: _Part, work: Callable[[_Part], Iterable[_Found]]) -> tuple[_Found, ...]:
    """Return what `work` yields of a part of the view; it is done once in the life of the part.

    Args:
        part: frozen, so that what is found of it does not change.
        work: a function of a module that looks at nothing else.
    """
    found: tuple[_Found, ...] | None = part.found.get(work)
    if found is None:
        found = part.found[work] = tuple(work(part))
    return found


_Key = TypeVar("_Key", bound=Hashable)
_Of = TypeVar("_Of")


class Parts(Generic[_Key, _Of]):
    """The parts of a view of one kind by key, and what was found of each.

    Args:
        parts: all of them.
        order: of a key, by which they come.
        last: those of the last view in the same frame, from which is taken over what was found.
        changed: keys of those that are not the same object there, and of those that were there
            and are not here, if not more; without it they are compared.
    """

    def __init__(
        self,
        parts: Mapping[_Key, _Of],
        *,
        order: Callable[[_Key], Any],
        last: Parts[_Key, _Of] | None = None,
        changed: Collection[_Key] | None = None,
    ) -> None:
        self.parts = parts
        self.results: dict[object, tuple[object, dict[_Key, tuple[Any, ...]]]] = {}
        self.changed: frozenset[_Key] = frozenset()
        self._order = order
        self._before = last.results if last is not None else {}
        if last is not None and changed is None:
            before = last.parts
            keys = parts.keys() | before.keys()
            changed = [each for each in keys if parts.get(each) is not before.get(each)]
        if last is not None and changed is not None:
            self.changed = frozenset(changed)

    def found(
        self,
        work: Callable[[_Of], Iterable[_Found]],
        *,
        name: object = None,
        terms: object = None,
    ) -> Mapping[_Key, tuple[_Found, ...]]:
        """Return what `work` yields of each part, without those of which it yields nothing.

        Args:
            work: looks at nothing but the part and its frame, and `terms`.
            name: of the work, where it is not always the same function.
            terms: what else it looks at; what was found on the same object is taken over.
        """
        name = name or work
        if name not in self.results:
            asked, before = self._before.get(name, (None, None))
            keys: Iterable[_Key] = self.parts
            found: dict[_Key, tuple[_Found, ...]] = {}
            if before is not None and asked is terms:
                keys, changed = self.changed, self.changed
                found = {key: each for key, each in before.items() if key not in changed}
            for key in keys:
                part = self.parts.get(key)
                yielded = () if part is None else tuple(work(part))
                if yielded:
                    found[key] = yielded
            self.results[name] = terms, found
        return self.results[name][1]

    def each(
        self,
        work: Callable[[_Of], Iterable[_Found]],
        *,
        name: object = None,
        terms: object = None,
    ) -> Iterator[_Found]:
        """Yield what `work` yields of each part in turn; see `found`."""
        for _, yielded in self.items(work, name=name, terms=terms):
            yield from yielded

    def items(
        self,
        work: Callable[[_Of], Iterable[_Found]],
        *,
        name: object = None,
        terms: object = None,
    ) -> Iterator[tuple[_Key, tuple[_Found, ...]]]:
        """Yield with its key what `work` yields of each part in turn; see `found`."""
        found = self.found(work, name=name, terms=terms)
        for key in sorted(found, key=self._order):
            yield key, found[key]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FlowView:
    """A planned flow and what was seen of its two ends.

    Attributes:
        publisher: fully qualified name of the publishing node.
        subscription: fully qualified name of the subscribing node.
        publishers: the publishing node's declared publishers of the topic; usually one.
        subscriptions: likewise.
        at: the subscription's declaration, else the publisher's.
        nodes: what is known of the two nodes.
        ends_of_topic: what is seen of the topic; None if nothing is.
        found: see `once`.
    """

    planned: PlannedFlow
    publisher: str
    subscription: str
    publishers: tuple[Actual, ...]
    subscriptions: tuple[Actual, ...]
    at: Position | None
    nodes: tuple[NodeFacts, NodeFacts]
    ends_of_topic: TopicFacts | None
    found: dict[Any, Any] = dataclasses.field(default_factory=dict)

    @property
    def subject(self) -> str:
        """What findings call this flow."""
        return subject_of(self.planned.topic, self.publisher, self.subscription)

    @property
    def ends(self) -> tuple[str, str]:
        """Fully qualified names of the two nodes."""
        return self.publisher, self.subscription

    @property
    def requirement(self) -> tuple[UniqueRequirement, UniqueRequirement]:
        """The strongest requirement of each end: several endpoints of a node are one end."""
        return _strongest(self.publishers), _strongest(self.subscriptions)

    @property
    def five_qi(self) -> int | None:
        """The planned 5QI; None if none is, or several publishers differ."""
        declared = {end.planned.five_qi for end in self.publishers}
        return declared.pop() if len(declared) == 1 else None


def subject_of(topic: str, publisher: str, subscription: str) -> str:
    """Return what findings call a flow."""
    return f"{topic}: {publisher} → {subscription}"


def _strongest(ends: Iterable[Actual]) -> UniqueRequirement:
    asked = {end.planned.unique for end in ends} or {UniqueRequirement.NOT_REQUIRED}
    return next(each for each in _BY_STRENGTH if each in asked)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Attributed:
    """The endpoints that discovery shows under one node name, and what is judged of them.

    Attributes:
        shown: as discovery shows them.
        owner: whose they may be, if it is a hidden node of one that reports; None for its own.
        ours: that node reports its configuration.
        judged: without what client libraries bring along, by the node whose they are.
    """

    shown: tuple[ObservedEndpoint, ...]
    owner: Owner | None
    ours: bool
    judged: Mapping[str, tuple[ObservedEndpoint, ...]]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NodeEndpoints:
    """The endpoints of one node.

    Attributes:
        judged: of all node names that are this node's.
        endpoints: the same with the parts of actions folded, sorted.
        seen: publishers and subscriptions of a node that no plan declares.
    """

    judged: tuple[ObservedEndpoint, ...]
    endpoints: tuple[ObservedEndpoint, ...]
    seen: tuple[SeenEndpoint, ...]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """The input of every rule.

    Attributes:
        observed: nodes of the graph by full name, tools and hidden participants left out, sorted.
        reported: every report, sorted by name.
        configurations: reports by full node name; the first of several.
        parameters: what parameter services returned, by full node name.
        actual: every declared endpoint, in plan order.
        actual_by_node: the same by full node name.
        undeclared: endpoints of declared nodes that no declaration covers, sorted.
        unattributed: endpoints whose node is not known, sorted.
        foreign: endpoints of nodes that are not in the plan and no tools, sorted.
        tools: undeclared nodes that the policy tolerates, and the pattern that says so, sorted.
        of_tools: their endpoints, housekeeping left out, sorted.
        seen: every publisher and subscription of the graph, tools left out, sorted.
        flows: every planned flow, in plan order.
        uniqueness: which of the reported endpoints have a flow of their own.
        nodes: what is known of every declared node, by full name, in plan order.
        topics: what is seen of every topic.
        by_node: `nodes` with what was found of them, and `by_topic`; `by_flow`, by their index.
        attributed: the endpoints by the name of the node that discovery shows, as they are judged.
        groups: all endpoints that are judged by full node name, sorted by it.
    """

    frame: Frame
    observed: dict[str, ObservedNode]
    reported: tuple[NodeConfiguration, ...]
    configurations: dict[str, NodeConfiguration]
    parameters: dict[str, NodeParameters]
    actual: tuple[Actual, ...]
    actual_by_node: dict[str, tuple[Actual, ...]]
    undeclared: tuple[ObservedEndpoint, ...]
    unattributed: tuple[ObservedEndpoint, ...]
    foreign: tuple[ObservedEndpoint, ...]
    tools: dict[str, str]
    of_tools: tuple[ObservedEndpoint, ...]
    seen: tuple[SeenEndpoint, ...]
    flows: tuple[FlowView, ...]
    uniqueness: Uniqueness
    nodes: dict[str, NodeFacts]
    topics: dict[str, TopicFacts]
    by_node: Parts[str, NodeFacts]
    by_topic: Parts[str, TopicFacts]
    by_flow: Parts[int, FlowView]
    attributed: dict[str, Attributed]
    groups: dict[str, NodeEndpoints]

    @property
    def plan(self) -> Plan:
        """What the system is judged against."""
        return self.frame.plan

    @property
    def stage(self) -> Stage:
        """Which moment it is judged against."""
        return self.frame.stage

    @property
    def machines(self) -> frozenset[str] | None:
        """As `Frame` has them."""
        return self.frame.machines

    @property
    def ahead(self) -> frozenset[str]:
        """As `Frame` has them."""
        return self.frame.ahead

    @property
    def over(self) -> Mapping[str, str]:
        """As `Frame` has them."""
        return self.frame.over

    @property
    def planned(self) -> dict[str, PlannedNode]:
        """Nodes of the plan by full name, in plan order."""
        return self.frame.planned

    @property
    def names(self) -> DeclaredNames:
        """What the plan declares, by name."""
        return self.frame.names

    @property
    def seen_of_tools(self) -> tuple[SeenEndpoint, ...]:
        """Publishers and subscriptions of tools, which others may be matched with too."""
        return tuple(
            SeenEndpoint(
                kind=each.kind,
                node=each.node,
                name=each.name,
                type=each.type,
                qos=each.qos,
                report=None,
                planned=None,
            )
            for each in self.of_tools
            if each.kind.is_topic
        )

    def is_absent(self, node: PlannedNode) -> bool:
        """Return whether nothing at all is seen of a node: then one finding says it all."""
        return self.nodes[node.full_name].absent

    def is_beyond(self, node: PlannedNode) -> bool:
        """As `Frame.is_beyond`."""
        return self.frame.is_beyond(node)

    def ours(self, node: PlannedNode) -> bool:
        """As `Frame.ours`."""
        return self.frame.ours(node)

    def brings_up(self, node: PlannedNode) -> bool:
        """As `Frame.brings_up`."""
        return self.frame.brings_up(node)

    def identity(self, full_name: str) -> Identity | None:
        """Return the identity that a node reports; None if it reports none."""
        configuration = self.configurations.get(full_name)
        return configuration.identity if configuration else None


def declared_addresses(plan: Plan) -> dict[str, str]:
    """Return the declared address of each node's machine, by full node name, where there is one."""
    machines = {each.name: each.address for each in plan.machines if each.address}
    return {
        node.full_name: machines[node.machine] for node in plan.nodes if node.machine in machines
    }


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
    for each in node.participants:
        if each.name == endpoint.participant:
            return bool(each.connections.urls or each.connections.static_participants)
    return bool(node.connections.urls or node.connections.static_participants)


def connection_of(node: PlannedNode, endpoint: PlannedEndpoint) -> str:
    """Return the name of the connection that an endpoint is planned on; empty for none."""
    for each in node.participants:
        if each.name == endpoint.participant:
            return each.connection
    return ""


def actual_qos(observed: QosProfile | None, reported: QosProfile | None) -> QosProfile | None:
    """Combine what discovery announces with what the node reports of itself.

    Discovery wins where it knows a policy: it is what the other side acts on. Fast DDS does not
    announce history and depth, so those come from the node.
    """
    if observed is None or reported is None:
        return observed or reported
    keeps = observed.history is not History.UNKNOWN
    return QosProfile(
        history=observed.history if keeps else reported.history,
        depth=observed.depth if keeps else reported.depth,
        reliability=(
            reported.reliability
            if observed.reliability is Reliability.UNKNOWN
            else observed.reliability
        ),
        durability=(
            reported.durability
            if observed.durability is Durability.UNKNOWN
            else observed.durability
        ),
        deadline_ns=observed.deadline_ns,
        lifespan_ns=observed.lifespan_ns,
        liveliness=(
            reported.liveliness
            if observed.liveliness is Liveliness.UNKNOWN
            else observed.liveliness
        ),
        liveliness_lease_duration_ns=observed.liveliness_lease_duration_ns,
    )
