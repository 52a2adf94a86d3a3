"""NEF and CAMARA bodies, and the settings that they follow from.

CAMARA's own document judges its half in test_camara.py.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec.structs import replace

from lifecycle.programming.camara import CamaraSettings, CamaraTarget
from lifecycle.programming.http import ServerSettings
from lifecycle.programming.nef import NefSettings, NefTarget
from lifecycle.programming.rules import FlowRule
from tests.unit.programming.flow_samples import EXPECTED, LEFT_OUT, RULES, VIDEO, rule
from tests.unit.programming.samples import exported, settings_file

ROBOT, VIEWER = "10.9.0.1", "10.9.0.2"
IPV6 = rule("/lidar", "fd09::1:17904", "fd09::2:17914", five_qi=85)


def nef(**rest: object) -> NefSettings:
    ordinary: dict[str, object] = {
        "url": "https://nef.example.net",
        "scs_as_id": "robots",
        "notification_destination": "https://robots.example.net/events",
        "devices": (VIEWER, "fd09::/64"),
        "qos_references": {85: "robot-control"},
    }
    return NefSettings(**{**ordinary, **rest})


def camara(**rest: object) -> CamaraSettings:
    ordinary: dict[str, object] = {
        "url": "https://api.example.net",
        "devices": (VIEWER, "fd09::/64"),
        "qos_profiles": {85: "QOS_E"},
    }
    return CamaraSettings(**{**ordinary, **rest})


@pytest.fixture
def asked(tmp_path: Path) -> Callable[..., dict[str, Any]]:
    """What a NEF, or another server, is asked for some rules, and what is left out."""

    def ask(
        *rules: FlowRule, settings: ServerSettings | None = None, left_out: tuple[str, ...] = ()
    ) -> dict[str, Any]:
        settings = settings or nef()
        kind = NefTarget if isinstance(settings, NefSettings) else CamaraTarget
        file = settings_file(tmp_path, **{kind.kind: msgspec.to_builtins(settings)})
        return json.loads(exported(kind, file, rules, left_out=left_out))

    return ask


def reasons(found: dict[str, Any]) -> list[str]:
    assert found["subscriptions"] == []
    return [each.partition(": ")[2] for each in found["left_out"]]


# --- NEF


def filters(body: dict[str, object]) -> list[str]:
    (flow,) = body["flowInfo"]
    return flow["flowDescriptions"]


def test_a_flow_between_two_devices_is_asked_for_once_for_each(
    asked: Callable[..., dict[str, Any]],
) -> None:
    found = asked(IPV6)["subscriptions"]
    assert [(each["key"].rpartition("udp ")[2], each["body"]["ueIpv6Addr"]) for each in found] == [
        ("fd09::2 to device", "fd09::2"),
        ("fd09::2 from device", "fd09::1"),
    ]
    assert [filters(each["body"]) for each in found] == [
        ["permit out 17 from fd09::1 17904 to fd09::2 17914"],
        ["permit in 17 from fd09::1 17904 to fd09::2 17914"],
    ]


def test_what_a_device_sends_is_asked_for_as_such(asked: Callable[..., dict[str, Any]]) -> None:
    (request,) = asked(VIDEO, settings=nef(devices=(ROBOT,)))["subscriptions"]
    assert filters(request["body"]) == ["permit in 17 from 10.9.0.1 17900 to 10.9.0.2 17910"]
    assert request["body"]["ueIpv4Addr"] == ROBOT


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (
            {"source_address": ""},
            "the address it is sent from is not known; give its machine an address in the manifest",
        ),
        ({"five_qi": 9}, "the operator's name for 5QI 9 is not known; add it to qos_references"),
        (
            {"five_qi": None},
            "it asks for no 5QI (EF = DSCP 46 = TOS 184 (0xb8), at most 5 ms)",
        ),
        (
            {"destination_address": "10.9.0.3"},
            "neither end is a device of the mobile network (10.9.0.2/32, fd09::/64)",
        ),
        (
            {"source_address": "127.0.0.1", "destination_address": "127.0.0.1"},
            "it never leaves its machine",
        ),
    ],
)
def test_what_cannot_be_asked_for_is_named_with_its_reason(
    asked: Callable[..., dict[str, Any]], change: dict[str, object], reason: str
) -> None:
    assert reasons(asked(replace(VIDEO, **change))) == [reason]


def test_the_export_says_what_each_body_is_for(asked: Callable[..., dict[str, Any]]) -> None:
    made = asked(*RULES, left_out=LEFT_OUT)
    assert made == json.loads((EXPECTED / "nef.json").read_text(encoding="utf-8"))


# --- CAMARA


def test_the_camara_export_says_what_each_body_is_for(
    asked: Callable[..., dict[str, Any]],
) -> None:
    made = asked(*RULES, settings=camara(), left_out=LEFT_OUT)
    assert made == json.loads((EXPECTED / "camara.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: nef(notification_destination="robots"), "notificationDestination 'robots'; use"),
        (lambda: nef(devices=()), "devices is empty; name the addresses or networks"),
        (lambda: nef(devices=("robots",)), "cannot use devices: 'robots' does not appear to be"),
        (lambda: camara(qos_profiles={85: "x"}), "cannot use qosProfile 'x'; use 3 to 256 letters"),
        (lambda: camara(qos_profiles={85: "a b"}), "cannot use qosProfile 'a b'; use 3 to 256"),
        (lambda: camara(duration_s=0), "cannot use a duration of 0 s; use 1 to 2147483647"),
    ],
)
def test_settings_that_a_server_would_refuse_or_misread_are_refused_by_us(
    make: Callable[[], object], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        make()
