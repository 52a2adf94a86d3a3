"""Whether each participant has both ports of a pair, as the kernel lists them."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.discovery.names_port import check_own_pair, pairs_are_whole
from lifecycle.network import participant_ports
from lifecycle.pytest_plugin import claimed_domain
from tests.unit.middleware.other_process import of_another_process

_LAST = 119
"""The last participant of a host."""


@pytest.fixture
def domain() -> Iterator[int]:
    with claimed_domain() as claimed:
        yield claimed


def bound(port: int, family: int = socket.AF_INET) -> socket.socket:
    each = socket.socket(family, socket.SOCK_DGRAM)
    each.bind(("", port))
    return each


@pytest.mark.parametrize("family", [socket.AF_INET, socket.AF_INET6])
@pytest.mark.parametrize("number", [0, 7, _LAST])
def test_one_that_has_only_the_second_port_of_a_pair_is_in_the_way(
    domain: int, number: int, family: int
) -> None:
    ports = participant_ports(domain, number)
    assert pairs_are_whole(domain)
    with of_another_process(bound(ports.user_unicast, family)):
        assert not pairs_are_whole(domain)
        assert pairs_are_whole(domain - 1)
    with bound(ports.user_unicast, family):
        assert not pairs_are_whole(domain)
    assert pairs_are_whole(domain)


def test_one_that_has_both_or_the_first_is_in_nobodys_way(domain: int) -> None:
    ports, other = participant_ports(domain, 3), participant_ports(domain, 5)
    both = bound(ports.discovery_unicast), bound(ports.user_unicast)
    with of_another_process(*both, bound(other.discovery_unicast)):
        assert pairs_are_whole(domain)


def test_a_process_of_which_another_one_has_the_second_port_is_refused(domain: int) -> None:
    ports, other = participant_ports(domain, 3), participant_ports(domain, 5)
    check_own_pair(domain)
    with bound(ports.discovery_unicast), bound(ports.user_unicast):
        check_own_pair(domain)
        with (
            bound(other.discovery_unicast),
            of_another_process(bound(other.user_unicast)),
            pytest.raises(MiddlewareError, match=f"UDP port {other.user_unicast} is another"),
        ):
            check_own_pair(domain)


def test_a_domain_whose_last_ports_do_not_exist_can_be_asked_about() -> None:
    assert pairs_are_whole(232)
    check_own_pair(232)
