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

from lifecycle.manifest.model import FlowTransport, UniqueHow
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
    says="{who} has {observed}, and must have {expected}",
    unproven="nothing shows that {who} has {expected}: {observed}",
    fix="see who was to make it: the node at connect, or the supervisor by connect_to",
)
FAILED_CONNECTION = _of_connections(
    id="connection.failed",
    meaning="a node reports that it could not make a connection",
    says="{who} has no {expected}: {observed}",
    fix="read the reason: addresses and ports of a URL must be free on the node's own machine",
)
OTHER_CONNECTION = _of_connections(
    id="connection.differs",
    meaning="a connection was made to other URLs than planned",
    says="{who} is connected to {observed}, and must be to {expected}",
    fix="see who called connect_to; disconnect it, and let its authority make it again",
)
WRONG_MAPPING = _of_connections(
    id="connection.wrong-mapping",
    meaning="an endpoint is mapped onto another connection than planned",
    says="{who} is mapped onto {observed}, and must be onto {expected}",
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
    expected = f"connection {name!r} ({', '.join(planned.urls)})"
    if configuration is None:
        if not facts.is_ours:  # of ours it is said that it does not report
            yield MISSING_CONNECTION.on(
                node,
                outcome=Outcome.UNVERIFIABLE,
                expected=expected,
                observed="the node does not report its connections",
            )
        return
    report = next((each for each in configuration.connections if each.name == name), None)
    if report is None:
        yield MISSING_CONNECTION.on(
            node,
            outcome=Outcome.VIOLATED,
            expected=expected,
            observed=_listed(configuration.connections),
        )
    elif report.error:
        yield FAILED_CONNECTION.on(node, expected=expected, observed=report.error)
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
        who=f"{what} of {node.full_name}",
        expected=", ".join(planned.urls),
        observed=", ".join(report.urls) or "no URL",
    )


def _mapping(actual: Actual) -> Iterator[Finding]:
    report = actual.report
    if report is None or report.error or not report.mapped:
        return  # that is judged as an endpoint
    wanted = connection_of(actual.owner, actual.planned)
    if report.connection != wanted:
        yield WRONG_MAPPING.on(
            actual,
            expected=_spell_connection(wanted),
            observed=_spell_connection(report.connection),
        )


def _spell_connection(connection: str) -> str:
    return f"connection {connection!r}" if connection else "the node's own participant"


def _listed(connections: Sequence[ConnectionReport]) -> str:
    return ", ".join(repr(each.name) for each in connections if each.name) or "no connection"


NOT_UNIQUE = Rule(
    id="flow.not-unique",
    meaning="an endpoint or a link needs a unique network flow and does not have it",
    says="{who} must have {expected}, and {observed}",
    fix="ask for `unique:` on the endpoint itself, so that it gets sockets of its own; see"
    " `lifecycle flows`",
    concerns_flow=True,
)
UNVERIFIABLE = Rule(
    id="flow.unverifiable",
    meaning="a unique network flow is strictly required or demanded and cannot be proven",
    says="{who} must have {expected}, which is not proven: {observed}",
    fix="run the node with `run: python` under rmw_fastrtps_cpp, which reports network flow"
    " endpoints; or ask for `unique: optionally_required`, or drop the link's `unique`",
    concerns_flow=True,
    heals=Heals.WITH_TIME,
    awaits=MISSING_REPORT,  # nothing else could prove it
)


def check(view: View) -> Iterator[Finding]:
    """Judge connections and mappings, strict endpoints, links' demands, media, then marks."""
    first_port = view.plan.discovery.first_port
    for facts in view.nodes.values():
        yield from _judge_connections(facts, first_port)
    for actual in view.actual:
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


def _strict(actual: Actual, uniqueness: Uniqueness) -> Iterator[Finding]:
    report = actual.report
    if (actual.observed is None and report is None) or (report is not None and report.error):
        return  # not made: that is said already
    unique, expected = uniqueness.is_unique(actual), "a unique network flow"
    if unique is None:
        yield UNVERIFIABLE.on(actual, expected=expected, observed=_why_unproven(actual))
    elif unique is False:
        shared = ", ".join(dict.fromkeys(map(_spell, uniqueness.nfes(actual)))) or "none"
        observed = f"has {shared} as other {actual.kind.noun}s have"
        yield NOT_UNIQUE.on(actual, expected=expected, observed=observed)


def _demanded(flow: FlowView, uniqueness: Uniqueness) -> Iterator[Finding]:
    if not flow.writer or not flow.reader or is_missing(flow):
        return  # the link is unmatched, and says so
    publisher = uniqueness.is_unique(flow.writer)
    subscription = uniqueness.is_unique(flow.reader)
    met = meets(flow.planned.unique, publisher=publisher, subscription=subscription)
    if met:
        return
    article = "has" if met is False else "it has"
    yield (UNVERIFIABLE if met is None else NOT_UNIQUE).on(
        flow,
        expected=f"{flow.planned.unique.value} unique network flow endpoints, as its link demands",
        observed=f"{article} a publisher that is {_answer(publisher)}, a subscription that is"
        f" {_answer(subscription)}",
    )


def _why_unproven(actual: Actual) -> str:
    """Return why the network flow endpoints of an endpoint, or of its neighbours, are not known."""
    if actual.report is None:
        return f"{actual.node} does not report its network flow endpoints"
    if actual.report.nfes is None:
        return "its RMW does not report network flow endpoints"
    return "its process has endpoints whose network flow endpoints are not reported"


def _answer(unique: bool | None) -> str:
    return {True: "unique", False: "not unique", None: "perhaps unique"}[unique]


def _spell(nfe: NetworkFlowEndpoint) -> str:
    """Spell an NFE for people: `udp 10.0.0.1:7412`, `shm`."""
    protocol = nfe.transport_protocol
    known = f"{protocol.value} " if protocol is not TransportProtocol.UNKNOWN else ""
    return known + nfe.describe()


_CARRIED = "what carries {who} is {observed}, and must be {expected}"
_NOT_SHOWN = "nothing shows that what carries {who} is {expected}: it is {observed}"

WRONG_TRANSPORT = Rule(
    id="flow.wrong-transport",
    meaning="a flow that needs the network is carried by something else",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    says=_CARRIED,
    unproven=_NOT_SHOWN,
    fix="run both ends in our host and in processes of their own, or drop `transport: network`",
    concerns_flow=True,
)
WRONG_MEDIUM = Rule(
    id="flow.wrong-medium",
    meaning="a flow is carried by something else than was negotiated",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    says=_CARRIED,
    unproven=_NOT_SHOWN,
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
    used = effective_transport(flow)
    network = [end for end in flow.endpoints if end.planned.transport is FlowTransport.NETWORK]
    rule, expected, at = WRONG_MEDIUM, _WORDS.get(flow.planned.medium, flow.planned.medium), flow.at
    if network and used not in NETWORK_MEDIA:
        rule, expected, at = WRONG_TRANSPORT, "an IP transport", network[0].planned.at
    elif flow.planned.medium in ("", used) or not _is_decided(view, flow):
        return
    outcome = Outcome.UNVERIFIABLE if used == UNKNOWN else Outcome.VIOLATED
    yield rule.on(flow, outcome=outcome, expected=expected, observed=_WORDS[used], at=at)


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


DSCP_NOT_APPLIED = Rule(
    id="flow.dscp-not-applied",
    meaning="the sockets that an endpoint sends from do not carry the declared DSCP",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    says="the sockets of {who} carry {observed}, and must carry {expected}",
    unproven="the sockets of {who} carry {observed}; the manifest does not enforce {expected}",
    fix="see the node's log for the refused socket option; `enforce: false` makes it a warning",
    concerns_flow=True,
    may_block=False,
)
DSCP_UNVERIFIABLE = Rule(
    id="flow.dscp-unverifiable",
    meaning="nobody read back the DSCP of an endpoint that declares one",
    outcomes=(Outcome.UNVERIFIABLE,),
    unproven="nothing shows that the sockets of {who} carry {expected}: {observed}",
    fix="only nodes in our host mark and read back; mark a foreign node's flow in the network",
    concerns_flow=True,
)
RULES = (
    *(MISSING_CONNECTION, FAILED_CONNECTION, OTHER_CONNECTION, WRONG_MAPPING),
    *(NOT_UNIQUE, UNVERIFIABLE),
    *(WRONG_TRANSPORT, WRONG_MEDIUM, DSCP_NOT_APPLIED, DSCP_UNVERIFIABLE),
)


def _judge_dscp(actual: Actual) -> Iterator[Finding]:
    """Judge the DSCP of an endpoint; a subscription's is that of its acknowledgements."""
    planned, report = actual.planned, actual.report
    wanted, read = planned.dscp, report.dscp if report else None
    if wanted is None or read == wanted:
        return
    if read is None:
        yield DSCP_UNVERIFIABLE.on(
            actual, expected=describe(wanted), observed="it was not read back"
        )
        return
    yield DSCP_NOT_APPLIED.on(
        actual,
        outcome=Outcome.VIOLATED if planned.enforce_dscp else Outcome.UNVERIFIABLE,
        expected=describe(wanted),
        observed=describe(read),
        hint="" if planned.enforce_dscp else "see the node's log for the refused option",
    )
