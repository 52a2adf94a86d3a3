"""QoS profiles with rmw's names, the presets of ROS, and offered/requested QoS compatibility.

Owns: the one rule of QoS compatibility that static checks and live verification share. Pure.
"""

from __future__ import annotations

import enum
import types
from collections.abc import Collection, Mapping
from typing import NamedTuple

import msgspec
from msgspec.structs import replace

from lifecycle.codec import Count


class History(enum.Enum):
    """rmw_qos_history_policy_t."""

    SYSTEM_DEFAULT = "SYSTEM_DEFAULT"
    KEEP_LAST = "KEEP_LAST"
    KEEP_ALL = "KEEP_ALL"
    UNKNOWN = "UNKNOWN"


class Reliability(enum.Enum):
    """rmw_qos_reliability_policy_t."""

    SYSTEM_DEFAULT = "SYSTEM_DEFAULT"
    RELIABLE = "RELIABLE"
    BEST_EFFORT = "BEST_EFFORT"
    BEST_AVAILABLE = "BEST_AVAILABLE"
    UNKNOWN = "UNKNOWN"


class Durability(enum.Enum):
    """rmw_qos_durability_policy_t."""

    SYSTEM_DEFAULT = "SYSTEM_DEFAULT"
    TRANSIENT_LOCAL = "TRANSIENT_LOCAL"
    VOLATILE = "VOLATILE"
    BEST_AVAILABLE = "BEST_AVAILABLE"
    UNKNOWN = "UNKNOWN"


class Liveliness(enum.Enum):
    """rmw_qos_liveliness_policy_t."""

    SYSTEM_DEFAULT = "SYSTEM_DEFAULT"
    AUTOMATIC = "AUTOMATIC"
    MANUAL_BY_TOPIC = "MANUAL_BY_TOPIC"
    BEST_AVAILABLE = "BEST_AVAILABLE"
    UNKNOWN = "UNKNOWN"


class QosProfile(msgspec.Struct, frozen=True, kw_only=True):
    """One rmw QoS profile; field names are NoDL v2's.

    A duration of None is rmw's default, which means infinite; a depth is 0 where not observable or
    KEEP_ALL.

    Attributes:
        history: Which messages are kept.
        depth: Messages kept under KEEP_LAST, at least 1.
        reliability: Whether lost messages are sent again.
        durability: Whether late subscriptions get earlier messages.
        deadline_ns: Longest time between two messages, nanoseconds.
        lifespan_ns: Age at which messages expire, nanoseconds.
        liveliness: Who asserts that the publisher is alive.
        liveliness_lease_duration_ns: Time without assertion after which a publisher counts as gone,
            nanoseconds.
    """

    history: History = History.KEEP_LAST
    depth: Count = 10
    reliability: Reliability = Reliability.RELIABLE
    durability: Durability = Durability.VOLATILE
    deadline_ns: Count | None = None
    lifespan_ns: Count | None = None
    liveliness: Liveliness = Liveliness.AUTOMATIC
    liveliness_lease_duration_ns: Count | None = None


UNKNOWN_QOS = QosProfile(
    history=History.UNKNOWN,
    depth=0,
    reliability=Reliability.UNKNOWN,
    durability=Durability.UNKNOWN,
    liveliness=Liveliness.UNKNOWN,
)
"""Nothing is known; compatible with nothing for certain."""

POLICIES = QosProfile.__struct_fields__
"""Every policy, in the order of rmw_qos_profile_t."""


def not_written(written: Collection[str]) -> tuple[str, ...]:
    """Return the policies that a manifest leaves to the default of the endpoint's kind.

    A depth means nothing without KEEP_LAST, and writes it too.
    """
    found = {*written, "history"} if "depth" in written else set(written)
    return tuple(policy for policy in POLICIES if policy not in found)


INFINITE_NS = 2**63 - 1
"""RMW_DURATION_INFINITE in nanoseconds; also the largest duration rmw can hold."""

BEST_AVAILABLE_NS = INFINITE_NS - 1
"""RMW_QOS_DEADLINE_BEST_AVAILABLE and RMW_QOS_LIVELINESS_LEASE_DURATION_BEST_AVAILABLE."""

_SYSTEM_LIVELINESS = QosProfile(liveliness=Liveliness.SYSTEM_DEFAULT)

PRESETS: Mapping[str, QosProfile] = types.MappingProxyType(
    {
        "default": _SYSTEM_LIVELINESS,
        "sensor_data": replace(_SYSTEM_LIVELINESS, depth=5, reliability=Reliability.BEST_EFFORT),
        "parameters": replace(_SYSTEM_LIVELINESS, depth=1000),
        "parameter_events": replace(_SYSTEM_LIVELINESS, depth=1000),
        "services_default": _SYSTEM_LIVELINESS,
        "system_default": QosProfile(
            history=History.SYSTEM_DEFAULT,
            depth=0,
            reliability=Reliability.SYSTEM_DEFAULT,
            durability=Durability.SYSTEM_DEFAULT,
            liveliness=Liveliness.SYSTEM_DEFAULT,
        ),
        "best_available": QosProfile(
            reliability=Reliability.BEST_AVAILABLE,
            durability=Durability.BEST_AVAILABLE,
            deadline_ns=BEST_AVAILABLE_NS,
            liveliness=Liveliness.BEST_AVAILABLE,
            liveliness_lease_duration_ns=BEST_AVAILABLE_NS,
        ),
        "rosout_default": replace(
            _SYSTEM_LIVELINESS,
            depth=1000,
            durability=Durability.TRANSIENT_LOCAL,
            lifespan_ns=10 * 10**9,
        ),
        "clock": replace(_SYSTEM_LIVELINESS, depth=1, reliability=Reliability.BEST_EFFORT),
        "action_status_default": replace(
            _SYSTEM_LIVELINESS, depth=1, durability=Durability.TRANSIENT_LOCAL
        ),
    }
)
"""Profiles by the names ROS gives them.

Values are those of rmw/qos_profiles.h, except `rosout_default` (rcl/logging_rosout.h), `clock`
(rclcpp::ClockQoS) and `action_status_default` (rcl_action/default_qos.h).
"""


class Certainty(enum.Enum):
    """Whether an incompatibility is a fact or only cannot be ruled out."""

    CERTAIN = "certain"
    POSSIBLE = "possible"


class Incompatibility(msgspec.Struct, frozen=True, kw_only=True):
    """One policy by which a publisher and a subscription do not, or may not, match.

    Attributes:
        policy: the profile's field, `reliability`, `liveliness_lease_duration`.
        offered: the publisher's value as rmw spells it, `BEST_EFFORT`; durations as `500000000 ns`.
        requested: the subscription's value, likewise.
        severity: CERTAIN where rmw reports an error, POSSIBLE where the values leave it open.
    """

    policy: str
    offered: str
    requested: str
    severity: Certainty


def incompatibilities(offered: QosProfile, requested: QosProfile) -> tuple[Incompatibility, ...]:
    """Compare what a publisher offers with what a subscription requests, policy by policy.

    A policy whose value is SYSTEM_DEFAULT, UNKNOWN or BEST_AVAILABLE represents every value it
    may turn out to be: if some of them do not match, the result is POSSIBLE, if all, CERTAIN. That
    yields rmw_dds_common's `qos_profile_check_compatible` (its errors are CERTAIN, its warnings
    POSSIBLE), but for BEST_AVAILABLE, which depends on what discovery has shown, so that a
    subscription with it may still fail to match; and an infinite duration equals an unset one.

    Returns:
        Findings in the order reliability, durability, deadline, liveliness, lease. History, depth
        and lifespan never stop a match (DDS 1.4 §2.2.3).
    """
    found = []
    for policy, values in _JUDGED.items():
        if values is None:
            name = f"{policy}_ns"
            found.append(_duration(policy, getattr(offered, name), getattr(requested, name)))
        else:
            offer, request = getattr(offered, policy), getattr(requested, policy)
            found.append(_ordered(policy, offer, request, values))
    return tuple(each for each in found if each is not None)


class _Values(NamedTuple):
    """The two values of a policy, and what a BEST_AVAILABLE publisher offers of it."""

    strong: enum.Enum
    weak: enum.Enum
    best: enum.Enum


_JUDGED: Mapping[str, _Values | None] = {
    "reliability": _Values(Reliability.RELIABLE, Reliability.BEST_EFFORT, Reliability.RELIABLE),
    "durability": _Values(
        Durability.TRANSIENT_LOCAL, Durability.VOLATILE, Durability.TRANSIENT_LOCAL
    ),
    "deadline": None,
    "liveliness": _Values(
        Liveliness.MANUAL_BY_TOPIC, Liveliness.AUTOMATIC, Liveliness.BEST_AVAILABLE
    ),
    "liveliness_lease_duration": None,
}
"""Policies that may stop a match; None for a duration.

rmw_dds_common gives a BEST_AVAILABLE publisher the stronger value whatever it has discovered; only
its liveliness and durations depend on the subscriptions seen when it is made.
"""


def _ordered(
    policy: str, offered: enum.Enum, requested: enum.Enum, values: _Values
) -> Incompatibility | None:
    """Judge a two-valued policy: only a weak offer to a strong request fails."""
    effective = values.best if offered.value == "BEST_AVAILABLE" else offered
    if effective is values.strong or requested is values.weak:
        return None
    certain = effective is values.weak and requested is values.strong
    return Incompatibility(
        policy=policy,
        offered=offered.value,
        requested=requested.value,
        severity=Certainty.CERTAIN if certain else Certainty.POSSIBLE,
    )


def _duration(policy: str, offered: int | None, requested: int | None) -> Incompatibility | None:
    """Judge a duration: the offered one may not be longer than the requested one."""
    offer, request = _finite(offered), _finite(requested)
    if request is None:
        return None
    if BEST_AVAILABLE_NS in (offer, request):
        severity = Certainty.POSSIBLE
    elif offer is not None and offer <= request:
        return None
    else:
        severity = Certainty.CERTAIN
    return Incompatibility(
        policy=policy, offered=_spell(offer), requested=_spell(request), severity=severity
    )


def _finite(duration_ns: int | None) -> int | None:
    """Return None for every spelling of infinite: unset, RMW_DURATION_UNSPECIFIED, INFINITE."""
    return None if duration_ns in (None, 0, INFINITE_NS) else duration_ns


def _spell(duration_ns: int | None) -> str:
    """Spell a duration as messages show it."""
    if duration_ns is None:
        return "infinite"
    return "BEST_AVAILABLE" if duration_ns == BEST_AVAILABLE_NS else f"{duration_ns} ns"
