"""The registry of rules: families of them, each a module with its rules and their check."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from lifecycle.verify.rules import (
    endpoints,
    flows,
    matching,
    measured,
    nodes,
    parameters,
    qos,
    state,
)
from lifecycle.verify.rules.catalogue import RUN_RULES, About, Heals, Rule
from lifecycle.verify.verdict import Finding
from lifecycle.verify.view import View

__all__ = ["CHECKS", "RULES", "About", "Heals", "Rule", "rule"]

_FAMILIES = (nodes, endpoints, qos, matching, state, parameters, flows, measured)

RULES: tuple[Rule, ...] = (*(rule for each in _FAMILIES for rule in each.RULES), *RUN_RULES)
"""Every rule, in the order in which findings are reported."""

CHECKS: tuple[Callable[[View], Iterator[Finding]], ...] = tuple(each.check for each in _FAMILIES)
"""Every family's check; each yields its findings in a fixed order."""

_BY_ID = {each.id: each for each in RULES}


def rule(rule_id: str) -> Rule:
    """Return a rule by its id.

    Raises:
        KeyError: no such rule.
    """
    return _BY_ID[rule_id]
