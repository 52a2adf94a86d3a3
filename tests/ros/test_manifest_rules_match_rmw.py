"""The static rules of names and QoS, held against the real rcl and rmw."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import rclpy
from hypothesis import assume, given
from hypothesis import strategies as st
from msgspec.structs import replace
from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.expand_topic_name import expand_topic_name
from rclpy.impl.implementation_singleton import rclpy_implementation as rcl
from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible
from rclpy.validate_full_topic_name import validate_full_topic_name

from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.names import (
    NameNotLegalError,
    expand,
    full_name_problem,
    name_problem,
    namespace_problem,
    node_name_problem,
    parse_rule,
    resolve,
)
from lifecycle.manifest.parameter_files import read_parameter_file
from lifecycle.manifest.parameter_values import type_of
from lifecycle.manifest.qos import (
    INFINITE_NS,
    PRESETS,
    Certainty,
    Durability,
    History,
    Liveliness,
    QosProfile,
    Reliability,
    incompatibilities,
)

pytestmark = pytest.mark.ros

RMW_PRESETS = {
    "default": "qos_profile_default",
    "sensor_data": "qos_profile_sensor_data",
    "parameters": "qos_profile_parameters",
    "parameter_events": "qos_profile_parameter_events",
    "services_default": "qos_profile_services_default",
    "system_default": "qos_profile_system_default",
    "best_available": "qos_profile_best_available",
}


def ours(profile: QoSProfile) -> QosProfile:
    def duration(value: Duration) -> int | None:
        return value.nanoseconds or None

    return QosProfile(
        history=History(profile.history.name),
        depth=profile.depth,
        reliability=Reliability(profile.reliability.name),
        durability=Durability(profile.durability.name),
        deadline_ns=duration(profile.deadline),
        lifespan_ns=duration(profile.lifespan),
        liveliness=Liveliness(profile.liveliness.name),
        liveliness_lease_duration_ns=duration(profile.liveliness_lease_duration),
    )


def theirs(profile: QosProfile) -> QoSProfile:
    policies = {
        name: type(getattr(QoSProfile(depth=1), name))[getattr(profile, name).name]
        for name in ("history", "reliability", "durability", "liveliness")
    }
    durations = {
        name: Duration(nanoseconds=getattr(profile, f"{name}_ns") or 0)
        for name in ("deadline", "lifespan", "liveliness_lease_duration")
    }
    return QoSProfile(depth=profile.depth, **policies, **durations)


@pytest.mark.parametrize("name", sorted(RMW_PRESETS))
def test_a_preset_has_exactly_the_values_of_rmw(name: str) -> None:
    real = rcl.rmw_qos_profile_t.predefined(RMW_PRESETS[name]).to_dict()
    assert PRESETS[name] == ours(QoSProfile(**real))


def test_the_action_status_preset_has_exactly_the_values_of_rcl_action() -> None:
    real = rcl.rclpy_action_get_rmw_qos_profile("rcl_action_qos_profile_status_default")
    assert PRESETS["action_status_default"] == ours(QoSProfile(**real))


def told(kind: type[Reliability]) -> list[Reliability]:
    return [each for each in kind if each.value != "BEST_AVAILABLE"]


POLICIES = {"reliability": Reliability, "durability": Durability, "liveliness": Liveliness}
VALUES = [
    {policy: value}
    for policy, kind in POLICIES.items()
    for value in told(kind)  # type: ignore[arg-type]
] + [
    {field: value}
    for field in ("deadline_ns", "liveliness_lease_duration_ns")
    for value in (None, 1, 10**9, 10**9 + 1)
]


def worst(offered: QosProfile, requested: QosProfile) -> QoSCompatibility:
    found = {each.severity for each in incompatibilities(offered, requested)}
    if Certainty.CERTAIN in found:
        return QoSCompatibility.ERROR
    return QoSCompatibility.WARNING if found else QoSCompatibility.OK


def test_two_profiles_that_differ_in_up_to_two_policies_match_as_rmw_says() -> None:
    wrong = []
    for offer, request in itertools.product(VALUES, VALUES):
        offered = replace(QosProfile(), **offer)  # type: ignore[arg-type]
        requested = replace(QosProfile(), **request)  # type: ignore[arg-type]
        real, reason = qos_check_compatible(theirs(offered), theirs(requested))
        if worst(offered, requested) != real:
            wrong.append((offer, request, reason))
    assert wrong == []


profiles = st.builds(
    QosProfile,
    reliability=st.sampled_from(told(Reliability)),
    durability=st.sampled_from(told(Durability)),  # type: ignore[arg-type]
    liveliness=st.sampled_from(told(Liveliness)),  # type: ignore[arg-type]
    deadline_ns=st.one_of(st.none(), st.integers(1, INFINITE_NS - 2)),
    liveliness_lease_duration_ns=st.one_of(st.none(), st.integers(1, INFINITE_NS - 2)),
)


@given(profiles, profiles)
def test_any_two_profiles_match_as_rmw_says(offered: QosProfile, requested: QosProfile) -> None:
    real, reason = qos_check_compatible(theirs(offered), theirs(requested))
    assert worst(offered, requested) == real, reason


@given(profiles)
def test_best_available_is_never_more_than_doubtful(profile: QosProfile) -> None:
    for pair in ((PRESETS["best_available"], profile), (profile, PRESETS["best_available"])):
        assert all(each.severity is Certainty.POSSIBLE for each in incompatibilities(*pair))


letters = st.text("ab1_/~{}nodes-é ", max_size=12)
VALIDATORS: list[tuple[Callable[[str], str], Callable[[str], object]]] = [
    (node_name_problem, rcl.rclpy_get_validation_error_for_node_name),
    (namespace_problem, rcl.rclpy_get_validation_error_for_namespace),
    (full_name_problem, rcl.rclpy_get_validation_error_for_full_topic_name),
]
LONG = ["a" * 255, "a" * 256, "/" + "a" * 244, "/" + "a" * 245, "/" + "a" * 246, "/" + "a" * 247]


@pytest.mark.parametrize(("check", "real"), VALIDATORS)
def test_a_name_is_legal_exactly_when_rmw_says_so(
    check: Callable[[str], str], real: Callable[[str], object]
) -> None:
    @given(letters)
    def agrees(name: str) -> None:
        assert (check(name) == "") == (real(name) is None)

    agrees()
    for name in LONG:
        assert (check(name) == "") == (real(name) is None)


@given(letters)
def test_a_declared_name_that_rcl_refuses_is_refused(name: str) -> None:
    if rcl.rclpy_get_validation_error_for_topic_name(name) is not None:
        assert name_problem(name) != ""


@given(
    letters,
    st.sampled_from(["n", "node_1", "_x"]),
    st.sampled_from(["/", "/ns", "/a/b"]),
)
def test_a_name_expands_as_rcl_expands_it(name: str, node: str, namespace: str) -> None:
    # rcl's check of '~' skips the last character and so lets '~x' through; rclpy's names do not.
    assume(not (len(name) == 2 and name[0] == "~"))
    try:
        real = expand_topic_name(name, node, namespace)
        validate_full_topic_name(real)
    except (ValueError, InvalidTopicNameException):
        with pytest.raises(NameNotLegalError):
            expand(name, node, namespace)
    else:
        assert expand(name, node, namespace) == real


RULES = (
    ("first", "wins"),
    ("first", "loses"),
    ("wins", "again"),
    ("~/private", "/public"),
    ("/absolute", "relative"),
    ("lidar:named", "other"),
    ("camera:named", "~/mine"),
    ("rostopic://kind", "topic"),
    ("rosservice://kind", "service"),
    ("dock", "park"),
    ("dock/_action/status", "park/_action/status"),
    ("_hidden/a_", "b"),
)
NAMES = (
    "first",
    "wins",
    "~/private",
    "/absolute",
    "/robot/absolute",
    "named",
    "kind",
    "dock",
    "dock/_action/status",
    "_hidden/a_",
    "{node}/private",
    "first/longer",
    "~",
)


@pytest.fixture(scope="module")
def node(domain_id: int) -> Iterator[rclpy.node.Node]:
    context = rclpy.Context()
    rules = [word for rule in RULES for word in ("-r", ":=".join(rule))]
    context.init(args=["--ros-args", *rules], domain_id=domain_id)
    node = rclpy.create_node(
        "camera",
        namespace="/robot",
        context=context,
        enable_rosout=False,
        start_parameter_services=False,
    )
    yield node
    node.destroy_node()
    context.shutdown()


@pytest.mark.parametrize("name", NAMES)
def test_a_name_resolves_as_rcl_resolves_it(node: rclpy.node.Node, name: str) -> None:
    identity = {"node_name": "camera", "namespace": "/robot", "remap": RULES}
    topic = resolve(name, kind=EndpointKind.SUBSCRIPTION, **identity)
    service = resolve(name, kind=EndpointKind.SERVICE_CLIENT, **identity)
    assert (topic, service) == (node.resolve_topic_name(name), node.resolve_service_name(name))


NOT_RULES = ("a*:=b", "a b:=c", "a__b:=c", "a:=1b", "__ns:=robot", "__node:=a/b", "a:=~b", "a:=")


@pytest.mark.parametrize("rule", [":=".join(each) for each in RULES] + list(NOT_RULES))
def test_a_rule_is_legal_exactly_when_rcl_reads_it(rule: str) -> None:
    context = rclpy.Context()
    match, replacement = rule.split(":=")
    try:
        context.init(args=["--ros-args", "-r", rule])
    except rcl.RCLError:
        with pytest.raises(NameNotLegalError):
            parse_rule(match, replacement)
    else:
        context.shutdown()
        parse_rule(match, replacement)


PARAMETER_FILE = """\
/**: {ros__parameters: {any: 1}}
/*: {ros__parameters: {one_deep: 1}}
/robot/*: {ros__parameters: {below_robot: 1}}
/**/camera: {ros__parameters: {camera: 1}}
camera: {ros__parameters: {elsewhere: 1}}
robot: {camera: {ros__parameters: {nested: {inner: 1}}}}
/robot/camera:
  ros__parameters:
%s
"""
SCALARS = (
    *("yes", "Off", "y", "tRue", "1", "+7", "-0x1F", "010", "08", "0", "1.5", ".5", "5.", "1e3"),
    *("-.inf", ".nan", "infinity", "nan", "9223372036854775808", "a", "1_000", "0o17", "12:30"),
    *("'1'", '"yes"', "[1, 0x2]", "[1.0]", "[a, 'b']", "[on, n]"),
)


def test_a_parameter_file_means_what_rclpy_reads_from_it(tmp_path: Path, domain_id: int) -> None:
    path = tmp_path / "p.yaml"
    path.write_text(
        PARAMETER_FILE % "\n".join(f"    s{index}: {each}" for index, each in enumerate(SCALARS))
    )
    context = rclpy.Context()
    context.init(args=["--ros-args", "--params-file", str(path)], domain_id=domain_id)
    node = rclpy.create_node(
        "camera",
        namespace="/robot",
        context=context,
        automatically_declare_parameters_from_overrides=True,
        enable_rosout=False,
        start_parameter_services=False,
    )
    real = {
        name: (each.type_.name, list(each.value) if each.type_.value > 4 else each.value)
        for name, each in node.get_parameters_by_prefix("").items()
    }
    node.destroy_node()
    context.shutdown()
    words = {"int": "INTEGER"}
    file = read_parameter_file(str(path), shown="p.yaml")
    ours = {
        name: (
            "_".join(words.get(word, word.upper()) for word in type_of(value).split("_")),
            list(value) if isinstance(value, tuple) else value,
        )
        for section in file.sections
        if section.matches("/robot/camera")
        for name, value, _ in section.parameters
    }
    assert file.flaws == ()
    assert str(sorted(ours.items())) == str(
        sorted(item for item in real.items() if item[0] in ours)
    )
    assert set(real) - set(ours) <= {"use_sim_time", "start_type_description_service"}
