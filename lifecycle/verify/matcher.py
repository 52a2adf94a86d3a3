"""Matches declared endpoints with those observed in the ROS graph and in node reports.

Owns: `lay_out`: which observed endpoint and which report belong to which declared endpoint, and
what is left over. All rules read the result, so that they agree on what is the same thing. Pure.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterable, Mapping, Sequence

from lifecycle.manifest import EndpointKind
from lifecycle.plan import Plan, PlannedEndpoint, PlannedFlow, PlannedNode
from lifecycle.verify.observation import (
    EndpointReport,
    NodeConfiguration,
    Observation,
    ObservedEndpoint,
    ObservedNode,
)
from lifecycle.verify.tool_filter import (
    DeclaredNames,
    Owners,
    action_part,
    fold_actions,
    is_noise_endpoint,
    known_node,
    tolerating_pattern,
)
from lifecycle.verify.uniqueness import Uniqueness
from lifecycle.verify.verdict import Stage
from lifecycle.verify.view import (
    Actual,
    FlowView,
    SeenEndpoint,
    View,
    actual_qos,
    may_hide,
    only_shared_memory,
)

_Pools = dict[tuple[EndpointKind, str], list[ObservedEndpoint]]
"""One node's endpoints by kind and name."""

_End = tuple[str, EndpointKind, str]
"""Full name of a node, kind and resolved name of what it declares."""

_TURNS = ((True, True), (True, False), (False, False))
"""Who chooses first among a node's endpoints: those whose type discovery shows as declared, those
whose node reports it so, the rest. So one wrong type does not take another one's place. Each says
whether the report, and what discovery shows, must have the declared type."""

_PREFIX_DIGITS = 24
"""A GUID begins with its participant's prefix of 12 bytes (DDSI-RTPS §9.3.1)."""


def lay_out(
    plan: Plan,
    observation: Observation,
    stage: Stage,
    *,
    machines: frozenset[str] | None = None,
    ahead: frozenset[str] = frozenset(),
    over: Mapping[str, str] | None = None,
) -> View:
    """Match everything observed to everything planned; deterministic for any input order."""
    planned = {node.full_name: node for node in plan.nodes}
    reported = _by_identity(observation)
    configurations = {each.name: each for each in reversed(reported)}
    duplicated = {each.full_name for each in observation.nodes if each.count > 1}
    owners = Owners(planned.values(), reported, plan.policy.tolerated_nodes)
    names = DeclaredNames.of(plan)
    everything = _attributed(observation, planned, configurations, owners, names)
    tools = _tools(observation, everything, planned, owners, plan.policy.tolerated_nodes)
    endpoints = tuple(each for each in everything if each.node not in tools)
    places: dict[str, _Pools] = {}
    for endpoint in endpoints:
        pools = places.setdefault(endpoint.node, {})
        pools.setdefault((endpoint.kind, endpoint.name), []).append(endpoint)
    by_node: dict[str, tuple[Actual, ...]] = {}
    left_over: list[ObservedEndpoint] = []
    for node in plan.nodes:
        configuration = configurations.get(node.full_name)
        remote_nodes = machines is not None and node.machine not in machines
        matched, rest = _match_node(
            node,
            configuration,
            places.get(node.full_name, {}),
            beyond=remote_nodes and only_shared_memory(node.connections),
        )
        by_node[node.full_name] = tuple(matched)
        # A second node of the same name has the same endpoints again; that is one finding.
        left_over += [] if node.full_name in duplicated else rest
    actual = tuple(each for matched in by_node.values() for each in matched)
    known_actions = {(each.node, each.kind, each.name) for each in endpoints} | {
        (each.node.full_name, each.planned.kind, each.planned.resolved) for each in actual
    }
    undeclared = [each for each in left_over if not _is_part_of(each, known_actions)]
    return View(
        plan=plan,
        stage=stage,
        machines=machines,
        ahead=ahead,
        over=dict(over or {}),
        planned=planned,
        names=names,
        observed=_graph_nodes(observation.nodes, planned, owners, tools),
        reported=reported,
        configurations=configurations,
        parameters={each.node: each for each in observation.parameters},
        actual=actual,
        actual_by_node=by_node,
        undeclared=_sorted(undeclared),
        unattributed=tuple(each for each in endpoints if not each.node),
        foreign=tuple(each for each in endpoints if each.node and each.node not in planned),
        tools=tools,
        of_tools=tuple(each for each in everything if each.node in tools),
        seen=_seen(
            (*endpoints, *(each.observed for each in actual if each.unseen and each.observed)),
            actual,
        ),
        flows=_flows(plan, actual),
        uniqueness=Uniqueness(reported, declared_addresses(plan)),
    )


def declared_addresses(plan: Plan) -> dict[str, str]:
    """Return the declared address of each node's machine, by full node name, where there is one."""
    machines = {each.name: each.address for each in plan.machines if each.address}
    return {
        node.full_name: machines[node.machine] for node in plan.nodes if node.machine in machines
    }


def _by_identity(observation: Observation) -> tuple[NodeConfiguration, ...]:
    return tuple(
        sorted(observation.configurations, key=lambda each: (each.name, repr(each.identity)))
    )


def _attributed(
    observation: Observation,
    planned: dict[str, PlannedNode],
    configurations: dict[str, NodeConfiguration],
    owners: Owners,
    names: DeclaredNames,
) -> tuple[ObservedEndpoint, ...]:
    """Give each endpoint to its node: by hidden participant, or by the GID that a node reported.

    Services have no GID of their own in reports: one whose node is not known is that of the node on
    its participant that declares it. What client libraries bring along is left out here, unless it
    is declared; under a declared name, unless it is a declared node's.
    """
    declared = {
        (name, each.kind, each.resolved)
        for name, node in planned.items()
        for each in node.endpoints
    }
    by_gid = {
        report.gid: name
        for name, configuration in configurations.items()
        for report in configuration.endpoints
        if report.gid
    }
    by_participant: dict[str, dict[str, None]] = {}
    for gid, name in by_gid.items():
        by_participant.setdefault(gid[:_PREFIX_DIGITS], {})[name] = None
    found: list[ObservedEndpoint] = []
    for endpoint in observation.endpoints:
        node = known_node(endpoint.node)
        if node not in planned:
            node = owners.of(node) or node
        if not node:
            node = by_gid.get(endpoint.gid, "")
        if not node and not endpoint.kind.is_topic:
            node = next(
                (
                    each
                    for each in by_participant.get(endpoint.gid[:_PREFIX_DIGITS], ())
                    if (each, *(action_part(endpoint.kind, endpoint.name) or _place(endpoint)))
                    in declared
                ),
                "",
            )
        feeds = node not in planned and names.fed_by(endpoint.kind, endpoint.name)
        if (
            not feeds
            and (node, endpoint.kind, endpoint.name) not in declared
            and is_noise_endpoint(
                endpoint.kind,
                known_node(endpoint.node),
                endpoint.name,
                endpoint.type,
                ours=node in configurations,
            )
        ):
            continue
        if node != endpoint.node:
            gid = endpoint.gid if endpoint.kind.is_topic or not node else ""
            endpoint = dataclasses.replace(endpoint, node=node, gid=gid)  # noqa: PLW2901
        found.append(endpoint)
    return _sorted(fold_actions(_sorted(found)))


def _place(endpoint: ObservedEndpoint) -> tuple[EndpointKind, str]:
    return endpoint.kind, endpoint.name


def _tools(
    observation: Observation,
    endpoints: Iterable[ObservedEndpoint],
    planned: dict[str, PlannedNode],
    owners: Owners,
    patterns: Sequence[str],
) -> dict[str, str]:
    """Return the undeclared nodes that are tolerated by their name, and the pattern, sorted."""
    seen = {each.full_name for each in observation.nodes} | {each.node for each in endpoints}
    found = {
        name: tolerating_pattern(name, patterns)
        for name in sorted(seen)
        if known_node(name) and name not in planned and not owners.of(name)
    }
    return {name: pattern for name, pattern in found.items() if pattern}


def _match_node(
    node: PlannedNode,
    configuration: NodeConfiguration | None,
    places: _Pools,
    *,
    beyond: bool,
) -> tuple[list[Actual], list[ObservedEndpoint]]:
    """Match one node's declarations to what is seen of it; return them and what is left over."""
    reports = _Reports(configuration.endpoints if configuration else ())
    pools = {place: list(endpoints) for place, endpoints in places.items()}
    matched: dict[int, Actual] = {}
    used: set[tuple[EndpointKind, str]] = set()
    for exact_report, exact_observed in _TURNS:
        for index, planned in enumerate(node.endpoints):
            if index in matched:
                continue
            place = (planned.kind, planned.resolved)
            picked = reports.pick(planned, exact=exact_report)
            report = reports.get(picked)
            observed = _pick_observed(planned, report, pools.get(place, []), exact=exact_observed)
            if exact_report and (observed if exact_observed else report) is None:
                continue  # its turn comes
            unseen = observed is None and may_hide(node, planned)
            if observed is not None and observed.gid:
                pools[place].remove(observed)
            elif observed is not None:
                used.add(place)  # found by name only: it represents any number of them
            elif unseen and report is not None and _is_there(report, planned.resolved):
                observed = _as_observed(node, report, report.resolved)
            reports.take(picked)
            matched[index] = Actual(
                node=node,
                planned=planned,
                observed=observed,
                report=report,
                unseen=unseen,
                beyond=beyond,
            )
    rest = [endpoint for place, pool in pools.items() if place not in used for endpoint in pool]
    rest += [
        _as_observed(node, actual.report, name)
        for actual in matched.values()
        if actual.report is not None
        for name in (actual.report.resolved, *actual.report.aliases)
        if name != actual.planned.resolved
        and _is_there(actual.report, name)
        and (actual.report.kind, name) not in places
    ]
    rest += [
        _as_observed(node, report, report.resolved)
        for report in reports.left
        if (report.kind, report.resolved) not in places
        and not is_noise_endpoint(
            report.kind, node.full_name, report.resolved, report.type, ours=True
        )
    ]
    return [matched[index] for index in range(len(node.endpoints))], rest


class _Reports:
    """What a node reports, in its order; each report is of one declared endpoint."""

    def __init__(self, endpoints: Iterable[EndpointReport]) -> None:
        self._left = dict(enumerate(endpoints))
        self._named: dict[tuple[EndpointKind, str], list[int]] = {}
        self._nameless: dict[tuple[EndpointKind, str], list[int]] = {}
        for index, each in self._left.items():
            self._named.setdefault((each.kind, each.name), []).append(index)
            if not each.name:
                self._nameless.setdefault((each.kind, each.resolved), []).append(index)

    @property
    def left(self) -> Iterable[EndpointReport]:
        """Those that were not taken."""
        return self._left.values()

    def pick(self, planned: PlannedEndpoint, *, exact: bool) -> int | None:
        """Choose the report on a declared endpoint: by its declared name, else its resolved one."""
        for index in self._named.get((planned.kind, planned.name), ()):
            if index in self._left:
                return index
        for index in self._nameless.get((planned.kind, planned.resolved), ()):
            if index in self._left and (not exact or self._left[index].type == planned.type):
                return index
        return None

    def get(self, index: int | None) -> EndpointReport | None:
        """Return a report that was picked."""
        return None if index is None else self._left[index]

    def take(self, index: int | None) -> None:
        """Leave out a report from now on: it belongs to a declared endpoint."""
        if index is not None:
            del self._left[index]


def _pick_observed(
    planned: PlannedEndpoint,
    report: EndpointReport | None,
    pool: Sequence[ObservedEndpoint],
    *,
    exact: bool,
) -> ObservedEndpoint | None:
    """Choose what discovery shows of a declared endpoint: by GID, else by type, else any."""
    if report is not None and report.gid:
        for endpoint in pool:
            if endpoint.gid == report.gid:
                return endpoint
    for endpoint in pool:
        if endpoint.type == planned.type or not exact:
            return endpoint
    return None


def _is_there(report: EndpointReport, name: str) -> bool:
    """Return whether a node reports an endpoint under a name; it may have been remapped."""
    return report.mapped and not report.error and name in (report.resolved, *report.aliases)


def _as_observed(node: PlannedNode, report: EndpointReport, name: str) -> ObservedEndpoint:
    """An endpoint that only its node reports: discovery does not show it, or not yet."""
    return ObservedEndpoint(
        kind=report.kind,
        node=node.full_name,
        name=name,
        type=report.type,
        qos=report.qos,
        gid=report.gid,
        type_hash=report.type_hash,
    )


def _is_part_of(endpoint: ObservedEndpoint, actions: set[tuple[str, EndpointKind, str]]) -> bool:
    """Return whether an endpoint is a hidden part of an action that is declared or seen."""
    action = action_part(endpoint.kind, endpoint.name)
    return action is not None and (endpoint.node, *action) in actions


def _graph_nodes(
    nodes: Iterable[ObservedNode],
    planned: dict[str, PlannedNode],
    owners: Owners,
    tools: Collection[str],
) -> dict[str, ObservedNode]:
    """Nodes that count: tools and hidden participants of declared nodes left out."""
    merged: dict[str, ObservedNode] = {}
    for node in sorted(nodes, key=lambda each: each.full_name):
        name = node.full_name
        if not known_node(name):
            continue  # its endpoints are judged; it is no name that could be declared or not
        if name not in planned and (name in tools or owners.of(name)):
            continue
        known = merged.get(name)
        merged[name] = (
            node if known is None else dataclasses.replace(known, count=known.count + node.count)
        )
    return merged


def _seen(
    endpoints: Iterable[ObservedEndpoint],
    actual: Sequence[Actual],
) -> tuple[SeenEndpoint, ...]:
    """Collect publishers and subscriptions with all that is known of them."""
    known = {id(each.observed): each for each in actual if each.observed is not None}
    # Not visible here, but the endpoints that match them count them.
    found = [
        SeenEndpoint(
            kind=each.planned.kind,
            node=each.node.full_name,
            name=each.planned.resolved,
            type=each.planned.type,
            qos=each.planned.qos,
            report=None,
            planned=each.planned,
        )
        for each in actual
        if each.beyond and each.planned.kind.is_topic
    ]
    for endpoint in endpoints:
        if not endpoint.kind.is_topic:
            continue
        match = known.get(id(endpoint))
        report = match.report if match else None
        found.append(
            SeenEndpoint(
                kind=endpoint.kind,
                node=endpoint.node,
                name=endpoint.name,
                type=endpoint.type,
                qos=actual_qos(endpoint.qos, report.qos if report else None),
                report=report,
                planned=match.planned if match else None,
                type_hash=_type_hash(endpoint, report),
            )
        )
    return tuple(found)


def _type_hash(endpoint: ObservedEndpoint, report: EndpointReport | None) -> str | None:
    """Discovery wins where it knows a hash; with static discovery only the node itself does."""
    if endpoint.type_hash or report is None or report.type_hash is None:
        return endpoint.type_hash
    return report.type_hash


def _flows(plan: Plan, actual: Iterable[Actual]) -> tuple[FlowView, ...]:
    names = {node.key: node.full_name for node in reversed(plan.nodes)}
    ends: dict[_End, tuple[Actual, ...]] = {}
    for each in actual:
        place = (each.node.full_name, each.planned.kind, each.planned.resolved)
        ends[place] = (*ends.get(place, ()), each)
    return tuple(_flow(each, names, ends) for each in plan.flows)


def _flow(
    planned: PlannedFlow, names: Mapping[str, str], ends: Mapping[_End, tuple[Actual, ...]]
) -> FlowView:
    publisher, subscription = names[planned.publisher], names[planned.subscription]
    publishers = ends.get((publisher, EndpointKind.PUBLISHER, planned.topic), ())
    subscriptions = ends.get((subscription, EndpointKind.SUBSCRIPTION, planned.topic), ())
    return FlowView(
        planned=planned,
        publisher=publisher,
        subscription=subscription,
        publishers=publishers,
        subscriptions=subscriptions,
        at=next((each.planned.at for each in (*subscriptions, *publishers)), None),
    )


def _sorted(endpoints: Iterable[ObservedEndpoint]) -> tuple[ObservedEndpoint, ...]:
    return tuple(
        sorted(
            endpoints,
            key=lambda each: (each.node, each.name, each.kind.value, each.type, each.gid),
        )
    )
