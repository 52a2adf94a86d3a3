"""What supervisors announce of their plans: whose must be ours, and what comes over the network."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import Machine
from lifecycle.plan import comparison as notices
from lifecycle.plan.comparison import (
    PlanNotice,
    PlanNoticeError,
    concerns,
    decode,
    encode,
    notice_of,
    plan_checksum,
)
from lifecycle.plan.model import Plan
from tests.builders import HERE, plan_of, planned_node


def plan(system: str = "robot", *names: str) -> Plan:
    nodes = [
        replace(planned_node(name), machine=machine)
        for name, machine in zip(names or ("camera", "viewer"), ("left", "right"), strict=False)
    ]
    machines = tuple(Machine(name=each, address="", at=HERE) for each in ("left", "right"))
    return replace(plan_of(*nodes), system=system, machines=machines)


def said(of: Plan, machine: str = "right", run: str = "1", host: str = "h2") -> PlanNotice:
    return notice_of(of, run=run, host=host, machines=(machine,))


OURS = frozenset({"left"})


def test_a_notice_brings_the_checksum_of_the_plan() -> None:
    notice = decode(encode(said(plan())))
    assert notice.checksum == plan_checksum(plan())


def test_the_same_system_on_another_of_its_machines_concerns_us() -> None:
    assert concerns(plan(), OURS, said(plan("robot", "lidar", "screen")))


def test_another_system_concerns_us_only_if_it_plans_a_node_of_ours() -> None:
    assert concerns(plan(), OURS, said(plan("other")))
    assert not concerns(plan(), OURS, said(plan("other", "lidar", "screen")))


def test_a_system_of_our_name_on_machines_of_its_own_does_not_concern_us() -> None:
    remote_nodes = said(plan("robot", "lidar", "screen"), machine="attic")
    assert not concerns(plan(), OURS, remote_nodes)


def test_a_notice_is_replaced_by_what_comes_in_its_place() -> None:
    first = said(plan())
    assert said(plan(), run="2").replaces(first)
    # Started again under another name, on the same host.
    assert said(plan("other"), run="2").replaces(first)
    assert not said(plan("other"), run="2", host="h3").replaces(first)
    gone = replace(first, left=True)
    assert said(plan("other"), run="2", host="h3").replaces(gone)


@pytest.mark.parametrize("host", ["h2", "h3"])
def test_a_notice_replaces_none_of_another_machine_of_its_system(host: str) -> None:
    beside = said(plan(), "left", run="2", host=host)
    first = said(plan())
    assert not beside.replaces(first)
    assert not beside.replaces(replace(first, left=True))


def test_what_is_no_notice_is_refused() -> None:
    shown_badly = encode(replace(said(plan()), reason="\x1b[2J"))
    for text in ("", "{}", '{"run": 1}', shown_badly, "x" * (notices.MAX_TEXT + 1)):
        with pytest.raises(PlanNoticeError, match=r"^cannot read"):
            decode(text)
