"""Matches declared endpoints with those observed in the ROS graph and in node reports.

All rules read the result, so that they agree on what is the same thing. Pure.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Mapping, Sequence

from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind
from lifecycle.plan.model import Plan, PlannedEndpoint, PlannedNode
from lifecycle.verify.network_flows import Uniqueness
from lifecycle.verify.observation import (
    EndpointReport,
    NodeConfiguration,
    Observation,
    ObservedEndpoint,
    ObservedNode,
)
from lifecycle.verify.tool_filter import (
    PREFIX_DIGITS,
    DeclaredNames,
    action_part,
    fold_actions,
    is_noise_endpoint,
    known_node,
    part_type,
    tolerating_pattern,
)
from lifecycle.verify.verdict import Stage
from lifecycle.verify.view import (
    Actual,
    FlowView,
    NodeFacts,
    SeenEndpoint,
    TopicEnds,
    View,
    Whose,
    actual_qos,
    is_beyond,
    may_hide,
)

_Pools = dict[tuple[EndpointKind, str], list[ObservedEndpoint]]
"""One node's endpoints by kind and name."""

_Left = dict[tuple[EndpointKind, str, bool], list[EndpointReport]]
"""Reports that are of no declared endpoint yet: by kind and declared name, or by kind and resolved
name of those that have no other; each report is of one declared endpoint."""


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
    names = DeclaredNames.of(plan)
    reported = _by_identity(observation)
    configurations = {each.name: each for each in reversed(reported)}
    groups, hidden = _attributed(observation, names, reported)
    duplicated = {each.full_name for each in observation.nodes if each.count > 1}
    # Of two of one name, or where an endpoint is not its owner's, one is somebody else's.
    hidden -= planned.keys() | groups.keys() | duplicated
    tools = _tools(observation, groups, planned, hidden, plan.policy.tolerated_nodes)
    observed = _graph_nodes(observation.nodes, planned, hidden, tools)
    parameters = {each.node: each for each in observation.parameters}
    nodes: dict[str, NodeFacts] = {}
    others: list[SeenEndpoint] = []
    for name, node in planned.items():
        configuration = configurations.get(name)
        matched, rest = _match_node(
            node, configuration, groups.get(name, ()), beyond=is_beyond(node, machines)
        )
        nodes[name] = NodeFacts(
            node=node,
            observed=observed.get(name),
            configuration=configuration,
            parameters=parameters.get(name),
            actual=tuple(matched),
            absent=name not in observed and all(each.observed is None for each in matched),
        )
        # A second node of the same name has the same endpoints again; that is one finding.
        whose = Whose.TWIN if name in duplicated else Whose.UNDECLARED
        others += (SeenEndpoint.of(each, whose) for each in rest)
    actual = tuple(itertools.chain.from_iterable(facts.actual for facts in nodes.values()))
    for name in groups.keys() - planned.keys():
        known = Whose.TOOL if name in tools else Whose.FOREIGN
        others += (SeenEndpoint.of(each, known if name else Whose.UNKNOWN) for each in groups[name])
    others += (SeenEndpoint.of(each, Whose.DEPARTED) for each in observation.departed)
    found = _without_halves(others, groups, actual)
    return View(
        plan=plan,
        stage=stage,
        machines=machines,
        ahead=ahead,
        over=over or {},
        planned=planned,
        names=names,
        observed=observed,
        reported=reported,
        configurations=configurations,
        nodes=nodes,
        actual=actual,
        others=found,
        topics=_topics(actual, found),
        tools=tools,
        flows=_flows(plan, nodes, actual),
        uniqueness=Uniqueness(
            reported, {each.full_name: plan.address_of(each.machine) for each in plan.nodes}
        ),
        measured=observation.measured,
        active_s=dict(observation.active_s),
        clocks=None if observation.clocks is None else dict(observation.clocks),
        marks={(each.machine, each.dscp): each.arrives_as for each in observation.marks},
    )


def _by_identity(observation: Observation) -> tuple[NodeConfiguration, ...]:
    found = observation.configurations
    return tuple(sorted(found, key=lambda each: (each.name, repr(each.identity))))


def _attributed(
    observation: Observation, names: DeclaredNames, reported: Iterable[NodeConfiguration]
) -> tuple[dict[str, tuple[ObservedEndpoint, ...]], frozenset[str]]:
    """Give each endpoint to its node; return them by node name, sorted, and hidden nodes' names.

    A name proves nothing: any process can call a node `_camera_flow_0`. Only the node that has it
    can say so, and on which participant it is. Where discovery shows no node, the GID that a node
    reported counts; services have none of their own in reports: one is that of the node on its
    participant that declares it. What client libraries bring along is left out here, unless it is
    declared; under a declared name, unless it is a declared node's.
    """
    by_gid: dict[str, str] = {}
    by_prefix: dict[str, dict[str, None]] = {}
    hidden: dict[str, str] = {}
    for each in reported:
        gids = {one.gid for one in each.endpoints} | {one.prefix for one in each.connections}
        for gid in gids - {""}:
            by_gid.setdefault(gid, each.name)
            by_prefix.setdefault(gid[:PREFIX_DIGITS], {})[each.name] = None
        others = {one.node_name for one in each.connections}
        others |= {one.participant for one in each.endpoints}
        if each.name in names.nodes:
            namespace = each.name.rpartition("/")[0]
            hidden |= {f"{namespace}/{other}": each.name for other in others - {""}}
    by_node: dict[str, list[ObservedEndpoint]] = {}
    ours = {each.name for each in reported}
    for endpoint in observation.endpoints:
        node, gid = known_node(endpoint.node), endpoint.gid
        on = by_prefix.get(gid[:PREFIX_DIGITS], {})
        if node:
            owner = hidden.get(node, node) if node not in names.nodes else node
            whose = owner if not gid or owner in on else node
            if not names.keeps(endpoint, whose, ours=owner in ours):
                continue
        else:
            whose = by_gid.get(gid, "")
            if not whose and not endpoint.kind.is_topic:
                place = action_part(endpoint.kind, endpoint.name) or _place(endpoint)
                whose = next((each for each in on if (each, *place) in names.ends), "")
            if whose and not endpoint.kind.is_topic:
                # Half of a service may be seen before its node is: it is no second one.
                gid = ""
        if (whose, gid) != (endpoint.node, endpoint.gid):
            endpoint = replace(endpoint, node=whose, gid=gid)  # noqa: PLW2901
        by_node.setdefault(whose, []).append(endpoint)
    groups = {name: _sorted(fold_actions(_sorted(by_node[name]))) for name in sorted(by_node)}
    return groups, frozenset(hidden)


def _place(endpoint: ObservedEndpoint) -> tuple[EndpointKind, str]:
    return endpoint.kind, endpoint.name


def _tools(
    observation: Observation,
    groups: Iterable[str],
    planned: dict[str, PlannedNode],
    hidden: Collection[str],
    patterns: Sequence[str],
) -> dict[str, str]:
    """Return the undeclared nodes that are tolerated by their name, and the pattern, sorted."""
    seen = {each.full_name for each in observation.nodes}.union(groups)
    found = {
        name: tolerating_pattern(name, patterns)
        for name in sorted(seen - planned.keys())
        if known_node(name) and name not in hidden
    }
    return {name: pattern for name, pattern in found.items() if pattern}


def _match_node(
    node: PlannedNode,
    configuration: NodeConfiguration | None,
    endpoints: Iterable[ObservedEndpoint],
    *,
    beyond: bool,
) -> tuple[list[Actual], list[ObservedEndpoint]]:
    """Match one node's declarations to what is seen of it; return them and what is left over."""
    reports: _Left = {}
    for one in configuration.endpoints if configuration else ():
        reports.setdefault(_left_key(one), []).append(one)
    pools: _Pools = {}
    for each in endpoints:
        pools.setdefault(_place(each), []).append(each)
    places = pools.keys()
    matched: list[Actual] = []
    used: set[tuple[EndpointKind, str]] = set()
    for planned in node.endpoints:
        place = (planned.kind, planned.resolved)
        report = _pick_report(planned, reports)
        observed = _pick_observed(planned, report, pools.get(place, ()))
        unseen = observed is None and may_hide(node, planned)
        if observed is not None and observed.gid:
            pools[place].remove(observed)
        elif observed is not None:
            used.add(place)  # found by name only: it represents any number of them
        elif unseen and report is not None and report.resolved == planned.resolved:
            observed = _as_observed(node, report) if _is_there(report) else None
        if report is not None:
            reports[_left_key(report)].remove(report)
        matched.append(_actual(node, planned, observed, report, unseen=unseen, beyond=beyond))
    rest = [endpoint for place, pool in pools.items() if place not in used for endpoint in pool]
    rest += [
        _as_observed(node, actual.report)
        for actual in matched
        if actual.report is not None
        and actual.report.resolved != actual.planned.resolved
        and _is_there(actual.report)
        and (actual.report.kind, actual.report.resolved) not in places
    ]
    rest += [
        _as_observed(node, report)
        for left in reports.values()
        for report in left
        if (report.kind, report.resolved) not in places
        and not is_noise_endpoint(
            report.kind, node.full_name, report.resolved, report.type, ours=True
        )
    ]
    return matched, rest


def _pick_report(planned: PlannedEndpoint, left: _Left) -> EndpointReport | None:
    """Choose the report on a declared endpoint: by its declared name, else its resolved one."""
    named = left.get((planned.kind, planned.name, True))
    if named:
        return named[0]
    nameless = left.get((planned.kind, planned.resolved, False), ())
    return min(nameless, key=lambda each: each.type != planned.type, default=None)


def _left_key(report: EndpointReport) -> tuple[EndpointKind, str, bool]:
    return report.kind, report.name or report.resolved, bool(report.name)


def _pick_observed(
    planned: PlannedEndpoint,
    report: EndpointReport | None,
    pool: Sequence[ObservedEndpoint],
) -> ObservedEndpoint | None:
    """Choose what discovery shows of a declared endpoint: by GID, else by type, else any."""
    gid = report.gid if report is not None else ""
    return min(
        pool,
        key=lambda each: (not gid or each.gid != gid, each.type != planned.type),
        default=None,
    )


def _is_there(report: EndpointReport) -> bool:
    """Return whether a node reports that an endpoint exists."""
    return report.mapped and not report.error


def _as_observed(node: PlannedNode, report: EndpointReport) -> ObservedEndpoint:
    """An endpoint that only its node reports: discovery does not show it, or not yet."""
    return ObservedEndpoint(
        kind=report.kind,
        node=node.full_name,
        name=report.resolved,
        type=report.type,
        qos=report.qos,
        gid=report.gid,
        type_hash=report.type_hash,
    )


def _without_halves(
    others: Iterable[SeenEndpoint],
    groups: Mapping[str, tuple[ObservedEndpoint, ...]],
    actual: Iterable[Actual],
) -> tuple[SeenEndpoint, ...]:
    """Leave out the parts of declared actions that are half seen; sort what is left."""
    seen = {
        (each.node, each.kind, each.name)
        for group in groups.values()
        for each in group
        if not each.kind.is_topic
    }
    declared = {(each.node, each.kind, each.name): each.planned.type for each in actual}

    def is_half(endpoint: SeenEndpoint) -> bool:
        action = action_part(endpoint.kind, endpoint.name)
        if action is None or endpoint.whose is not Whose.UNDECLARED:
            return False
        place = (endpoint.node, *action)
        if place not in declared or (place in seen and _gid(endpoint)):
            return False
        return endpoint.type == part_type(endpoint.name, declared[place])

    return tuple(
        sorted(
            (each for each in others if not is_half(each)),
            key=lambda each: (each.node, each.name, each.kind.value, each.type, _gid(each)),
        )
    )


def _gid(endpoint: SeenEndpoint) -> str:
    return "" if endpoint.observed is None else endpoint.observed.gid


def _topics(actual: Iterable[Actual], others: Iterable[SeenEndpoint]) -> dict[str, TopicEnds]:
    """Collect publishers and subscriptions; one beyond reach is counted by what it matches."""
    found: dict[str, TopicEnds] = {}
    seen = (each for each in actual if each.observed is not None or each.beyond)
    for each in itertools.chain(seen, others):
        if each.kind.is_topic:
            ends = found.setdefault(each.name, ([], []))
            ends[each.kind is EndpointKind.SUBSCRIPTION].append(each)
    return found


def _graph_nodes(
    nodes: Iterable[ObservedNode],
    planned: dict[str, PlannedNode],
    hidden: Collection[str],
    tools: Collection[str],
) -> dict[str, ObservedNode]:
    """Nodes that count: tools and hidden participants of declared nodes left out."""
    merged: dict[str, ObservedNode] = {}
    for node in sorted(nodes, key=lambda each: each.full_name):
        name = node.full_name
        if not known_node(name):
            continue  # its endpoints are judged; it is no name that could be declared or not
        if name not in planned and (name in tools or name in hidden):
            continue
        known = merged.get(name)
        merged[name] = node if known is None else replace(known, count=known.count + node.count)
    return merged


def _actual(
    node: PlannedNode,
    planned: PlannedEndpoint,
    observed: ObservedEndpoint | None,
    report: EndpointReport | None,
    *,
    unseen: bool,
    beyond: bool,
) -> Actual:
    """Return a declared endpoint with all that is known of it."""
    type_hash = observed.type_hash if observed else None
    if not type_hash and report is not None and report.type_hash is not None:
        # Discovery wins where it knows a hash; with static discovery only the node itself does.
        type_hash = report.type_hash
    return Actual(
        kind=planned.kind,
        node=node.full_name,
        name=planned.resolved,
        type=observed.type if observed else planned.type,
        qos=actual_qos(observed.qos if observed else None, report.qos if report else None),
        report=report,
        planned=planned,
        type_hash=type_hash,
        owner=node,
        observed=observed,
        unseen=unseen,
        beyond=beyond,
    )


def _flows(
    plan: Plan, nodes: Mapping[str, NodeFacts], actual: Sequence[Actual]
) -> tuple[FlowView, ...]:
    by_key = {facts.node.key: facts for facts in nodes.values()}
    ends = {(each.node, each.kind, each.name): each for each in reversed(actual)}
    found = []
    for planned in plan.flows:
        source, destination = by_key[planned.publisher], by_key[planned.subscription]
        flow = FlowView(
            planned=planned,
            publisher=source.name,
            subscription=destination.name,
            writer=ends.get((source.name, EndpointKind.PUBLISHER, planned.topic)),
            reader=ends.get((destination.name, EndpointKind.SUBSCRIPTION, planned.topic)),
            nodes=(source, destination),
        )
        found.append(flow)
    return tuple(found)


def _sorted(endpoints: Iterable[ObservedEndpoint]) -> tuple[ObservedEndpoint, ...]:
    return tuple(
        sorted(
            endpoints,
            key=lambda each: (each.node, each.name, each.kind.value, each.type, each.gid),
        )
    )
