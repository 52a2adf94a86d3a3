"""Rules about the uniqueness of network flows. Pure.

An optionally required endpoint never violates: the requirement is met by trying. `system_default`
demands nothing either; the flow report says what came of it.
"""

from __future__ import annotations

from collections.abc import Iterator

from lifecycle.manifest.model import EndpointKind, UniqueHow
from lifecycle.network.nfe import (
    FlowUniqueness,
    NetworkFlowEndpoint,
    TransportProtocol,
    UniqueRequirement,
    meets,
)
from lifecycle.verify.rules.catalogue import Rule
from lifecycle.verify.uniqueness import Uniqueness
from lifecycle.verify.verdict import Finding, Outcome
from lifecycle.verify.view import Actual, FlowView, View

NOT_UNIQUE = Rule(
    id="flow.not-unique",
    meaning="an endpoint or a link needs a unique network flow and does not have it",
    outcomes=(Outcome.VIOLATED,),
    fix="ask for `unique:` on the endpoint itself, so that it gets sockets of its own; see"
    " `lifecycle flows`",
    concerns_flow=True,
)
UNVERIFIABLE = Rule(
    id="flow.unverifiable",
    meaning="a unique network flow is needed and nobody tells the network flow endpoints",
    outcomes=(Outcome.UNVERIFIABLE,),
    fix="run the node in our host under an RMW that tells them (rmw_fastrtps_cpp)",
    concerns_flow=True,
)
BROKEN_ENDPOINT = Rule(
    id="flow.broken-endpoint",
    meaning="a subscription has no network flow endpoint at all, so nothing can reach it",
    outcomes=(Outcome.VIOLATED,),
    fix="look for two processes with the same fixed ports, or an interface whitelist that matches"
    " no interface",
    concerns_flow=True,
)
RULES = (NOT_UNIQUE, UNVERIFIABLE, BROKEN_ENDPOINT)


def check(view: View) -> Iterator[Finding]:
    """Judge every endpoint that strictly requires a unique flow, then every link's demand."""
    uniqueness = Uniqueness(view.reported, view.addresses)
    for actual in view.actual:
        yield from _broken(actual)
        if actual.planned.unique is UniqueRequirement.STRICTLY_REQUIRED:
            yield from _strict(actual, uniqueness)
    for flow in view.flows:
        if flow.planned.unique is not UniqueHow.NOT:
            yield from _demanded(flow, uniqueness)


def _broken(actual: Actual) -> Iterator[Finding]:
    planned, report = actual.planned, actual.report
    if planned.kind is not EndpointKind.SUBSCRIPTION or report is None or report.error:
        return
    if report.nfes == ():
        yield BROKEN_ENDPOINT.on_endpoint(
            Outcome.VIOLATED,
            actual,
            expected="at least one network flow endpoint",
            observed="none",
            message=f"cannot reach the subscription of {planned.resolved} in"
            f" {actual.node.full_name}: it has no network flow endpoint",
        )


def _strict(actual: Actual, uniqueness: Uniqueness) -> Iterator[Finding]:
    planned, report = actual.planned, actual.report
    if actual.observed is None and report is None:
        return
    if report is not None and (report.error or report.nfes == ()):
        return  # not made, or broken: that is said already
    word = planned.kind.noun
    where = f"the {word} of {planned.resolved} in {actual.node.full_name}"
    unique = uniqueness.is_unique(actual)
    if unique is None:
        yield UNVERIFIABLE.on_endpoint(
            Outcome.UNVERIFIABLE,
            actual,
            expected=f"unique {word}",
            observed="network flow endpoints not reported",
            message=f"cannot verify that {where} has a unique network flow: nobody tells its"
            " network flow endpoints",
        )
    elif unique is False:
        shared = spell_nfes(uniqueness.nfes((actual,)))
        yield NOT_UNIQUE.on_endpoint(
            Outcome.VIOLATED,
            actual,
            expected=f"unique {word}",
            observed=f"shares {shared}",
            message=f"cannot accept {where}: it strictly requires a unique network flow and shares"
            f" {shared} with other {word}s",
        )


def _demanded(flow: FlowView, uniqueness: Uniqueness) -> Iterator[Finding]:
    ends = (*flow.publishers, *flow.subscriptions)
    if not flow.publishers or not flow.subscriptions:
        return  # the link is unmatched, and says so
    if any(end.observed is None and end.report is None for end in ends):
        return
    how = flow.planned.unique.value
    publisher = uniqueness.all_unique(flow.publishers)
    subscription = uniqueness.all_unique(flow.subscriptions)
    met = meets(
        FlowUniqueness(flow.planned.unique.value), publisher=publisher, subscription=subscription
    )
    if met:
        return
    observed = f"publisher {_answer(publisher)}, subscription {_answer(subscription)}"
    rule = UNVERIFIABLE if met is None else NOT_UNIQUE
    verb = "cannot verify" if met is None else "cannot accept"
    yield rule.finding(
        Outcome.UNVERIFIABLE if met is None else Outcome.VIOLATED,
        subject=flow.subject,
        expected=f"{how} unique flow",
        observed=observed,
        message=f"{verb} the flow {flow.publisher} → {flow.subscription} on {flow.planned.topic}:"
        f" its link demands a {how} unique flow; {observed}",
        at=flow.at,
    )


def _answer(unique: bool | None) -> str:
    return {True: "unique", False: "not unique", None: "unknown"}[unique]


def spell_nfes(nfes: tuple[NetworkFlowEndpoint, ...]) -> str:
    """Spell NFEs for people: `udp 10.0.0.1:7412, shm`; `none` without any."""
    return ", ".join(dict.fromkeys(_spell(each) for each in nfes)) or "none"


def _spell(nfe: NetworkFlowEndpoint) -> str:
    if nfe.transport_protocol is TransportProtocol.UNKNOWN:
        return "shm"
    address = nfe.internet_address
    host = f"[{address}]" if ":" in address else address
    return f"{nfe.transport_protocol.value} {host}:{nfe.transport_port}"
