"""Rules about the manifest itself: what `lifecycle check` warns of that no observation can settle.

What the running graph shows anyway (an endpoint that may not match, a type that is not installed
here, …) is judged by the rules about that. Advice (notes) and what `policy:` asks for are none of
it. Pure.
"""

from __future__ import annotations

from collections.abc import Iterator

from lifecycle.manifest.diagnostics import Diagnostic
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.catalogue import Rule
from lifecycle.verify.rules.parameters import REACHED_NONE
from lifecycle.verify.verdict import Finding
from lifecycle.verify.view import View

UNPROVEN = Rule(
    id="declaration.unproven",
    meaning="`lifecycle check` warns of something that is declared and that nothing can prove",
    outcomes=(Outcome.UNVERIFIABLE,),
    fix="see what `lifecycle check` says of it",
)
RULES = (UNPROVEN,)

_NO_NODE = frozenset(
    (
        "check.parameter-file-unmatched",
        "check.parameter-undeclared",
        "check.parameter-for-no-node",
    )
)
_JUDGED = frozenset(
    (
        *("check.qos-doubtful", "check.type-not-installed", "check.parameter-empty-array"),
        *("check.flow-foreign", "check.flow-transport", "check.ipv6-transports"),
        "yaml.tag",
    )
)
"""Rules of `check` whose matter is judged where the system runs, by the rule that is about it."""


def check(view: View) -> Iterator[Finding]:
    """Repeat the warnings that stay true whatever is seen."""
    for each in view.plan.unproven:
        if each.rule not in _JUDGED:
            yield _finding(each)


def _finding(warning: Diagnostic) -> Finding:
    rule = REACHED_NONE if warning.rule in _NO_NODE else UNPROVEN
    return rule.finding(
        subject=warning.at.path or warning.at.file,
        expected="no warning",
        observed=warning.rule,
        message=warning.message,
        at=warning.at,
        hint=warning.hint,
    )
