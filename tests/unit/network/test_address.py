"""Addresses: spelling and scope."""

from __future__ import annotations

import pytest

from lifecycle.network.nfe import canonical, is_multicast, is_wildcard, may_be_same


@pytest.mark.parametrize(
    ("text", "spelling"),
    [
        ("10.0.0.1", "10.0.0.1"),
        ("FD09:0:0::2", "fd09::2"),
        ("robot", "robot"),
        ("", ""),
    ],
)
def test_an_address_has_one_spelling(text: str, spelling: str) -> None:
    assert canonical(text) == spelling


def test_wildcards_and_groups_are_recognised() -> None:
    assert [is_wildcard(each) for each in ("0.0.0.0", "::", "0::0", "10.0.0.1", "")] == [
        True,
        True,
        True,
        False,
        False,
    ]
    assert [is_multicast(each) for each in ("239.255.0.1", "ff02::1", "10.0.0.1", "")] == [
        True,
        True,
        False,
        False,
    ]


@pytest.mark.parametrize(
    ("a", "b", "on_one_machine", "not_known", "on_two_machines"),
    [
        ("10.0.0.1", "10.0.0.1", True, True, True),
        ("10.0.0.1", "10.0.0.2", False, False, False),
        ("0.0.0.0", "0.0.0.0", True, True, False),
        ("0.0.0.0", "10.0.0.1", True, True, False),
        ("127.0.0.1", "127.0.0.1", True, True, False),
        ("127.0.0.1", "0.0.0.0", True, True, False),
        ("169.254.1.1", "169.254.1.1", True, True, False),
        ("239.255.0.1", "239.255.0.1", True, True, True),
        ("239.255.0.1", "0.0.0.0", False, False, False),
        ("::1", "0:0::1", True, True, False),
        ("::", "fd09::2", True, True, False),
        ("fe80::1%eth0", "fe80::1", True, True, False),
        ("fe80::1%eth0", "fe80::1%eth1", False, False, False),
        ("10.0.0.1", "fd09::2", False, False, False),
        ("robot", "robot", True, True, True),
    ],
)
def test_two_addresses_may_be_one_by_scope_and_machine(
    a: str, b: str, *, on_one_machine: bool, not_known: bool, on_two_machines: bool
) -> None:
    for x, y in ((a, b), (b, a)):
        assert may_be_same(x, y, same_machine=True) is on_one_machine
        assert may_be_same(x, y, same_machine=None) is not_known
        assert may_be_same(x, y, same_machine=False) is on_two_machines


def test_text_that_is_no_address_is_never_taken_for_one_that_is() -> None:
    assert not may_be_same("robot", "10.0.0.1", same_machine=True)
    assert not may_be_same("0.0.0.0", "robot", same_machine=True)
