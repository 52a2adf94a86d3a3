"""Rules about connections and mappings: missing, failed, otherwise than planned. Pure.

A connection is a participant that only its own node can report on: discovery shows a hidden node,
but neither its connection URLs nor why it could not connect. So the nodes' reports are judged.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence

from lifecycle.network.connection_url import ConnectionUrl, ConnectionUrlError, parse
from lifecycle.plan.model import ParticipantConnections, PlannedNode
from lifecycle.plan.restart import is_restarted_url
from lifecycle.verify.outcome import ConnectionReport, Outcome
from lifecycle.verify.rules.catalogue import About, Heals, Rule
from lifecycle.verify.verdict import Finding
from lifecycle.verify.view import Actual, NodeFacts, View, connection_of

_rule = functools.partial(Rule, concerns_flow=True, about=About.CONNECTION, heals=Heals.WITH_TIME)

MISSING = _rule(
    id="connection.missing",
    meaning="a planned connection of a node does not exist",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    fix="see who was to make it: the node at connect, or the supervisor by connect_to",
)
FAILED = _rule(
    id="connection.failed",
    meaning="a node reports that it could not make a connection",
    fix="read the reason: addresses and ports of a URL must be free on the node's own machine",
)
DIFFERS = _rule(
    id="connection.differs",
    meaning="a connection was made to other URLs than planned",
    fix="see who called connect_to; disconnect it, and let its authority make it again",
)
WRONG_MAPPING = _rule(
    id="connection.wrong-mapping",
    meaning="an endpoint is mapped onto another connection than planned",
    fix="see who called map_to; map it back, or change the node's `connections`",
)
RULES = (MISSING, FAILED, DIFFERS, WRONG_MAPPING)


def check(view: View) -> Iterator[Finding]:
    """Judge every planned connection and mapping."""
    first_port = view.plan.discovery.first_port
    for facts in view.nodes.values():
        yield from _judge(facts, first_port)


def _judge(facts: NodeFacts, first_port: int) -> Iterator[Finding]:
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
        yield MISSING.on(
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
        yield MISSING.on(
            node,
            outcome=Outcome.VIOLATED,
            expected=f"connection {name}",
            observed=_listed(configuration.connections),
            message=f"{node.full_name} has no connection {name!r};"
            f" it has {_listed(configuration.connections)}",
        )
    elif report.error:
        yield FAILED.on(
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
    if _as_planned(report.urls, planned.urls, first_port=first_port):
        return
    what = f"connection {report.name!r}" if report.name else "the own participant"
    yield DIFFERS.on(
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
    wanted = connection_of(actual.node, actual.planned)
    if report.connection == wanted:
        return
    node, planned = actual.node, actual.planned
    yield WRONG_MAPPING.on(
        actual,
        expected=_spell(wanted),
        observed=_spell(report.connection),
        message=f"the {planned.kind.noun} of {planned.resolved} in"
        f" {node.full_name} is mapped onto {_spell(report.connection)} and must be onto"
        f" {_spell(wanted)}",
    )


def _as_planned(reported: Sequence[str], planned: Sequence[str], *, first_port: int) -> bool:
    """Whether URLs mean the same, or what a node has after a restart."""
    was, now = _meant(planned), _meant(reported)
    if len(was) != len(now):
        return False
    return all(
        old == new
        or (
            isinstance(old, ConnectionUrl)
            and isinstance(new, ConnectionUrl)
            and is_restarted_url(str(old), str(new), first_port=first_port)
        )
        for old, new in zip(was, now, strict=True)
    )


def _meant(urls: Sequence[str]) -> tuple[ConnectionUrl | str, ...]:
    """Return what URLs mean: one URL may be written in several ways."""
    return tuple(_read(each) for each in urls)


def _read(url: str) -> ConnectionUrl | str:
    try:
        return parse(url)
    except ConnectionUrlError:
        return url


def _spell(connection: str) -> str:
    return f"connection {connection!r}" if connection else "the node's own participant"


def _listed(connections: Sequence[ConnectionReport]) -> str:
    return ", ".join(repr(each.name) for each in connections if each.name) or "no connection"
