"""What a supervisor offers in ROS, and what is taken for it: by name, type and whose it is."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind, Mode, Policy, RosInterfaceAccess
from lifecycle.plan.model import Plan
from lifecycle.verify.tool_filter import (
    is_supervisor_endpoint,
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


OURS = "/some/_lifecycle_supervisor_7"
TRIGGER = "std_srvs/srv/Trigger"
ARRAY = "diagnostic_msgs/msg/DiagnosticArray"
PUBLISHER, SERVER = EndpointKind.PUBLISHER, EndpointKind.SERVICE_SERVER


@pytest.mark.parametrize(
    ("kind", "node", "name", "type_", "is_one"),
    [
        (PUBLISHER, OURS, "/lifecycle/t/status", "std_msgs/msg/String", True),
        (PUBLISHER, OURS, "/lifecycle/t/robot/status", "std_msgs/msg/String", True),
        (PUBLISHER, OURS, "/diagnostics", ARRAY, True),
        (SERVER, OURS, "/lifecycle/t/pause", TRIGGER, True),
        (SERVER, OURS, "/lifecycle/t/get_status", TRIGGER, True),
        (SERVER, OURS, "/lifecycle/t/mode/day", TRIGGER, True),
        (PUBLISHER, "/camera", "/lifecycle/t/status", "std_msgs/msg/String", False),
        (PUBLISHER, OURS, "/lifecycle/t/status", "std_msgs/msg/Bool", False),
        (PUBLISHER, OURS, "/elsewhere/status", "std_msgs/msg/String", False),
        (PUBLISHER, OURS, "/diagnostics", "std_msgs/msg/String", False),
        (SERVER, OURS, "/lifecycle/t/pause", "std_srvs/srv/Empty", False),
        (SERVER, OURS, "/elsewhere/pause", TRIGGER, False),
        (SERVER, OURS, "/lifecycle/t/explode", TRIGGER, False),
        (SERVER, OURS, "/lifecycle/t/mod/day", TRIGGER, False),
        (SERVER, OURS, "/elsewhere/mode/day", TRIGGER, False),
        (EndpointKind.SUBSCRIPTION, OURS, "/lifecycle/t/status", "std_msgs/msg/String", False),
        (EndpointKind.SERVICE_CLIENT, OURS, "/lifecycle/t/pause", TRIGGER, False),
    ],
)
def test_an_endpoint_is_a_supervisor_s_by_its_name_its_type_and_its_node(
    kind: EndpointKind, node: str, name: str, type_: str, is_one: bool
) -> None:
    assert is_supervisor_endpoint(kind, node, name, type_) is is_one
