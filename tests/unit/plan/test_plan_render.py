"""What people see of a plan, and the verb that shows it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from lifecycle.cli.verbs.plan import command
from lifecycle.manifest.model import (
    Authority,
    Condition,
    DataLayer,
    Discovery,
    DiscoveryMode,
    EndpointKind,
    FlowTransport,
    Run,
    RunKind,
)
from lifecycle.manifest.qos import PRESETS, History, Liveliness, QosProfile
from lifecycle.plan.build import build_plan
from lifecycle.plan.render import render_text, spell_qos
from tests.builders import need, node, planned, publisher, subscription, teleop

TELEOP = """\
system robot: 2 nodes, 2 processes, 3 flows; domain 7, discovery range system_default

processes
  camera  robot     python  robot:Node
  viewer  operator  python  robot:Node

order
  1.  camera
  2.  viewer (after camera configured)

nodes
  /robot/camera                             managed, process camera, machine robot, endpoints
                                            declared, held by its state machine until verified
    publisher /robot/video                  sensor_msgs/msg/CompressedImage; BEST_EFFORT VOLATILE
                                            KEEP_LAST(1); unique strictly_required; EF = DSCP 46 =
                                            TOS 184 (0xb8); 5QI 85; at most 5 ms
    publisher /robot/battery                sensor_msgs/msg/BatteryState; RELIABLE VOLATILE
                                            KEEP_LAST(10); CS1 = DSCP 8 = TOS 32 (0x20)
    publisher /robot/status                 std_msgs/msg/String; RELIABLE VOLATILE KEEP_LAST(10)
    service server /robot/camera/calibrate  std_srvs/srv/Trigger; RELIABLE VOLATILE KEEP_LAST(10)
    action server /robot/dock               robot/action/Dock
  /viewer                                   managed, process viewer, machine operator, endpoints
                                            declared, held by its state machine until verified
    subscription /robot/video               sensor_msgs/msg/CompressedImage; BEST_EFFORT VOLATILE
                                            KEEP_LAST(1); unique strictly_required
    subscription /robot/battery             sensor_msgs/msg/BatteryState; RELIABLE VOLATILE
                                            KEEP_LAST(10)
    subscription /robot/status              std_msgs/msg/String; RELIABLE VOLATILE KEEP_LAST(10)
    service client /robot/camera/calibrate  std_srvs/srv/Trigger; RELIABLE VOLATILE KEEP_LAST(10)
    action client /robot/dock               robot/action/Dock

participants
  /robot/_camera_flow_0  unique publisher video marked EF = DSCP 46 = TOS 184 (0xb8): as the RMW
                         chooses
                         carries publishers/video
  /robot/_camera_flow_1  publisher battery marked CS1 = DSCP 8 = TOS 32 (0x20): as the RMW chooses
                         carries publishers/battery

flows
  /robot/video    /robot/camera → /viewer  udpv4 (other host); strongly unique; at most 5 ms
  /robot/battery  /robot/camera → /viewer  udpv4 (other host)
  /robot/status   /robot/camera → /viewer  udpv4 (other host)
"""


def test_a_plan_is_shown_whole():
    assert render_text(build_plan(teleop(), environment={})) == TELEOP


@pytest.mark.parametrize("width", [60, 80, 100, 140])
def test_lines_fit_where_words_allow_it(width: int):
    lines = render_text(build_plan(teleop(), environment={}), width=width).splitlines()
    long = [line for line in lines if len(line) > max(width, 86)]
    assert long == []


def test_a_command_is_shown_as_a_shell_would_take_it():
    plan = planned(
        node(
            "talker",
            publisher("chatter"),
            run=Run(kind=RunKind.COMMAND, command=("talker", "a b")),
            managed=False,
            after=[("other", Condition.STARTED)],
        ),
        node("other", run=Run(kind=RunKind.ATTACH)),
    )
    lines = render_text(plan, width=140).splitlines()
    assert "  talker  command  talker 'a b'" in lines
    assert "  other   attach   started by others" in lines
    assert "not managed, process talker, endpoints declared, not held" in "".join(lines)


def test_an_empty_system_is_one_line():
    assert render_text(planned()) == (
        "system robot: 0 nodes, 0 processes, 0 flows; domain 0, discovery range system_default\n"
    )


@pytest.mark.parametrize(
    ("qos", "words"),
    [
        (PRESETS["sensor_data"], ["BEST_EFFORT VOLATILE KEEP_LAST(5)"]),
        (QosProfile(history=History.KEEP_ALL, depth=0), ["RELIABLE VOLATILE KEEP_ALL"]),
        (
            QosProfile(
                deadline_ns=100_000_000,
                lifespan_ns=1_500_000,
                liveliness=Liveliness.MANUAL_BY_TOPIC,
                liveliness_lease_duration_ns=10**9,
            ),
            [
                "RELIABLE VOLATILE KEEP_LAST(10)",
                "deadline 100 ms",
                "lifespan 1.5 ms",
                "lease 1000 ms",
                "liveliness MANUAL_BY_TOPIC",
            ],
        ),
        (
            PRESETS["best_available"],
            [
                "BEST_AVAILABLE BEST_AVAILABLE KEEP_LAST(10)",
                "deadline BEST_AVAILABLE",
                "lease BEST_AVAILABLE",
                "liveliness BEST_AVAILABLE",
            ],
        ),
    ],
)
def test_a_profile_is_spelled_in_one_line(qos: QosProfile, words: list[str]):
    assert spell_qos(qos) == ", ".join(words)


# --- the verb


MANIFEST = """\
manifest_version: 1
system: pair
discovery: {domain_id: 3}
nodes:
  talker:
    run: {python: "robot:Talker"}
    interface:
      publishers:
        - {name: chatter, type: std_msgs/msg/String, qos: sensor_data}
  listener:
    run: {python: "robot:Listener"}
    interface:
      subscriptions:
        - {name: chatter, type: std_msgs/msg/String, qos: sensor_data}
"""


def plan_verb(tmp_path: Path, *arguments: str):
    path = tmp_path / "pair.lifecycle.yaml"
    path.write_text(MANIFEST)
    return CliRunner().invoke(command, [str(path), *arguments], standalone_mode=False)


def test_the_verb_shows_json(tmp_path: Path):
    document = json.loads(plan_verb(tmp_path, "--format", "json").stdout)
    assert [each["name"] for each in document["nodes"]] == ["talker", "listener"]


@pytest.mark.parametrize(
    ("format_", "start"),
    [("mermaid", "flowchart"), ("svg", "<svg"), ("html", "<!DOCTYPE html>")],
)
def test_the_verb_draws(tmp_path: Path, format_: str, start: str):
    result = plan_verb(tmp_path, "--format", format_)
    assert result.exception is None
    assert start in result.stdout


def test_connections_are_shown_with_their_urls_and_what_they_carry():
    multicast = need(EndpointKind.PUBLISHER, "chatter", transport=FlowTransport.MULTICAST)
    plan = planned(
        node("talker", publisher("chatter"), needs=[multicast]),
        node("listener", subscription("chatter")),
        discovery=Discovery(domain_id=65),
        data_layer=DataLayer(authority=Authority.SUPERVISOR, events=True),
    )
    text = render_text(plan)
    group = "udpm://239.255.1.1:8910?ttl=0&interface=127.0.0.1"
    assert (
        """
data layer
  authority  supervisor, from the manifest; what is lost is made again
"""
        in text
    )
    assert (
        f"""
participants
  /_talker_udpm_chatter    connection udpm_chatter, /chatter by udpm:
                           {group}
                           carries publishers/chatter
  /_listener_udpm_chatter  connection udpm_chatter, /chatter by udpm:
                           {group}
                           carries subscriptions/chatter
"""
        in text
    )
    assert "/chatter  /talker → /listener  udpm (the publisher asks for it)\n" in text


def test_a_discovery_server_is_shown_with_whoever_it_tells_everything():
    plan = planned(
        node("talker", publisher("chatter")),
        node("listener", subscription("chatter")),
        discovery=Discovery(domain_id=65, mode=DiscoveryMode.SERVER),
    )
    assert """
data layer
  discovery         server
  discovery server  TCP 127.0.0.1:7910
  observer          tcpv4://127.0.0.1:7914?server=127.0.0.1:7910 finds everything that the server
                    knows
""" in render_text(plan)
