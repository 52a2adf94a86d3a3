"""Which flows the NFEs of a publisher and a subscription form."""

from __future__ import annotations

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


def test_fast_dds_sends_unicast_from_its_wildcard_socket() -> None:
    source = [shared_memory(), nfe("0.0.0.0", 45000), nfe("10.0.0.1", 45001)]
    (flow,) = flow_tuples(source, [shared_memory(), nfe("10.0.0.2", 7000)])
    assert ends(flow) == ("0.0.0.0", 45000, "10.0.0.2", 7000)


def test_fast_dds_sends_multicast_from_the_socket_of_each_interface() -> None:
    source = [nfe("0.0.0.0", 45000), nfe("10.0.0.1", 45001), nfe("192.168.1.1", 45002)]
    flows = flow_tuples(source, [nfe("239.255.0.1", 7401)])
    assert [ends(flow)[:2] for flow in flows] == [("10.0.0.1", 45001), ("192.168.1.1", 45002)]


def test_a_sender_of_one_kind_serves_both_destinations() -> None:
    source = [nfe("10.0.0.1", 45001)]
    flows = flow_tuples(source, [nfe("10.0.0.2", 7000), nfe("239.255.0.1", 7401)])
    assert [flow.destination_address for flow in flows] == ["10.0.0.2", "239.255.0.1"]


def test_loopback_talks_to_loopback_only() -> None:
    source = [nfe("127.0.0.1", 45000), nfe("10.0.0.1", 45001)]
    flows = flow_tuples(source, [nfe("127.0.0.1", 7000), nfe("10.0.0.2", 7000)])
    assert [ends(flow) for flow in flows] == [
        ("127.0.0.1", 45000, "127.0.0.1", 7000),
        ("10.0.0.1", 45001, "10.0.0.2", 7000),
    ]


def test_protocols_do_not_mix_and_shared_memory_forms_no_flow() -> None:
    assert flow_tuples([nfe("10.0.0.1", 1)], [nfe("10.0.0.2", 2, TCP)]) == ()
    assert flow_tuples([nfe("10.0.0.1", 1)], [nfe("fd09::2", 2)]) == ()
    assert flow_tuples([shared_memory()], [shared_memory()]) == ()


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


def test_a_wildcard_sender_reaches_loopback_and_a_loopback_sender_a_group() -> None:
    for source, destination in (("0.0.0.0", "127.0.0.1"), ("127.0.0.1", "239.255.0.1")):
        (flow,) = flow_tuples([nfe(source, 7411)], [nfe(destination, 7401)])
        assert ends(flow) == (source, 7411, destination, 7401)
    assert flow_tuples([nfe("127.0.0.1", 7411)], [nfe("10.0.0.2", 7401)]) == ()
