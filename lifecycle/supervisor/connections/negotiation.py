"""Instructions that are negotiated from what nodes report, and the plan that follows from them.

Owns: `NegotiatedSource`: which nodes take part, on which host each is, and how the outcome is told
to nodes and to the verifier. The rules of negotiation are lifecycle.plan's. Pure.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterable, Mapping

from lifecycle.manifest.model import EndpointKind, EndpointPolicy
from lifecycle.network.connection_url import ConnectionTransport, parse
from lifecycle.plan import (
    DataLayerGraph,
    NegotiationProblem,
    ParticipantConnections,
    Party,
    Plan,
    PlannedEndpoint,
    PlannedFlow,
    PlannedNode,
    hosts_of,
    negotiate,
    party_of_node,
    terms_of,
    wishes_of,
    with_graph,
)
from lifecycle.plan.connections.contacts import ports_of
from lifecycle.supervisor.connections.desired_state import Instructions, planned_instructions
from lifecycle.verify.observation import EndpointReport, NodeConfiguration
from lifecycle.verify.party import party_of

_RMW = "RMW_IMPLEMENTATION"


class NegotiatedSource:
    """Negotiates the data layer graph from node configurations, again whenever one changes.

    A planned node that has not reported yet takes part with what its manifest declares. A node
    that nobody declared takes part where `policy.undeclared_nodes` is open.

    Args:
        plan: what is declared.
        before: what was negotiated already; see renegotiation.py for who only looks on.

    Attributes:
        graph: what was negotiated last.
        expected: the plan as it must be seen now: with what was negotiated, and with the endpoints
            that nodes made in code and may make.
        problems: pairs of declared nodes that nothing can connect, in whole sentences.
    """

    def __init__(self, plan: Plan, *, before: DataLayerGraph | None = None) -> None:
        self._take(plan)
        self._hosts = hosts_of(plan)
        self._terms = terms_of(plan)
        self._wishes = wishes_of(plan.flows)
        self._rmw = {
            key: dict(process.environment).get(_RMW, plan.rmw)
            for process in plan.processes
            for key in process.nodes
        }
        self.graph = DataLayerGraph() if before is None else before
        self._heard: frozenset[tuple[str, str]] | None = None
        self._told: Mapping[str, Instructions] = {}
        self.expected = plan
        self.problems: tuple[str, ...] = ()

    def instructions(self, known: Mapping[str, NodeConfiguration]) -> Mapping[str, Instructions]:
        """Return what each node must have, by full name, given what nodes report."""
        known = {name: each for name, each in known.items() if self._takes_part(name)}
        heard = frozenset((each.name, each.checksum) for each in known.values())
        if heard == self._heard:
            return self._told
        self._heard = heard
        parties = [self._party(node, known.get(node.full_name)) for node in self._plan.nodes]
        places = self._places(known)
        guests = [each for name, each in known.items() if name not in self._planned]
        parties += [
            party_of(each, places(each), negotiated=self._negotiated(each.name)) for each in guests
        ]
        graph = negotiate(parties, self._wishes, self._terms, before=self.graph)
        before, self.graph = self.graph, graph
        self.problems = tuple(map(_words, self._declared(graph.problems)))
        self.expected = _with_flows(with_graph(self._grown(known), graph), graph)
        told = {
            node.full_name: planned_instructions(node)
            for node in self.expected.nodes
            if node.managed
        }
        for each in guests:
            told[each.name] = _guest_instructions(each, graph, before)
        self._told = told
        return told

    def replan(self, plan: Plan, names: Collection[str]) -> None:
        """Negotiate anew for nodes that are started again, and never the TCP ports they had.

        Fast DDS would not find them there (see lifecycle.plan.restart).
        """
        keys = {self._planned[name].key for name in names}
        taken = {host: set(ports) for host, ports in self._terms.taken}
        hosts = {each.key: self._hosts.host(each.machine) for each in plan.nodes}
        for each in self.graph.connections:
            if each.node in keys:
                urls = (parse(text) for text in each.urls)
                tcp = (url for url in urls if url.transport is ConnectionTransport.TCPV4)
                taken.setdefault(hosts[each.node], set()).update(ports_of(tcp))
        self._terms = dataclasses.replace(
            self._terms,
            taken=tuple((host, tuple(sorted(ports))) for host, ports in sorted(taken.items())),
        )
        self.graph = dataclasses.replace(
            self.graph,
            connections=tuple(each for each in self.graph.connections if each.node not in keys),
        )
        self._heard = None
        self._take(plan)

    def _take(self, plan: Plan) -> None:
        self._plan = plan
        self._planned = {each.full_name: each for each in plan.nodes}

    def _takes_part(self, name: str) -> bool:
        is_open = self._plan.policy.undeclared_nodes is EndpointPolicy.OPEN
        return name in self._planned or is_open

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

    def _places(self, known: Mapping[str, NodeConfiguration]) -> _Places:
        """Learn from the planned nodes which host a machine id stands for."""
        return _Places(
            {
                each.identity.machine_id: self._hosts.host(self._planned[name].machine)
                for name, each in known.items()
                if name in self._planned
            }
        )

    def _declared(self, problems: Iterable[NegotiationProblem]) -> Iterable[NegotiationProblem]:
        """Leave out what concerns a node that nobody declared: the system does without it."""
        keys = {each.key for each in self._plan.nodes}
        return (each for each in problems if {each.publisher, each.subscription} <= keys)

    def _grown(self, known: Mapping[str, NodeConfiguration]) -> Plan:
        """The plan with the endpoints that its nodes made in code, where they may."""
        return dataclasses.replace(
            self._plan,
            nodes=tuple(
                _with_made(node, known[node.full_name])
                if node.full_name in known and node.endpoint_policy is EndpointPolicy.OPEN
                else node
                for node in self._plan.nodes
            ),
        )


class _Places:
    """Hosts of nodes that no manifest places, by machine id; an unknown id is a host of its own."""

    def __init__(self, hosts: Mapping[str, str]) -> None:
        self._hosts = hosts

    def __call__(self, configuration: NodeConfiguration) -> str:
        machine = configuration.identity.machine_id
        return self._hosts.get(machine, f"unknown host {machine}")


def _with_made(node: PlannedNode, configuration: NodeConfiguration) -> PlannedNode:
    declared = {(each.kind, each.name) for each in node.endpoints}
    resolved = {(each.kind, each.resolved) for each in node.endpoints}
    made = tuple(
        PlannedEndpoint(
            kind=each.kind,
            name=each.name or each.resolved,
            resolved=each.resolved,
            type=each.type,
            qos=each.qos,
            lossy=each.lossy,
            max_message_size=each.size_bytes,
            at=node.at,
        )
        for each in configuration.endpoints
        if (each.kind, each.name) not in declared
        and (each.name or (each.kind, each.resolved) not in resolved)
    )
    return dataclasses.replace(node, endpoints=(*node.endpoints, *made))


def _with_flows(plan: Plan, graph: DataLayerGraph) -> Plan:
    """Add the flows of endpoints that were made in code."""
    keys = {each.key for each in plan.nodes}
    there = {(each.topic, each.publisher, each.subscription) for each in plan.flows}
    more = {
        place: PlannedFlow(
            topic=each.topic,
            publisher=each.publisher,
            subscription=each.subscription,
            medium=each.medium,
            medium_reason=each.reason,
        )
        for each in graph.flows
        if (place := (each.topic, each.publisher, each.subscription)) not in there
        and {each.publisher, each.subscription} <= keys
    }
    return dataclasses.replace(plan, flows=(*plan.flows, *more.values()))


def _guest_instructions(
    configuration: NodeConfiguration, graph: DataLayerGraph, before: DataLayerGraph
) -> Instructions:
    """Tell a node that nobody declared what concerns the system, and leave the rest to it."""
    name = configuration.name
    mine = [each for each in graph.connections if each.node == name]
    mapped = {label: each.name for each in mine for label in each.map}
    gone = {each.name for each in before.connections if each.node == name} - {
        each.name for each in mine
    }
    for each in configuration.endpoints:
        label = _label(each)
        if label not in mapped and each.connection in gone and each.connection:
            mapped[label] = ""
    return Instructions(
        node=name,
        connections=tuple((each.name, ParticipantConnections(urls=each.urls)) for each in mine),
        mappings=tuple(mapped.items()),
    )


def _label(report: EndpointReport) -> str:
    kind: EndpointKind = report.kind
    return kind.spell(report.name or report.resolved)


def _words(problem: NegotiationProblem) -> str:
    return f"{problem.message}; {problem.hint}" if problem.hint else problem.message
