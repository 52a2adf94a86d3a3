"""Whether so many participants and unique subscriptions fit on one host. Owns the judgement. Pure.

`ports` knows the arithmetic; this module says what to tell a person whose system overflows.
"""

from __future__ import annotations

from lifecycle.network.ports import (
    MAX_DOMAIN_ID,
    EphemeralRange,
    Platform,
    max_participants,
    max_unique_subscriptions,
    safe_domains,
    unique_flow_ports,
)


def overflows(
    domain_id: int,
    *,
    participants: int,
    unique_subscriptions: int = 0,
    ephemeral: Platform | EphemeralRange = Platform.LINUX,
    host: str = "one host",
) -> tuple[str, ...]:
    """Return why so much does not fit on one host, one sentence per limit; empty if it fits.

    Args:
        domain_id: 0–232.
        participants: of this domain on the host; each process has one and each unique publisher
            one more.
        unique_subscriptions: asked for on the host.
        ephemeral: the host's ephemeral range, or a platform for its default.
        host: what to call it, "machine 'robot'".

    Raises:
        ValueError: the domain is not 0–232, or a number is negative.
    """
    if participants < 0 or unique_subscriptions < 0:
        fewest = min(participants, unique_subscriptions)
        raise ValueError(f"cannot count {fewest} participants or subscriptions; use 0 or more")
    found: list[str] = []
    capacity = max_participants(domain_id, ephemeral)
    if participants > capacity.participants:
        fit = f"{capacity.participants} fit" if capacity.participants else "none fits"
        safe = safe_domains(ephemeral)
        every = sum(len(run) for run in safe) > MAX_DOMAIN_ID
        found.append(
            f"cannot run {count(participants, 'participant')} in domain {domain_id} on {host}: "
            f"{fit} before {capacity.limit}; use another domain, run fewer processes, "
            f"or give fewer publishers a flow of their own"
            + ("" if every else f" (safe domains: {describe_domains(safe)})")
        )
    places = max_unique_subscriptions(participants)
    if unique_subscriptions > places:
        ports = unique_flow_ports()
        found.append(
            f"cannot give {count(unique_subscriptions, 'subscription')} a port of their own on "
            f"{host}: {places} fit, because Fast DDS takes them from {ports[0]}–{ports[-1]} in "
            f"every domain and each of {count(participants, 'participant')} takes one; "
            f"ask for fewer unique subscriptions"
        )
    return tuple(found)


def describe_domains(runs: tuple[range, ...]) -> str:
    """Return runs of domain ids for people: `0–101, 215–232`; `none` if there is none."""
    words = (str(run[0]) if len(run) == 1 else f"{run[0]}–{run[-1]}" for run in runs)
    return ", ".join(words) or "none"


def count(number: int, noun: str) -> str:
    """Return a number and its noun: `1 participant`, `2 participants`."""
    return f"{number} {noun}" + ("" if number == 1 else "s")
