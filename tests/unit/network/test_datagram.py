"""How large a datagram may be."""

from __future__ import annotations

import pytest

from lifecycle.network.datagram import (
    RTPS_OVERHEAD_BYTES,
    SAFE_DATAGRAM_BYTES,
    datagram_bytes,
    is_fragmented,
    max_unfragmented,
)


@pytest.mark.parametrize(
    ("ipv6", "mtu", "payload"),
    [(False, 1500, 1472), (True, 1500, 1452), (True, 1280, 1232), (False, 9000, 8972)],
)
def test_what_ip_and_udp_leave_of_an_mtu(ipv6: bool, mtu: int, payload: int) -> None:
    assert max_unfragmented(ipv6=ipv6, mtu=mtu) == payload


def test_the_safe_size_fits_ethernet() -> None:
    assert max_unfragmented(ipv6=True) >= SAFE_DATAGRAM_BYTES


@pytest.mark.parametrize(("message", "datagram"), [(4, 108), (5, 112), (1368, 1472)])
def test_a_message_is_padded_and_wrapped_by_rtps(message: int, datagram: int) -> None:
    assert datagram_bytes(message) == datagram
    assert RTPS_OVERHEAD_BYTES == 104


def test_the_largest_message_that_ip_leaves_whole_on_ethernet_has_1368_bytes() -> None:
    assert not is_fragmented(1368, max_unfragmented())
    assert is_fragmented(1369, max_unfragmented())
