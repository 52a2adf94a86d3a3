"""Rules about declared clients of services and actions that no server is matched with. Pure.

A client reports whether a server is matched with it both ways; a server reports nothing about its
clients.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from lifecycle.manifest import EndpointKind
from lifecycle.verify.observation import ObservedEndpoint
from lifecycle.verify.rules.catalogue import About, Heals, Rule
from lifecycle.verify.verdict import Finding, Outcome
from lifecycle.verify.view import Actual, View

UNMATCHED_CLIENT = Rule(
    id="graph.unmatched-client",
    meaning="a declared client and a declared server of its service or action are not matched",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    fix="look at the QoS of both ends, and at the network between the two",
    about=About.MATCH,
    heals=Heals.WITH_TIME,
    if_unheard=True,
    absence="match",
)
RULES = (UNMATCHED_CLIENT,)

_Place = tuple[EndpointKind, str, str]
"""Kind, name and type."""

SERVER_OF = {
    EndpointKind.SERVICE_CLIENT: EndpointKind.SERVICE_SERVER,
    EndpointKind.ACTION_CLIENT: EndpointKind.ACTION_SERVER,
}


def check(view: View) -> Iterator[Finding]:
    """Judge every declared client that reports and of which declared servers are there."""
    servers: dict[_Place, list[str]] = {}
    for actual in view.actual:
        if actual.observed is not None:
            servers.setdefault(_place(actual.observed), []).append(actual.node.full_name)
    others = Counter(
        map(_place, (*view.undeclared, *view.foreign, *view.of_tools, *view.unattributed))
    )
    for client in view.actual:
        kind = SERVER_OF.get(client.planned.kind)
        if kind is None or client.observed is None:
            continue
        if client.report is None:
            # Of ours that has its own finding; of others no more can be seen than that both ends
            # are there and of one type, as of their topics.
            continue
        place = kind, client.observed.name, client.observed.type
        found = servers.get(place, ())
        for server in dict.fromkeys(found):
            yield from _judge(client, server, count=len(found) + others[place])


def _place(seen: ObservedEndpoint) -> _Place:
    return seen.kind, seen.name, seen.type


def _judge(client: Actual, server: str, *, count: int) -> Iterator[Finding]:
    report = client.report
    assert report is not None
    if not report.mapped:
        return  # it is about to go, or discovery is ahead of the report
    if report.server_matched is False:
        outcome, reason = Outcome.VIOLATED, "the client counts no server as available"
    elif report.server_matched is None:
        outcome, reason = Outcome.UNVERIFIABLE, "its client does not tell"
    elif count > 1:
        outcome = Outcome.UNVERIFIABLE
        reason = f"it has {count} servers, and the client does not tell which it is matched with"
    else:
        return
    name, node = client.planned.resolved, client.node.full_name
    verb = "see" if outcome is Outcome.VIOLATED else "verify that"
    state = "matched" if outcome is Outcome.VIOLATED else "are matched"
    yield UNMATCHED_CLIENT.finding(
        outcome,
        subject=f"{name}: {node} → {server}",
        ends=(node, server),
        expected="matched",
        observed=reason,
        message=f"cannot {verb} {node} → {server} {state} on"
        f" {client.planned.kind.noun.partition(' ')[0]} {name}: {reason}",
        at=client.planned.at,
        node=node,
        endpoint=client.planned.kind,
    )
