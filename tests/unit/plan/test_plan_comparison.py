"""What differs between two plans, in the manifest's words."""

from __future__ import annotations

from pathlib import Path

import pytest
from msgspec.structs import replace

from lifecycle import codec
from lifecycle.cli.verbs.plan import command as plan_command
from lifecycle.manifest.loading import load
from lifecycle.plan.build import build_plan
from lifecycle.plan.comparison import changes, plan_checksum
from lifecycle.plan.model import Plan
from lifecycle.plan.processes import shown, without_secrets


def differences(old: Plan, new: Plan) -> tuple[str, ...]:
    return tuple(f"{each.path}: was {each.old}, is {each.new}" for each in changes(old, new))


MANIFEST = """
manifest_version: 1
system: robot
arguments:
  rate: {default: "10"}
machines:
  base: {address: 10.77.0.1}
  arm: {address: 10.77.0.2}
discovery: {domain_id: 7}
network: {max_datagram_bytes: 1400}
nodes:
  talker:
    run: {python: "robot:Talker", working_directory: work, environment: {LEVEL: low}}
    machine: base
    parameters: {rate: $(arg rate), names: [a, b]}
    parameter_files: [talker.yaml]
    interface:
      parameters:
        rate: {type: int}
        names: {type: string_array}
        volume: {type: int}
      publishers:
        - name: chatter
          type: std_msgs/msg/String
          qos: {history: KEEP_LAST, depth: 10, reliability: RELIABLE}
    flows:
      publishers:
        chatter: {five_qi: auto, max_delay_ms: 5}
  listener:
    run: {command: [listen, --loud]}
    machine: arm
    after: {talker: configured}
    interface:
      subscriptions:
        - name: chatter
          type: std_msgs/msg/String
          qos: {history: KEEP_LAST, depth: 10, reliability: RELIABLE}
links:
  - {topic: /chatter, from: talker, to: listener, max_delay_ms: 5}
"""
PARAMETERS = "talker: {ros__parameters: {volume: 3}}\n"


def plan_of(folder: Path, text: str = MANIFEST, **environment: str) -> Plan:
    """Write the manifest into a folder and plan it."""
    folder.mkdir(exist_ok=True)
    path = folder / "robot.lifecycle.yaml"
    path.write_text(text)
    if not (folder / "talker.yaml").exists():
        (folder / "talker.yaml").write_text(PARAMETERS)
    return build_plan(load(str(path), {}).manifest, environment=environment)


@pytest.mark.parametrize(
    ("written", "instead", "said"),
    [
        ("system: robot", "system: robots", 'system: was "robot", is "robots"'),
        ("domain_id: 7", "domain_id: 8", "discovery.domain_id: was 7, is 8"),
        ("10.77.0.2", "10.77.0.3", 'machines.arm.address: was "10.77.0.2", is "10.77.0.3"'),
        (
            "robot:Talker",
            "robot:Talkr",
            'nodes.talker.run.python: was "robot:Talker", is "robot:Talkr"',
        ),
        (
            "[listen, --loud]",
            "[listen]",
            'nodes.listener.run.command: was ["listen", "--loud"], is ["listen"]',
        ),
        ("LEVEL: low", "LEVEL: high", 'nodes.talker.run.environment.LEVEL: was "low", is "high"'),
        (
            "working_directory: work",
            "working_directory: .",
            'nodes.talker.run.working_directory: was "work", is "."',
        ),
        ('default: "10"', 'default: "20"', "nodes.talker.parameters.rate: was 10, is 20"),
        (
            ", names: [a, b]",
            "",
            'nodes.talker.parameters.names: was ["a", "b"], is not set',
        ),
        (
            "{talker: configured}",
            "{talker: active}",
            'nodes.listener.after.talker: was "configured", is "active"',
        ),
        (
            "depth: 10",
            "depth: 5",
            "nodes.talker.interface.publishers.chatter.qos.depth: was 10, is 5",
        ),
        (
            "five_qi: auto, max",
            "five_qi: 85, max",
            'nodes.talker.flows.publishers.chatter.five_qi: was "auto", is "85"',
        ),
        (
            "to: listener, max_delay_ms: 5",
            "to: listener, max_delay_ms: 9",
            'links./chatter from talker to listener.max_delay_ms: was "5", is "9"',
        ),
        (
            "five_qi: auto, max",
            "five_qi: auto, max_silence_s: 3, max",
            'nodes.talker.flows.publishers.chatter.max_silence_s: was not set, is "3"',
        ),
        (
            "five_qi: auto, max",
            "five_qi: auto, quantile: 0.5, max",
            'nodes.talker.flows.publishers.chatter.max_delay_ms: was "5", is "5 for 0.5"',
        ),
        (
            "five_qi: auto, max",
            "five_qi: auto, measure: true, max",
            "nodes.talker.flows.publishers.chatter.measure: was false, is true",
        ),
        (
            "to: listener, max_delay_ms: 5",
            "to: listener, rate_hz: {min: 4, max: 6}, max_delay_ms: 5",
            'links./chatter from talker to listener.rate_hz: was not set, is "{min: 4, max: 6}"',
        ),
        ("machine: arm", "machine: base", 'nodes.listener.machine: was "arm", is "base"'),
    ],
)
def test_every_change_is_said_by_its_place_in_the_manifest(
    tmp_path: Path, written: str, instead: str, said: str
):
    assert written in MANIFEST
    old = plan_of(tmp_path / "old")
    new = plan_of(tmp_path / "new", MANIFEST.replace(written, instead, 1))
    found = differences(old, new)
    assert said in found
    assert plan_checksum(old) != plan_checksum(new)
    assert differences(new, old) != found


def test_a_node_that_came_or_went_is_one_line(tmp_path: Path):
    old = plan_of(tmp_path)
    new = replace(old, nodes=old.nodes[:1])
    assert differences(old, new) == ("nodes.listener: was declared, is not declared",)


def test_two_hosts_with_one_manifest_plan_the_same_wherever_they_keep_it(tmp_path: Path):
    here = plan_of(tmp_path / "here", RMW_IMPLEMENTATION="rmw_fastrtps_cpp")
    there = plan_of(tmp_path / "there", "\n\n" + MANIFEST, ROS_DOMAIN_ID="3")
    assert differences(here, there) == ()
    assert plan_checksum(here) == plan_checksum(there)


def test_limits_that_are_written_elsewhere_are_the_same(tmp_path: Path):
    text = MANIFEST.replace("working_directory: work", "resources: {memory_max_mib: 64}")
    here = plan_of(tmp_path / "here", text)
    there = plan_of(tmp_path / "there", "\n\n" + text)
    assert differences(here, there) == ()
    assert plan_checksum(here) == plan_checksum(there)
    less = plan_of(tmp_path / "less", text.replace("64", "32"))
    assert differences(here, less) == ("nodes.talker.run.resources.memory_max_mib: was 64, is 32",)


def test_the_checksum_does_not_depend_on_which_types_are_installed(tmp_path: Path):
    here = plan_of(tmp_path / "here")
    unknown = replace(
        here.nodes[0],
        endpoints=tuple(replace(each, type_hash="", five_qi=1) for each in here.nodes[0].endpoints),
    )
    there = replace(here, nodes=(unknown, *here.nodes[1:]))
    assert plan_checksum(here) == plan_checksum(there)


def test_the_order_of_nodes_does_not_count(tmp_path: Path):
    plan = plan_of(tmp_path)
    turned = replace(plan, nodes=plan.nodes[::-1], machines=plan.machines[::-1])
    assert plan_checksum(plan) == plan_checksum(turned)


def test_what_stands_in_a_parameter_file_counts(tmp_path: Path):
    old = plan_of(tmp_path)
    (tmp_path / "talker.yaml").write_text(PARAMETERS.replace("3", "4"))
    (line,) = differences(old, plan_of(tmp_path))
    assert line.startswith('nodes.talker.parameter_files: was ["talker.yaml ')


def test_a_change_points_at_its_node_in_the_new_manifest(tmp_path: Path):
    old, new = (
        plan_of(tmp_path / "old"),
        plan_of(tmp_path / "new", MANIFEST.replace("max_delay_ms: 5", "max_delay_ms: 6")),
    )
    places = {each.path: each.at and each.at.line for each in changes(old, new)}
    assert places["nodes.talker.flows.publishers.chatter.max_delay_ms"] == 23
    assert {each.node for each in changes(old, new)} == {"talker", ""}


def test_a_plan_that_crossed_the_control_socket_is_the_same(tmp_path: Path):
    plan = plan_of(tmp_path)
    again = codec.from_json(codec.to_json(plan), Plan)
    assert plan_checksum(again) == plan_checksum(plan)


def test_long_differences_are_cut(tmp_path: Path):
    old = plan_of(tmp_path)
    rates = tuple((f"rate_{number:02}", "x" * 1000) for number in range(30))
    new = replace(old, nodes=(replace(old.nodes[0], parameters=rates), *old.nodes[1:]))
    assert max(map(len, differences(old, new))) < 200


def test_secrets_of_the_environment_are_in_nothing_that_is_shown_or_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def made(folder: str, secret: str, level: str) -> Plan:
        said = f"{{LEVEL: {level}, CAMERA_TOKEN: {secret}, AUTHOR: me}}"
        return plan_of(tmp_path / folder, MANIFEST.replace("{LEVEL: low}", said))

    old, new = made("old", "hunter2", "low"), made("new", "hunter3", "high")
    assert dict(old.node("talker").run.environment)["CAMERA_TOKEN"] == "hunter2"
    kept = without_secrets(old)
    redacted = {"LEVEL": "low", "CAMERA_TOKEN": "(redacted)", "AUTHOR": "me"}
    assert kept.node("talker").run.environment == redacted
    assert "hunter" not in repr(kept)
    assert without_secrets(kept) == kept
    # That they differ is said, not how.
    assert differences(old, new) == (
        'nodes.talker.run.environment.CAMERA_TOKEN: was "(redacted)", is "(redacted)"',
        'nodes.talker.run.environment.LEVEL: was "low", is "high"',
    )
    assert plan_checksum(old) == plan_checksum(made("old", "hunter3", "low"))
    assert plan_command.main(
        [str(tmp_path / "old" / "robot.lifecycle.yaml"), "--format", "json"],
        standalone_mode=False,
    ) in (0, None)
    shown = capsys.readouterr().out
    assert "CAMERA_TOKEN" in shown
    assert "hunter" not in shown


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        *(
            (each, "x", "(redacted)")
            for each in (
                *("API_TOKEN", "DB_PASSWORD", "PASSWD", "KEY_PASSPHRASE", "MQTT_PASS", "db_pwd"),
                *("SIGNING_KEY", "apikey", "SESSION_COOKIE", "GH_AUTH", "SSH_KEYS", "PASS"),
            )
        ),
        *(
            (each, "x", "x")
            for each in ("PWD", "OLDPWD", "AUTHOR", "KEYBOARD", "PASSES", "BYPASS", "KEYSTORE_DIR")
        ),
        ("BROKER", "mqtt://me:pa:ss@host:1883/x", "mqtt://me:(redacted)@host:1883/x"),
        ("BROKER", "redis://:pass@host", "redis://:(redacted)@host"),
        ("BROKER", "http://host:80/a@b", "http://host:80/a@b"),
    ],
)
def test_a_secret_is_known_by_its_variable_or_its_place_in_a_url(
    name: str, value: str, said: str
) -> None:
    assert shown(name, value) == said
