"""Connections and mappings of nodes: those that each must have, has, and still lacks.

Owns: `Instructions`, and `steps`, the difference of two in the order in which it is made, so that
the first wiring, a change and what was lost are one case; what nodes must have by the plan, or by a
negotiation (`NegotiatedSource`): which nodes take part, on which host each is, and how the outcome
reaches nodes and the verifier; and `expected_by_onlooker`: the same for an observer that decides
nothing. The rules of negotiation are lifecycle.plan's. Pure.

What the authority of such a system decided is in no manifest, but negotiation is a pure function:
the same node configurations always result in the same data layer graph, but for ports and groups
that were given out earlier, and those are in the nodes' reports.
"""

from __future__ import annotations

import functools
from collections.abc import Collection, Iterator, Mapping

import msgspec
from msgspec.structs import replace

from lifecycle.manifest.diagnostics import Position
from lifecycle.manifest.model import Authority, DataLayerSource, EndpointPolicy
from lifecycle.network.connection_url import parse
from lifecycle.network.medium import CONNECTABLE, FAST_DDS, RMW_DEFAULT
from lifecycle.node.host.control import Command, Operation
from lifecycle.plan.discovery import Hosts, contacts_of, ports_of
from lifecycle.plan.media import (
    DataLayerGraph,
    NegotiatedConnection,
    Party,
    party_of_node,
    terms_of,
    transports_of,
    wishes_of,
)
from lifecycle.plan.model import (
    ParticipantConnections,
    Plan,
    PlannedEndpoint,
    PlannedNode,
    PlannedParticipant,
)
from lifecycle.plan.negotiate import negotiate
from lifecycle.plan.wiring import participant_name, with_graph
from lifecycle.verify.observation import EndpointReport, NodeConfiguration, Observation
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.catalogue import NOT_WIRED, node_of
from lifecycle.verify.verdict import Finding


class Instructions(msgspec.Struct, frozen=True, kw_only=True):
    """What one node must have, or what it has.

    Attributes:
        node: fully qualified name.
        connections: (name, how it is connected), in the order in which they are made.
        mappings: (endpoint as `publishers/video`, name of its connection); an empty name is the
            node's own participant.
    """

    node: str
    connections: tuple[tuple[str, ParticipantConnections], ...] = ()
    mappings: tuple[tuple[str, str], ...] = ()


def planned_instructions(node: PlannedNode) -> Instructions:
    """Return what the plan instructs a node to do.

    A participant that is no connection, made only to distinguish a publisher's flow, is the
    node's own to make: for its publisher, the node's own participant is named in its place.
    """
    named = {each.name: each for each in node.participants if each.connection}
    return Instructions(
        node=node.full_name,
        connections=tuple((each.connection, each.connections) for each in named.values()),
        mappings=tuple(
            (
                each.kind.spell(each.name),
                named[each.participant].connection if each.participant in named else "",
            )
            for each in node.endpoints
        ),
    )


def by_plan(plan: Plan) -> Mapping[str, Instructions]:
    """Return what the plan instructs each managed node to do, by full name."""
    return {each.full_name: planned_instructions(each) for each in plan.nodes if each.managed}


def wired(configuration: NodeConfiguration) -> Instructions:
    """Return what a node says that it has; what it could not make it has not."""
    return Instructions(
        node=configuration.name,
        connections=tuple(
            (each.name, ParticipantConnections(urls=each.urls))
            for each in configuration.connections
            if each.name and not each.error
        ),
        mappings=tuple(
            (each.kind.spell(each.name or each.resolved), each.connection)
            for each in configuration.endpoints
            if each.mapped
        ),
    )


def steps(
    wanted: Instructions, has: Instructions, *, ours: Collection[str] = ()
) -> tuple[Command, ...]:
    """Return what is missing, in the order in which it is made: make before break.

    A connection whose URLs differ cannot be had twice under one name: it alone is broken first.
    `ours`: names of connections that this authority made; others are not its to break.
    """
    step = functools.partial(Command, node=wanted.node)
    connections, mappings = dict(has.connections), dict(has.mappings)
    made: list[Command] = []
    stale: set[str] = set()
    for name, how in wanted.connections:
        if name in connections:
            if connections[name].urls == how.urls:
                continue
            stale.add(name)
            made.append(step(operation=Operation.DISCONNECT_FROM, connection=name))
        made.append(step(operation=Operation.CONNECT_TO, connection=name, connections=how))
    for endpoint, name in wanted.mappings:
        if name in stale or mappings.get(endpoint) != name:
            made.append(step(operation=Operation.MAP_TO, connection=name, endpoint=endpoint))
    needed = {name for name, _ in wanted.connections}
    made += [
        step(operation=Operation.DISCONNECT_FROM, connection=name)
        for name in connections
        if name in ours and name not in needed
    ]
    return tuple(made)


def not_wired(subject: str, message: str) -> Finding:
    """Return the finding that a node, or the system, could not be wired."""
    return NOT_WIRED.finding(
        outcome=Outcome.VIOLATED,
        subject=subject,
        expected="wired",
        observed="not wired",
        message=message,
        node=node_of(subject),
    )


# Negotiation


def party_of(
    configuration: NodeConfiguration,
    host: str,
    *,
    planned: PlannedNode | None = None,
    negotiated: Collection[str] = (),
) -> Party:
    """Return a node as a party, from its node configuration.

    What `planned` asks for an endpoint wins over the node's own hints. Endpoints that were made in
    code take part under their resolved names.

    Args:
        configuration: as the node reports it.
        host: its host, see `lifecycle.plan.discovery`.
        planned: the node as the manifest declares it; None if it does not.
        negotiated: names of connections that a negotiation made before: it may unmake them. Others
            are not its own, and what is mapped onto them stays there.
    """
    known = configuration.rmw.startswith(FAST_DDS)
    own_urls = planned.connections.urls if planned else ()
    own = next((each for each in configuration.connections if not each.name), None)
    if own is not None and own.urls:
        own_urls = own.urls
    default = (planned.transports if planned else ()) or RMW_DEFAULT
    base = configuration.name.rpartition("/")[2]
    there = tuple(
        PlannedParticipant(
            name=participant_name(base, each.name),
            dscp=None,
            reason="",
            connection=each.name,
            connections=ParticipantConnections(urls=each.urls),
        )
        for each in configuration.connections
        if each.name and each.name not in {*negotiated}
    )
    return Party(
        key=planned.key if planned else configuration.name,
        host=host,
        process=str(configuration.identity.process_id),
        transports=(configuration.transports or CONNECTABLE) if known else (),
        own=(transports_of(own_urls) or default) if known else (),
        connectable=known,
        endpoints=tuple(
            _endpoint(each, planned, {one.connection: one.name for one in there})
            for each in configuration.endpoints
            if each.kind.is_topic
        ),
        participants=(*there, *(planned.participants if planned else ())),
        contacts=contacts_of(host, own_urls),
    )


def _endpoint(
    report: EndpointReport, planned: PlannedNode | None, there: Mapping[str, str]
) -> PlannedEndpoint:
    """Return an endpoint where its node reports it; `there`: participants, by connection."""
    endpoint = next(
        (
            each
            for each in (planned.endpoints if planned else ())
            if (each.kind, each.name) == (report.kind, report.name)
        ),
        None,
    )
    if endpoint is None:
        endpoint = replace(_made_in_code(report, _NOWHERE), unique=report.unique)
    size = endpoint.max_message_size
    return replace(
        endpoint,
        resolved=report.resolved or endpoint.resolved,
        lossy=report.lossy if endpoint.lossy is None else endpoint.lossy,
        max_message_size=report.size_bytes if size is None else size,
        participant=there.get(report.connection, endpoint.participant),
    )


_NOWHERE = Position(file="", line=1, column=1)


def _made_in_code(report: EndpointReport, at: Position) -> PlannedEndpoint:
    """Return an endpoint that no interface declares, as its node reports it."""
    return PlannedEndpoint(
        kind=report.kind,
        name=report.name or report.resolved,
        resolved=report.resolved,
        type=report.type,
        qos=report.qos,
        lossy=report.lossy,
        max_message_size=report.size_bytes,
        at=at,
    )


_RMW = "RMW_IMPLEMENTATION"


class NegotiatedSource:
    """Negotiates the data layer graph from node configurations, again whenever one changes.

    A planned node that has not reported yet takes part with what its manifest declares. A node
    that is not declared takes part where `policy.undeclared_nodes` is open.

    Args:
        plan: what is declared.
        before: what was negotiated already.

    Attributes:
        graph: what was negotiated last.
        expected: the plan as it must be seen now: with what was negotiated, and with the endpoints
            that nodes made in code and may make.
        problems: pairs of declared nodes that nothing can connect, in whole sentences.
    """

    def __init__(self, plan: Plan, *, before: DataLayerGraph | None = None) -> None:
        self._take(plan)
        self._terms = terms_of(plan)
        self.graph = DataLayerGraph() if before is None else before
        self._judged: frozenset[tuple[str, str]] | None = None
        self._instructions: Mapping[str, Instructions] = {}
        self.expected = plan
        self.problems: tuple[str, ...] = ()

    def instructions(self, known: Mapping[str, NodeConfiguration]) -> Mapping[str, Instructions]:
        """Return what each node must have, by full name, given what nodes report."""
        if self._plan.policy.undeclared_nodes is not EndpointPolicy.OPEN:
            known = {name: each for name, each in known.items() if name in self._planned}
        seen = frozenset((each.name, each.checksum) for each in known.values())
        if seen == self._judged:
            return self._instructions
        self._judged = seen
        parties = [self._party(node, known.get(node.full_name)) for node in self._plan.nodes]
        # Which host a machine id means is learnt from the planned nodes; another is one of its own.
        hosts = {
            each.identity.machine_id: self._hosts.host(self._planned[name].machine)
            for name, each in known.items()
            if name in self._planned
        }
        unplanned = [each for name, each in known.items() if name not in self._planned]
        parties += [
            party_of(
                each,
                hosts.get(machine := each.identity.machine_id, f"unknown host {machine}"),
                negotiated=self._negotiated(each.name),
            )
            for each in unplanned
        ]
        graph = negotiate(parties, self._wishes, self._terms, before=self.graph)
        before, self.graph = self.graph, graph
        # What concerns an undeclared node is left out: the system does without it.
        keys = {each.key for each in self._plan.nodes}
        self.problems = tuple(
            f"{each.why.message}; {each.why.hint}" if each.why.hint else each.why.message
            for each in graph.problems
            if {each.flow.publisher, each.flow.subscription} <= keys
        )
        self.expected = _with_flows(with_graph(self._grown(known), graph), graph)
        instructions = dict(by_plan(self.expected))
        for each in unplanned:
            instructions[each.name] = _unplanned_instructions(each, graph, before)
        self._instructions = instructions
        return instructions

    def replan(self, plan: Plan, names: Collection[str]) -> None:
        """Negotiate again for nodes that are started again, new or gone, on other TCP ports.

        Fast DDS would not find them where they were (see lifecycle.plan.restart).
        """
        keys = {self._planned[name].key for name in names if name in self._planned}
        taken = {host: set(ports) for host, ports in self._terms.taken.items()}
        hosts = {each.key: self._hosts.host(each.machine) for each in self._plan.nodes}
        for each in self.graph.connections:
            if each.node in keys:
                urls = (parse(text) for text in each.urls)
                tcp = (url for url in urls if url.transport.is_tcp)
                taken.setdefault(hosts[each.node], set()).update(ports_of(tcp))
        for host, ports in terms_of(plan).taken.items():
            taken.setdefault(host, set()).update(ports)
        self._terms = replace(self._terms, taken=taken)
        self.graph = replace(
            self.graph,
            connections=tuple(each for each in self.graph.connections if each.node not in keys),
        )
        self._judged = None
        self._take(plan)

    def _take(self, plan: Plan) -> None:
        self._plan = plan
        self._planned = {each.full_name: each for each in plan.nodes}
        self._hosts = Hosts.of(plan)
        self._wishes = wishes_of(plan.flows)
        self._rmw = {
            key: dict(process.environment).get(_RMW, plan.rmw)
            for process in plan.processes
            for key in process.nodes
        }

    def _party(self, node: PlannedNode, configuration: NodeConfiguration | None) -> Party:
        if configuration is None:
            return party_of_node(node, self._hosts, rmw=self._rmw.get(node.key, self._plan.rmw))
        return party_of(
            configuration,
            self._hosts.host(node.machine),
            planned=node,
            negotiated=self._negotiated(node.key),
        )

    def _negotiated(self, key: str) -> frozenset[str]:
        return frozenset(each.name for each in self.graph.connections if each.node == key)

    def _grown(self, known: Mapping[str, NodeConfiguration]) -> Plan:
        """The plan with the endpoints that its nodes made in code, where they may."""
        return replace(
            self._plan,
            nodes=tuple(
                _with_made(node, known[node.full_name])
                if node.full_name in known and node.endpoint_policy is EndpointPolicy.OPEN
                else node
                for node in self._plan.nodes
            ),
        )


def _with_made(node: PlannedNode, configuration: NodeConfiguration) -> PlannedNode:
    declared = {(each.kind, each.name) for each in node.endpoints}
    resolved = {(each.kind, each.resolved) for each in node.endpoints}
    made = tuple(
        _made_in_code(each, node.at)
        for each in configuration.endpoints
        if (each.kind, each.name) not in declared
        and (each.name or (each.kind, each.resolved) not in resolved)
    )
    return replace(node, endpoints=(*node.endpoints, *made))


def _with_flows(plan: Plan, graph: DataLayerGraph) -> Plan:
    keys = {each.key for each in plan.nodes}
    there = {(each.topic, each.publisher, each.subscription) for each in plan.flows}
    more = {
        place: each
        for each in graph.flows
        if (place := (each.topic, each.publisher, each.subscription)) not in there
        and {each.publisher, each.subscription} <= keys
    }
    return replace(plan, flows=(*plan.flows, *more.values()))


def _unplanned_instructions(
    configuration: NodeConfiguration, graph: DataLayerGraph, before: DataLayerGraph
) -> Instructions:
    """Instruct an undeclared node in what concerns the system, and leave the rest to it."""
    name = configuration.name
    mine = [each for each in graph.connections if each.node == name]
    mapped = {label: each.name for each in mine for label in each.map}
    gone = {each.name for each in before.connections if each.node == name} - {
        each.name for each in mine
    }
    for each in configuration.endpoints:
        label = each.kind.spell(each.name or each.resolved)
        if label not in mapped and each.connection in gone and each.connection:
            mapped[label] = ""
    return Instructions(
        node=name,
        connections=tuple((each.name, ParticipantConnections(urls=each.urls)) for each in mine),
        mappings=tuple(mapped.items()),
    )


def is_negotiated(plan: Plan) -> bool:
    """Whether a plan's connections are decided from what its nodes report while they run."""
    layer = plan.data_layer
    return layer.authority is Authority.SUPERVISOR and layer.source is DataLayerSource.DYNAMIC


def expected_by_onlooker(plan: Plan, observation: Observation) -> tuple[Plan, tuple[Finding, ...]]:
    """Return the plan as an outside observer must see it, and declared pairs nothing can connect.

    It negotiates again from what was seen: it begins with all reported connections, and each round
    leaves out those that no negotiation would have made, as another client called connect_to; an
    endpoint on one of these stays there, is mapped wrongly, and may make another superfluous. The
    URLs of one that fits are not judged: only its authority knows which ports it gave out.
    """
    if not is_negotiated(plan):
        return plan, ()
    known = {each.name: each for each in observation.configurations}
    before = DataLayerGraph(connections=tuple(_reported(plan, known)))
    while True:
        source = NegotiatedSource(plan, before=before)
        source.instructions(known)
        made = {(each.node, each.name) for each in source.graph.connections}
        stays = tuple(each for each in before.connections if (each.node, each.name) in made)
        if stays == before.connections:
            break
        before = DataLayerGraph(connections=stays)
    return source.expected, tuple(not_wired(plan.system, each) for each in source.problems)


def _reported(plan: Plan, known: Mapping[str, NodeConfiguration]) -> Iterator[NegotiatedConnection]:
    """Yield the connections that nodes have and no manifest declares."""
    planned = {each.full_name: each for each in plan.nodes}
    for name, configuration in known.items():
        node = planned.get(name)
        declared = {each.connection for each in node.participants} if node else set()
        for each in configuration.connections:
            if each.name and not each.error and each.name not in declared:
                yield NegotiatedConnection(
                    node=node.key if node else name,
                    name=each.name,
                    urls=each.urls,
                    map=tuple(sorted(each.mappings)),
                    reason="",
                )
