"""Which flows the NFEs of a publisher and a subscription form."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lifecycle.network.nfe import (
    FlowTuple,
    InternetProtocol,
    NetworkFlowEndpoint,
    TransportProtocol,
    flow_tuples,
)
from tests.builders import nfe, shared_memory

IPV4, IPV6 = InternetProtocol.IPV4, InternetProtocol.IPV6
UDP, TCP = TransportProtocol.UDP, TransportProtocol.TCP


def ends(flow: FlowTuple) -> tuple[str, int, str, int]:
    return (
        flow.source_address,
        flow.source_port,
        flow.destination_address,
        flow.destination_port,
    )


def test_two_nfes_make_one_flow_that_carries_the_senders_dscp_and_label() -> None:
    source = [nfe("FD09::1", 17900, dscp=46, flow_label=0x12345)]
    assert flow_tuples(source, [nfe("fd09::2", 17910)]) == (
        FlowTuple(
            transport_protocol=UDP,
            internet_protocol=IPV6,
            source_address="fd09::1",
            source_port=17900,
            destination_address="fd09::2",
            destination_port=17910,
            flow_label=0x12345,
            dscp=46,
        ),
    )


def test_a_flow_is_written_as_its_5_tuple_and_on_ipv6_with_its_label() -> None:
    (flow,) = flow_tuples([nfe("10.0.0.1", 7411)], [nfe("10.0.0.2", 7000)])
    assert (flow.describe(), flow.label) == ("udp 10.0.0.1:7411 → 10.0.0.2:7000", "")
    (flow,) = flow_tuples([nfe("fd09::1", 7411, flow_label=5)], [nfe("fd09::2", 7000)])
    assert flow.describe() == "udp [fd09::1]:7411 → [fd09::2]:7000 flow_label 0x00005"
    (flow,) = flow_tuples([nfe("fd09::1", 7411)], [nfe("fd09::2", 7000)])
    assert flow.describe() == "udp [fd09::1]:7411 → [fd09::2]:7000 flow_label unset"


ANY, LOOPBACK, ONE = nfe("0.0.0.0", 45000), nfe("127.0.0.1", 45000), nfe("10.0.0.1", 45001)


@pytest.mark.parametrize(
    ("source", "destination", "flows"),
    [
        # Fast DDS sends unicast from its wildcard socket, multicast from that of each interface.
        ([ANY, ONE], [nfe("10.0.0.2", 7000)], [(ANY, "10.0.0.2")]),
        (
            [ANY, ONE, nfe("192.168.1.1", 45002)],
            [nfe("239.255.0.1", 7000)],
            [(ONE, "239.255.0.1"), (nfe("192.168.1.1", 45002), "239.255.0.1")],
        ),
        # A sender of one kind serves both destinations.
        (
            [ONE],
            [nfe("10.0.0.2", 7000), nfe("239.255.0.1", 7000)],
            [(ONE, "10.0.0.2"), (ONE, "239.255.0.1")],
        ),
        # Loopback talks to loopback and groups only, to which a wildcard talks, too.
        (
            [LOOPBACK, ONE],
            [nfe("127.0.0.1", 7000), nfe("10.0.0.2", 7000)],
            [(LOOPBACK, "127.0.0.1"), (ONE, "10.0.0.2")],
        ),
        ([ANY], [nfe("127.0.0.1", 7000)], [(ANY, "127.0.0.1")]),
        ([LOOPBACK], [nfe("239.255.0.1", 7000)], [(LOOPBACK, "239.255.0.1")]),
        ([LOOPBACK], [nfe("10.0.0.2", 7000)], []),
        # Protocols do not mix, and shared memory forms no flow.
        ([ONE], [nfe("10.0.0.2", 7000, TCP)], []),
        ([ONE], [nfe("fd09::2", 7000)], []),
        ([], [], []),
    ],
)
def test_a_destination_is_reached_from_the_sockets_that_fast_dds_sends_from(
    source: list[NetworkFlowEndpoint],
    destination: list[NetworkFlowEndpoint],
    flows: list[tuple[NetworkFlowEndpoint, str]],
) -> None:
    found = flow_tuples([shared_memory(), *source], [shared_memory(), *destination])
    assert [ends(flow) for flow in found] == [
        (sender.internet_address, sender.transport_port, address, 7000) for sender, address in flows
    ]


NFES = st.lists(
    st.just(shared_memory())
    | st.builds(
        nfe,
        st.sampled_from(("0.0.0.0", "127.0.0.1", "10.0.0.1", "239.255.0.1", "::", "fd09::1")),
        st.integers(1, 3),
        st.sampled_from((UDP, TCP)),
    ),
    max_size=5,
)


@given(source=NFES, destination=NFES)
def test_every_flow_has_its_ends_among_the_nfes_and_is_listed_once(
    source: list[NetworkFlowEndpoint], destination: list[NetworkFlowEndpoint]
) -> None:
    flows = flow_tuples(source, destination)
    assert len(set(flows)) == len(flows)
    for flow in flows:
        assert (flow.transport_protocol, flow.source_address, flow.source_port) in {
            (each.transport_protocol, each.internet_address, each.transport_port) for each in source
        }
        assert (flow.transport_protocol, flow.destination_address, flow.destination_port) in {
            (each.transport_protocol, each.internet_address, each.transport_port)
            for each in destination
        }
