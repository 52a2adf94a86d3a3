"""ROS names: legal, expanded, remapped."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.names import (
    NameNotLegalError,
    RemapKind,
    RemapRule,
    expand,
    full_name_problem,
    hidden_names,
    name_problem,
    namespace_problem,
    node_name_problem,
    parse_rule,
    resolve,
)

PUBLISHER, SERVER = EndpointKind.PUBLISHER, EndpointKind.SERVICE_SERVER
ACTION = EndpointKind.ACTION_SERVER
A_NAME = "a name, as in 'scan', '~/scan' or '/robot/scan'"


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("camera", ""),
        ("_hidden_2", ""),
        ("a" * 255, ""),
        ("", "a node name must not be empty"),
        ("front camera", "a node name holds letters, digits and '_' only, not ' '"),
        ("a/b", "a node name holds letters, digits and '_' only, not '/'"),
        ("größe", "a node name holds letters, digits and '_' only, not 'ö'"),
        ("2nd", "a node name must not start with a digit"),
        ("a" * 256, "a node name has at most 255 characters, this one 256"),
    ],
)
def test_node_names_are_letters_digits_and_underscores(name: str, problem: str) -> None:
    assert node_name_problem(name) == problem


@pytest.mark.parametrize(
    ("namespace", "problem"),
    [
        ("/", ""),
        ("/robot/arm_1", ""),
        ("/" + "a" * 244, ""),
        ("", "a namespace must not be empty"),
        ("robot", "a namespace must start with '/'"),
        ("/robot/", "a namespace must not end with '/'"),
        ("/robot-1", "a namespace holds letters, digits, '_' and '/' only, not '-'"),
        ("/a//b", "a namespace must not hold two '/' in a row"),
        ("/a/1b", "no part of a namespace may start with a digit"),
        ("/" + "a" * 245, "a namespace has at most 245 characters, this one 246"),
    ],
)
def test_namespaces_are_absolute(namespace: str, problem: str) -> None:
    assert namespace_problem(namespace) == problem


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("/robot/video", ""),
        ("/" + "a" * 246, ""),
        ("video", "a fully qualified name must start with '/'"),
        ("/", "a fully qualified name must not end with '/'"),
        ("/~/a", "a fully qualified name holds letters, digits, '_' and '/' only, not '~'"),
        ("/" + "a" * 247, "a fully qualified name has at most 247 characters, this one 248"),
    ],
)
def test_fully_qualified_names_are_absolute(name: str, problem: str) -> None:
    assert full_name_problem(name) == problem


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("video", ""),
        ("/robot/video", ""),
        ("~", ""),
        ("~/video", ""),
        ("{node}/video", ""),
        ("", "a name must not be empty"),
        ("video/", "a name must not end with '/'"),
        ("a~", "'~' may only be the first character of a name"),
        ("~video", "'~' must be followed by '/', as in '~/video'"),
        ("{node", "braces must be paired and not nested, as in '{node}/status'"),
        ("{{node}}", "braces must be paired and not nested, as in '{node}/status'"),
        (
            "{robot}/video",
            "there is no substitution '{robot}'; rcl knows '{node}', '{ns}', '{namespace}'",
        ),
        ("my video", "a name holds letters, digits, '_' and '/' only, not ' '"),
        ("1video", "no part of a name may start with a digit"),
        ("a/1video", "no part of a name may start with a digit"),
    ],
)
def test_declared_names_may_be_relative_private_or_hold_substitutions(
    name: str, problem: str
) -> None:
    assert name_problem(name) == problem


@pytest.mark.parametrize(
    ("name", "full"),
    [
        ("video", "/robot/video"),
        ("a/b", "/robot/a/b"),
        ("/video", "/video"),
        ("~", "/robot/camera"),
        ("~/video", "/robot/camera/video"),
        ("{node}/video", "/robot/camera/video"),
        ("/all/{node}", "/all/camera"),
        ("{ns}/video", "/robot/video"),
        ("{namespace}/video", "/robot/video"),
        ("~/{node}", "/robot/camera/camera"),
    ],
)
def test_a_name_expands_under_namespace_and_node(name: str, full: str) -> None:
    assert expand(name, "camera", "/robot") == full


@pytest.mark.parametrize(
    ("name", "full"), [("video", "/video"), ("~/video", "/camera/video"), ("~", "/camera")]
)
def test_a_name_expands_under_the_root(name: str, full: str) -> None:
    assert expand(name, "camera", "/") == full


@pytest.mark.parametrize(
    ("name", "node", "namespace", "message"),
    [
        ("a b", "n", "/", "cannot use 'a b' as a name: "),
        ("a", "n-1", "/", "cannot use 'n-1' as a name: "),
        ("a", "n", "ns", "cannot use 'ns' as a name: "),
    ],
)
def test_only_legal_parts_expand(name: str, node: str, namespace: str, message: str) -> None:
    with pytest.raises(NameNotLegalError) as caught:
        expand(name, node, namespace)
    assert str(caught.value).startswith(message)


def resolved(name: str, *remap: tuple[str, str], kind: EndpointKind = PUBLISHER) -> str:
    return resolve(name, node_name="camera", namespace="/robot", remap=remap, kind=kind)


@pytest.mark.parametrize(
    ("name", "rules", "full"),
    [
        ("video", [("video", "image")], "/robot/image"),
        ("video", [("/robot/video", "image")], "/robot/image"),
        ("~/video", [("~/video", "/image")], "/image"),
        ("/robot/camera/video", [("~/video", "~/image")], "/robot/camera/image"),
        ("video/raw", [("video", "image")], "/robot/video/raw"),
        ("a", [("a", "b"), ("a", "c"), ("b", "d")], "/robot/b"),
        ("a", [("lidar:a", "b"), ("camera:a", "c")], "/robot/c"),
        ("a", [("__node", "b"), ("__ns", "/c")], "/robot/a"),
    ],
)
def test_the_first_rule_for_the_whole_name_and_this_node_gives_it_another(
    name: str, rules: list[tuple[str, str]], full: str
) -> None:
    assert resolved(name, *rules) == full


def test_topic_and_service_rules_keep_to_their_kind() -> None:
    rules = (("rostopic://a", "topic"), ("rosservice://a", "service"))
    assert resolved("a", *rules) == "/robot/topic"
    assert resolved("a", *rules, kind=EndpointKind.SUBSCRIPTION) == "/robot/topic"
    assert resolved("a", *rules, kind=SERVER) == "/robot/service"
    assert resolved("a", *rules, kind=EndpointKind.SERVICE_CLIENT) == "/robot/service"


def test_a_rule_for_an_action_name_does_not_rename_the_action() -> None:
    assert resolved("dock", ("dock", "park"), kind=ACTION) == "/robot/dock"


def test_rules_for_all_hidden_names_rename_the_action() -> None:
    rules = [(name, name.replace("dock", "park")) for name, _ in hidden_names("dock")]
    assert resolved("dock", *rules, kind=ACTION) == "/robot/park"


def test_an_action_is_three_services_and_two_topics() -> None:
    assert hidden_names("/dock") == (
        ("/dock/_action/send_goal", EndpointKind.SERVICE_SERVER),
        ("/dock/_action/cancel_goal", EndpointKind.SERVICE_SERVER),
        ("/dock/_action/get_result", EndpointKind.SERVICE_SERVER),
        ("/dock/_action/feedback", EndpointKind.PUBLISHER),
        ("/dock/_action/status", EndpointKind.PUBLISHER),
    )


def test_a_rule_knows_its_node_and_kind() -> None:
    assert parse_rule("camera:rostopic://~/a", "/b") == RemapRule(
        kind=RemapKind.TOPIC, node="camera", match="~/a", replacement="/b"
    )
    assert parse_rule("camera:__ns", "/b") == RemapRule(
        kind=RemapKind.NAMESPACE, node="camera", match="", replacement="/b"
    )
    for word in ("__node", "__name"):
        assert parse_rule(word, "b") == RemapRule(
            kind=RemapKind.NODE_NAME, node="", match="", replacement="b"
        )


@pytest.mark.parametrize(
    ("match", "replacement", "message"),
    [
        (
            "a",
            "",
            f"cannot use '' in a remap rule: it must be {A_NAME}",
        ),
        (
            "__node",
            "a/b",
            "cannot use 'a/b' in a remap rule: it must be a node name, as in '__node:=camera'",
        ),
    ],
)
def test_a_rule_that_rcl_refuses_is_refused(match: str, replacement: str, message: str) -> None:
    with pytest.raises(NameNotLegalError) as caught:
        parse_rule(match, replacement)
    assert str(caught.value) == message


words = st.from_regex(r"[a-z](?:_?[a-z0-9]){0,5}", fullmatch=True)
namespaces = st.one_of(
    st.just("/"), st.lists(words, min_size=1, max_size=3).map(lambda parts: "/" + "/".join(parts))
)
relative = st.lists(words, min_size=1, max_size=3).map("/".join)
rule_names = st.one_of(relative, relative.map("/{}".format), relative.map("~/{}".format))
declared = st.one_of(rule_names, st.just("~"), relative.map("{{node}}/{}".format))
kinds = st.sampled_from(EndpointKind)


@given(declared, words, namespaces)
def test_expansion_is_always_absolute_legal_and_idempotent(
    name: str, node: str, namespace: str
) -> None:
    full = expand(name, node, namespace)
    assert full_name_problem(full) == ""
    assert expand(full, node, namespace) == full


@given(declared, words, namespaces, st.lists(st.tuples(rule_names, rule_names), max_size=4))
def test_a_resolved_topic_is_always_absolute_and_legal(
    name: str, node: str, namespace: str, remap: list[tuple[str, str]]
) -> None:
    full = resolve(name, node_name=node, namespace=namespace, remap=remap)
    assert full_name_problem(full) == ""


@given(declared, words, namespaces, kinds)
def test_resolving_without_rules_is_expanding(
    name: str, node: str, namespace: str, kind: EndpointKind
) -> None:
    full = resolve(name, node_name=node, namespace=namespace, kind=kind)
    assert full == expand(name, node, namespace)
    assert resolve(full, node_name=node, namespace=namespace, kind=kind) == full


@given(declared, rule_names, words, namespaces)
def test_a_rule_for_the_name_itself_always_wins_when_it_is_first(
    name: str, replacement: str, node: str, namespace: str
) -> None:
    rules = [(expand(name, node, namespace), replacement), (name.replace("{node}", node), "/x")]
    full = resolve(name, node_name=node, namespace=namespace, remap=rules[:1])
    assert full == expand(replacement, node, namespace)


@given(st.text(max_size=12), st.text(max_size=12))
def test_any_text_as_a_rule_is_read_or_refused_with_a_reason(match: str, replacement: str) -> None:
    refused = ""
    try:
        rule = parse_rule(match, replacement)
    except NameNotLegalError as error:
        refused = str(error)
    assert refused.startswith("cannot ") or rule.replacement == replacement
