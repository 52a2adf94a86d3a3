"""Rules about the transport that carries a flow: shared memory, intra-process, UDP, TCP. Pure.

A network treats only what it sees: a flow that is passed on in shared memory, or inside a process,
meets no rule of it. NFEs list what an endpoint could use; which one is used is decided in
`verify.transport`.
"""

from __future__ import annotations

from collections.abc import Iterator

from lifecycle.manifest import FlowTransport
from lifecycle.network import NETWORK_MEDIA, Medium
from lifecycle.verify.rules.catalogue import Heals, Rule
from lifecycle.verify.transport import (
    NONE,
    UNKNOWN,
    effective_transport,
)
from lifecycle.verify.verdict import Finding, Outcome
from lifecycle.verify.view import Actual, FlowView, View, connection_of

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
    if_unheard=True,
)
RULES = (WRONG_TRANSPORT, WRONG_MEDIUM)

_WORDS = {
    **{each.value: each.meaning for each in Medium},
    NONE: "no transport that both have",
    UNKNOWN: "not known",
}


def check(view: View) -> Iterator[Finding]:
    """Judge every flow that must be carried by something."""
    for flow in view.flows:
        ends = (*flow.publishers, *flow.subscriptions)
        if not flow.publishers or not flow.subscriptions:
            continue
        if any(end.observed is None and end.report is None for end in ends):
            continue  # it is missing, and that is said
        used = effective_transport(view, flow)
        demanding = [end for end in ends if end.planned.transport is FlowTransport.NETWORK]
        if demanding and used not in NETWORK_MEDIA:
            yield _not_by_network(flow, demanding[0], used)
        elif flow.planned.medium not in ("", used) and _is_decided(view, flow):
            yield _otherwise(flow, used)


def _is_decided(view: View, flow: FlowView) -> bool:
    """Return whether the medium was asked for; else the plan only has what is expected."""
    if view.plan.data_layer.at is not None:
        return True
    return any(
        end.planned.transport not in (FlowTransport.ANY, FlowTransport.NETWORK)
        or connection_of(end.node, end.planned)
        or end.node.connections.urls
        for end in (*flow.publishers, *flow.subscriptions)
    )


def _not_by_network(flow: FlowView, demanding: Actual, used: str) -> Finding:
    unknown = used == UNKNOWN
    why = "nobody tells what carries it" if unknown else f"what carries it is {_WORDS[used]}"
    return WRONG_TRANSPORT.finding(
        Outcome.UNVERIFIABLE if unknown else Outcome.VIOLATED,
        subject=flow.subject,
        ends=flow.ends,
        expected="an IP transport",
        observed=_WORDS[used],
        message=f"cannot {'verify' if unknown else 'accept'} the flow {flow.publisher} →"
        f" {flow.subscription} on {flow.planned.topic}: it needs the network, and {why}",
        at=demanding.planned.at,
    )


def _otherwise(flow: FlowView, used: str) -> Finding:
    unknown = used == UNKNOWN
    planned = _WORDS.get(flow.planned.medium, flow.planned.medium)
    word = _WORDS.get(used, used)
    return WRONG_MEDIUM.finding(
        Outcome.UNVERIFIABLE if unknown else Outcome.VIOLATED,
        subject=flow.subject,
        ends=flow.ends,
        expected=planned,
        observed=word,
        message=f"cannot {'verify' if unknown else 'accept'} what carries {flow.publisher} →"
        f" {flow.subscription} on {flow.planned.topic}: it must be {planned}, and"
        f" {'nobody tells what it is' if unknown else f'it is {word}'}",
        at=flow.at,
    )
