"""The verdict of a verification: three outcomes, findings, flow reports.

Owns: the result types of `verify` (schema: schemas/verdict.v1.schema.json). Pure.
"""

from __future__ import annotations

import enum
from typing import Annotated

import msgspec

from lifecycle.codec import DscpValue, Octet, says
from lifecycle.manifest.model import EndpointKind, UniqueHow
from lifecycle.measure.flows import FlowMeasurement, Pair
from lifecycle.network.medium import Medium
from lifecycle.network.nfe import FlowTuple, NetworkFlowEndpoint, UniqueRequirement, flow_tuples
from lifecycle.verify.outcome import Outcome

_Carrier = Annotated[str, says(enum=[*map(str, Medium), "none", "unknown"])]


class Stage(enum.Enum):
    """Which moment of the lifecycle an observation is judged against."""

    CONNECTED = "connected"  # before the gate: managed nodes inactive, data layer made
    ACTIVE = "active"  # after the gate, and for `lifecycle verify`


class Finding(msgspec.Struct, frozen=True, kw_only=True):
    """One rule's result on one subject; only violated and unverifiable ones are kept.

    Attributes:
        rule: id, `graph.missing-node`; documented in docs/rules.md.
        subject: what it is about, `/robot/camera`, `/robot/video`, `/robot/camera → /viewer`.
        message: a whole sentence for people.
        at: `file:line:column` of the declaration; empty for something undeclared.
        node: fully qualified name of the node it concerns; empty if none or several.
        endpoint: kind of the endpoint it concerns; None if it is not about one endpoint.
        hint: what to do about it.
        ends: of a flow or a pair, fully qualified names of the nodes at its two ends, as far as
            they are known; `subject` says it for people.
    """

    rule: str
    outcome: Outcome
    subject: str
    expected: str
    observed: str
    message: str
    at: str = ""
    node: str = ""
    endpoint: EndpointKind | None = None
    hint: str = ""
    ends: tuple[str, ...] = ()

    @property
    def nodes(self) -> tuple[str, ...]:
        """Fully qualified names of the nodes it concerns: of a flow both ends."""
        return (self.node,) if self.node else self.ends

    @property
    def key(self) -> FindingKey:
        """What makes it the same one in a later verdict."""
        return self.rule, self.subject, self.node, self.endpoint


FindingKey = tuple[str, str, str, "EndpointKind | None"]


class FlowReport(msgspec.Struct, frozen=True, kw_only=True):
    """One publisher → subscription pair as it runs.

    Attributes:
        publisher: fully qualified node name.
        subscription: fully qualified node name.
        source: the publisher's NFEs, with the DSCP read back from its sockets; empty when unknown.
        destination: the subscription's NFEs; empty when unknown.
        unique: how unique the flow is; None when it cannot be determined.
        dscp: read back from the sender's UDP sockets; None when not read, or where TCP carries it.
        reader_dscp: likewise of what the subscription sends, its acknowledgements; None also where
            it sends from its node's own participant, which is never marked.
        requirement: the publisher's and the subscription's requirement.
        demanded: what a link demands.
        max_delay_ms: what a link demands, declared and not measured here; None if not asked for.
        five_qi: what is planned, 3GPP TS 23.501 Table 5.7.4-1; None if not asked for, or if several
            publishers differ.
        five_qi_reason: why it is this 5QI, or none, where the manifest says `auto`; else empty.
        effective_transport: name of the Medium that carries it; "unknown" where nothing shows it,
            "none" where the ends have nothing in common.
        tuples: IP flows that the two ends' NFEs form, each with its 5-tuple and flow label; follows
            from source and destination. Where shared memory carries the flow, none of them does.
    """

    topic: str
    publisher: str
    subscription: str
    source: tuple[NetworkFlowEndpoint, ...]
    destination: tuple[NetworkFlowEndpoint, ...]
    unique: UniqueHow | None
    dscp: DscpValue | None
    requirement: tuple[UniqueRequirement, UniqueRequirement]
    demanded: UniqueHow
    outcome: Outcome
    max_delay_ms: float | None = None
    five_qi: int | None = None
    five_qi_reason: str = ""
    effective_transport: _Carrier = "unknown"
    reader_dscp: DscpValue | None = None
    tuples: tuple[FlowTuple, ...] = ()

    def __post_init__(self) -> None:
        msgspec.structs.force_setattr(self, "tuples", flow_tuples(self.source, self.destination))

    @property
    def pair(self) -> Pair:
        """Topic, publisher and subscription."""
        return self.topic, self.publisher, self.subscription


class ToleratedNode(msgspec.Struct, frozen=True, kw_only=True):
    """A node that no manifest declares and that the policy lets be there.

    Attributes:
        node: fully qualified node name; empty for endpoints whose node is not known.
        because: what tolerates it: `tolerated_nodes: rviz_*` or `undeclared_nodes: open`.
    """

    node: str
    because: str

    @property
    def name(self) -> str:
        """How messages name it."""
        return self.node or "an unknown node"


_ENDED = {
    None: "before it was connected",
    "connected": "when connected, before it was verified",
    "verified": "when verified, before it was active",
    "active": "after it was active",
}


class RunEnd(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """How a run of a supervisor ended.

    Attributes:
        reason: why: "interrupted", what failed, what kept the gate closed; "done" if it did what
            was asked for.
        reached: how far the system came: "connected", "verified" or "active"; None before.
        exit_code: of the command that ran it.
        trusted: what its gate could not verify and took on trust, in one line; empty if nothing, or
            if the gate did not open.
    """

    reason: str
    reached: Annotated[str, says(enum=["connected", "verified", "active"])] | None
    exit_code: Octet
    trusted: str = ""

    def describe(self) -> str:
        """Return it in one line."""
        trusted = f"; taken on trust: {self.trusted}" if self.trusted else ""
        return f"ended {_ENDED[self.reached]}, exit code {self.exit_code}: {self.reason}{trusted}"


class Verdict(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The result of `verify`.

    Attributes:
        verdict: VIOLATED if any finding is; else UNVERIFIABLE if any finding is; else OK.
        blocking: the gate stays closed: VIOLATED, or UNVERIFIABLE where the policy says so.
        tolerated: undeclared nodes that the policy lets be there; no finding. Observers of this
            project are not listed.
        judged: a system was looked at and every rule applied. If not, a rule without a finding
            says nothing, and the findings are what kept it from being judged.
        measured: what has arrived of each flow that is counted, of an active system.
        run: how the run ended that this is the last verdict of; None of a system that is running.
    """

    verdict: Outcome
    blocking: bool
    findings: tuple[Finding, ...]
    flows: tuple[FlowReport, ...]
    tolerated: tuple[ToleratedNode, ...] = ()
    judged: bool = True
    run: RunEnd | None = None
    measured: tuple[FlowMeasurement, ...] = ()

    def is_measuring(self, within_s: float) -> bool:
        """Return whether a declared number will be decided within so many seconds."""
        return any(
            bound.decides_in_s is not None and bound.decides_in_s <= within_s
            for flow in self.measured
            for bound in flow.bounds
        )


NOT_JUDGED = Verdict(
    verdict=Outcome.UNVERIFIABLE, blocking=True, findings=(), flows=(), judged=False
)
"""The verdict of a system that never came as far as being judged."""
