"""What a node of ours reports of its parameters, and that a change of one is a change of it all."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import rclpy
from lifecycle_driver import Driver
from planning import built_with, planned
from rcl_interfaces.msg import ParameterDescriptor, ParameterType
from rclpy.parameter import Parameter

from lifecycle import LifecycleNode, codec
from lifecycle.verify.observation import LONGEST_VALUE, NodeConfiguration, ParameterReport

SCHEMA = Path(__file__).parents[3] / "schemas" / "node_configuration.v1.schema.json"


class It(LifecycleNode):
    """Declares parameters of every kind."""

    def __init__(self) -> None:
        super().__init__()
        self.declare_parameter("double", float("nan"))
        self.declare_parameter("ints", [1, -2])
        self.declare_parameter("bytes", [b"\x01", b"\xff"])
        self.declare_parameter("empty", Parameter.Type.STRING_ARRAY)
        self.declare_parameter("any", descriptor=ParameterDescriptor(dynamic_typing=True))
        self.declare_parameter("fixed", "as it is", ParameterDescriptor(read_only=True))
        self.declare_parameter("long", "x" * LONGEST_VALUE)


@pytest.fixture
def node(driver: Driver, context: rclpy.Context) -> Any:
    with built_with(planned("it"), context):
        node = It()
    driver.add(node)
    return node


def configuration(driver: Driver) -> NodeConfiguration:
    text = driver.configuration("/it")
    jsonschema.validate(json.loads(text), json.loads(SCHEMA.read_text(encoding="utf-8")))
    return codec.from_json(text, NodeConfiguration)


def reported(driver: Driver) -> dict[str, ParameterReport]:
    return {each.name: each for each in configuration(driver).parameters or ()}


@pytest.mark.usefixtures("node")
def test_every_parameter_is_reported_as_it_is(driver: Driver) -> None:
    found = reported(driver)
    digest = found.pop("long").digest
    assert len(digest) == 64
    assert {name: (each.type, each.value, each.read_only) for name, each in found.items()} == {
        "any": ("", None, False),
        "bytes": ("byte_array", (1, 255), False),
        "double": ("double", ".nan", False),
        "empty": ("string_array", None, False),
        "fixed": ("string", "as it is", True),
        "ints": ("int_array", (1, -2), False),
        "start_type_description_service": ("bool", True, True),
        "use_sim_time": ("bool", False, False),
    }


def test_each_change_makes_another_checksum_and_is_told(driver: Driver, node: Any) -> None:
    told: list[NodeConfiguration] = []
    fixed = ParameterDescriptor(type=ParameterType.PARAMETER_INTEGER_ARRAY, read_only=True)
    node.lifecycle.configuration_changes.listen(told.append)
    for change, name in (
        (lambda: node.set_parameters([Parameter("ints", value=[3])]), "ints"),
        (lambda: node.set_parameters([Parameter("any", value=1)]), "any"),
        (lambda: node.declare_parameter("late", 1), "late"),
        (lambda: node.undeclare_parameter("late"), "late"),
        (lambda: node.set_descriptor("ints", fixed), "ints"),
    ):
        before, count = configuration(driver), len(told)
        change()
        driver.spin_until(lambda count=count: len(told) > count)
        after = configuration(driver)
        assert after.checksum == told[-1].checksum != before.checksum
        changed = set(after.parameters or ()) ^ set(before.parameters or ())
        assert {each.name for each in changed} == {name}
