"""The exports by name, and those for other middlewares whole."""

from __future__ import annotations

import dataclasses
import json
import re
import xml.etree.ElementTree as ET

import pytest

from lifecycle.programming.rules.camara import CamaraSettings
from lifecycle.programming.rules.fastdds_pro import render_fastdds_pro
from lifecycle.programming.rules.nef import NefSettings
from lifecycle.programming.rules.registry import EXPORTS, ExportSettings, export_input, flows_to_csv
from lifecycle.programming.rules.tc import TcSettings
from lifecycle.programming.rules.zenoh import render_zenoh, zenoh_endpoint
from tests.unit.programming.rules.samples import EXPECTED, LEFT_OUT, RULES, VIDEO, plan, report

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


def cannot(message: str) -> object:
    return pytest.raises(ValueError, match=f"^{re.escape(message)}$")


def test_every_export_of_the_issue_has_its_name() -> None:
    assert list(EXPORTS) == [
        "nft",
        "nft-json",
        "tc",
        "nef",
        "camara",
        "fastdds-pro",
        "zenoh",
        "csv",
    ]


@pytest.mark.parametrize("name", [each for each in EXPORTS if each != "nft-json"])
def test_every_export_shows_the_flow_and_names_what_it_left_out(name: str) -> None:
    text = EXPORTS[name](export_input(FLOWS, plan(), settings=SETTINGS))
    assert text.endswith("\n")
    assert "/robot/video" in text
    assert "/robot/status" in text
    if name != "csv":
        assert "its network flow endpoints are not known" in text
        assert "EF = DSCP 46 = TOS 184 (0xb8)" in text


def test_the_json_ruleset_has_no_room_for_comments_but_those_of_rules() -> None:
    text = EXPORTS["nft-json"](export_input(FLOWS, plan()))
    rules = [
        each["add"]["rule"]
        for each in json.loads(text)["nftables"]
        if "rule" in each.get("add", {})
    ]
    assert [each["comment"] for each in rules][1:] == ["EF = DSCP 46 = TOS 184 (0xb8)"]


def test_the_csv_is_that_of_the_reports() -> None:
    assert EXPORTS["csv"](export_input(FLOWS, plan())) == flows_to_csv(FLOWS)


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
        EXPORTS[name](export_input(FLOWS, plan()))


def test_fast_dds_pro_gets_its_priority_mappings() -> None:
    text = render_fastdds_pro(RULES, system="teleop", left_out=LEFT_OUT)
    assert text == (EXPECTED / "fastdds_pro.xml").read_text(encoding="utf-8")


def test_every_priority_of_a_transport_is_its_own_and_ends_in_the_tos_byte() -> None:
    rules = [
        dataclasses.replace(VIDEO, source_port=port, dscp=dscp)
        for port in (1, 2, 3, 4, 5, 6)
        for dscp in (0, 1, 46)
    ]
    root = ET.fromstring(render_fastdds_pro(rules, system="teleop"))
    found = [
        (int(each.get("value", "")), int(each.get("dscp", "")))
        for each in root.iter("{http://www.eprosima.com}priority")
    ]
    assert len({value for value, _ in found}) == len(found) == 18
    assert all(value & 0xFF == dscp << 2 for value, dscp in found)
    assert all(value > 0 for value, _ in found)


def test_a_name_cannot_end_an_xml_comment() -> None:
    odd = dataclasses.replace(VIDEO, names=(("/a--></x>", "/b", "/c"),))
    ET.fromstring(render_fastdds_pro([odd], system="teleop"))


def test_zenoh_gets_endpoints_with_the_whole_tos_byte() -> None:
    text = render_zenoh(RULES, left_out=LEFT_OUT)
    assert text == (EXPECTED / "zenoh.json5").read_text(encoding="utf-8")


def test_one_zenoh_link_has_one_dscp() -> None:
    other = dataclasses.replace(VIDEO, source_port=17999, dscp=34)
    text = render_zenoh([VIDEO, other])
    assert text.count("// choose one: other flows to this address and port differ in DSCP") == 2
    assert '"udp/10.9.0.2:17910#dscp=0xb8"' in text
    assert '"udp/10.9.0.2:17910#dscp=0x88"' in text


def test_a_flow_without_dscp_makes_no_zenoh_endpoint() -> None:
    with cannot("cannot make a Zenoh endpoint for /video /robot/camera → /viewer: it has no DSCP"):
        zenoh_endpoint(dataclasses.replace(VIDEO, dscp=None))
