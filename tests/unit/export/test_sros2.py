"""`lifecycle export sros2`: the documents' form, and that they allow what is needed and no more."""

from __future__ import annotations

import datetime as dt
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path

import pytest
from click.testing import CliRunner

from lifecycle.cli import cli
from lifecycle.errors import ExitCode, UsageError
from lifecycle.export.sros2 import OVERRIDE, PLANS_TOPIC, Enclave, documents, enclaves_of
from lifecycle.manifest import load, supervisor_alive_topic
from lifecycle.middleware.discovery import liveliness
from lifecycle.middleware.discovery.liveliness import node_topic
from lifecycle.plan import Plan, build_plan

ROOT = Path(__file__).parents[3]
TODAY = dt.datetime(2026, 1, 2, tzinfo=dt.timezone.utc)
MANIFESTS = sorted((ROOT / "manifests").glob("*.lifecycle.yaml"))

_ANY, _NUMBER, _BOOLEAN = ".+", r"\d+", "true|false"
_BASIC = "NONE|SIGN|ENCRYPT"
_KIND = f"{_BASIC}|(SIGN|ENCRYPT)_WITH_ORIGIN_AUTHENTICATION"
_TIME = r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d"

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
_DOMAINS = {"domains": "(id |id_range )+", "id": "=" + _NUMBER}
PERMISSIONS = {
    **_DOMAINS,
    "dds": "permissions ",
    "permissions": "(grant )+",
    "grant": "subject_name validity (allow_rule |deny_rule )+default ",
    "subject_name": "=CN=.+",
    "validity": "not_before not_after ",
    "not_before": "=" + _TIME,
    "not_after": "=" + _TIME,
    "allow_rule": "domains (publish )*(subscribe )*(relay )*",
    "publish": "topics (partitions )?(data_tags )?",
    "subscribe": "topics (partitions )?(data_tags )?",
    "topics": "(topic )+",
    "topic": "=" + _ANY,
    "default": "=ALLOW|DENY",
}
GOVERNANCE = {
    **_DOMAINS,
    "dds": "domain_access_rules ",
    "domain_access_rules": "(domain_rule )+",
    "domain_rule": (
        "domains allow_unauthenticated_participants enable_join_access_control "
        "discovery_protection_kind liveliness_protection_kind rtps_protection_kind "
        "topic_access_rules "
    ),
    "allow_unauthenticated_participants": "=" + _BOOLEAN,
    "enable_join_access_control": "=" + _BOOLEAN,
    "discovery_protection_kind": "=" + _KIND,
    "liveliness_protection_kind": "=" + _KIND,
    "rtps_protection_kind": "=" + _KIND,
    "topic_access_rules": "(topic_rule )+",
    "topic_rule": (
        "topic_expression enable_discovery_protection enable_liveliness_protection "
        "enable_read_access_control enable_write_access_control metadata_protection_kind "
        "data_protection_kind "
    ),
    "topic_expression": "=" + _ANY,
    "enable_discovery_protection": "=" + _BOOLEAN,
    "enable_liveliness_protection": "=" + _BOOLEAN,
    "enable_read_access_control": "=" + _BOOLEAN,
    "enable_write_access_control": "=" + _BOOLEAN,
    "metadata_protection_kind": "=" + _KIND,
    "data_protection_kind": "=" + _BASIC,
}
ATTRIBUTES = {
    "policy": {"version": r"0\.2\.0"},
    "enclave": {"path": "(/[A-Za-z_][A-Za-z0-9_]*)+"},
    "profile": {"ns": "/.*", "node": _ANY},
    "grant": {"name": _ANY},
}
RULES = {
    "topics": ("publish", "subscribe"),
    "services": ("reply", "request"),
    "actions": ("call", "execute"),
}


def complaints(element: ET.Element, form: Mapping[str, str]) -> list[str]:
    """What the schema of sros2, or of DDS Security, would refuse."""
    found = []
    model = form.get(element.tag)
    children = "".join(f"{each.tag} " for each in element)
    if model is None:
        found.append(f"{element.tag}: not known here")
    elif model.startswith("="):
        if children or not re.fullmatch(model[1:], element.text or ""):
            found.append(f"{element.tag}: {element.text!r}")
    elif not re.fullmatch(model, children) or (element.text or "").strip():
        found.append(f"{element.tag}: {children}")
    wanted = {} if element.tag == "grant" and form is POLICY else ATTRIBUTES.get(element.tag, {})
    if form is POLICY and element.tag in RULES:
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
    return found + [each for child in element for each in complaints(child, form)]


def plan_of(path: Path, directory: Path | None = None, text: str = "") -> Plan:
    if directory is not None:
        path = directory / "m.lifecycle.yaml"
        path.write_text(f"manifest_version: 1\nsystem: my-robot\n{text}")
    return build_plan(load(path).manifest)


def made(plan: Plan) -> tuple[tuple[Enclave, ...], Mapping[str, ET.Element]]:
    enclaves, files = documents(plan, not_before=TODAY, not_after=TODAY + dt.timedelta(days=1))
    return enclaves, {name: ET.fromstring(text) for name, text in files.items()}


@pytest.mark.parametrize("path", MANIFESTS, ids=lambda path: path.name.partition(".")[0])
def test_every_document_has_the_form_that_its_readers_demand(path: Path) -> None:
    enclaves, files = made(plan_of(path))

    assert complaints(files.pop("policy.xml"), POLICY) == []
    assert complaints(files.pop("enclaves/governance.xml"), GOVERNANCE) == []
    assert len(files) == len(enclaves)
    for each in files.values():
        assert complaints(each, PERMISSIONS) == []


@pytest.mark.parametrize(
    ("text", "form"),
    [
        ('<policy version="0.1.0"><enclaves/></policy>', POLICY),
        ('<policy version="0.2.0"><enclave path="/a"/></policy>', POLICY),
        ('<topics publish="YES"><topic>a</topic></topics>', POLICY),
        ('<topics reply="ALLOW"><topic>a</topic></topics>', POLICY),
        ("<domains><id>-1</id></domains>", PERMISSIONS),
        ("<validity><not_after>2026-01-01T00:00:00</not_after></validity>", PERMISSIONS),
        (
            "<data_protection_kind>SIGN_WITH_ORIGIN_AUTHENTICATION</data_protection_kind>",
            GOVERNANCE,
        ),
    ],
)
def test_the_form_is_told_from_others(text: str, form: Mapping[str, str]) -> None:
    assert complaints(ET.fromstring(text), form)


NODES = """
discovery: {domain_id: 7}
nodes:
  talk:
    run: {command: [talker, --ros-args, --enclave, /given]}
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


def dds(permissions: ET.Element, verb: str) -> set[str]:
    return {each.text or "" for each in permissions.iterfind(f".//allow_rule/{verb}//topic")}


def test_what_is_declared_is_allowed_under_its_dds_names(tmp_path: Path) -> None:
    enclaves, files = made(plan_of(Path(), tmp_path, NODES))

    paths = [(each.path, each.processes, each.chosen) for each in enclaves]
    assert paths == [
        ("/given", ("talk", "dock"), True),
        ("/my_robot/drive", ("drive",), False),
        ("/my_robot/supervisor_local", (), False),
    ]
    given = files["enclaves/given/permissions.xml"]
    drive = files["enclaves/my_robot/drive/permissions.xml"]
    assert given.findtext(".//subject_name") == "CN=/given"
    assert [each.text for each in given.iter("id")] == ["7"]
    assert {"rt/loud", "rq/askRequest", "rr/askReply", "ros_discovery_info"} <= dds(
        given, "publish"
    )
    assert {"rt/loud", "rr/askReply", "rq/askRequest", "ros_discovery_info"} <= dds(
        given, "subscribe"
    )
    replies = {f"rr/move/_action/{e}Reply" for e in ("send_goal", "cancel_goal", "get_result")}
    requests = {f"rq/move/_action/{e}Request" for e in ("send_goal", "cancel_goal", "get_result")}
    news = {"rt/move/_action/feedback", "rt/move/_action/status"}
    assert replies | news <= dds(given, "publish")
    assert requests <= dds(given, "subscribe")
    assert requests <= dds(drive, "publish")
    assert replies | news <= dds(drive, "subscribe")
    assert not (replies | news) & dds(drive, "publish")
    assert "rt/loud" not in dds(drive, "publish") | dds(drive, "subscribe")


def test_a_managed_node_has_its_own_services_and_a_plain_one_only_those_of_its_library(
    tmp_path: Path,
) -> None:
    _, files = made(plan_of(Path(), tmp_path, NODES))
    written = dds(files["enclaves/given/permissions.xml"], "publish")
    asked = dds(files["enclaves/my_robot/supervisor_local/permissions.xml"], "publish")

    assert {
        "rr/dock/change_stateReply",
        "rr/dock/map_toReply",
        "rt/dock/transition_event",
    } <= written
    assert "rr/a/talk/get_parametersReply" in written
    assert "rr/a/talk/change_stateReply" not in written
    assert {"rq/dock/change_stateRequest", "rq/a/talk/get_parametersRequest"} <= asked
    assert "rq/a/talk/change_stateRequest" not in asked


def test_names_of_topics_are_those_that_the_middleware_uses(tmp_path: Path) -> None:
    machines = "machines: {here: {address: 127.0.0.1}, there: {address: 10.1.2.3}}\n"
    text = machines + NODES.replace("run: ", "machine: here\n    run: ")
    _, files = made(plan_of(Path(), tmp_path, text))
    here = files["enclaves/my_robot/supervisor_here/permissions.xml"]
    mine, others = (f"rt{supervisor_alive_topic('my-robot', each)}" for each in ("here", "there"))

    assert PLANS_TOPIC == liveliness.PLANS_TOPIC
    assert mine in dds(here, "publish")
    assert others in dds(here, "subscribe")
    assert f"rt{node_topic('/dock')}" in dds(here, "subscribe")


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


def test_the_command_writes_all_and_says_how_to_sign_it(tmp_path: Path) -> None:
    plan_of(
        Path(),
        tmp_path,
        NODES.replace('run: {python: "x:Z"}', 'endpoints: open\n    run: {python: "x:Z"}'),
    )
    code, out, err = run(str(tmp_path / "m.lifecycle.yaml"), "-o", str(tmp_path / "out"))

    assert code == ExitCode.OK
    assert (tmp_path / "out/enclaves/my_robot/drive/permissions.xml").is_file()
    policy = tmp_path / "out/policy.xml"
    assert f"\nros2 security create_permission keystore /my_robot/drive {policy}\n" in out
    assert f"\n#   drive: {OVERRIDE}: /my_robot/drive\n" in out
    assert "#   talk, dock" not in out
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
    assert said.startswith(f"cannot use enclave {path!r} of process 'dock'; write an absolute name")
    assert not (tmp_path / "out").exists()
