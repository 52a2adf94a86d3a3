"""Matches declared endpoints with those observed in the ROS graph and in node reports.

Owns: `lay_out`: which observed endpoint and which report belong to which declared endpoint, and
what is left over. All rules read the result, so that they agree on what is the same thing. Pure.
"""

from __future__ import annotations

import itertools
import operator
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

from lifecycle import dataclasses
from lifecycle.manifest import EndpointKind
from lifecycle.plan import Plan, PlannedEndpoint, PlannedFlow, PlannedNode
from lifecycle.verify.observation import (
    EndpointReport,
    NodeConfiguration,
    NodeParameters,
    Observation,
    ObservedEndpoint,
    ObservedNode,
)
from lifecycle.verify.tool_filter import (
    action_part,
    fold_actions,
    is_noise_endpoint,
    known_node,
    owners,
    part_type,
    tolerating_pattern,
)
from lifecycle.verify.uniqueness import Uniqueness
from lifecycle.verify.verdict import Stage
from lifecycle.verify.view import (
    Actual,
    Attributed,
    FlowView,
    Frame,
    NodeEndpoints,
    NodeFacts,
    Parts,
    SeenEndpoint,
    TopicFacts,
    View,
    actual_qos,
    may_hide,
    once,
)

_Pools = dict[tuple[EndpointKind, str], list[ObservedEndpoint]]
"""One node's endpoints by kind and name."""

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
    last: View | None = None,
) -> View:
    """Match everything observed to everything planned; deterministic for any input order.

    Args:
        plan: what must be.
        observation: what was seen.
        stage: which moment it is judged against.
        machines: as `Frame` has them, and `ahead`, and `over`.
        ahead: see there.
        over: see there.
        last: the view of an earlier moment, whose parts are taken over where all that they are
            made of is the same: the same object, not an equal one. The result does not depend on
            it but for what it costs.
    """
    over = over or {}
    if last is not None and not last.frame.is_of(plan, stage, machines, ahead, over):
        last = None
    frame = last.frame if last is not None else Frame.of(plan, stage, machines, ahead, over)
    planned = frame.planned
    reported = _by_identity(observation)
    configurations = {each.name: each for each in reversed(reported)}
    duplicated = {each.full_name for each in observation.nodes if each.count > 1}
    attributed, groups = _attributed(observation, frame, reported, configurations, last)
    # Of two of one name, or where an endpoint is not its owner's, one is somebody else's.
    hidden = owners(planned, reported).keys() - planned.keys() - groups.keys() - duplicated
    tools = _tools(observation, groups, planned, hidden, plan.policy.tolerated_nodes)
    observed = _graph_nodes(observation.nodes, planned, hidden, tools)
    parameters = {each.node: each for each in observation.parameters}
    nodes: dict[str, NodeFacts] = {}
    left_over: list[ObservedEndpoint] = []
    for node in plan.nodes:
        name = node.full_name
        group = groups.get(name)
        facts = nodes[name] = _facts(
            frame,
            node,
            configurations.get(name),
            observed.get(name),
            parameters.get(name),
            () if group is None else group.endpoints,
            last.nodes.get(name) if last is not None else None,
        )
        # A second node of the same name has the same endpoints again; that is one finding.
        left_over += () if name in duplicated else facts.rest
    by_node = Parts(
        nodes, order=frame.order.__getitem__, last=last.by_node if last is not None else None
    )
    actual = tuple(itertools.chain.from_iterable(facts.actual for facts in nodes.values()))
    strangers = [name for name in groups if name and name not in planned and name not in tools]
    of_tools = tuple(
        each for name, group in groups.items() if name in tools for each in group.endpoints
    )
    seen = _seen(groups, nodes, tools)
    topics, retold = _topics(frame, seen, of_tools, last)
    flows, moved = _flows(frame, nodes, topics, last, changed=(*by_node.changed, *retold))
    return View(
        frame=frame,
        observed=observed,
        reported=reported,
        configurations=configurations,
        parameters=parameters,
        actual=actual,
        actual_by_node={name: facts.actual for name, facts in nodes.items()},
        undeclared=_undeclared(left_over, groups, actual),
        unattributed=groups[""].endpoints if "" in groups else (),
        foreign=tuple(each for name in strangers for each in groups[name].endpoints),
        tools=tools,
        of_tools=of_tools,
        seen=seen,
        flows=flows,
        uniqueness=Uniqueness.of(
            reported, frame.addresses, last.uniqueness if last is not None else None
        ),
        nodes=nodes,
        topics=topics,
        by_node=by_node,
        by_topic=Parts(
            topics,
            order=str,
            last=last.by_topic if last is not None else None,
            changed=retold,
        ),
        by_flow=Parts(
            dict(enumerate(flows)),
            order=int,
            last=last.by_flow if last is not None else None,
            changed=moved,
        ),
        attributed=attributed,
        groups=groups,
    )


def _same(one: Sequence[object], other: Sequence[object]) -> bool:
    """Return whether two sequences hold the same objects: equal ones may have other identities."""
    return one is other or (len(one) == len(other) and all(map(operator.is_, one, other)))


def _by_identity(observation: Observation) -> tuple[NodeConfiguration, ...]:
    by_name = sorted(observation.configurations, key=lambda each: each.name)
    if all(one.name != other.name for one, other in itertools.pairwise(by_name)):
        return tuple(by_name)
    return tuple(sorted(by_name, key=lambda each: (each.name, repr(each.identity))))


def _attributed(
    observation: Observation,
    frame: Frame,
    reported: Iterable[NodeConfiguration],
    configurations: dict[str, NodeConfiguration],
    last: View | None,
) -> tuple[dict[str, Attributed], dict[str, NodeEndpoints]]:
    """Give each endpoint to its node: by hidden participant, or by the GID that a node reported.

    Services have no GID of their own in reports: one whose node is not known is that of the node on
    its participant that declares it. What client libraries bring along is left out here, unless it
    is declared; under a declared name, unless it is a declared node's.

    Returns:
        The endpoints by the name that discovery shows, but for those without one; and all by the
        name of the node whose they are, sorted by it.
    """
    hidden = owners(frame.planned, reported)
    shown: dict[str, list[ObservedEndpoint]] = {}
    for name, of_node in itertools.groupby(observation.endpoints, operator.attrgetter("node")):
        shown.setdefault(name, []).extend(of_node)
    attributed: dict[str, Attributed] = {}
    by_node: dict[str, list[Sequence[ObservedEndpoint]]] = {}
    for name, endpoints in shown.items():
        node = known_node(name)
        if not node:
            for each in _unknown(endpoints, frame, configurations):
                by_node.setdefault(each.node, []).append((each,))
            continue
        owner = hidden.get(node) if node not in frame.planned else None
        ours = (owner.node if owner is not None else node) in configurations
        known = last.attributed.get(name) if last is not None else None
        if (
            known is None
            or known.owner != owner
            or known.ours is not ours
            or not _same(known.shown, endpoints)
        ):
            judged: dict[str, list[ObservedEndpoint]] = {}
            for each in endpoints:
                whose = owner.node if owner is not None and owner.has(each) else node
                if _counts(each, whose, frame, ours=ours):
                    judged.setdefault(whose, []).append(_as_of(each, whose))
            known = Attributed(
                shown=tuple(endpoints),
                owner=owner,
                ours=ours,
                judged={whose: tuple(found) for whose, found in judged.items()},
            )
        attributed[name] = known
        for whose, found in known.judged.items():
            by_node.setdefault(whose, []).append(found)
    groups = {
        name: _group(
            by_node[name],
            last.groups.get(name) if last is not None else None,
            declared=name in frame.planned,
        )
        for name in sorted(by_node)
    }
    return attributed, groups


def _unknown(
    endpoints: Iterable[ObservedEndpoint],
    frame: Frame,
    configurations: dict[str, NodeConfiguration],
) -> Iterator[ObservedEndpoint]:
    """Yield the endpoints whose node discovery does not show, as far as they count."""
    by_gid = {
        report.gid: name
        for name, configuration in configurations.items()
        for report in configuration.endpoints
        if report.gid
    }
    by_participant: dict[str, dict[str, None]] = {}
    for gid, name in by_gid.items():
        by_participant.setdefault(gid[:_PREFIX_DIGITS], {})[name] = None
    for endpoint in endpoints:
        node = by_gid.get(endpoint.gid, "")
        if not node and not endpoint.kind.is_topic:
            node = next(
                (
                    each
                    for each in by_participant.get(endpoint.gid[:_PREFIX_DIGITS], ())
                    if (each, *(action_part(endpoint.kind, endpoint.name) or _place(endpoint)))
                    in frame.declared
                ),
                "",
            )
        if _counts(endpoint, node, frame, ours=node in configurations):
            # Half of a service may be seen before its node is: it is no second one.
            known = node and not endpoint.kind.is_topic
            yield _as_of(dataclasses.replace(endpoint, gid="") if known else endpoint, node)


def _counts(endpoint: ObservedEndpoint, node: str, frame: Frame, *, ours: bool) -> bool:
    """Return whether an endpoint of a node is declared, feeds what is, or was made on purpose."""
    return (
        (node, endpoint.kind, endpoint.name) in frame.declared
        or (node not in frame.planned and frame.names.looks_for(endpoint.kind, endpoint.name))
        or not is_noise_endpoint(
            endpoint.kind, known_node(endpoint.node), endpoint.name, endpoint.type, ours=ours
        )
    )


def _as_of(endpoint: ObservedEndpoint, node: str) -> ObservedEndpoint:
    if node == endpoint.node:
        return endpoint
    return dataclasses.replace(endpoint, node=node)


def _group(
    parts: Sequence[Sequence[ObservedEndpoint]], last: NodeEndpoints | None, *, declared: bool
) -> NodeEndpoints:
    judged = parts[0] if len(parts) == 1 else [each for part in parts for each in part]
    if last is not None and _same(last.judged, judged):
        return last
    endpoints = _sorted(fold_actions(_sorted(judged)))
    return NodeEndpoints(
        judged=tuple(judged),
        endpoints=endpoints,
        seen=() if declared else tuple(_seen_endpoint(each, None) for each in _topical(endpoints)),
    )


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


def _facts(  # noqa: PLR0917 - all that is known of one node
    frame: Frame,
    node: PlannedNode,
    configuration: NodeConfiguration | None,
    observed: ObservedNode | None,
    parameters: NodeParameters | None,
    endpoints: tuple[ObservedEndpoint, ...],
    last: NodeFacts | None,
) -> NodeFacts:
    """Match one node's declarations to what is seen of it."""
    if (
        last is not None
        and last.node is node
        and last.configuration is configuration
        and last.observed is observed
        and last.parameters is parameters
        and last.endpoints is endpoints
    ):
        return last
    places: _Pools = {}
    for endpoint in endpoints:
        places.setdefault((endpoint.kind, endpoint.name), []).append(endpoint)
    matched, rest = _match_node(node, configuration, places, beyond=frame.is_beyond(node))
    ends: dict[tuple[EndpointKind, str], tuple[Actual, ...]] = {}
    for each in matched:
        place = (each.planned.kind, each.planned.resolved)
        ends[place] = (*ends.get(place, ()), each)
    by_observed = {id(each.observed): each for each in matched if each.observed is not None}
    unseen = [each.observed for each in matched if each.unseen and each.observed is not None]
    return NodeFacts(
        frame=frame,
        node=node,
        observed=observed,
        configuration=configuration,
        parameters=parameters,
        endpoints=endpoints,
        actual=tuple(matched),
        ends=ends,
        rest=tuple(rest),
        seen=tuple(_seen_endpoint(each, by_observed.get(id(each))) for each in _topical(endpoints)),
        beyond=tuple(
            _planned_endpoint(each) for each in matched if each.beyond and _is_topic(each)
        ),
        unseen=tuple(_seen_endpoint(each, by_observed[id(each)]) for each in _topical(unseen)),
        absent=observed is None and not by_observed,
        may_hide=any(each.unseen for each in matched),
    )


def _topical(endpoints: Iterable[ObservedEndpoint]) -> Iterator[ObservedEndpoint]:
    return (each for each in endpoints if each.kind.is_topic)


def _is_topic(actual: Actual) -> bool:
    return actual.planned.kind.is_topic


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
                observed = _as_observed(node, report, planned.resolved)
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


def _undeclared(
    left_over: Sequence[ObservedEndpoint],
    groups: Mapping[str, NodeEndpoints],
    actual: Iterable[Actual],
) -> tuple[ObservedEndpoint, ...]:
    """Leave out of what no declaration covers the parts of declared actions that are half seen."""
    if not any(action_part(each.kind, each.name) for each in left_over):
        return _sorted(left_over)
    seen = {
        (each.node, each.kind, each.name)
        for group in groups.values()
        for each in group.endpoints
        if not each.kind.is_topic
    }
    declared = {
        (each.node.full_name, each.planned.kind, each.planned.resolved): each.planned.type
        for each in actual
    }

    def is_half(endpoint: ObservedEndpoint) -> bool:
        action = action_part(endpoint.kind, endpoint.name)
        place = (endpoint.node, *action) if action is not None else None
        if place not in declared or (place in seen and endpoint.gid):
            return False
        return endpoint.type == part_type(endpoint.name, declared[place])

    return _sorted(each for each in left_over if not is_half(each))


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
        merged[name] = (
            node if known is None else dataclasses.replace(known, count=known.count + node.count)
        )
    return merged


def _seen(
    groups: Mapping[str, NodeEndpoints], nodes: Mapping[str, NodeFacts], tools: Collection[str]
) -> tuple[SeenEndpoint, ...]:
    """Collect publishers and subscriptions with all that is known of them."""
    # Not visible here, but the endpoints that match them count them.
    found = [each for facts in nodes.values() for each in facts.beyond]
    for name, group in groups.items():
        facts = nodes.get(name)
        if facts is not None:
            found += facts.seen
        elif name not in tools:
            found += group.seen
    found += [each for facts in nodes.values() for each in facts.unseen]
    return tuple(found)


def _planned_endpoint(actual: Actual) -> SeenEndpoint:
    return SeenEndpoint(
        kind=actual.planned.kind,
        node=actual.node.full_name,
        name=actual.planned.resolved,
        type=actual.planned.type,
        qos=actual.planned.qos,
        report=None,
        planned=actual.planned,
    )


def _seen_endpoint(endpoint: ObservedEndpoint, match: Actual | None) -> SeenEndpoint:
    report = match.report if match else None
    return SeenEndpoint(
        kind=endpoint.kind,
        node=endpoint.node,
        name=endpoint.name,
        type=endpoint.type,
        qos=actual_qos(endpoint.qos, report.qos if report else None),
        report=report,
        planned=match.planned if match else None,
        type_hash=_type_hash(endpoint, report),
    )


def _topics(
    frame: Frame,
    seen: Iterable[SeenEndpoint],
    of_tools: Iterable[ObservedEndpoint],
    last: View | None,
) -> tuple[dict[str, TopicFacts], Collection[str]]:
    """Return what is seen of every topic, and of which of them another thing than last."""
    tools: dict[str, list[SeenEndpoint]] = {}
    for endpoint in _topical(of_tools):
        tools.setdefault(endpoint.name, []).append(_seen_endpoint(endpoint, None))
    ends: dict[str, list[SeenEndpoint]] = {}
    if last is None:
        for each in seen:
            ends.setdefault(each.name, []).append(each)
        found: dict[str, TopicFacts] = {}
        touched: Collection[str] = ends.keys() | tools.keys()
    else:
        # Ends that are there in both moments are in the same order: nodes have theirs.
        now, before = set(map(id, seen)), set(map(id, last.seen))
        touched = {each.name for each in seen if id(each) not in before}
        touched |= {each.name for each in last.seen if id(each) not in now}
        touched |= tools.keys() | {each.name for each in last.of_tools}
        for each in seen:
            if each.name in touched:
                ends.setdefault(each.name, []).append(each)
        found = dict(last.topics)
    changed: set[str] = set()
    for name in touched:
        here, beside = tuple(ends.get(name, ())), tuple(tools.get(name, ()))
        known = found.get(name)
        if not here and not beside:
            if found.pop(name, None) is not None:
                changed.add(name)
        elif known is None or not _same(known.ends, here) or known.of_tools != beside:
            found[name] = TopicFacts(frame=frame, ends=here, of_tools=beside)
            changed.add(name)
    return found, changed


def _type_hash(endpoint: ObservedEndpoint, report: EndpointReport | None) -> str | None:
    """Discovery wins where it knows a hash; with static discovery only the node itself does."""
    if endpoint.type_hash or report is None or report.type_hash is None:
        return endpoint.type_hash
    return report.type_hash


def _flows(
    frame: Frame,
    nodes: Mapping[str, NodeFacts],
    topics: Mapping[str, TopicFacts],
    last: View | None,
    changed: Iterable[str],
) -> tuple[tuple[FlowView, ...], Collection[int]]:
    """Return every flow, and the indices of those that have another node or topic than last."""

    def flow(planned: PlannedFlow) -> FlowView:
        return _flow(
            planned,
            nodes[frame.by_key[planned.publisher]],
            nodes[frame.by_key[planned.subscription]],
            topics.get(planned.topic),
        )

    if last is None:
        return tuple(map(flow, frame.plan.flows)), ()
    (concerned,) = once(frame, _flows_by_name)
    moved = {index for name in changed for index in concerned.get(name, ())}
    found = list(last.flows)
    for index in moved:
        found[index] = flow(frame.plan.flows[index])
    return tuple(found), moved


def _flows_by_name(frame: Frame) -> Iterator[dict[str, list[int]]]:
    """Yield the indices of the flows that a node or a topic is of; names may be of both."""
    found: dict[str, list[int]] = {}
    for index, each in enumerate(frame.plan.flows):
        for name in {frame.by_key[each.publisher], frame.by_key[each.subscription], each.topic}:
            found.setdefault(name, []).append(index)
    yield found


def _flow(
    planned: PlannedFlow, source: NodeFacts, destination: NodeFacts, topic: TopicFacts | None
) -> FlowView:
    publishers = source.ends.get((EndpointKind.PUBLISHER, planned.topic), ())
    subscriptions = destination.ends.get((EndpointKind.SUBSCRIPTION, planned.topic), ())
    return FlowView(
        planned=planned,
        publisher=source.name,
        subscription=destination.name,
        publishers=publishers,
        subscriptions=subscriptions,
        at=next((each.planned.at for each in (*subscriptions, *publishers)), None),
        nodes=(source, destination),
        ends_of_topic=topic,
    )


def _sorted(endpoints: Iterable[ObservedEndpoint]) -> tuple[ObservedEndpoint, ...]:
    return tuple(
        sorted(
            endpoints,
            key=lambda each: (each.node, each.name, each.kind.value, each.type, each.gid),
        )
    )
