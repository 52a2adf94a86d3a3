"""NEF and CAMARA bodies, and the settings that they follow from.

CAMARA's own document judges its half in test_camara.py.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from types import SimpleNamespace

import pytest
from msgspec.structs import replace

from lifecycle.programming.camara import CamaraSettings, CamaraTarget
from lifecycle.programming.nef import NefSettings, NefTarget
from lifecycle.programming.rules import RuleSet
from tests.unit.programming.flow_samples import EXPECTED, LEFT_OUT, RULES, VIDEO, rule

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


def nef_subscriptions(rules: object, settings: NefSettings) -> SimpleNamespace:
    requests, left_out = NefTarget.wanted(rules, settings)
    return SimpleNamespace(requests=requests, left_out=left_out)


def reasons(found: object) -> list[str]:
    assert found.requests == ()
    return [each.partition(": ")[2] for each in found.left_out]


# --- NEF


def filters(body: dict[str, object]) -> list[str]:
    (flow,) = body["flowInfo"]
    return flow["flowDescriptions"]


def test_a_flow_between_two_devices_is_asked_for_once_for_each() -> None:
    found = nef_subscriptions([IPV6], nef())
    assert [
        (each.key.rpartition("udp ")[2], each.body["ueIpv6Addr"]) for each in found.requests
    ] == [("fd09::2 to device", "fd09::2"), ("fd09::2 from device", "fd09::1")]
    assert [filters(each.body) for each in found.requests] == [
        ["permit out 17 from fd09::1 17904 to fd09::2 17914"],
        ["permit in 17 from fd09::1 17904 to fd09::2 17914"],
    ]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({}, "permit in 17 from 10.9.0.1 17900 to 10.9.0.2 17910"),
        ({"protocol_by_name": True}, "permit in udp from 10.9.0.1 17900 to 10.9.0.2 17910"),
    ],
)
def test_servers_differ_in_how_they_want_what_a_device_sends(
    change: dict[str, object], text: str
) -> None:
    (request,) = nef_subscriptions([VIDEO], nef(devices=(ROBOT,), **change)).requests
    assert filters(request.body) == [text]
    assert request.body["ueIpv4Addr"] == ROBOT


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
    change: dict[str, object], reason: str
) -> None:
    changed = replace(VIDEO, **change)
    assert reasons(nef_subscriptions([changed], nef())) == [reason]


def test_the_export_says_what_each_body_is_for() -> None:
    made = json.loads(NefTarget.document(RuleSet(rules=RULES, left_out=LEFT_OUT), nef()))
    assert made == json.loads((EXPECTED / "nef.json").read_text(encoding="utf-8"))


# --- CAMARA


def test_the_camara_export_says_what_each_body_is_for() -> None:
    made = json.loads(CamaraTarget.document(RuleSet(rules=RULES, left_out=LEFT_OUT), camara()))
    assert made == json.loads((EXPECTED / "camara.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: nef(notification_destination="robots"),
            (
                "cannot use notificationDestination 'robots'; "
                "use an http or https URL that the network can reach"
            ),
        ),
        (
            lambda: nef(devices=()),
            (
                "cannot tell which ends of flows are devices: devices is empty; name the "
                "addresses or networks of the devices, such as 10.45.0.0/16"
            ),
        ),
        (
            lambda: nef(devices=("robots",)),
            (
                "cannot use devices: 'robots' does not appear to be an IPv4 or IPv6 network; "
                "use 10.45.0.0/16, for example"
            ),
        ),
        (
            lambda: camara(qos_profiles={85: "x"}),
            (
                "cannot use qosProfile 'x'; "
                "use 3 to 256 letters, digits, '_', '.' and '-', such as QOS_E"
            ),
        ),
        (lambda: camara(duration_s=0), "cannot use a duration of 0 s; use 1 to 2147483647"),
        (
            lambda: camara(qos_profiles={85: "a b"}),
            (
                "cannot use qosProfile 'a b'; "
                "use 3 to 256 letters, digits, '_', '.' and '-', such as QOS_E"
            ),
        ),
    ],
)
def test_settings_that_a_server_would_refuse_or_misread_are_refused_by_us(
    make: Callable[[], object], message: str
) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        make()
