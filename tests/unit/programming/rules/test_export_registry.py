"""The exports of flows, by name."""

from __future__ import annotations

import re

import pytest

from lifecycle.programming.rules.camara import CamaraSettings
from lifecycle.programming.rules.nef import NefSettings
from lifecycle.programming.rules.registry import EXPORTS, ExportInput, ExportSettings, flows_to_csv
from lifecycle.programming.rules.rules import flow_rules
from lifecycle.programming.rules.tc import TcSettings
from tests.unit.programming.rules.samples import plan, report

FLOWS = (report(), report("/robot/status", source=(), destination=()))
SETTINGS = ExportSettings(
    tc=TcSettings(device="eth0", link_kbit=10_000),
    nef=NefSettings(
        notification_destination="https://robots.example.net/",
        devices=("10.77.0.2",),
        qos_references={85: "robot-control"},
    ),
    camara=CamaraSettings(devices=("10.77.0.2",), qos_profiles={85: "QOS_E"}),
)


def given(settings: ExportSettings = ExportSettings()) -> ExportInput:
    rules = flow_rules(FLOWS, plan())
    return ExportInput(flows=FLOWS, plan=plan(), rules=rules, settings=settings)


def cannot(message: str) -> object:
    return pytest.raises(ValueError, match=f"^{re.escape(message)}$")


def test_every_export_of_the_issue_has_its_name() -> None:
    assert list(EXPORTS) == [
        "nft",
        "tc",
        "nef",
        "camara",
        "csv",
    ]


@pytest.mark.parametrize("name", EXPORTS)
def test_every_export_shows_the_flow_and_names_what_it_left_out(name: str) -> None:
    text = EXPORTS[name](given(SETTINGS))
    assert text.endswith("\n")
    assert "/robot/video" in text
    assert "/robot/status" in text
    if name != "csv":
        assert "its network flow endpoints are not known" in text
        assert "EF = DSCP 46 = TOS 184 (0xb8)" in text


def test_the_csv_is_that_of_the_reports() -> None:
    assert EXPORTS["csv"](given()) == flows_to_csv(FLOWS)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("tc", "cannot export tc: nothing says the network device; give tc its settings"),
        (
            "nef",
            (
                "cannot export nef: nothing says devices and a notification destination; "
                "give nef its settings"
            ),
        ),
        (
            "camara",
            (
                "cannot export camara: nothing says devices and QoS profiles; "
                "give camara its settings"
            ),
        ),
    ],
)
def test_an_export_that_lacks_its_settings_says_which(name: str, message: str) -> None:
    with cannot(message):
        EXPORTS[name](given())
