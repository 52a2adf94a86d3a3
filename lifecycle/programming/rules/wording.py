"""Rules in words, the same in the comments of every export.

Owns: how a rule's flows and wishes are written; DSCP and TOS always side by side, because products
differ in which of the two they ask for. Pure.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

from lifecycle.codec import to_json
from lifecycle.network.dscp import describe
from lifecycle.programming.rules.rules import FlowRule


def named(rule: FlowRule) -> str:
    """Return the flows of a rule: `/robot/video /robot/camera → /viewer`, several with commas."""
    return ", ".join(
        f"{topic} {publisher} → {subscription}" for topic, publisher, subscription in rule.names
    )


def asks(rule: FlowRule) -> str:
    """Return what a rule asks for: `EF = DSCP 46 = TOS 184 (0xb8), 5QI 85`."""
    found = [] if rule.dscp is None else [describe(rule.dscp)]
    if rule.five_qi is not None:
        found.append(f"5QI {rule.five_qi}")
    if rule.flow_label:
        found.append(f"flow label {rule.flow_label:#07x}")
    if rule.max_delay_ms is not None:
        found.append(f"at most {rule.max_delay_ms:g} ms")
    return ", ".join(found) or "nothing"


def rules_digest(rules: Iterable[FlowRule]) -> str:
    """Return sixteen hexadecimal digits that are equal for equal rules in equal order."""
    return hashlib.sha256(to_json(tuple(rules))).hexdigest()[:16]
