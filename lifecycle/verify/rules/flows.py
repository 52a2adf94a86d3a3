"""Rules about the uniqueness of network flows. Pure.

What is strictly required, or demanded by a link, must be proven: what cannot be is violated. An
optionally required endpoint never violates: the requirement is met by trying. `system_default`
demands nothing either; the flow report has the result.
"""

from __future__ import annotations

from collections.abc import Iterator

from lifecycle.manifest.model import EndpointKind, Quantity, UniqueHow
from lifecycle.network.medium import Medium
from lifecycle.network.nfe import (
    FlowUniqueness,
    NetworkFlowEndpoint,
    TransportProtocol,
    UniqueRequirement,
    meets,
)
from lifecycle.verify.rules.catalogue import Heals, Rule
from lifecycle.verify.rules.configuration import MISSING_REPORT
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
    meaning="a unique network flow is strictly required or demanded and cannot be proven",
    outcomes=(Outcome.VIOLATED,),
    fix="run the node with `run: python` under rmw_fastrtps_cpp, which reports network flow"
    " endpoints; or ask for `unique: optionally_required`, or drop the link's `unique`",
    concerns_flow=True,
    heals=Heals.WITH_TIME,
    awaits=MISSING_REPORT,  # nothing else could prove it
)
BROKEN_ENDPOINT = Rule(
    id="flow.broken-endpoint",
    meaning="a subscription has no network flow endpoint at all, so nothing can reach it",
    outcomes=(Outcome.VIOLATED,),
    fix="look for two processes with the same fixed ports, or an interface whitelist that matches"
    " no interface",
    concerns_flow=True,
)
NOT_MEASURED = Rule(
    id="flow.not-measured",
    meaning="a number that the manifest declares of a flow has not been measured",
    outcomes=(Outcome.UNVERIFIABLE,),
    fix="nothing here measures it: measure it where the data are used, or leave it out of the"
    " manifest; `--strict` refuses it, and so does `policy.unverifiable: block`",
    heals=Heals.NEVER,
    names_expected=True,
)
RULES = (NOT_UNIQUE, UNVERIFIABLE, BROKEN_ENDPOINT, NOT_MEASURED)


def check(view: View) -> Iterator[Finding]:
    """Judge every strict endpoint, then every link's demand, then name what is not measured."""
    uniqueness = view.uniqueness
    for actual in view.actual:
        yield from _broken(actual)
        if actual.planned.unique is UniqueRequirement.STRICTLY_REQUIRED:
            yield from _strict(actual, uniqueness)
    for flow in view.flows:
        if flow.planned.unique is not UniqueHow.NOT:
            yield from _demanded(flow, uniqueness)
    yield from _not_measured(view)


def _not_measured(view: View) -> Iterator[Finding]:
    """One finding per declared number: it reports that the number was not compared."""
    for actual in view.actual:
        planned, node = actual.planned, actual.node.full_name
        if actual.observed is None and actual.report is None:
            continue  # it is missing, and that is said
        for each in planned.quantities:
            where = f"the {planned.kind.noun} of {planned.resolved} in {node}"
            yield _unmeasured(
                each, where, subject=planned.resolved, node=node, endpoint=planned.kind
            )
    for flow in view.flows:
        ends = (*flow.publishers, *flow.subscriptions)
        if any(end.observed is None and end.report is None for end in ends):
            continue
        for each in flow.planned.quantities:
            where = f"the flow {flow.publisher} → {flow.subscription} on {flow.planned.topic}"
            yield _unmeasured(each, where, subject=flow.subject, ends=flow.ends)


def _unmeasured(
    quantity: Quantity,
    where: str,
    *,
    subject: str,
    node: str = "",
    endpoint: EndpointKind | None = None,
    ends: tuple[str, ...] = (),
) -> Finding:
    return NOT_MEASURED.finding(
        Outcome.UNVERIFIABLE,
        subject=subject,
        expected=str(quantity),
        observed="not measured",
        message=f"cannot verify {quantity} of {where}: nothing measures it",
        at=quantity.at,
        node=node,
        endpoint=endpoint,
        ends=ends,
    )


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
            Outcome.VIOLATED,
            actual,
            expected=f"unique {word}",
            observed="network flow endpoints not reported",
            message=f"cannot accept {where}: it strictly requires a unique network flow, which"
            f" cannot be proven: {_why_unproven(actual)}",
        )
    elif unique is False:
        shared = _spell_all(uniqueness.nfes((actual,)))
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
    unproven = ", which cannot be proven" if met is None else ""
    rule = UNVERIFIABLE if met is None else NOT_UNIQUE
    yield rule.finding(
        Outcome.VIOLATED,
        subject=flow.subject,
        ends=flow.ends,
        expected=f"{how} unique flow",
        observed=observed,
        message=f"cannot accept the flow {flow.publisher} → {flow.subscription} on"
        f" {flow.planned.topic}: its link demands a {how} unique flow{unproven}; {observed}",
        at=flow.at,
    )


def _why_unproven(actual: Actual) -> str:
    """Return why the network flow endpoints of an endpoint, or of its neighbours, are not known."""
    if actual.report is None:
        return f"{actual.node.full_name} does not report its network flow endpoints"
    if actual.report.nfes is None:
        return "its RMW does not report network flow endpoints"
    return "its process has endpoints whose network flow endpoints are not reported"


def _answer(unique: bool | None) -> str:
    return {True: "unique", False: "not unique", None: "unknown"}[unique]


def _spell_all(nfes: tuple[NetworkFlowEndpoint, ...]) -> str:
    """Spell NFEs for people: `udp 10.0.0.1:7412, shm`."""
    return ", ".join(dict.fromkeys(_spell(each) for each in nfes))


def _spell(nfe: NetworkFlowEndpoint) -> str:
    if nfe.transport_protocol is TransportProtocol.UNKNOWN:
        return Medium.SHM
    address = nfe.internet_address
    host = f"[{address}]" if ":" in address else address
    return f"{nfe.transport_protocol.value} {host}:{nfe.transport_port}"
