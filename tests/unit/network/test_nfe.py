"""Dissimilar, unique, weakly and strongly unique: *Unique Network Flows*, "Definitions"."""

from __future__ import annotations

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lifecycle.network.nfe import (
    FlowIdentifier,
    FlowUniqueness,
    InternetProtocol,
    LocatedNfe,
    NetworkFlowEndpoint,
    Nfe,
    TransportProtocol,
    UniqueRequirement,
    dissimilar,
    is_ip,
    is_unique,
    is_unique_endpoint,
    located,
    meets,
    uniqueness,
)

SHARED_MEMORY = NetworkFlowEndpoint(
    transport_protocol=TransportProtocol.UNKNOWN,
    internet_protocol=InternetProtocol.UNKNOWN,
    transport_port=0,
)


def udp(address: str, port: int, *, dscp: int = 0, flow_label: int = 0) -> NetworkFlowEndpoint:
    return NetworkFlowEndpoint(
        transport_protocol=TransportProtocol.UDP,
        internet_protocol=InternetProtocol.IPV6 if ":" in address else InternetProtocol.IPV4,
        transport_port=port,
        internet_address=address,
        dscp=dscp,
        flow_label=flow_label,
    )


def at(machine: str, *nfes: NetworkFlowEndpoint) -> tuple[LocatedNfe, ...]:
    found = located(nfes, machine)
    assert found is not None
    return found


BASE = udp("fd09::1", 7411, dscp=0, flow_label=0)


@pytest.mark.parametrize(
    "change",
    [
        {"transport_protocol": TransportProtocol.TCP},
        {"transport_port": 7413},
        {"internet_protocol": InternetProtocol.IPV4},
        {"internet_address": "fd09::2"},
        {"dscp": 46},
        {"flow_label": 0x12345},
    ],
    ids=lambda change: next(iter(change)),
)
def test_a_difference_in_one_resource_makes_two_nfes_dissimilar(change: dict[str, object]) -> None:
    changed = dataclasses.replace(BASE, **change)  # type: ignore[arg-type]
    assert dissimilar(BASE, changed)
    assert not dissimilar(BASE, dataclasses.replace(BASE))


def test_an_nfe_is_unique_if_it_is_dissimilar_to_all_others() -> None:
    nfe = udp("10.0.0.1", 7000)
    assert is_unique(nfe, [udp("10.0.0.1", 7001), udp("10.0.0.2", 7000)])
    assert not is_unique(nfe, [udp("10.0.0.1", 7001), udp("10.0.0.1", 7000)])
    assert is_unique(nfe, [])


def test_the_articles_example_of_ordinary_ros_2_has_no_unique_flow() -> None:
    # N1 on D1 publishes video and battery, N2 on D2 subscribes to both; RMWs give ports to nodes.
    p1 = p2 = [udp("10.0.0.1", 7411)]
    s1 = s2 = [udp("10.0.0.2", 7411)]
    assert uniqueness(p1, s1, [p2], [s2]) is FlowUniqueness.NOT


def test_one_unique_nfe_makes_the_articles_video_flow_weakly_unique() -> None:
    p1 = p2 = [udp("10.0.0.1", 7411)]
    s1, s2 = [udp("10.0.0.2", 7000)], [udp("10.0.0.2", 7411)]
    assert uniqueness(p1, s1, [p2], [s2]) is FlowUniqueness.WEAKLY
    # and so does one on the publisher's side
    q1 = [udp("10.0.0.1", 45000)]
    assert uniqueness(q1, s2, [p2], [s2]) is FlowUniqueness.WEAKLY


def test_two_unique_nfes_make_the_articles_video_flow_strongly_unique() -> None:
    p1, p2 = [udp("10.0.0.1", 45000)], [udp("10.0.0.1", 7411)]
    s1, s2 = [udp("10.0.0.2", 7000)], [udp("10.0.0.2", 7411)]
    assert uniqueness(p1, s1, [p2], [s2]) is FlowUniqueness.STRONGLY


def test_the_getter_example_compares_all_pairs_so_one_shared_nfe_is_enough() -> None:
    shared_group = udp("239.255.0.1", 7401)
    x = [udp("10.0.0.2", 7000), shared_group]
    y = [udp("10.0.0.2", 7411), shared_group]
    assert is_unique_endpoint(x, [y]) is False
    assert is_unique_endpoint(x[:1], [y]) is True


def test_every_interface_of_an_endpoint_counts() -> None:
    x = [udp("10.0.0.2", 7000), udp("192.168.1.2", 7000)]
    y = [udp("10.0.0.2", 7001), udp("192.168.1.2", 7000)]
    assert is_unique_endpoint(x, [y]) is False


def test_shared_memory_is_no_ip_flow_and_never_makes_two_endpoints_similar() -> None:
    assert not is_ip(SHARED_MEMORY)
    assert not is_ip(at("robot", SHARED_MEMORY)[0])
    x, y = [SHARED_MEMORY, udp("10.0.0.2", 7000)], [SHARED_MEMORY, udp("10.0.0.2", 7001)]
    assert is_unique_endpoint(x, [y]) is True


@pytest.mark.parametrize("nfes", [[], [SHARED_MEMORY]])
def test_an_endpoint_without_an_ip_nfe_is_not_unique(nfes: list[Nfe]) -> None:
    assert is_unique_endpoint(nfes, []) is False


def test_an_endpoint_is_not_compared_with_itself() -> None:
    # 0.0.0.0:p covers the other two: that is one socket family of one participant.
    x = at("robot", udp("0.0.0.0", 45000), udp("127.0.0.1", 45000), udp("10.0.0.1", 45000))
    assert is_unique_endpoint(x, []) is True


def test_publishers_of_one_participant_send_from_the_same_wildcard_sockets() -> None:
    sender = at("robot", udp("0.0.0.0", 45000), udp("10.0.0.1", 45001))
    assert is_unique_endpoint(sender, [sender]) is False


def test_wildcard_senders_of_two_machines_are_dissimilar_as_their_addresses_differ() -> None:
    robot, operator = at("robot", udp("0.0.0.0", 45000)), at("operator", udp("0.0.0.0", 45000))
    assert is_unique_endpoint(robot, [operator]) is True
    assert is_unique_endpoint(robot, [at("robot", udp("0.0.0.0", 45000))]) is False


def test_a_wildcard_covers_every_address_of_its_own_machine() -> None:
    wildcard = at("robot", udp("0.0.0.0", 45000))
    assert is_unique_endpoint(wildcard, [at("robot", udp("10.0.0.1", 45000))]) is False
    assert is_unique_endpoint(wildcard, [at("operator", udp("10.0.0.2", 45000))]) is True


def test_the_same_port_on_two_machines_is_dissimilar_only_if_the_addresses_differ() -> None:
    robot = at("robot", udp("10.0.0.1", 7411))
    assert is_unique_endpoint(robot, [at("operator", udp("10.0.0.2", 7411))]) is True
    assert is_unique_endpoint(robot, [at("operator", udp("10.0.0.1", 7411))]) is False


def test_without_a_machine_two_wildcards_may_be_the_same() -> None:
    assert not dissimilar(udp("0.0.0.0", 45000), udp("0.0.0.0", 45000))
    assert not dissimilar(at("robot", udp("0.0.0.0", 45000))[0], udp("10.0.0.1", 45000))


def test_what_was_read_back_from_the_sockets_replaces_the_dscp_that_the_rmw_reports() -> None:
    found = located([udp("0.0.0.0", 45000)], "robot", dscp=46)
    assert found is not None
    assert found[0] == LocatedNfe(machine_id="robot", nfe=udp("0.0.0.0", 45000, dscp=46))
    assert located(None, "robot", dscp=46) is None


@pytest.mark.parametrize(
    ("a", "b", "told_apart_by"),
    [
        (udp("10.0.0.1", 1), udp("10.0.0.1", 2), {"5-tuple", "6-tuple", "any"}),
        (udp("10.0.0.1", 1), udp("10.0.0.1", 1, dscp=46), {"6-tuple", "any"}),
        (udp("fd09::1", 1), udp("fd09::1", 1, flow_label=5), {"3-tuple", "any"}),
        (udp("fd09::1", 1), udp("fd09::1", 2), {"5-tuple", "6-tuple", "any"}),
        (udp("fd09::1", 1), udp("fd09::2", 1), {"3-tuple", "5-tuple", "6-tuple", "any"}),
        (udp("10.0.0.1", 1), udp("10.0.0.2", 1), {"3-tuple", "5-tuple", "6-tuple", "any"}),
        (udp("10.0.0.1", 1), udp("10.0.0.1", 1, flow_label=5), {"any"}),
    ],
)
def test_each_flow_identifier_sees_its_own_resources(
    a: NetworkFlowEndpoint, b: NetworkFlowEndpoint, told_apart_by: set[str]
) -> None:
    assert {each.value for each in FlowIdentifier if dissimilar(a, b, by=each)} == told_apart_by


def test_dscp_as_identifier_makes_a_flow_unique_by_the_6_tuple_but_not_by_the_5_tuple() -> None:
    p1, p2 = [udp("10.0.0.1", 7411, dscp=1)], [udp("10.0.0.1", 7411, dscp=2)]
    s1 = s2 = [udp("10.0.0.2", 7411)]
    assert uniqueness(p1, s1, [p2], [s2]) is FlowUniqueness.WEAKLY
    assert uniqueness(p1, s1, [p2], [s2], by=FlowIdentifier.SIX_TUPLE) is FlowUniqueness.WEAKLY
    assert uniqueness(p1, s1, [p2], [s2], by=FlowIdentifier.FIVE_TUPLE) is FlowUniqueness.NOT


def test_a_flow_is_unverifiable_while_an_end_or_another_endpoint_is_not_known() -> None:
    p, s = [udp("10.0.0.1", 45000)], [udp("10.0.0.2", 7000)]
    assert uniqueness(None, s, [], []) is None
    assert uniqueness(p, None, [], []) is None
    assert uniqueness(p, s, [None], []) is None
    assert uniqueness(p, s, [], [None]) is None
    assert uniqueness(p, s, [], []) is FlowUniqueness.STRONGLY


def test_a_known_equal_nfe_settles_it_although_another_endpoint_is_not_known() -> None:
    p = [udp("10.0.0.1", 45000)]
    assert is_unique_endpoint(p, [None, p]) is False
    assert uniqueness(p, p, [None, p], [None, p]) is FlowUniqueness.NOT


@pytest.mark.parametrize(
    ("publisher", "subscription", "weakly", "strongly"),
    [
        (True, True, True, True),
        (True, False, True, False),
        (False, False, False, False),
        (True, None, True, None),
        (False, None, None, False),
        (None, None, None, None),
    ],
)
def test_a_demand_is_met_not_met_or_cannot_be_told(
    *, publisher: bool | None, subscription: bool | None, weakly: bool | None, strongly: bool | None
) -> None:
    for a, b in ((publisher, subscription), (subscription, publisher)):
        assert meets(FlowUniqueness.NOT, publisher=a, subscription=b) is True
        assert meets(FlowUniqueness.WEAKLY, publisher=a, subscription=b) is weakly
        assert meets(FlowUniqueness.STRONGLY, publisher=a, subscription=b) is strongly


def test_the_requirement_has_the_articles_four_values_in_its_order() -> None:
    assert [(each.name, each.rmw_value) for each in UniqueRequirement] == [
        ("NOT_REQUIRED", 0),
        ("STRICTLY_REQUIRED", 1),
        ("OPTIONALLY_REQUIRED", 2),
        ("SYSTEM_DEFAULT", 3),
    ]


ADDRESSES = ("0.0.0.0", "127.0.0.1", "10.0.0.1", "10.0.0.2", "239.255.0.1", "::", "fe80::1")
NFES = st.builds(
    LocatedNfe,
    machine_id=st.sampled_from(("", "robot", "operator")),
    nfe=st.builds(
        udp,
        st.sampled_from(ADDRESSES),
        st.integers(1, 2),
        dscp=st.integers(0, 1),
        flow_label=st.integers(0, 1),
    ),
)


@given(a=NFES, b=NFES, by=st.sampled_from(FlowIdentifier))
def test_dissimilarity_is_symmetric_and_nothing_is_dissimilar_to_itself(
    a: LocatedNfe, b: LocatedNfe, by: FlowIdentifier
) -> None:
    assert dissimilar(a, b, by=by) == dissimilar(b, a, by=by)
    assert not dissimilar(a, a, by=by)


@given(a=NFES, b=NFES)
def test_what_a_narrower_identifier_tells_apart_any_difference_does_too(
    a: LocatedNfe, b: LocatedNfe
) -> None:
    for by in FlowIdentifier:
        assert dissimilar(a, b) or not dissimilar(a, b, by=by)


@given(own=st.lists(NFES, max_size=3), others=st.lists(st.none() | st.lists(NFES, max_size=3)))
def test_one_more_unknown_endpoint_never_makes_a_verdict_better(
    own: list[LocatedNfe], others: list[list[LocatedNfe] | None]
) -> None:
    before = is_unique_endpoint(own, others)
    after = is_unique_endpoint(own, [*others, None])
    assert after is (None if before else before)


def test_an_endpoint_is_described_as_its_socket_or_as_shared_memory() -> None:
    assert udp("10.0.0.1", 7411).describe() == "10.0.0.1:7411"
    assert udp("fd09::1", 7411).describe() == "[fd09::1]:7411"
    assert SHARED_MEMORY.describe() == "shm"


@pytest.mark.parametrize(
    "change",
    [
        {"transport_protocol": TransportProtocol.UNKNOWN},
        {"internet_protocol": InternetProtocol.UNKNOWN},
        {"internet_address": ""},
    ],
)
def test_an_nfe_that_lacks_protocol_or_address_is_no_ip_nfe(change: dict[str, object]) -> None:
    assert is_ip(BASE)
    assert not is_ip(dataclasses.replace(BASE, **change))  # type: ignore[arg-type]


def test_both_ends_of_a_flow_are_compared_by_the_resources_asked_for() -> None:
    marked, plain = [udp("10.0.0.1", 7411, dscp=46)], [udp("10.0.0.1", 7411)]
    by = FlowIdentifier.SIX_TUPLE
    assert uniqueness(marked, marked, [plain], [plain], by=by) is FlowUniqueness.STRONGLY
    by = FlowIdentifier.FIVE_TUPLE
    assert uniqueness(marked, marked, [plain], [plain], by=by) is FlowUniqueness.NOT
    assert uniqueness(marked, marked, [], [plain], by=by) is FlowUniqueness.WEAKLY
    assert uniqueness(marked, marked, [plain], [], by=by) is FlowUniqueness.WEAKLY
