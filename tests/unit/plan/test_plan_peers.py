"""Whom a host looks for by address, because multicast may end at a router."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import Discovery, DiscoveryMode, DiscoveryRange, Machine
from lifecycle.middleware.fastdds.discovery import discovery_peers, peers_environment
from lifecycle.middleware.fastdds.profiles import discovery_profile
from lifecycle.plan.discovery import reached_hosts
from lifecycle.plan.model import Plan
from tests.builders import HERE, plan_of, planned_node

ADDRESSES = {"left": "10.0.1.1", "right": "10.0.2.1", "idle": "10.0.3.1", "near": "127.0.0.1"}


def system(**fields: object) -> Plan:
    nodes = [
        replace(planned_node(key), machine=machine)
        for key, machine in (("a", "left"), ("b", "right"), ("c", "right"), ("d", "near"))
    ]
    machines = tuple(Machine(name=n, address=a, at=HERE) for n, a in ADDRESSES.items())
    subnet = {"machines": machines, "discovery_range": DiscoveryRange.SUBNET, **fields}
    return replace(plan_of(*nodes), **subnet)  # type: ignore[arg-type]


def test_hosts_with_nodes_are_looked_for_by_address_and_nobody_else() -> None:
    # A supervisor, two processes, and four of others.
    assert reached_hosts(system(), {"left", "near"}) == {"10.0.2.1": 7}


@pytest.mark.parametrize(
    "fields",
    [
        {"discovery_range": DiscoveryRange.LOCALHOST},
        {"discovery_range": DiscoveryRange.OFF},
        {"discovery": Discovery(mode=DiscoveryMode.STATIC)},
        {"discovery": Discovery(mode=DiscoveryMode.SERVER)},
    ],
)
def test_where_discovery_ends_at_this_host_or_is_planned_nobody_is(
    fields: dict[str, object],
) -> None:
    assert reached_hosts(system(**fields), {"left"}) == {}


def test_peers_of_the_users_are_kept_and_extended() -> None:
    given = {"ROS_STATIC_PEERS": "robot.local; 10.0.2.1"}
    assert peers_environment(["10.0.2.1", "10.0.3.1"], given) == {
        "ROS_STATIC_PEERS": "robot.local;10.0.2.1;10.0.3.1"
    }
    assert peers_environment([], {}) == {}


@pytest.mark.parametrize(
    "chosen",
    [
        {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv6"},
        {"FASTDDS_BUILTIN_TRANSPORTS": "SHM"},
        {"ROS_DISCOVERY_SERVER": "10.0.0.1:11811"},
    ],
)
def test_participants_without_udp_over_ipv4_are_given_no_peers(chosen: dict[str, str]) -> None:
    assert peers_environment(["10.0.2.1"], chosen) == {}


def test_all_participants_of_a_host_are_looked_for_and_multicast_stays() -> None:
    peers = discovery_peers(0, {"10.0.2.1": 2}, {})
    assert peers == (("239.255.0.1", 7400), ("10.0.2.1", 7410), ("10.0.2.1", 7412))
    assert "<address>10.0.2.1</address><port>7412</port>" in discovery_profile(peers=peers)
    assert discovery_peers(0, {}, {}) == ()
    chosen = {"FASTDDS_BUILTIN_TRANSPORTS": "SHM"}
    assert discovery_peers(0, {"10.0.2.1": 2}, chosen) == ()
