"""Rules about connections, and about network flows: uniqueness, transport, DSCP marking. Pure.

A connection is a participant that only its own node can report on: discovery shows a hidden node,
but neither its connection URLs nor why it could not connect.

What is strictly required, or demanded by a link, must be proven: what cannot be is violated. An
optionally required endpoint never violates: the requirement is met by trying. `system_default`
demands nothing either; the flow report has the result.

A network treats only what it sees: a flow that is passed on in shared memory, or inside a process,
meets no rule of it. NFEs list what an endpoint could use; which one is used is decided in
`verify.network_flows`.

The DSCP judged is the one read back from the sender sockets (getsockopt), never the NFE's `dscp`
field, which Fast DDS always leaves 0. It proves what this host sends, not what routers keep.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence

from lifecycle.manifest.model import EndpointKind, FlowTransport, UniqueHow
from lifecycle.network.dscp import describe
from lifecycle.network.medium import NETWORK_MEDIA, Medium
from lifecycle.network.nfe import NetworkFlowEndpoint, TransportProtocol, UniqueRequirement
from lifecycle.plan.model import ParticipantConnections, PlannedNode
from lifecycle.plan.restart import is_same_url
from lifecycle.verify.network_flows import NONE, UNKNOWN, Uniqueness, effective_transport, meets
from lifecycle.verify.outcome import ConnectionReport, Outcome
from lifecycle.verify.rules.catalogue import About, Heals, Rule
from lifecycle.verify.rules.state import MISSING_REPORT
from lifecycle.verify.verdict import Finding
from lifecycle.verify.view import Actual, FlowView, NodeFacts, View, connection_of

_of_connections = functools.partial(
    Rule, concerns_flow=True, about=About.CONNECTION, heals=Heals.WITH_TIME
)

MISSING_CONNECTION = _of_connections(
    id="connection.missing",
    meaning="a planned connection of a node does not exist",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    fix="see who was to make it: the node at connect, or the supervisor by connect_to",
)
FAILED_CONNECTION = _of_connections(
    id="connection.failed",
    meaning="a node reports that it could not make a connection",
    fix="read the reason: addresses and ports of a URL must be free on the node's own machine",
)
OTHER_CONNECTION = _of_connections(
    id="connection.differs",
    meaning="a connection was made to other URLs than planned",
    fix="see who called connect_to; disconnect it, and let its authority make it again",
)
WRONG_MAPPING = _of_connections(
    id="connection.wrong-mapping",
    meaning="an endpoint is mapped onto another connection than planned",
    fix="see who called map_to; map it back, or change the node's `connections`",
)


def _judge_connections(facts: NodeFacts, first_port: int) -> Iterator[Finding]:
    if facts.absent:
        return
    yield from _own(facts, first_port)
    for participant in facts.node.participants:
        if participant.connection:
            yield from _connection(
                facts, participant.connection, participant.connections, first_port
            )
    for actual in facts.actual:
        yield from _mapping(actual)


def _own(facts: NodeFacts, first_port: int) -> Iterator[Finding]:
    """The node's own participant: it is always there, but may be connected otherwise."""
    node, configuration = facts.node, facts.configuration
    for report in configuration.connections if configuration else ():
        if not report.name and report.urls and node.connections.urls:
            yield from _urls(node, report, node.connections, first_port)


def _connection(
    facts: NodeFacts, name: str, planned: ParticipantConnections, first_port: int
) -> Iterator[Finding]:
    node, configuration = facts.node, facts.configuration
    if configuration is None:
        if facts.is_ours:
            return  # that it does not report is said
        yield MISSING_CONNECTION.on(
            node,
            outcome=Outcome.UNVERIFIABLE,
            expected=f"connection {name}",
            observed="unknown",
            message=f"nothing shows connection {name!r} of {node.full_name}: the node does not"
            " report its connections",
        )
        return
    report = next((each for each in configuration.connections if each.name == name), None)
    if report is None:
        yield MISSING_CONNECTION.on(
            node,
            outcome=Outcome.VIOLATED,
            expected=f"connection {name}",
            observed=_listed(configuration.connections),
            message=f"{node.full_name} has no connection {name!r};"
            f" it has {_listed(configuration.connections)}",
        )
    elif report.error:
        yield FAILED_CONNECTION.on(
            node,
            expected=f"connection {name}",
            observed=report.error,
            message=f"{node.full_name} is not connected to {name!r}"
            f" ({', '.join(report.urls or planned.urls)}): {report.error}",
        )
    else:
        yield from _urls(node, report, planned, first_port)


def _urls(
    node: PlannedNode, report: ConnectionReport, planned: ParticipantConnections, first_port: int
) -> Iterator[Finding]:
    pairs = zip(planned.urls, report.urls, strict=False)
    if len(planned.urls) == len(report.urls) and all(
        is_same_url(*each, first_port=first_port) for each in pairs
    ):
        return
    what = f"connection {report.name!r}" if report.name else "the own participant"
    yield OTHER_CONNECTION.on(
        node,
        expected=", ".join(planned.urls),
        observed=", ".join(report.urls) or "no URL",
        message=f"{what} of {node.full_name} was made to"
        f" {', '.join(report.urls) or 'no URL'} and must be to {', '.join(planned.urls)}",
    )


def _mapping(actual: Actual) -> Iterator[Finding]:
    report = actual.report
    if report is None or report.error or not report.mapped:
        return  # that is judged as an endpoint
    wanted = connection_of(actual.owner, actual.planned)
    if report.connection == wanted:
        return
    yield WRONG_MAPPING.on(
        actual,
        expected=_spell_connection(wanted),
        observed=_spell_connection(report.connection),
        message=f"{actual.where} is mapped onto {_spell_connection(report.connection)}"
        f" and must be onto {_spell_connection(wanted)}",
    )


def _spell_connection(connection: str) -> str:
    return f"connection {connection!r}" if connection else "the node's own participant"


def _listed(connections: Sequence[ConnectionReport]) -> str:
    return ", ".join(repr(each.name) for each in connections if each.name) or "no connection"


NOT_UNIQUE = Rule(
    id="flow.not-unique",
    meaning="an endpoint or a link needs a unique network flow and does not have it",
    fix="ask for `unique:` on the endpoint itself, so that it gets sockets of its own; see"
    " `lifecycle flows`",
    concerns_flow=True,
)
UNVERIFIABLE = Rule(
    id="flow.unverifiable",
    meaning="a unique network flow is strictly required or demanded and cannot be proven",
    fix="run the node with `run: python` under rmw_fastrtps_cpp, which reports network flow"
    " endpoints; or ask for `unique: optionally_required`, or drop the link's `unique`",
    concerns_flow=True,
    heals=Heals.WITH_TIME,
    awaits=MISSING_REPORT,  # nothing else could prove it
)
BROKEN_ENDPOINT = Rule(
    id="flow.broken-endpoint",
    meaning="a subscription has no network flow endpoint at all, so nothing can reach it",
    fix="look for two processes with the same fixed ports, or an interface whitelist that matches"
    " no interface",
    concerns_flow=True,
)


def check(view: View) -> Iterator[Finding]:
    """Judge connections and mappings, strict endpoints, links' demands, media, then marks."""
    first_port = view.plan.discovery.first_port
    for facts in view.nodes.values():
        yield from _judge_connections(facts, first_port)
    for actual in view.actual:
        yield from _broken(actual)
        if actual.planned.unique is UniqueRequirement.STRICTLY_REQUIRED:
            yield from _strict(actual, view.uniqueness)
    for flow in view.flows:
        if flow.planned.unique is not UniqueHow.NOT:
            yield from _demanded(flow, view.uniqueness)
    for flow in view.flows:
        if flow.writer and flow.reader and not is_missing(flow):
            yield from _judge_transport(view, flow)
    for actual in view.actual:
        if actual.observed is not None or actual.report is not None:
            yield from _judge_dscp(actual)


def is_missing(flow: FlowView) -> bool:
    """Return whether nothing is seen of one end: it is missing, and that is said."""
    return any(end.observed is None and end.report is None for end in flow.endpoints)


def _broken(actual: Actual) -> Iterator[Finding]:
    report = actual.report
    if actual.kind is not EndpointKind.SUBSCRIPTION or report is None or report.error:
        return
    if report.nfes == ():
        yield BROKEN_ENDPOINT.on(
            actual,
            expected="at least one network flow endpoint",
            observed="none",
            message=f"nothing reaches {actual.where}: it has no network flow endpoint",
        )


def _strict(actual: Actual, uniqueness: Uniqueness) -> Iterator[Finding]:
    report = actual.report
    if actual.observed is None and report is None:
        return
    if report is not None and (report.error or report.nfes == ()):
        return  # not made, or broken: that is said already
    word, where = actual.kind.noun, actual.where
    unique = uniqueness.is_unique(actual)
    if unique is None:
        yield UNVERIFIABLE.on(
            actual,
            expected=f"unique {word}",
            observed="network flow endpoints not reported",
            message=f"{where} strictly requires a unique network flow, which"
            f" is not proven: {_why_unproven(actual)}",
        )
    elif unique is False:
        shared = ", ".join(dict.fromkeys(map(_spell, uniqueness.nfes(actual))))
        yield NOT_UNIQUE.on(
            actual,
            expected=f"unique {word}",
            observed=f"shares {shared}",
            message=f"{where} strictly requires a unique network flow and shares"
            f" {shared} with other {word}s",
        )


def _demanded(flow: FlowView, uniqueness: Uniqueness) -> Iterator[Finding]:
    if not flow.writer or not flow.reader or is_missing(flow):
        return  # the link is unmatched, and says so
    how = flow.planned.unique.value
    publisher = uniqueness.is_unique(flow.writer)
    subscription = uniqueness.is_unique(flow.reader)
    met = meets(flow.planned.unique, publisher=publisher, subscription=subscription)
    if met:
        return
    observed = f"publisher {_answer(publisher)}, subscription {_answer(subscription)}"
    unproven = ", which is not proven" if met is None else ""
    rule = UNVERIFIABLE if met is None else NOT_UNIQUE
    yield rule.on(
        flow,
        expected=f"{how} unique flow",
        observed=observed,
        message=f"the flow {flow.publisher} → {flow.subscription} on {flow.planned.topic} is not as"
        f" its link demands, a {how} unique flow{unproven}; {observed}",
    )


def _why_unproven(actual: Actual) -> str:
    """Return why the network flow endpoints of an endpoint, or of its neighbours, are not known."""
    if actual.report is None:
        return f"{actual.node} does not report its network flow endpoints"
    if actual.report.nfes is None:
        return "its RMW does not report network flow endpoints"
    return "its process has endpoints whose network flow endpoints are not reported"


def _answer(unique: bool | None) -> str:
    return {True: "unique", False: "not unique", None: "unknown"}[unique]


def _spell(nfe: NetworkFlowEndpoint) -> str:
    """Spell an NFE for people: `udp 10.0.0.1:7412`, `shm`."""
    protocol = nfe.transport_protocol
    known = f"{protocol.value} " if protocol is not TransportProtocol.UNKNOWN else ""
    return known + nfe.describe()


WRONG_TRANSPORT = Rule(
    id="flow.wrong-transport",
    meaning="a flow that needs the network is carried by something else",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    fix="run both ends in our host and in processes of their own, or drop `transport: network`",
    concerns_flow=True,
)
WRONG_MEDIUM = Rule(
    id="flow.wrong-medium",
    meaning="a flow is carried by something else than was negotiated",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    fix="compare the connections of both ends with `lifecycle plan`; see what each process was"
    " given by its environment",
    concerns_flow=True,
    heals=Heals.WITH_TIME,
    if_undiscovered=True,
)
_WORDS = {
    **{each.value: each.meaning for each in Medium},
    NONE: "no transport that both have",
    UNKNOWN: "not known",
}


def _judge_transport(view: View, flow: FlowView) -> Iterator[Finding]:
    ends = flow.endpoints
    used = effective_transport(flow)
    demanding = [end for end in ends if end.planned.transport is FlowTransport.NETWORK]
    if demanding and used not in NETWORK_MEDIA:
        yield _not_by_network(flow, demanding[0], used)
    elif flow.planned.medium not in ("", used) and _is_decided(view, flow):
        yield _otherwise(flow, used)


def _is_decided(view: View, flow: FlowView) -> bool:
    """Return whether the medium was asked for; else the plan only has what is expected."""
    if "data_layer" in view.plan.positions:
        return True
    return any(
        end.planned.transport not in (FlowTransport.ANY, FlowTransport.NETWORK)
        or connection_of(end.owner, end.planned)
        or end.owner.connections.urls
        for end in flow.endpoints
    )


def _not_by_network(flow: FlowView, demanding: Actual, used: str) -> Finding:
    unknown = used == UNKNOWN
    why = "nothing shows what carries it" if unknown else f"what carries it is {_WORDS[used]}"
    return WRONG_TRANSPORT.finding(
        outcome=Outcome.UNVERIFIABLE if unknown else Outcome.VIOLATED,
        subject=flow.subject,
        ends=flow.ends,
        expected="an IP transport",
        observed=_WORDS[used],
        message=f"the flow {flow.publisher} →"
        f" {flow.subscription} on {flow.planned.topic} needs the network, and {why}",
        at=demanding.planned.at,
    )


def _otherwise(flow: FlowView, used: str) -> Finding:
    unknown = used == UNKNOWN
    planned = _WORDS.get(flow.planned.medium, flow.planned.medium)
    word = _WORDS[used]
    return WRONG_MEDIUM.on(
        flow,
        outcome=Outcome.UNVERIFIABLE if unknown else Outcome.VIOLATED,
        expected=planned,
        observed=word,
        message=f"what carries {flow.publisher} →"
        f" {flow.subscription} on {flow.planned.topic} must be {planned}, and"
        f" {'nothing shows what it is' if unknown else f'is {word}'}",
    )


DSCP_NOT_APPLIED = Rule(
    id="flow.dscp-not-applied",
    meaning="the sockets that an endpoint sends from do not carry the declared DSCP",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    fix="see the node's log for the refused socket option; `enforce: false` makes it a warning",
    concerns_flow=True,
    may_block=False,
)
DSCP_UNVERIFIABLE = Rule(
    id="flow.dscp-unverifiable",
    meaning="nobody read back the DSCP of an endpoint that declares one",
    outcomes=(Outcome.UNVERIFIABLE,),
    fix="only nodes in our host mark and read back; mark a foreign node's flow in the network",
    concerns_flow=True,
)
RULES = (
    *(MISSING_CONNECTION, FAILED_CONNECTION, OTHER_CONNECTION, WRONG_MAPPING),
    *(NOT_UNIQUE, UNVERIFIABLE, BROKEN_ENDPOINT),
    *(WRONG_TRANSPORT, WRONG_MEDIUM),
    *(DSCP_NOT_APPLIED, DSCP_UNVERIFIABLE),
)


def _judge_dscp(actual: Actual) -> Iterator[Finding]:
    """Judge the DSCP of an endpoint; a subscription's is that of its acknowledgements."""
    planned, report = actual.planned, actual.report
    wanted, read = planned.dscp, report.dscp if report else None
    if wanted is None:
        return
    if read is None:
        yield DSCP_UNVERIFIABLE.on(
            actual,
            expected=describe(wanted),
            observed="not read back",
            message=f"nothing shows the DSCP of {actual.where}: it was not read back",
        )
    elif read != wanted:
        waived = "" if planned.enforce_dscp else "; the manifest does not enforce it"
        yield DSCP_NOT_APPLIED.on(
            actual,
            outcome=Outcome.VIOLATED if planned.enforce_dscp else Outcome.UNVERIFIABLE,
            expected=describe(wanted),
            observed=describe(read),
            message=f"the sockets of {actual.where} carry {describe(read)}"
            f" and not {describe(wanted)}{waived}",
            hint="" if planned.enforce_dscp else "see the node's log for the refused option",
        )
