"""Whose participant a GUID prefix may be."""

from __future__ import annotations

from lifecycle.middleware.discovery.prefixes import is_of_process

OURS = "010f7f013c5d59590000" + "0000"
PREFIX = "010f7f015d3c1b4c00000000"


def test_a_prefix_is_taken_only_for_that_of_the_process_whose_pid_and_host_it_bears() -> None:
    assert is_of_process(PREFIX, 0x3C5D, OURS)
    assert is_of_process(PREFIX, 0x13C5D, OURS)
    assert not is_of_process(PREFIX, 0x3C5E, OURS)
    assert not is_of_process(PREFIX, 0x3C5D, "010f0a04" + OURS[8:])
