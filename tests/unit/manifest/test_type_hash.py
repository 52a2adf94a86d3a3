"""The type hash of what is installed, by its type description alone."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lifecycle.manifest.installed_types import installed_hash, join, search_prefixes

INSTALLED = search_prefixes({})
STRING = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"


@pytest.fixture
def prefix(tmp_path: Path) -> Path:
    index = tmp_path / "share/ament_index/resource_index/rosidl_interfaces/p"
    index.parent.mkdir(parents=True)
    index.write_text("")
    return tmp_path


def _install(prefix: Path, type_: str, **hashes: str) -> None:
    listed = [
        {"type_name": f"p/{type_}{part}", "hash_string": each} for part, each in hashes.items()
    ]
    file = prefix / "share/p" / f"{type_}.json"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps({"type_hashes": listed}))


def test_an_installed_message_has_its_hash() -> None:
    assert installed_hash("std_msgs/msg/String", INSTALLED) == STRING


def test_a_service_has_those_of_its_request_and_response(prefix: Path) -> None:
    _install(prefix, "srv/Ask", _Request="q", _Response="r", _Event="e")
    assert installed_hash("p/srv/Ask", [prefix]) == "q r"


def test_an_action_has_those_of_all_that_goes_over_the_wire(prefix: Path) -> None:
    _install(
        prefix,
        "action/Dock",
        _SendGoal_Request="g",
        _SendGoal_Response="h",
        _GetResult_Request="q",
        _GetResult_Response="r",
        _FeedbackMessage="f",
        _Goal="not on the wire",
    )
    assert installed_hash("p/action/Dock", [prefix]) == "g h q r f"


@pytest.mark.parametrize(
    "type_", ["p/msg/Missing", "q/msg/Missing", "p", "p/idl/Odd", "p/msg/Broken", "p/srv/Half"]
)
def test_what_is_not_installed_or_cannot_be_read_has_none(prefix: Path, type_: str) -> None:
    _install(prefix, "srv/Half", _Request="q")
    (prefix / "share/p/msg").mkdir()
    (prefix / "share/p/msg/Broken.json").write_text("[]")
    assert installed_hash(type_, [prefix]) == ""


def test_one_unknown_part_leaves_the_whole_unknown() -> None:
    assert (join(["a", "b"]), join(["a", ""])) == ("a b", "")
