"""What a rule is. Owns: `Rule`, which makes the findings that carry its id. Pure."""

from __future__ import annotations

import dataclasses

from lifecycle.manifest.diagnostics import Position
from lifecycle.manifest.model import EndpointKind
from lifecycle.plan.model import PlannedNode
from lifecycle.verify.verdict import Finding, Outcome
from lifecycle.verify.view import Actual


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """One thing that verification judges.

    Attributes:
        id: `family.name`, stable for ever; a section of docs/rules.md.
        meaning: what a finding of it says, one line.
        outcomes: the outcomes that it can have besides ok.
        fix: what to do about it, one line.
        concerns_flow: a finding on an endpoint also spoils the flows of that endpoint.
        may_block: False for a rule whose unverifiable findings never close the gate, because the
            manifest waived the requirement itself.
        heals: False for a rule whose findings no second look can take back.
    """

    id: str
    meaning: str
    outcomes: tuple[Outcome, ...]
    fix: str
    concerns_flow: bool = False
    may_block: bool = True
    heals: bool = True

    def finding(
        self,
        outcome: Outcome,
        *,
        subject: str,
        expected: str,
        observed: str,
        message: str,
        at: Position | None = None,
        node: str = "",
        endpoint: EndpointKind | None = None,
        hint: str = "",
    ) -> Finding:
        """Make a finding of this rule; `hint` defaults to the rule's fix.

        Raises:
            ValueError: the rule is not documented to have this outcome.
        """
        if outcome not in self.outcomes:
            raise ValueError(f"cannot give rule {self.id} the outcome {outcome.value}")
        return Finding(
            rule=self.id,
            outcome=outcome,
            subject=subject,
            expected=expected,
            observed=observed,
            message=message,
            at=f"{at.file}:{at.line}:{at.column}" if at else "",
            node=node,
            endpoint=endpoint,
            hint=hint or self.fix,
        )

    def on_endpoint(
        self,
        outcome: Outcome,
        actual: Actual,
        *,
        expected: str,
        observed: str,
        message: str,
        hint: str = "",
    ) -> Finding:
        """Make a finding on a declared endpoint, at its declaration; as `finding`."""
        return self.finding(
            outcome,
            subject=actual.planned.resolved,
            expected=expected,
            observed=observed,
            message=message,
            at=actual.planned.at,
            node=actual.node.full_name,
            endpoint=actual.planned.kind,
            hint=hint,
        )

    def on_node(
        self,
        outcome: Outcome,
        node: PlannedNode,
        *,
        expected: str,
        observed: str,
        message: str,
        hint: str = "",
    ) -> Finding:
        """Make a finding on a declared node, at its declaration; as `finding`."""
        return self.finding(
            outcome,
            subject=node.full_name,
            expected=expected,
            observed=observed,
            message=message,
            at=node.at,
            node=node.full_name,
            hint=hint,
        )
