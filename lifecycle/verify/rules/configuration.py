"""Rules about the reports of nodes that run in our host. Pure."""

from __future__ import annotations

from collections.abc import Iterator

from lifecycle.verify.rules.catalogue import About, Heals, Rule
from lifecycle.verify.verdict import Finding, Outcome
from lifecycle.verify.view import View

MISSING_REPORT = Rule(
    id="config.missing-report",
    meaning="a node of ours did not report its configuration",
    outcomes=(Outcome.VIOLATED,),
    fix="see whether its ~/get_configuration answers; look at its log",
    about=About.PROGRESS,
    heals=Heals.WITH_TIME,
    if_unheard=True,
    absence="report",
)
INCOMPLETE_REPORT = Rule(
    id="config.incomplete-report",
    meaning="a node of ours does not mention a declared endpoint in its report",
    outcomes=(Outcome.VIOLATED,),
    fix="the node runs from another manifest, or has not connected: compare and restart it",
    about=About.PROGRESS,
    heals=Heals.WITH_TIME,
    if_unheard=True,
    absence="{kind} in the report of {node}",
)
RULES = (MISSING_REPORT, INCOMPLETE_REPORT)


def check(view: View) -> Iterator[Finding]:
    """Judge that our own nodes report all that only they can report."""
    for name, node in view.planned.items():
        if not view.ours(node) or view.is_absent(node):
            continue
        if name not in view.configurations:
            yield MISSING_REPORT.on_node(
                Outcome.VIOLATED,
                node,
                expected="node configuration",
                observed="no report",
                message=f"cannot judge node {name}: it did not report its configuration",
            )
            continue
        for actual in view.actual_by_node[name]:
            if actual.report is not None:
                continue
            planned = actual.planned
            word = planned.kind.noun
            yield INCOMPLETE_REPORT.on_endpoint(
                Outcome.VIOLATED,
                actual,
                expected=f"{word} in the report of {name}",
                observed="not mentioned",
                message=f"cannot judge the {word} of {planned.resolved}: {name} does not report it",
            )
