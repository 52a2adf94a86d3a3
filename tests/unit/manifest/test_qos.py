"""One rule of QoS compatibility, for static checks and live verification."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from lifecycle.manifest.qos import (
    BEST_AVAILABLE_NS,
    INFINITE_NS,
    PRESETS,
    Certainty,
    Durability,
    History,
    Incompatibility,
    Liveliness,
    QosProfile,
    Reliability,
    incompatibilities,
)

CERTAIN, POSSIBLE = Certainty.CERTAIN, Certainty.POSSIBLE
UNTOLD = ("SYSTEM_DEFAULT", "UNKNOWN")


def only(policy: str, offered: QosProfile, requested: QosProfile) -> Incompatibility | None:
    found = incompatibilities(offered, requested)
    assert all(each.policy == policy for each in found)
    return found[0] if found else None


def severity(policy: str, offered: QosProfile, requested: QosProfile) -> Certainty | None:
    found = only(policy, offered, requested)
    return found.severity if found else None


def rmw_rule(offered: str, requested: str, weak: str, strong: str) -> Certainty | None:
    """qos_profile_check_compatible, one two-valued policy, without BEST_AVAILABLE."""
    if offered == weak and requested == strong:
        return CERTAIN
    if offered in UNTOLD and requested in UNTOLD:
        return POSSIBLE
    if offered in UNTOLD and requested == strong:
        return POSSIBLE
    if offered == weak and requested in UNTOLD:
        return POSSIBLE
    return None


POLICIES = {
    "reliability": (Reliability, "BEST_EFFORT", "RELIABLE"),
    "durability": (Durability, "VOLATILE", "TRANSIENT_LOCAL"),
    "liveliness": (Liveliness, "AUTOMATIC", "MANUAL_BY_TOPIC"),
}
TOLD_PAIRS = [
    (policy, offered, requested)
    for policy, (kind, _, _) in POLICIES.items()
    for offered, requested in itertools.product(kind, repeat=2)
    if "BEST_AVAILABLE" not in (offered.value, requested.value)
]


@pytest.mark.parametrize(("policy", "offered", "requested"), TOLD_PAIRS)
def test_every_pair_of_values_is_judged_as_rmw_dds_common_judges_it(
    policy: str, offered: Reliability, requested: Reliability
) -> None:
    _, weak, strong = POLICIES[policy]
    found = severity(
        policy,
        replace(QosProfile(), **{policy: offered}),
        replace(QosProfile(), **{policy: requested}),
    )
    assert found is rmw_rule(offered.value, requested.value, weak, strong)


@pytest.mark.parametrize("policy", ["reliability", "durability"])
def test_a_best_available_publisher_offers_the_stronger_value_for_certain(policy: str) -> None:
    kind, _, _ = POLICIES[policy]
    offered = replace(QosProfile(), **{policy: kind("BEST_AVAILABLE")})
    for requested in kind:
        assert incompatibilities(offered, replace(QosProfile(), **{policy: requested})) == ()


@pytest.mark.parametrize("policy", POLICIES)
def test_a_best_available_subscription_may_fail_to_match_a_weak_publisher(policy: str) -> None:
    kind, weak, strong = POLICIES[policy]
    requested = replace(QosProfile(), **{policy: kind("BEST_AVAILABLE")})
    weakly = replace(QosProfile(), **{policy: kind(weak)})
    strongly = replace(QosProfile(), **{policy: kind(strong)})
    assert severity(policy, weakly, requested) is POSSIBLE
    assert severity(policy, strongly, requested) is None


DURATIONS = [
    # offered, requested, verdict
    (None, None, None),
    (None, 0, None),
    (0, INFINITE_NS, None),
    (5, None, None),
    (5, 0, None),
    (5, 5, None),
    (4, 5, None),
    (6, 5, CERTAIN),
    (None, 5, CERTAIN),
    (0, 5, CERTAIN),
    (INFINITE_NS, 5, CERTAIN),
    (BEST_AVAILABLE_NS, 5, POSSIBLE),
    (BEST_AVAILABLE_NS, None, None),
    (5, BEST_AVAILABLE_NS, POSSIBLE),
    (None, BEST_AVAILABLE_NS, POSSIBLE),
    (BEST_AVAILABLE_NS, BEST_AVAILABLE_NS, POSSIBLE),
]


@pytest.mark.parametrize(("offered", "requested", "verdict"), DURATIONS)
@pytest.mark.parametrize("policy", ["deadline", "liveliness_lease_duration"])
def test_an_offered_duration_may_not_exceed_the_requested_one(
    policy: str, offered: int | None, requested: int | None, verdict: Certainty | None
) -> None:
    field = f"{policy}_ns"
    found = severity(
        policy,
        replace(QosProfile(), **{field: offered}),
        replace(QosProfile(), **{field: requested}),
    )
    assert found is verdict


def test_a_finding_spells_policy_and_values_as_rmw_does() -> None:
    offered = QosProfile(reliability=Reliability.BEST_EFFORT)
    requested = QosProfile(deadline_ns=500_000_000, durability=Durability.TRANSIENT_LOCAL)
    assert incompatibilities(offered, requested) == (
        Incompatibility(
            policy="reliability", offered="BEST_EFFORT", requested="RELIABLE", severity=CERTAIN
        ),
        Incompatibility(
            policy="durability", offered="VOLATILE", requested="TRANSIENT_LOCAL", severity=CERTAIN
        ),
        Incompatibility(
            policy="deadline", offered="infinite", requested="500000000 ns", severity=CERTAIN
        ),
    )


@pytest.mark.parametrize("history", History)
def test_history_depth_and_lifespan_never_stop_a_match(history: History) -> None:
    assert incompatibilities(QosProfile(history=history, depth=0), QosProfile(lifespan_ns=1)) == ()


profiles = st.builds(
    QosProfile,
    reliability=st.sampled_from(Reliability),
    durability=st.sampled_from(Durability),
    liveliness=st.sampled_from(Liveliness),
    deadline_ns=st.sampled_from([None, 0, 1, 2, BEST_AVAILABLE_NS, INFINITE_NS]),
    liveliness_lease_duration_ns=st.sampled_from([None, 0, 1, 2, BEST_AVAILABLE_NS, INFINITE_NS]),
)


@given(profiles)
def test_a_profile_never_certainly_mismatches_itself(profile: QosProfile) -> None:
    assert all(each.severity is POSSIBLE for each in incompatibilities(profile, profile))


@given(profiles)
def test_the_strongest_offer_always_matches_fixed_durations(requested: QosProfile) -> None:
    strongest = QosProfile(
        reliability=Reliability.RELIABLE,
        durability=Durability.TRANSIENT_LOCAL,
        liveliness=Liveliness.MANUAL_BY_TOPIC,
        deadline_ns=1,
        liveliness_lease_duration_ns=1,
    )
    assert all(
        each.requested == "BEST_AVAILABLE" for each in incompatibilities(strongest, requested)
    )


@given(profiles, profiles)
def test_each_policy_is_judged_on_its_own(offered: QosProfile, requested: QosProfile) -> None:
    whole = {each.policy: each for each in incompatibilities(offered, requested)}
    for policy in ("reliability", "durability", "liveliness"):
        alone = incompatibilities(
            QosProfile(**{policy: getattr(offered, policy)}),
            QosProfile(**{policy: getattr(requested, policy)}),
        )
        assert alone == tuple(filter(None, [whole.get(policy)]))


def test_presets_bear_the_names_of_ros() -> None:
    assert sorted(PRESETS) == [
        "action_status_default",
        "best_available",
        "clock",
        "default",
        "parameter_events",
        "parameters",
        "rosout_default",
        "sensor_data",
        "services_default",
        "system_default",
    ]


def test_presets_cannot_be_changed() -> None:
    with pytest.raises(TypeError):
        PRESETS["default"] = QosProfile()  # type: ignore[index]
