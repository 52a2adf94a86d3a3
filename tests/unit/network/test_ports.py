"""Port arithmetic: every number of the article *The ROS_DOMAIN_ID*, and its properties."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lifecycle.network.ports import (
    EPHEMERAL_RANGE_FILE,
    LINUX,
    PARTICIPANTS_PER_DOMAIN,
    Capacity,
    ParticipantPorts,
    describe_domains,
    domain_base,
    domain_of,
    max_participants,
    participant_ports,
    read_ephemeral_range,
    safe_domains,
    unicast_pairs,
    unique_flow_ports,
)

MACOS = WINDOWS = range(49152, 65536)
DOMAINS = st.integers(0, 232)


@pytest.mark.parametrize(
    ("domain_id", "participant_id", "ports"),
    [
        (0, 0, (7400, 7401, 7410, 7411)),
        (1, 0, (7650, 7651, 7660, 7661)),
        (1, 119, (7650, 7651, 7898, 7899)),
        (1, 120, (7650, 7651, 7900, 7901)),
        (2, 0, (7900, 7901, 7910, 7911)),
        (101, 0, (32650, 32651, 32660, 32661)),
        (101, 1, (32650, 32651, 32662, 32663)),
        (101, 2, (32650, 32651, 32664, 32665)),
        (101, 53, (32650, 32651, 32766, 32767)),
        (101, 54, (32650, 32651, 32768, 32769)),
        (232, 62, (65400, 65401, 65534, 65535)),
    ],
)
def test_the_articles_ports(
    domain_id: int, participant_id: int, ports: tuple[int, int, int, int]
) -> None:
    names = ("discovery_multicast", "user_multicast", "discovery_unicast", "user_unicast")
    expected = ParticipantPorts(**dict(zip(names, ports, strict=True)))
    assert participant_ports(domain_id, participant_id) == expected


@pytest.mark.parametrize("domain_id", [-1, 233])
def test_the_highest_domain_is_232_because_ports_end_at_65535(domain_id: int) -> None:
    with pytest.raises(ValueError, match=f"cannot use domain id {domain_id}: .*; use 0 to 232"):
        participant_ports(domain_id, 0)


@pytest.mark.parametrize(
    ("platform", "ephemeral", "safe"),
    [
        (LINUX, (32768, 60999), (range(102), range(215, 233))),
        (MACOS, (49152, 65535), (range(167),)),
        (WINDOWS, (49152, 65535), (range(167),)),
    ],
)
def test_the_articles_safe_domains(
    platform: range, ephemeral: tuple[int, int], safe: tuple[range, ...]
) -> None:
    assert (platform[0], platform[-1]) == ephemeral
    assert safe_domains(platform) == safe


@pytest.mark.parametrize(
    ("domain_id", "platform", "participants", "limit"),
    [
        (1, LINUX, 120, "the ports of domain 2, from 7900"),
        (101, LINUX, 54, "the ephemeral ports 32768–60999"),
        (214, LINUX, 0, "the ephemeral ports 32768–60999: they hold its multicast ports"),
        (232, LINUX, 63, "the highest port, 65535"),
        (232, range(0), 63, "the highest port, 65535"),
        (166, MACOS, 120, "the ports of domain 167, from 49150"),
        (166, WINDOWS, 120, "the ports of domain 167, from 49150"),
    ],
)
def test_how_many_participants_fit(
    domain_id: int, platform: range, participants: int, limit: str
) -> None:
    assert max_participants(domain_id, platform) == Capacity(participants=participants, limit=limit)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: participant_ports(232, 63),  # where Fast DDS wraps to port 1
            (
                "cannot use participant id 63 in domain 232: its unicast ports would be 65536 and "
                "65537, beyond 65535; use 0 to 62"
            ),
        ),
        (lambda: participant_ports(0, -1), "cannot use participant id -1; use 0 or more"),
    ],
)
def test_what_no_port_is_for_is_refused(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError) as caught:
        make()
    assert str(caught.value) == message


def test_the_machines_own_range_moves_the_safe_domains() -> None:
    files = {EPHEMERAL_RANGE_FILE: "10000\t20000\n"}
    own = read_ephemeral_range(files.__getitem__)
    assert own == range(10000, 20001)
    assert safe_domains(own) == (range(10 + 1), range(51, 233))
    assert max_participants(10, own).participants == 45


def test_unique_subscriptions_share_ports_7000_to_7399_in_every_domain() -> None:
    assert (unique_flow_ports()[0], unique_flow_ports()[-1]) == (7000, 7399)


def fits(domain_id: int, participant_id: int, ephemeral: range) -> bool:
    """The rule of the article, said without arithmetic."""
    try:
        ports = participant_ports(domain_id, participant_id)
    except ValueError:
        return False
    used = (
        ports.discovery_multicast,
        ports.user_multicast,
        ports.discovery_unicast,
        ports.user_unicast,
    )
    return participant_id < PARTICIPANTS_PER_DOMAIN and not any(port in ephemeral for port in used)


CLOSE = st.builds(
    lambda domain_id, offset, width: (
        domain_id,
        range(
            min(domain_base(domain_id) + offset, 65535),
            min(domain_base(domain_id) + offset + width, 65535) + 1,
        ),
    ),
    DOMAINS,
    st.integers(-3, 14),
    st.integers(0, 3),
)
ANYWHERE = st.builds(
    lambda domain_id, ends: (domain_id, range(min(ends), max(ends) + 1)),
    DOMAINS,
    st.tuples(st.integers(1, 65535), st.integers(1, 65535)),
)


@given(CLOSE | ANYWHERE)
def test_the_capacity_is_where_the_first_participant_does_not_fit(
    case: tuple[int, range],
) -> None:
    domain_id, ephemeral = case
    count = max_participants(domain_id, ephemeral).participants
    for participant_id in {0, 1, count // 2, count - 1}:
        if 0 <= participant_id < count:
            assert fits(domain_id, participant_id, ephemeral)
    assert not fits(domain_id, count, ephemeral)


@pytest.mark.parametrize(
    ("text", "domain"),
    [
        ("0", 0),
        ("232", 232),
        ("000000007", 7),
        ("233", None),
        ("-1", None),
        ("", None),
        ("0x7", None),
        ("٧", None),
        ("0000000007", None),
        ("9" * 5000, None),
    ],
)
def test_ros_domain_id_is_a_plain_number_up_to_232(text: str, domain: int | None) -> None:
    assert domain_of(text) == domain


@pytest.mark.parametrize("domain", [0, 77, 101, 231, 232])
def test_the_pairs_of_a_host_are_those_of_its_participants(domain: int) -> None:
    expected = []
    with contextlib.suppress(ValueError):  # the domain has no such port
        for participant in range(PARTICIPANTS_PER_DOMAIN):
            ports = participant_ports(domain, participant)
            expected.append((ports.discovery_unicast, ports.user_unicast))
    assert unicast_pairs(domain) == expected
    assert unicast_pairs(domain, 7) == expected[:7]
    assert unicast_pairs(domain, 0) == []


@pytest.mark.parametrize("offset", [0, 1])
def test_one_multicast_port_among_the_ephemeral_ports_is_enough(offset: int) -> None:
    port = domain_base(3) + offset
    capacity = max_participants(3, range(port, port + 1))
    assert capacity.participants == 0
    beside = domain_base(3) - 1
    assert max_participants(3, range(beside, beside + 1)).participants == 120


@pytest.mark.parametrize(
    ("runs", "text"),
    [((), "none"), ((range(3, 4),), "3"), ((range(102), range(215, 233)), "0–101, 215–232")],
)
def test_runs_of_domains_are_read_by_people(runs: tuple[range, ...], text: str) -> None:
    assert describe_domains(runs) == text
