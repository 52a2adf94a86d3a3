"""Checks of names and remap rules."""

from __future__ import annotations

from collections.abc import Callable

import pytest

Findings = Callable[..., list[str]]

NODE = """
policy: {{unheard: ignore}}
nodes:
  camera:
    namespace: /robot
    run: {{python: "demo:Camera"}}
    remap: {{{rules}}}
    interface:
      publishers: [{{name: video, type: std_msgs/msg/String}}]
      service_servers: [{{name: ~/reset, type: std_srvs/srv/Trigger}}]
"""


@pytest.mark.parametrize(
    "rules",
    [
        "video: image",
        "/robot/video: ~/image",
        "~/reset: /reset",
        "rosservice://~/reset: /reset",
        "camera:video: image",
        "rostopic:///robot/video: image",
    ],
)
def test_a_rule_that_applies_is_silent(findings: Findings, rules: str) -> None:
    match, replacement = rules.rsplit(": ", 1)
    assert findings(NODE.format(rules=f'"{match}": {replacement}')) == []


def test_a_rule_for_a_service_matches_no_topic(findings: Findings) -> None:
    assert findings(NODE.format(rules='"rosservice://video": image')) == [
        (
            'check.remap-unused 8:13: warning: nodes.camera.remap["rosservice://video"]: cannot '
            "apply the rule 'rosservice://video': no endpoint of the node is named '/robot/video'"
        )
    ]


def test_a_rule_of_a_node_with_open_endpoints_may_match_what_is_not_declared(
    findings: Findings,
) -> None:
    text = NODE.format(rules="tf: /tf") + "    endpoints: open\n"
    assert findings(text) == []


def test_a_name_that_cannot_be_used_is_reported_once_and_compared_with_nothing(
    findings: Findings,
) -> None:
    assert findings("""
        nodes:
          camera:
            name: 1st
            run: {python: "demo:Camera"}
            remap: {video: image}
            interface:
              publishers: [{name: video, type: std_msgs/msg/String}]
              subscriptions: [{name: ~/in, type: std_msgs/msg/String}]
    """) == [
        (
            "check.name 5:11: nodes.camera.name: cannot use '1st' as the name of a node: "
            "a node name must not start with a digit"
        )
    ]


@pytest.mark.parametrize(
    ("rules", "ends"),
    [
        ("", "publishers: [&a {name: a, type: std_msgs/msg/String}], subscriptions: [*a]"),
        (
            "left: right, right: left",
            "publishers: [{name: left, type: &t std_msgs/msg/Bool}, {name: right, type: *t}]",
        ),
    ],
)
def test_one_topic_may_be_published_and_subscribed_and_two_names_swapped(
    findings: Findings, rules: str, ends: str
) -> None:
    assert not findings(f"""
        policy: {{unheard: ignore}}
        nodes:
          node: {{run: {{python: "demo:Node"}}, remap: {{{rules}}}, interface: {{{ends}}}}}
    """)


def test_remapping_onto_another_nodes_topic_is_how_systems_are_wired(findings: Findings) -> None:
    assert not findings("""
        nodes:
          camera:
            run: {python: "demo:Camera"}
            remap: {video: /images}
            interface:
              publishers: [{name: video, type: std_msgs/msg/String}]
          viewer:
            run: {python: "demo:Viewer"}
            remap: {in: /images}
            interface:
              subscriptions: [{name: in, type: std_msgs/msg/String}]
    """)


def test_an_action_renamed_by_all_its_hidden_names_meets_its_client(findings: Findings) -> None:
    rules = ", ".join(
        f"dock/_action/{each}: park/_action/{each}"
        for each in ("send_goal", "cancel_goal", "get_result", "feedback", "status")
    )
    found = findings(f"""
        nodes:
          dock:
            run: {{python: "demo:Dock"}}
            remap: {{{rules}}}
            interface:
              action_servers: [{{name: dock, type: acme_msgs/action/Dock}}]
          client:
            run: {{python: "demo:Client"}}
            interface:
              action_clients: [{{name: park, type: acme_msgs/action/Dock}}]
    """)
    assert [each.split()[0] for each in found] == ["check.type-not-installed"]
