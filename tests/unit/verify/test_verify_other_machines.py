"""What is said of a node that is missing on a machine that somebody else brings up."""

from __future__ import annotations

import pytest

from lifecycle.verify.judge import verify
from lifecycle.verify.verdict import Stage
from tests.builders import node, planned, publisher, subscription
from tests.unit.verify.edits import drop_node
from tests.unit.verify.perfect import perfect

_OURS = "look at the node's process and its log; compare domain, RMW and discovery range"


def _hint(machine: str, ours: frozenset[str] | None) -> str:
    plan = planned(
        node("one", publisher("a"), machine="m1"), node("two", subscription("a"), machine=machine)
    )
    seen = drop_node("/two")(perfect(plan, Stage.CONNECTED))
    findings = verify(plan, seen, stage=Stage.CONNECTED, machines=ours).findings
    (missing,) = [each for each in findings if each.rule == "graph.missing-node"]
    assert missing.message == "cannot find node /two in domain 0"
    return missing.hint


@pytest.mark.parametrize(
    ("machine", "ours", "hint"),
    [
        (
            "m2",
            frozenset({"m1"}),
            "its machine has a supervisor of its own: lifecycle up MANIFEST --machine m2",
        ),
        (
            "",
            frozenset({"m1"}),
            "its machine has a supervisor of its own: lifecycle up MANIFEST",
        ),
        ("m2", frozenset({"m1", "m2"}), _OURS),
        ("m2", None, _OURS),
    ],
)
def test_a_missing_node_of_another_machine_is_hinted_at_with_the_command_that_brings_it(
    machine: str, ours: frozenset[str] | None, hint: str
) -> None:
    assert _hint(machine, ours) == hint
