"""Port arithmetic: every number of the article *The ROS_DOMAIN_ID*, and its properties."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lifecycle.network.ports import (
    EPHEMERAL_RANGE_FILE,
    PARTICIPANTS_PER_DOMAIN,
    Capacity,
    EphemeralRange,
    ParticipantPorts,
    Platform,
    PortUse,
    domain_base,
    domain_of,
    max_participants,
    overlaps,
    owner_of,
    participant_ports,
    read_ephemeral_range,
    safe_domains,
    unicast_pairs,
    unique_flow_ports,
)

LINUX = Platform.LINUX
DOMAINS = st.integers(0, 232)


def unicast(domain_id: int, participant_id: int) -> tuple[int, int]:
    ports = participant_ports(domain_id, participant_id)
    return ports.discovery_unicast, ports.user_unicast


def multicast(domain_id: int) -> tuple[int, int]:
    ports = participant_ports(domain_id, 0)
    return ports.discovery_multicast, ports.user_multicast


class TestTheArticle:
    def test_the_calculator_shows_7400_7401_7410_7411_for_domain_0_participant_0(self) -> None:
        assert participant_ports(0, 0) == ParticipantPorts(
            discovery_multicast=7400,
            user_multicast=7401,
            discovery_unicast=7410,
            user_unicast=7411,
        )

    def test_the_lowest_domain_is_0_and_the_highest_232_because_ports_end_at_65535(self) -> None:
        assert domain_base(0) == 7400
        assert domain_base(232) == 65400
        with pytest.raises(ValueError) as caught:
            domain_base(233)
        assert str(caught.value) == (
            "cannot use domain id 233: its ports would lie outside 1 to 65535; use 0 to 232"
        )
        with pytest.raises(ValueError, match="cannot use domain id -1: "):
            participant_ports(-1, 0)

    def test_linux_hands_out_32768_to_60999_so_0_to_101_and_215_to_232_are_safe(self) -> None:
        assert safe_domains(LINUX) == (range(102), range(215, 233))
        assert safe_domains(EphemeralRange(first=32768, last=60999)) == safe_domains(LINUX)

    @pytest.mark.parametrize("platform", [Platform.MACOS, Platform.WINDOWS])
    def test_macos_and_windows_hand_out_49152_to_65535_so_0_to_166_are_safe(
        self, platform: Platform
    ) -> None:
        assert safe_domains(platform) == (range(167),)
        assert safe_domains(EphemeralRange(first=49152, last=65535)) == safe_domains(platform)

    def test_choosing_0_to_101_is_safe_everywhere(self) -> None:
        for platform in Platform:
            assert all(d in safe_domains(platform)[0] for d in range(102))

    def test_domain_1_uses_7650_and_7651_for_multicast(self) -> None:
        assert multicast(1) == (7650, 7651)

    def test_domain_2_uses_7900_and_7901_for_multicast(self) -> None:
        assert multicast(2) == (7900, 7901)

    def test_the_first_process_in_domain_1_uses_7660_and_7661(self) -> None:
        assert unicast(1, 0) == (7660, 7661)

    def test_the_120th_process_in_domain_1_uses_7898_and_7899(self) -> None:
        assert unicast(1, 119) == (7898, 7899)
        assert overlaps(1, 119) == ()

    def test_the_121st_process_in_domain_1_uses_7900_and_7901_which_overlaps_domain_2(self) -> None:
        assert unicast(1, 120) == (7900, 7901)
        assert overlaps(1, 120) == (
            PortUse(domain_id=2, role="discovery_multicast", participant_id=None),
            PortUse(domain_id=2, role="user_multicast", participant_id=None),
        )

    def test_one_host_may_run_120_processes_per_domain(self) -> None:
        assert max_participants(1, LINUX) == Capacity(
            participants=120, limit="the ports of domain 2, from 7900"
        )

    @pytest.mark.parametrize(
        ("participant_id", "ports"),
        [
            (0, (32660, 32661)),
            (1, (32662, 32663)),
            (2, (32664, 32665)),
            (53, (32766, 32767)),
            (54, (32768, 32769)),
        ],
    )
    def test_domain_101_uses_32650_32651_and_these_unicast_ports(
        self, participant_id: int, ports: tuple[int, int]
    ) -> None:
        assert multicast(101) == (32650, 32651)
        assert unicast(101, participant_id) == ports

    def test_54_processes_fit_domain_101_on_linux(self) -> None:
        assert max_participants(101, LINUX) == Capacity(
            participants=54, limit="the ephemeral ports 32768–60999"
        )

    def test_63_processes_fit_domain_232_on_linux_because_the_highest_port_is_65535(self) -> None:
        assert max_participants(232, LINUX) == Capacity(
            participants=63, limit="the highest port, 65535"
        )
        assert unicast(232, 62) == (65534, 65535)

    @pytest.mark.parametrize("platform", [Platform.MACOS, Platform.WINDOWS])
    def test_120_processes_fit_domain_166_on_macos_and_windows(self, platform: Platform) -> None:
        assert max_participants(166, platform) == Capacity(
            participants=120, limit="the ports of domain 167, from 49150"
        )


def test_participant_63_of_domain_232_is_refused_where_fast_dds_wraps_to_port_1() -> None:
    with pytest.raises(ValueError) as caught:
        participant_ports(232, 63)
    assert str(caught.value) == (
        "cannot use participant id 63 in domain 232: its unicast ports would be 65536 and 65537, "
        "beyond 65535; use 0 to 62"
    )


def test_a_negative_participant_is_refused() -> None:
    with pytest.raises(ValueError) as caught:
        participant_ports(0, -1)
    assert str(caught.value) == "cannot use participant id -1; use 0 or more"


def test_no_participant_fits_a_domain_whose_multicast_ports_are_ephemeral() -> None:
    assert max_participants(214, LINUX) == Capacity(
        participants=0,
        limit="the ephemeral ports 32768–60999: they hold its multicast ports",
    )


def test_the_machines_own_range_moves_the_safe_domains() -> None:
    files = {EPHEMERAL_RANGE_FILE: "10000\t20000\n"}
    own = read_ephemeral_range(files.__getitem__)
    assert own == EphemeralRange(first=10000, last=20000)
    assert safe_domains(own) == (range(10 + 1), range(51, 233))
    assert max_participants(10, own).participants == 45


@pytest.mark.parametrize("text", ["", "32768", "1 2 3", "a b", "-1 5"])
def test_a_range_file_that_does_not_hold_two_ports_is_refused(text: str) -> None:
    with pytest.raises(ValueError) as caught:
        read_ephemeral_range(lambda _: text)
    assert str(caught.value) == f"cannot read {EPHEMERAL_RANGE_FILE}: {text!r} is not two ports"


def test_an_ephemeral_range_the_wrong_way_round_is_refused() -> None:
    with pytest.raises(ValueError) as caught:
        EphemeralRange(first=5, last=4)
    assert str(caught.value) == (
        "cannot use ephemeral port range 5–4; use 1 to 65535, lower end first"
    )


def test_unique_subscriptions_share_ports_7000_to_7399_in_every_domain() -> None:
    assert (unique_flow_ports()[0], unique_flow_ports()[-1]) == (7000, 7399)
    assert all(owner_of(port) is None for port in unique_flow_ports())


@given(domain_id=DOMAINS, participant_id=st.integers(0, 119))
def test_a_port_leads_back_to_the_domain_participant_and_role_that_own_it(
    domain_id: int, participant_id: int
) -> None:
    try:
        ports = participant_ports(domain_id, participant_id)
    except ValueError:
        assert (domain_id, participant_id >= 63) == (232, True)
        return
    for role in ("discovery_unicast", "user_unicast"):
        assert owner_of(getattr(ports, role)) == PortUse(
            domain_id=domain_id, role=role, participant_id=participant_id
        )
    for role in ("discovery_multicast", "user_multicast"):
        assert owner_of(getattr(ports, role)) == PortUse(
            domain_id=domain_id, role=role, participant_id=None
        )


def fits(domain_id: int, participant_id: int, ephemeral: EphemeralRange) -> bool:
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
    return not overlaps(domain_id, participant_id) and not any(port in ephemeral for port in used)


CLOSE = st.builds(
    lambda domain_id, offset, width: (
        domain_id,
        EphemeralRange(
            first=min(domain_base(domain_id) + offset, 65535),
            last=min(domain_base(domain_id) + offset + width, 65535),
        ),
    ),
    DOMAINS,
    st.integers(-3, 14),
    st.integers(0, 3),
)
ANYWHERE = st.builds(
    lambda domain_id, ends: (domain_id, EphemeralRange(first=min(ends), last=max(ends))),
    DOMAINS,
    st.tuples(st.integers(1, 65535), st.integers(1, 65535)),
)


@given(CLOSE | ANYWHERE)
def test_the_capacity_is_where_the_first_participant_does_not_fit(
    case: tuple[int, EphemeralRange],
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


def test_an_ephemeral_range_begins_at_1() -> None:
    assert EphemeralRange(first=1, last=1).last == 1
    with pytest.raises(ValueError, match="cannot use ephemeral port range 0–1"):
        EphemeralRange(first=0, last=1)


def test_participants_of_the_highest_domain_end_with_the_last_port() -> None:
    out_of_the_way = EphemeralRange(first=1, last=1)
    assert max_participants(232, out_of_the_way) == Capacity(
        participants=63, limit="the highest port, 65535"
    )
    assert isinstance(max_participants(232, out_of_the_way).participants, int)
    assert owner_of(65400) == PortUse(
        domain_id=232, role="discovery_multicast", participant_id=None
    )
    assert owner_of(65535) == PortUse(domain_id=232, role="user_unicast", participant_id=62)


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
    capacity = max_participants(3, EphemeralRange(first=port, last=port))
    assert capacity.participants == 0
    beside = domain_base(3) - 1
    assert max_participants(3, EphemeralRange(first=beside, last=beside)).participants == 120
