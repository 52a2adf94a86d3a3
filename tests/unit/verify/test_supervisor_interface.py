"""What a supervisor offers in ROS, and what is taken for it: by name, type and whose it is."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind, Mode, Policy, RosInterfaceAccess
from lifecycle.plan.model import Plan
from lifecycle.verify.tool_filter import (
    supervisor_endpoints,
    supervisor_label,
)
from tests.builders import HERE, plan_of, planned_node

STATUS = (EndpointKind.PUBLISHER, "/lifecycle/t/status")
DIAGNOSTICS = (EndpointKind.PUBLISHER, "/diagnostics")
ASKED = (EndpointKind.SERVICE_SERVER, "/lifecycle/t/get_status")
ORDERS = {
    (EndpointKind.SERVICE_SERVER, f"/lifecycle/t/{each}")
    for each in ("pause", "resume", "restart", "down", "mode/day")
}


def plan(access: RosInterfaceAccess) -> Plan:
    made = plan_of(planned_node("camera"))
    policy = Policy(ros_interface=access)
    return replace(made, system="t", policy=policy, modes=(Mode(name="day", at=HERE),))


@pytest.mark.parametrize(
    ("access", "offered"),
    [
        (RosInterfaceAccess.OFF, set()),
        (RosInterfaceAccess.READ_ONLY, {STATUS, DIAGNOSTICS, ASKED}),
        (RosInterfaceAccess.FULL, {STATUS, DIAGNOSTICS, ASKED, *ORDERS}),
    ],
)
def test_a_supervisor_offers_what_the_policy_says(
    access: RosInterfaceAccess, offered: set[tuple[EndpointKind, str]]
) -> None:
    assert supervisor_endpoints(plan(access)) == offered


def test_one_of_several_supervisors_has_its_machine_in_its_names_and_enters_no_mode() -> None:
    found = {name for _, name in supervisor_endpoints(plan(RosInterfaceAccess.FULL), "robot")}
    orders = ("status", "get_status", "pause", "resume", "restart", "down")
    assert found == {"/diagnostics", *(f"/lifecycle/t/robot/{each}" for each in orders)}
    assert (supervisor_label("t"), supervisor_label("t", "robot")) == ("t", "t/robot")
