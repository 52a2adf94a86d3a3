"""The DSCP with which arrives what another machine's supervisor sends beside a flow."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind
from lifecycle.verify.judge import verify
from lifecycle.verify.observation import ArrivedMark
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Stage
from tests.builders import link, need, node, planned, publisher, subscription
from tests.unit.verify.perfect import perfect

EF = need(EndpointKind.PUBLISHER, "/video", dscp=46)


@pytest.mark.parametrize(
    ("marks", "said"),
    [
        ([], None),
        ([("robot", 46, 46)], None),
        ([("robot", 10, 0), ("desk", 46, 0)], None),  # of other flows
        (
            [("robot", 46, 0)],
            (
                Outcome.VIOLATED,
                "DF = DSCP 0 = TOS 0 (0x00)",
            ),
        ),
        (
            [("robot", 46, None)],
            (
                Outcome.UNVERIFIABLE,
                "nothing",
            ),
        ),
    ],
)
@pytest.mark.parametrize("machine", ["desk", "robot"])
def test_the_receiving_host_judges_what_arrives(
    marks: list[tuple[str, int, int | None]], said: tuple[Outcome, str] | None, machine: str
) -> None:
    plan = planned(
        node("camera", publisher("/video"), machine="robot", needs=[EF]),
        node("viewer", subscription("/video"), machine="desk"),
        links=[link("/video", "camera", "viewer")],
    )
    arrived = [ArrivedMark(machine=of, dscp=dscp, arrives_as=mark) for of, dscp, mark in marks]
    seen = replace(perfect(plan, Stage.ACTIVE), marks=tuple(arrived))
    verdict = verify(plan, seen, stage=Stage.ACTIVE, machines=frozenset({machine}))
    lost = [
        (each.outcome, each.observed) for each in verdict.findings if each.rule == "flow.dscp-lost"
    ]
    assert lost == ([said] if said is not None and machine == "desk" else [])
