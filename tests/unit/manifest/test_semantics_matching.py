"""Checks of types, QoS and who talks to whom."""

from __future__ import annotations

from collections.abc import Callable

import pytest

Findings = Callable[..., list[str]]

PAIR = """
policy: {{{policy}}}
nodes:
  talker:
    run: {{python: "demo:Talker"}}
    interface:
      publishers: [{{name: a, type: std_msgs/msg/String, qos: {offered}}}]
  listener:
    run: {{python: "demo:Listener"}}
    interface:
      subscriptions: [{{name: a, type: std_msgs/msg/String, qos: {requested}}}]
"""


def test_of_a_node_of_others_only_what_is_written_is_presumed(findings: Findings) -> None:
    """What its code asks for is not known here; whether it fits is judged when it runs."""
    command = PAIR.replace('{{python: "demo:Talker"}}', "{{command: [talker]}}")
    unwritten = command.replace(", qos: {offered}", "").format(
        policy="", requested="{deadline_ns: 4}"
    )
    assert findings(unwritten) == []
    written = command.format(policy="", offered="{reliability: BEST_EFFORT}", requested="default")
    (found,) = findings(written)
    assert "reliability is offered BEST_EFFORT and requested RELIABLE" in found


def pair(offered: str, requested: str) -> str:
    return PAIR.format(policy="", offered=offered, requested=requested)


@pytest.mark.parametrize(
    "qos",
    ["default", "sensor_data", "parameters", "services_default", "rosout_default", "clock"],
)
def test_one_preset_at_both_ends_always_matches(findings: Findings, qos: str) -> None:
    assert findings(pair(qos, qos)) == []


def test_an_untold_liveliness_is_no_reason_to_doubt(findings: Findings) -> None:
    assert findings(pair("sensor_data", "{preset: sensor_data, liveliness: AUTOMATIC}")) == []


def test_ends_of_different_types_are_not_compared_further(findings: Findings) -> None:
    text = pair("sensor_data", "default").replace("String, qos: default", "Empty, qos: default")
    assert [each.split()[0] for each in findings(text)] == ["check.type-mismatch"]


LONELY = """
policy: {{{policy}}}
nodes:
  node:
    run: {{python: "demo:Node"}}
    interface:
      {kind}: [{{name: a, type: {type}}}]
"""


@pytest.mark.parametrize(
    ("kind", "type_", "policy", "rule"),
    [
        ("publishers", "std_msgs/msg/Empty", "unheard", "check.unheard"),
        ("subscriptions", "std_msgs/msg/Empty", "unpublished", "check.unpublished"),
        ("service_clients", "std_srvs/srv/Empty", "unpublished", "check.no-server"),
    ],
)
@pytest.mark.parametrize("severity", ["error", "warning", "ignore"])
def test_the_policy_decides_how_bad_a_loose_end_is(
    findings: Findings, kind: str, type_: str, policy: str, rule: str, severity: str
) -> None:
    found = findings(LONELY.format(policy=f"{policy}: {severity}", kind=kind, type=type_))
    expected = [] if severity == "ignore" else [rule]
    assert [each.split()[0] for each in found] == expected
    assert all(("warning:" in each) == (severity == "warning") for each in found)


@pytest.mark.parametrize(
    ("name", "managed", "known"),
    [
        ("/server/change_state", "true", True),
        ("/server/change_state", "false", False),
        ("/server/get_parameters", "false", True),
        ("/server/get_type_description", "false", True),
        ("/server/get_configuration", "true", True),
        ("/nobody/get_parameters", "true", False),
    ],
)
def test_services_that_every_node_has_need_no_declaration(
    findings: Findings, name: str, managed: str, known: bool
) -> None:
    found = findings(f"""
        nodes:
          server: {{run: {{python: "demo:Server"}}, managed: {managed}}}
          client:
            run: {{python: "demo:Client"}}
            interface:
              service_clients: [{{name: {name}, type: std_srvs/srv/Empty}}]
    """)
    assert [each.split()[0] for each in found] == ([] if known else ["check.no-server"])


def test_a_server_that_nobody_calls_is_an_offer(findings: Findings) -> None:
    text = LONELY.format(policy="", kind="service_servers", type="std_srvs/srv/Empty")
    assert findings(text) == []


def test_a_package_that_is_not_installed_is_reported_once(findings: Findings) -> None:
    found = findings("""
        policy: {unheard: ignore}
        nodes:
          node:
            run: {python: "demo:Node"}
            interface:
              publishers:
                - {name: a, type: acme_msgs/msg/A}
                - {name: b, type: acme_msgs/msg/B}
    """)
    assert found == [
        (
            "check.type-not-installed 9:11: warning: nodes.node.interface.publishers[0]: "
            "cannot tell whether 'acme_msgs/msg/A' exists: 'acme_msgs' is not installed here"
        )
    ]
