"""Ports and peers of what is started again over TCP, where the old ports cannot be had again."""

from __future__ import annotations

import pytest

from lifecycle.manifest.model import Discovery, DiscoveryMode, FlowTransport
from lifecycle.network.connection_url import parse
from lifecycle.plan.model import Plan, PlanError
from lifecycle.plan.restart import is_same_url, restarted
from tests.builders import node, planned, publisher, subscription

HOST = "tcpv4://127.0.0.1"


def system(mode: DiscoveryMode = DiscoveryMode.STATIC, first_port: int = 8000) -> Plan:
    """A publisher and two listeners on one host, over TCP."""
    return planned(
        node("talker", publisher("t")),
        node("near", subscription("t")),
        node("far", subscription("t")),
        discovery=Discovery(mode=mode, transport=FlowTransport.TCPV4, first_port=first_port),
    )


def own(plan: Plan) -> dict[str, str]:
    """The URL of every node's own participant."""
    return {each.key: each.connections.urls[0] for each in plan.nodes}


def ports(plan: Plan) -> dict[str, int | None]:
    return {key: parse(url).port for key, url in own(plan).items()}


def test_who_comes_again_has_a_port_of_its_own_and_dials_all_who_stay():
    first = system()
    assert own(first) == {
        "talker": f"{HOST}:8004?peer=127.0.0.1:8003",
        "near": f"{HOST}:8005?peer=127.0.0.1:8003&peer=127.0.0.1:8004",
        "far": f"{HOST}:8006?peer=127.0.0.1:8003&peer=127.0.0.1:8004&peer=127.0.0.1:8005",
    }
    again = restarted(first, ["talker"], first=first)
    others = "&".join(f"peer=127.0.0.1:{port}" for port in (8003, 8005, 8006))
    assert own(again) == {**own(first), "talker": f"{HOST}:10000?{others}"}


def test_who_comes_later_dials_who_came_again_where_it_is_now():
    first = system()
    again = restarted(first, ["talker"], first=first)
    later = restarted(again, ["far"], first=first)
    peers = "&".join(f"peer=127.0.0.1:{port}" for port in (8003, 8005, 10000))
    assert own(later) == {**own(again), "far": f"{HOST}:10001?{peers}"}


def test_of_those_who_come_again_together_one_end_dials_as_planned():
    first = system()
    again = restarted(first, ["talker", "near", "far"], first=first)
    assert own(again) == {
        "talker": f"{HOST}:10000?peer=127.0.0.1:8003",
        "near": f"{HOST}:10001?peer=127.0.0.1:8003&peer=127.0.0.1:10000",
        "far": f"{HOST}:10002?peer=127.0.0.1:8003&peer=127.0.0.1:10000&peer=127.0.0.1:10001",
    }


@pytest.mark.parametrize("mode", [DiscoveryMode.STATIC, DiscoveryMode.SERVER])
def test_nobody_ever_has_a_port_again(mode: DiscoveryMode):
    first = plan = system(mode)
    had = [*ports(first).values()]
    for keys in (["talker"], ["talker"], ["near", "far"], ["talker", "near", "far"], ["far"]):
        before, plan = plan, restarted(plan, keys, first=first)
        assert {key for key in ports(plan) if ports(plan)[key] != ports(before)[key]} == {*keys}
        had += [ports(plan)[key] for key in keys]
    assert len(set(had)) == len(had)


def test_a_client_of_a_discovery_server_needs_to_dial_nobody_else():
    first = system(DiscoveryMode.SERVER)
    again = restarted(first, ["near"], first=first)
    assert own(again) == {**own(first), "near": f"{HOST}:10000?server=127.0.0.1:8000"}


def test_what_a_node_of_another_supervisor_says_counts_more_than_the_plan():
    first = system()
    heard = {"/near": {"": (f"{HOST}:10001?peer=127.0.0.1:8003",)}}
    again = restarted(first, ["talker"], first=first, reported=heard)
    assert [each.port for each in parse(own(again)["talker"]).peers] == [8003, 8006, 10001]


def test_over_udp_everybody_stays_where_it_is():
    first = planned(
        node("talker", publisher("t")),
        node("near", subscription("t")),
        discovery=Discovery(mode=DiscoveryMode.STATIC, first_port=8000),
    )
    assert restarted(first, ["talker"], first=first) == first


def test_a_host_without_ports_left_says_so():
    first = system(first_port=63534)
    with pytest.raises(PlanError, match=r"^cannot give out 1 more ports"):
        restarted(first, ["talker", "near", "far"], first=first)


@pytest.mark.parametrize(
    ("planned_url", "reported", "same"),
    [
        (f"{HOST}:8004?peer=127.0.0.1:8003", f"{HOST}:10000?peer=127.0.0.1:8006", True),
        (f"{HOST}:8004?server=127.0.0.1:8000", f"{HOST}:10003?server=127.0.0.1:8000", True),
        (f"{HOST}:8004?server=127.0.0.1:8000", f"{HOST}:10003?server=127.0.0.1:8001", False),
        (f"{HOST}:8004?peer=127.0.0.1:8003", f"{HOST}:9999?peer=127.0.0.1:8003", False),
        (f"{HOST}:8004?peer=127.0.0.1:8003", "tcpv4://127.0.0.2:10000?peer=127.0.0.1:8003", False),
        (f"{HOST}:8004", f"{HOST}:10000", False),
        ("udpv4://127.0.0.1:8004", "udpv4://127.0.0.1:10000", False),
        ("udpv4://127.0.0.1:8004", "udpv4://127.0.0.1:8004", True),
        (f"{HOST}:8004", "nonsense", False),
    ],
)
def test_a_url_after_a_restart_is_known(planned_url: str, reported: str, same: bool):
    assert is_same_url(planned_url, reported, first_port=8000) is same
