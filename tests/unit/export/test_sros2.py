"""`lifecycle export sros2`: the policy's form, and that it allows what is needed and no more."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from click.testing import CliRunner

from lifecycle.cli import cli
from lifecycle.errors import ExitCode, UsageError
from lifecycle.export.sros2 import PLANS_TOPIC, enclaves_of, render_policy
from lifecycle.manifest.loading import load
from lifecycle.manifest.names import supervisor_alive_topic
from lifecycle.middleware.services import supervisor_topics
from lifecycle.plan.build import build_plan
from lifecycle.plan.model import Plan

ROOT = Path(__file__).parents[3]
MANIFESTS = sorted((ROOT / "manifests").glob("*.lifecycle.yaml"))

# Element → its children in order as a regular expression of `name `, or the text of a leaf.
POLICY = {
    "policy": "enclaves ",
    "enclaves": "(enclave )+",
    "enclave": "(profiles )+",
    "profiles": "(profile )+(metadata )?",
    "profile": "(topics |services |actions )*",
    "topics": "(topic )+",
    "services": "(service )+",
    "actions": "(action )+",
    **dict.fromkeys(("topic", "service", "action"), "=" + r"[/~]?\S+"),
}
ATTRIBUTES = {
    "policy": {"version": r"0\.2\.0"},
    "enclave": {"path": "(/[A-Za-z_][A-Za-z0-9_]*)+"},
    "profile": {"ns": "/.*", "node": ".+"},
}
RULES = {
    "topics": ("publish", "subscribe"),
    "services": ("reply", "request"),
    "actions": ("call", "execute"),
}


def complaints(element: ET.Element) -> list[str]:
    """What the schema of sros2 would refuse."""
    found = []
    model = POLICY.get(element.tag)
    children = "".join(f"{each.tag} " for each in element)
    if model is None:
        found.append(f"{element.tag}: not known here")
    elif model.startswith("="):
        if children or not re.fullmatch(model[1:], element.text or ""):
            found.append(f"{element.tag}: {element.text!r}")
    elif not re.fullmatch(model, children) or (element.text or "").strip():
        found.append(f"{element.tag}: {children}")
    wanted = ATTRIBUTES.get(element.tag, {})
    if element.tag in RULES:
        if not {*element.attrib} <= {*RULES[element.tag]}:
            found.append(f"{element.tag}: {element.attrib}")
        found += [f"{element.tag}: {e}" for e in element.attrib.values() if e not in "ALLOW DENY"]
    elif {*element.attrib} != {*wanted}:
        found.append(f"{element.tag}: {element.attrib}")
    found += [
        f"{element.tag}/@{name}: {element.get(name)!r}"
        for name, pattern in wanted.items()
        if not re.fullmatch(pattern, element.get(name, ""))
    ]
    return found + [each for child in element for each in complaints(child)]


def plan_of(path: Path, directory: Path | None = None, text: str = "") -> Plan:
    if directory is not None:
        path = directory / "m.lifecycle.yaml"
        path.write_text(f"manifest_version: 1\nsystem: my-robot\n{text}")
    return build_plan(load(path).manifest)


def policy_of(plan: Plan) -> ET.Element:
    return ET.fromstring(render_policy(enclaves_of(plan)))


@pytest.mark.parametrize("path", MANIFESTS, ids=lambda path: path.name.partition(".")[0])
def test_the_policy_has_the_form_that_its_readers_demand(path: Path) -> None:
    assert complaints(policy_of(plan_of(path))) == []


NODES = """
discovery: {domain_id: 7}
nodes:
  talk:
    run: {command: [talker], environment: {ROS_SECURITY_ENCLAVE_OVERRIDE: /given}}
    namespace: /a
    managed: false
    remap: {chatter: /loud}
    interface:
      publishers: [{name: chatter, type: std_msgs/msg/String}]
      service_clients: [{name: /ask, type: std_srvs/srv/Trigger}]
  dock:
    run: {python: "x:Y", environment: {ROS_SECURITY_ENCLAVE_OVERRIDE: /given}}
    interface:
      subscriptions: [{name: /loud, type: std_msgs/msg/String}]
      service_servers: [{name: /ask, type: std_srvs/srv/Trigger}]
      action_servers: [{name: move, type: test_msgs/action/Fibonacci}]
  drive:
    run: {python: "x:Z"}
    interface:
      action_clients: [{name: /move, type: test_msgs/action/Fibonacci}]
"""


def allowed(policy: ET.Element, enclave: str, verb: str) -> set[str]:
    return {
        each.text or ""
        for each in policy.iterfind(f".//enclave[@path='{enclave}']//*[@{verb}='ALLOW']/*")
    }


def test_what_is_declared_is_allowed(tmp_path: Path) -> None:
    plan = plan_of(Path(), tmp_path, NODES)
    policy = policy_of(plan)

    paths = [(each.path, each.processes) for each in enclaves_of(plan)]
    assert paths == [
        ("/given", ("talk", "dock")),
        ("/my_robot/drive", ("drive",)),
        ("/my_robot/supervisor_local", ()),
    ]
    assert "/loud" in allowed(policy, "/given", "publish")
    assert "/loud" in allowed(policy, "/given", "subscribe")
    assert "/ask" in allowed(policy, "/given", "request")
    assert "/ask" in allowed(policy, "/given", "reply")
    assert allowed(policy, "/given", "execute") == {"/move"}
    assert allowed(policy, "/my_robot/drive", "call") == {"/move"}
    assert allowed(policy, "/my_robot/drive", "execute") == set()
    assert "/loud" not in allowed(policy, "/my_robot/drive", "subscribe")


def test_a_managed_node_has_its_own_services_and_a_plain_one_only_those_of_its_library(
    tmp_path: Path,
) -> None:
    policy = policy_of(plan_of(Path(), tmp_path, NODES))
    served = allowed(policy, "/given", "reply")
    asked = allowed(policy, "/my_robot/supervisor_local", "request")

    assert {"/dock/change_state", "/dock/map_to", "/a/talk/get_parameters"} <= served
    assert "/dock/transition_event" in allowed(policy, "/given", "publish")
    assert "/a/talk/change_state" not in served
    assert {"/dock/change_state", "/a/talk/get_parameters"} <= asked
    assert "/a/talk/change_state" not in asked


def test_names_of_topics_are_those_that_the_middleware_uses(tmp_path: Path) -> None:
    machines = "machines: {here: {address: 127.0.0.1}, there: {address: 10.1.2.3}}\n"
    text = machines + NODES.replace("run: ", "machine: here\n    run: ")
    policy = policy_of(plan_of(Path(), tmp_path, text))
    here = "/my_robot/supervisor_here"
    mine, others = (supervisor_alive_topic("my-robot", each) for each in ("here", "there"))

    assert PLANS_TOPIC == supervisor_topics.PLANS_TOPIC
    assert mine in allowed(policy, here, "publish")
    assert others in allowed(policy, here, "subscribe")


def test_a_process_named_as_a_supervisor_keeps_an_enclave_of_its_own(tmp_path: Path) -> None:
    text = "nodes: {a: {process: supervisor_local, run: {python: 'x:Y'}}}\n"
    assert [each.path for each in enclaves_of(plan_of(Path(), tmp_path, text))] == [
        "/my_robot/supervisor_local",
        "/my_robot/supervisor_local_2",
    ]


def run(*words: str) -> tuple[int, str, str]:
    try:
        result = CliRunner().invoke(cli, ["export", "sros2", *words], standalone_mode=False)
    except UsageError as error:
        return int(error.exit_code), "", str(error)
    if isinstance(result.exception, UsageError):
        return int(result.exception.exit_code), "", str(result.exception)
    assert result.exception is None, result.exception
    return int(result.return_value), result.stdout, result.stderr


def test_the_command_writes_it_and_says_how_to_sign_it(tmp_path: Path) -> None:
    plan_of(
        Path(),
        tmp_path,
        NODES.replace('run: {python: "x:Z"}', 'endpoints: open\n    run: {python: "x:Z"}'),
    )
    code, out, err = run(str(tmp_path / "m.lifecycle.yaml"), "-o", str(tmp_path / "out"))

    assert code == ExitCode.OK
    policy = tmp_path / "out/policy.xml"
    assert policy.is_file()
    assert "/my_robot/drive: drive\n" in out
    assert "/drive may make endpoints that are not declared" in err


def test_what_cannot_be_written_is_one_clear_error(tmp_path: Path) -> None:
    plan_of(Path(), tmp_path, NODES)
    manifest = str(tmp_path / "m.lifecycle.yaml")
    (tmp_path / "file").write_text("")

    code, _, said = run(manifest, "-o", str(tmp_path / "file"))
    assert (code, said) == (
        ExitCode.USAGE,
        f"cannot write '{tmp_path}/file/policy.xml': File exists",
    )


@pytest.mark.parametrize("path", ["/../../etc", "relative", "/a b", "/a/", "/1"])
def test_an_enclave_that_leads_elsewhere_is_refused(path: str, tmp_path: Path) -> None:
    plan_of(Path(), tmp_path, NODES.replace("OVERRIDE: /given", f"OVERRIDE: {path}"))

    code, _, said = run(str(tmp_path / "m.lifecycle.yaml"), "-o", str(tmp_path / "out"))

    assert code == ExitCode.USAGE
    assert said.startswith(f"cannot use enclave {path!r} of process 'talk'; write an absolute name")
    assert not (tmp_path / "out").exists()
