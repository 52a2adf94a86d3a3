"""What a picture is drawn from: plan and observation side by side, and the verdict on them.

Owns: what a plan alone changes, and which findings stand where. Pure.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

from lifecycle.export.picture.model import Presence
from lifecycle.verify.verdict import Finding, FlowReport, Outcome, Verdict
from lifecycle.verify.view import View


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Basis:
    """The two sides of a picture.

    Attributes:
        view: plan and observation; the observation is empty where nobody looked.
        verdict: on the two; None where nobody looked, which makes it the picture of a plan.
        reports: the verdict's, by topic, publisher and subscription.
    """

    view: View
    verdict: Verdict | None
    reports: Mapping[tuple[str, str, str], FlowReport]

    @classmethod
    def of(cls, view: View, verdict: Verdict | None) -> Basis:
        """Return the basis of the picture of a view."""
        flows = verdict.flows if verdict else ()
        reports = {(each.topic, each.publisher, each.subscription): each for each in flows}
        return cls(view=view, verdict=verdict, reports=reports)

    @property
    def absent(self) -> Presence:
        """What everything declared is that is not in the observation."""
        return Presence.PLANNED if self.verdict is None else Presence.MISSING

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All findings; elements call them by their place here, from 1."""
        return () if self.verdict is None else self.verdict.findings

    def numbers(self, concerns: Callable[[Finding], bool]) -> tuple[int, ...]:
        """Return the numbers of the findings that concern something."""
        return tuple(n for n, each in enumerate(self.findings, start=1) if concerns(each))

    def outcome(self, name: str, source: str, target: str) -> Outcome | None:
        """What the verdict is on two ends that belong together; None in the picture of a plan."""
        if self.verdict is None:
            return None
        report = self.reports.get((name, source, target))
        subject = f"{name}: {source} → {target}"
        found = [each.outcome for each in self.findings if each.subject == subject]
        return Outcome.worst([*found, *([report.outcome] if report else [])])
