"""Whether a system fits on one host, and what its user reads when it does not."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lifecycle.network.ports import (
    LINUX,
    EphemeralRange,
    describe_domains,
    max_participants,
    overflows,
)

PLATFORMS = {"linux": LINUX, "macos": EphemeralRange(first=49152, last=65535)}

HINT = (
    "use another domain, run fewer processes, or give fewer publishers a flow of their own "
    "(safe domains: 0–101, 215–232)"
)


def test_54_participants_fit_domain_101_on_linux_and_55_do_not() -> None:
    assert overflows(101, participants=54) == ()
    (message,) = overflows(101, participants=55)
    assert message == (
        "cannot run 55 participants in domain 101 on one host: "
        f"54 fit before the ephemeral ports 32768–60999; {HINT}"
    )


def test_no_participant_fits_an_unsafe_domain() -> None:
    (message,) = overflows(120, participants=1)
    assert message == (
        "cannot run 1 participant in domain 120 on one host: none fits before the ephemeral ports "
        f"32768–60999: they hold its multicast ports; {HINT}"
    )
    assert overflows(120, participants=1, ephemeral=PLATFORMS["macos"]) == ()


def test_400_unique_ports_are_shared_with_one_per_participant() -> None:
    assert overflows(0, participants=3, unique_subscriptions=397) == ()
    (message,) = overflows(0, participants=3, unique_subscriptions=398)
    assert message == (
        "cannot give 398 subscriptions a port of their own on one host: 397 fit, because Fast DDS "
        "takes them from 7000–7399 in every domain and each of 3 participants takes one; "
        "ask for fewer unique subscriptions"
    )


def test_every_limit_is_reported_at_once() -> None:
    assert len(overflows(232, participants=64, unique_subscriptions=400)) == 2


@pytest.mark.parametrize(
    ("runs", "text"),
    [((), "none"), ((range(3, 4),), "3"), ((range(102), range(215, 233)), "0–101, 215–232")],
)
def test_runs_of_domains_are_read_by_people(runs: tuple[range, ...], text: str) -> None:
    assert describe_domains(runs) == text


@given(domain_id=st.integers(0, 232), platform=st.sampled_from(sorted(PLATFORMS)))
def test_exactly_as_many_fit_as_the_arithmetic_says(domain_id: int, platform: str) -> None:
    ephemeral = PLATFORMS[platform]
    count = max_participants(domain_id, ephemeral).participants
    assert overflows(domain_id, participants=count, ephemeral=ephemeral) == ()
    assert len(overflows(domain_id, participants=count + 1, ephemeral=ephemeral)) == 1


def test_every_unique_port_may_go_to_the_subscription_of_one_that_does_not_say_how_many() -> None:
    assert overflows(0, participants=120) == ()
    (message,) = overflows(0, participants=401, ephemeral=EVERYWHERE)
    assert message.startswith("cannot run 401 participants in domain 0 on one host")


EVERYWHERE = EphemeralRange(first=1, last=1)
"""A host whose ephemeral range is in nobody's way, so that every domain is safe."""


def test_safe_domains_are_not_listed_where_every_domain_is_safe() -> None:
    (message,) = overflows(7, participants=121, ephemeral=EVERYWHERE)
    assert message.endswith("or give fewer publishers a flow of their own")


def test_safe_domains_are_listed_where_only_one_is_not() -> None:
    last_domain_only = EphemeralRange(first=65400, last=65535)
    (message,) = overflows(7, participants=121, ephemeral=last_domain_only)
    assert message.endswith("a flow of their own (safe domains: 0–231)")
