"""The registry of rules: one module per family, each with its `RULES` and its `check`."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from lifecycle.verify.rules import (
    clients,
    configuration,
    connections,
    definitions,
    dscp,
    endpoints,
    flows,
    matching,
    nodes,
    outsiders,
    parameters,
    qos,
    run,
    state,
    transport,
)
from lifecycle.verify.rules.catalogue import About, Heals, Rule
from lifecycle.verify.verdict import Finding
from lifecycle.verify.view import View

__all__ = ["CHECKS", "RULES", "About", "Heals", "Rule", "rule"]

_FAMILIES = (
    nodes,
    endpoints,
    definitions,
    outsiders,
    qos,
    matching,
    clients,
    state,
    configuration,
    parameters,
    connections,
    flows,
    transport,
    dscp,
    run,
)

RULES: tuple[Rule, ...] = tuple(each for family in _FAMILIES for each in family.RULES)
"""Every rule, in the order in which findings are reported."""

CHECKS: tuple[Callable[[View], Iterator[Finding]], ...] = tuple(
    family.check for family in _FAMILIES
)
"""Every family's check; each yields its findings in a fixed order."""

_BY_ID = {each.id: each for each in RULES}


def rule(rule_id: str) -> Rule:
    """Return a rule by its id.

    Raises:
        KeyError: no such rule.
    """
    return _BY_ID[rule_id]
