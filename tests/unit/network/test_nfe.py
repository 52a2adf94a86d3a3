"""Dissimilar, unique, weakly and strongly unique: *Unique Network Flows*, "Definitions"."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from lifecycle.network.nfe import (
    InternetProtocol,
    LocatedNfe,
    NetworkFlowEndpoint,
    TransportProtocol,
    UniqueRequirement,
    dissimilar,
    is_ip,
    located,
)
from tests.builders import nfe, shared_memory


def at(machine: str, *nfes: NetworkFlowEndpoint) -> tuple[LocatedNfe, ...]:
    found = located(nfes, machine)
    assert found is not None
    return found


BASE = nfe("fd09::1", 7411, dscp=0, flow_label=0)


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
    changed = replace(BASE, **change)  # type: ignore[arg-type]
    base, other, equal = at("", BASE, changed, replace(BASE))
    assert dissimilar(base, other)
    assert not dissimilar(base, equal)


def test_shared_memory_is_no_ip_flow() -> None:
    assert not is_ip(shared_memory())


WILDCARD = at("robot", nfe("0.0.0.0", 45000))[0]


@pytest.mark.parametrize(
    ("machine", "address", "differs"),
    [
        ("robot", "0.0.0.0", False),
        ("operator", "0.0.0.0", True),
        ("robot", "10.0.0.1", False),
        ("operator", "10.0.0.2", True),
    ],
)
def test_a_wildcard_covers_every_address_of_its_own_machine(
    machine: str, address: str, differs: bool
) -> None:
    assert dissimilar(WILDCARD, at(machine, nfe(address, 45000))[0]) is differs


@pytest.mark.parametrize(("address", "differs"), [("10.0.0.2", True), ("10.0.0.1", False)])
def test_the_same_port_on_two_machines_is_dissimilar_only_if_the_addresses_differ(
    address: str, differs: bool
) -> None:
    robot, operator = at("robot", nfe("10.0.0.1", 7411)), at("operator", nfe(address, 7411))
    assert dissimilar(robot[0], operator[0]) is differs


def test_without_a_machine_two_wildcards_may_be_the_same() -> None:
    (unknown,) = at("", nfe("0.0.0.0", 45000))
    assert not dissimilar(unknown, *at("", nfe("0.0.0.0", 45000)))
    assert not dissimilar(WILDCARD, *at("", nfe("10.0.0.1", 45000)))


def test_what_was_read_back_from_the_sockets_replaces_the_dscp_that_the_rmw_reports() -> None:
    found = located([nfe("0.0.0.0", 45000)], "robot", dscp=46)
    assert found is not None
    assert found[0] == LocatedNfe(machine_id="robot", nfe=nfe("0.0.0.0", 45000, dscp=46))
    assert located(None, "robot", dscp=46) is None


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
        nfe,
        st.sampled_from(ADDRESSES),
        st.integers(1, 2),
        dscp=st.integers(0, 1),
        flow_label=st.integers(0, 1),
    ),
)


@given(a=NFES, b=NFES)
def test_dissimilarity_is_symmetric_and_nothing_is_dissimilar_to_itself(
    a: LocatedNfe, b: LocatedNfe
) -> None:
    assert dissimilar(a, b) == dissimilar(b, a)
    assert not dissimilar(a, a)


def test_an_endpoint_is_described_as_its_socket_or_as_shared_memory() -> None:
    assert nfe("10.0.0.1", 7411).describe() == "10.0.0.1:7411"
    assert nfe("fd09::1", 7411).describe() == "[fd09::1]:7411"
    assert shared_memory().describe() == "shm"


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
    assert not is_ip(replace(BASE, **change))  # type: ignore[arg-type]
