"""What a node shows of what others wait for: by discovery, by its report, by its parameters."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind, ParameterValue, Readiness, ReadyBy
from lifecycle.verify.observation import (
    NodeParameters,
    Observation,
    ObservedEndpoint,
    ParameterReport,
    shown,
)
from tests.builders import configuration, planned_node, reported

PUBLISHER, SUBSCRIPTION, SERVER, CLIENT, ACTION, _ = EndpointKind
DRIVER = replace(
    planned_node("driver"), namespace="/front", remap=(("scan", "/laser"), ("~/reset", "again"))
)
SCAN = Readiness(by=ReadyBy.PUBLISHES, name="scan")
RESET = Readiness(by=ReadyBy.SERVES, name="~/reset")
DOCK = Readiness(by=ReadyBy.SERVES, name="dock")


def seen(kind: EndpointKind, name: str, node: str = "/front/driver") -> Observation:
    return Observation(endpoints=(ObservedEndpoint(kind=kind, node=node, name=name, type="t"),))


@pytest.mark.parametrize(
    ("observation", "expected"),
    [
        (Observation(), set()),
        (seen(PUBLISHER, "/laser"), {SCAN}),
        (seen(PUBLISHER, "/laser", "/other"), set()),
        (seen(PUBLISHER, "/laser", ""), set()),  # nobody knows whose it is yet
        (seen(PUBLISHER, "/front/scan"), set()),
        (seen(SUBSCRIPTION, "/laser"), set()),
        (seen(SERVER, "/front/again"), {RESET}),
        (seen(CLIENT, "/front/again"), set()),
        (seen(ACTION, "/front/dock"), {DOCK}),
    ],
)
def test_an_endpoint_is_the_node_s_own_and_named_as_its_remaps_say(
    observation: Observation, expected: set[Readiness]
) -> None:
    assert shown((SCAN, RESET, DOCK), DRIVER, observation) == expected


def test_what_is_on_another_participant_is_known_by_the_report_once_it_is_there() -> None:
    found = reported(PUBLISHER, "scan", resolved="/laser")
    for mapped in (False, True):
        report = configuration("/front/driver", replace(found, mapped=mapped))
        seen = Observation(configurations=(report,))
        assert shown((SCAN,), DRIVER, seen) == ({SCAN} if mapped else set())


@pytest.mark.parametrize(
    ("type_", "value", "holds"),
    [
        ("bool", True, True),
        ("bool", False, False),
        ("bool", None, False),
        ("integer", 1, False),
        ("string", "true", False),
    ],
)
@pytest.mark.parametrize("reports", [True, False])
def test_a_parameter_is_true(
    type_: str, value: ParameterValue | None, *, holds: bool, reports: bool
) -> None:
    ready = Readiness(by=ReadyBy.PARAMETER, name="ready")
    has = (ParameterReport(name="ready", type=type_, value=value),)
    if reports:
        seen = Observation(
            configurations=(replace(configuration("/front/driver"), parameters=has),)
        )
    else:
        seen = Observation(parameters=(NodeParameters(node="/front/driver", parameters=has),))
    assert shown((ready,), DRIVER, seen) == ({ready} if holds else set())
