"""`lifecycle up` from the first process to the last, on real DDS through the real command line."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree as ET

import psutil
import pytest
import yaml

from lifecycle.errors import ExitCode
from lifecycle.middleware.versions import KNOWN_FAST_DDS, KNOWN_RCL
from lifecycle.network.ports import participant_ports
from tests.ros.middleware.free_ports import first_port
from tests.ros.supervisor.running import (
    BOUND_S,
    ROOT,
    Up,
    environment,
    left_of,
    marked,
    pair,
    up,
    verb,
    write,
)


def test_a_healthy_system_is_connected_verified_activated_held_and_taken_down(
    tmp_path: Path, fresh_domain: int
) -> None:
    report = tmp_path / "verdict.json"
    options = ("--stop-after", "2", "--report", str(report))
    with up(pair(tmp_path, fresh_domain), *options, runtime=tmp_path) as run:
        run.until("system", reached="active")
        run.note_segments()
        run.met("log", line="heard hello")
        assert run.finish() == ExitCode.OK
        assert [each["reached"] for each in run.of_kind("system")] == [
            "connected",
            "verified",
            "active",
        ]
        assert run.verdict["verdict"] == "ok"
        assert json.loads(report.read_text())["verdict"] == "ok"
        activated = [e["node"] for e in run.of_kind("request") if e["operation"] == "activate"]
        assert sorted(activated) == ["/listener", "/talker"]
        run.assert_gate_held()
        assert "heard hello" in verb("logs", "listener", runtime=tmp_path).stdout
        run.assert_nothing_left()
        logs = Path(run.of_kind("run")[0]["log_directory"])
        assert logs.parent == tmp_path / "log"
        assert (logs / "listener.log").read_text() == "heard hello\n"


OTHER_VERSIONS = """
import ctypes

library = ctypes.CDLL


class Library(library):
    def __init__(self, name, *arguments, **options):
        if name and name.startswith(("libfastrtps.so", "libfastdds.so")):
            raise OSError(f"{name}: cannot open shared object file: No such file or directory")
        super().__init__(name, *arguments, **options)


ctypes.CDLL = Library
"""


@pytest.mark.thorough
def test_with_libraries_that_are_not_known_all_but_unique_flows_is_verified(
    tmp_path: Path, fresh_domain: int
) -> None:
    (tmp_path / "sitecustomize.py").write_text(OTHER_VERSIONS)
    (tmp_path / "ros_rcl-11.0.0.dist-info").mkdir()
    other = ("env", f"PYTHONPATH={tmp_path}")
    optionally = {"chatter": {"unique": "optionally_required"}}
    edit = {
        "nodes/talker/flows": {"publishers": optionally},
        "nodes/listener/flows": {"subscriptions": optionally},
    }
    manifest = pair(tmp_path, fresh_domain, edit=edit)
    with up(manifest, "--stop-after", "0.5", runtime=tmp_path, through=other) as run:
        notice = run.met("notice")["message"]
        assert f"rcl 11.0.0 is not known (known: {KNOWN_RCL})" in notice
        assert f"Fast DDS is not known (known: {KNOWN_FAST_DDS})" in notice
        run.until("system", reached="active")
        assert run.finish() == ExitCode.OK
        assert run.verdict["verdict"] == "ok"
        assert run.verdict["flows"][0]["unique"] is None
        run.assert_gate_held()
        run.assert_nothing_left()


@pytest.mark.thorough
def test_what_needs_libraries_that_are_known_is_refused_before_anything_is_started(
    tmp_path: Path, fresh_domain: int
) -> None:
    (tmp_path / "sitecustomize.py").write_text(OTHER_VERSIONS)
    (tmp_path / "ros_rcl-11.0.0.dist-info").mkdir()
    other = ("env", f"PYTHONPATH={tmp_path}")
    for flows, refused in (
        ({"unique": "strictly_required"}, "a flow of its own ('unique: strictly_required'): rcl"),
        ({"transport": "network"}, "a participant of 'talker' with 'transport'"),
    ):
        edit = {"nodes/talker/flows": {"publishers": {"chatter": flows}}}
        manifest = pair(tmp_path, fresh_domain, edit=edit)
        with up(manifest, "--stop-after", "0.5", runtime=tmp_path, through=other) as run:
            assert run.finish() == ExitCode.BRING_UP_FAILED
            assert run.of_kind("process") == []
            assert refused in run.said()
            assert re.match(rf"{re.escape(str(manifest))}:\d+:\d+: cannot ", run.said())


def test_a_plain_node_that_is_not_declared_as_one_is_named_with_the_key_that_mends_it(
    tmp_path: Path, fresh_domain: int
) -> None:
    plain = "import rclpy; rclpy.init(); rclpy.spin(rclpy.create_node('plain'))"
    node = {"run": {"command": [sys.executable, "-c", plain]}, "timeouts": {"start_s": 4}}
    with up(write(tmp_path, fresh_domain, {"plain": node}, "one"), runtime=tmp_path) as run:
        said = run.until("notice")["message"]
        assert re.fullmatch(
            "'/plain' is still waiting for its lifecycle services, for up to [12] s more; "
            "if it is a plain node, write 'managed: false' at nodes.plain",
            said,
        ), said
        shown = verb("status", "one", runtime=tmp_path).stdout
        assert "waiting for its lifecycle services" in shown
        drawn = verb("graph", "one", runtime=tmp_path).stdout
        assert "waiting for its lifecycle services" in drawn
        assert "missing" not in drawn  # nobody has looked yet
        assert run.finish() == ExitCode.BRING_UP_FAILED
        assert "write 'managed: false' at nodes.plain" in run.verdict["findings"][0]["message"]


@pytest.mark.thorough
def test_nodes_that_keep_each_other_from_the_processor_are_not_too_late(
    tmp_path: Path, fresh_domain: int
) -> None:
    node = {"run": {"python": "tests.ros.supervisor.systems:Quiet"}, "timeouts": {"start_s": 0.5}}
    nodes = {f"node_{index}": node for index in range(12)}
    manifest = write(tmp_path, fresh_domain, nodes, "crowd")
    one_processor = ("taskset", "--cpu-list", str(min(os.sched_getaffinity(0))))
    options = ("--until", "connected")
    with up(manifest, *options, runtime=tmp_path, through=one_processor) as run:
        assert run.finish() == ExitCode.OK
        run.assert_nothing_left()


def test_no_node_that_is_being_activated_is_said_to_be_in_a_wrong_state(
    tmp_path: Path, fresh_domain: int
) -> None:
    edit = {"nodes/listener/after": {"talker": "active"}}
    with up(pair(tmp_path, fresh_domain, edit=edit), runtime=tmp_path) as run:
        run.until("system", reached="active")
        verdicts = [each["verdict"] for each in run.of_kind("verdict")]
        rules = {each["rule"] for verdict in verdicts for each in verdict["findings"]}
        assert "state.wrong-state" not in rules


@pytest.mark.parametrize("until", ["connected", "verified"])
def test_until_stops_short_of_activating(tmp_path: Path, fresh_domain: int, until: str) -> None:
    with up(pair(tmp_path, fresh_domain), "--until", until, runtime=tmp_path) as run:
        assert run.finish() == ExitCode.OK
        assert run.of_kind("system")[-1]["reached"] == until
        assert run.verdict["run"] == {"reason": "done", "reached": until, "exit_code": 0}
        assert run.of_kind("gate") == []
        assert "activate" not in [each["operation"] for each in run.of_kind("request")]
        run.assert_nothing_left()


def test_an_interrupt_takes_the_system_down_in_reverse_order(
    tmp_path: Path, fresh_domain: int
) -> None:
    with up(pair(tmp_path, fresh_domain), runtime=tmp_path) as run:
        run.until("system", reached="active")
        run.note_segments()
        run.signal(signal.SIGINT)
        assert run.finish() == ExitCode.INTERRUPTED
        assert run.verdict["run"] == {
            "reason": "interrupted",
            "reached": "active",
            "exit_code": ExitCode.INTERRUPTED,
        }
        last = [each["node"] for each in run.of_kind("request") if each["operation"] == "shutdown"]
        assert last == ["/listener", "/talker"]
        run.assert_nothing_left()


def test_a_bring_up_takes_no_orders_and_is_rolled_back_by_a_signal(
    tmp_path: Path, fresh_domain: int
) -> None:
    manifest = pair(tmp_path, fresh_domain, misbehave="configure:hang")
    with up(manifest, runtime=tmp_path) as run:
        run.until("log", line="about to hang in configure")
        refused = verb("pause", "pair", runtime=tmp_path)
        assert refused.returncode == ExitCode.USAGE
        assert refused.stderr == (
            "cannot pause 'pair': it is connecting; only an active system can be paused\n"
        )
        run.note_segments()
        run.signal(signal.SIGINT)
        assert run.finish() == ExitCode.INTERRUPTED
        assert run.verdict["run"].pop("reason").endswith("; /talker is still configuring")
        assert run.verdict["run"] == {"reached": None, "exit_code": ExitCode.INTERRUPTED}
        run.assert_nothing_left()


def test_a_signal_while_the_supervisor_itself_is_starting_leaves_nothing(
    tmp_path: Path, fresh_domain: int
) -> None:
    with up(pair(tmp_path, fresh_domain), runtime=tmp_path) as run:
        deadline = time.monotonic() + BOUND_S
        while not _has_participant(run.process.pid):  # which it makes before all else
            assert run.process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.001)
        run.note_segments()
        run.signal(signal.SIGTERM)
        assert run.finish() == ExitCode.TERMINATED
        assert run.verdict["verdict"] == "unverifiable"
        assert run.verdict["run"]["reason"].startswith("terminated")
        run.assert_gate_held()
        run.assert_nothing_left()


def _has_participant(pid: int) -> bool:
    """Whether threads of Fast DDS run in a process."""
    try:
        return any(
            each.read_text().startswith("dds.") for each in Path(f"/proc/{pid}/task").glob("*/comm")
        )
    except OSError:
        return False


def _cases(report: Path) -> dict[str, str]:
    """What each test case of a JUnit report comes to."""
    return {
        f"{case.get('classname')}: {case.get('name')}": next(
            (each.tag for each in case if each.tag in {"failure", "skipped"}), "passed"
        )
        for case in ET.parse(report).getroot().iter("testcase")
    }


def _end(run: Up, how: int | str, runtime: Path) -> None:
    if isinstance(how, int):
        run.signal(how)
    else:
        assert verb(how, "pair", runtime=runtime).returncode == ExitCode.OK


_ENDS = [
    (signal.SIGTERM, ExitCode.TERMINATED),
    (signal.SIGHUP, ExitCode.HUNG_UP),
    ("down", ExitCode.BRING_UP_FAILED),
]


def test_a_node_that_its_code_names_otherwise_is_named_as_the_graph_shows_it(
    tmp_path: Path, fresh_domain: int
) -> None:
    plain = "import rclpy; rclpy.init(); rclpy.spin(rclpy.create_node('plain'))"
    node = {"run": {"command": [sys.executable, "-c", plain]}, "timeouts": {"start_s": 4}}
    with up(write(tmp_path, fresh_domain, {"driver": node}, "one"), runtime=tmp_path) as run:
        said = run.until("notice")["message"]
        assert said.startswith("'/driver' is still waiting to appear in the graph, for up to "), (
            said
        )
        mends = "if it is this one, write 'name: plain' at nodes.driver"
        assert said.endswith(f"; the graph shows '/plain', not declared: {mends}"), said


@pytest.mark.parametrize(("how", "code"), _ENDS)
def test_a_run_that_is_ended_before_it_was_verified_is_no_success(
    tmp_path: Path, fresh_domain: int, how: int | str, code: ExitCode
) -> None:
    report = tmp_path / "report.xml"
    # The gate stays closed for as long as a node is missing that somebody else must start.
    edit = {"nodes/third": {"run": {"attach": True}, "managed": False}}
    with up(
        pair(tmp_path, fresh_domain, edit=edit), "--report", str(report), runtime=tmp_path
    ) as run:
        run.until_found("graph.missing-node", "/third")
        run.note_segments()
        _end(run, how, tmp_path)
        assert run.finish() == code
        assert (
            run.verdict["run"]
            .pop("reason")
            .endswith("; /third is still waiting to appear in the graph")
        )
        assert run.verdict["run"] == {"reached": "connected", "exit_code": code}
        assert run.of_kind("gate") == []
        cases = _cases(report)
        assert cases["run: end"] == "failure"
        assert cases["graph.missing-node: a declared node is not in the graph"] == "failure"
        run.assert_nothing_left()


def test_a_run_that_cannot_hold_for_as_long_as_asked_is_no_success_and_its_report_is_red(
    tmp_path: Path, fresh_domain: int
) -> None:
    manifest = pair(tmp_path, fresh_domain)
    reports = {name: tmp_path / f"{name}.xml" for name in ("short", "active", "invalid")}
    for name, options, code in (
        ("short", ("--stop-after", "30"), ExitCode.TERMINATED),
        ("active", (), ExitCode.OK),
    ):
        with up(manifest, *options, "--report", str(reports[name]), runtime=tmp_path) as run:
            run.until("system", reached="active")
            run.signal(signal.SIGTERM)
            assert run.finish() == code
            assert run.verdict["verdict"] == "ok"
            assert run.verdict["run"]["exit_code"] == code
    cases = {name: _cases(path) for name, path in reports.items() if path.exists()}
    assert set(cases["active"].values()) == {"passed"}
    assert [name for name, came in cases["short"].items() if came != "passed"] == ["run: end"]
    wrong = pair(tmp_path, fresh_domain, edit={"links": [{"topic": "/nothing"}]})
    for name in ("up", "verify"):
        done = verb(name, str(wrong), "--report", str(reports["invalid"]), runtime=tmp_path)
        assert done.returncode == ExitCode.MANIFEST_INVALID
        cases["invalid"] = _cases(reports["invalid"])
        failed = [each for each, came in cases["invalid"].items() if came == "failure"]
        assert failed == ["manifest: the manifest is valid", "run: end"]
    assert list(cases["active"]) == list(cases["short"]) == list(cases["invalid"])


_IMPORTING = "import time\nprint('importing', flush=True)\ntime.sleep(300)"


@pytest.mark.thorough
def test_every_import_that_fails_is_named_once_and_whoever_still_imports_is_not_waited_for(
    tmp_path: Path, fresh_domain: int
) -> None:
    broken = {"run": {"python": "tests.ros.faults.broken_import:Talker"}}
    missing = {"run": {"python": "other_import:Talker"}}
    manifest = pair(
        tmp_path,
        fresh_domain,
        edit={
            "nodes/broken": {**broken, "process": "shared"},
            "nodes/missing": {**missing, "process": "shared"},
            "nodes/alone": missing,
            "nodes/slow": {"run": {"python": "slow_import:Talker"}},
            "nodes/foreign": {
                "run": {"command": [sys.executable, "-c", _IMPORTING]},
                "managed": False,
            },
        },
    )
    talker = "from lifecycle import LifecycleNode\n\nclass Talker(LifecycleNode): ...\n"
    (tmp_path / "slow_import.py").write_text(f"{_IMPORTING}\n{talker}")
    (tmp_path / "other_import.py").write_text(f"import no_such_sensor\n{talker}")
    done = verb(
        "up", str(manifest), runtime=tmp_path, variables={"PYTHONPATH": f"{tmp_path}:{ROOT}"}
    )
    assert done.returncode == ExitCode.BRING_UP_FAILED
    said = done.stdout
    driver = "cannot start '/broken': ModuleNotFoundError: No module named 'no_such_driver'"
    assert said.count(driver) == 1
    for node in ("missing", "alone"):
        sensor = f"cannot start '/{node}': ModuleNotFoundError: No module named 'no_such_sensor'"
        assert said.count(sensor) == 1
    assert said.count("Traceback") == 3, said
    assert "KeyboardInterrupt" not in said
    assert "had to be ended" not in said
    for node in ("broken", "missing", "alone"):
        assert said.count(f"failed: /{node} (run.start-failed)\n") == 1
        assert said.count(f"violated run.start-failed: /{node}\n") == 1
    assert "verdict: violated (3 violated)" in said
    assert "/talker (run." not in said
    for process in ("slow", "foreign"):
        (log,) = (tmp_path / "log").glob(f"latest/{process}.log")
        assert log.read_text() == "importing\n"


@pytest.mark.thorough
def test_with_all_warnings_on_a_run_gives_none(tmp_path: Path, fresh_domain: int) -> None:
    warnings = {"PYTHONWARNINGS": "always"}
    manifest = str(pair(tmp_path, fresh_domain))
    done = verb("up", manifest, "--stop-after", "0", runtime=tmp_path, variables=warnings)
    assert (done.returncode, done.stderr) == (ExitCode.OK, "")
    assert "Warning" not in done.stdout


@pytest.mark.thorough
def test_that_nodes_are_found_by_a_server_of_the_user_s_is_said(
    tmp_path: Path, fresh_domain: int
) -> None:
    there_is_none = {"ROS_DISCOVERY_SERVER": "127.0.0.1:9"}
    options = (str(pair(tmp_path, fresh_domain)), "--timeout", "2")
    done = verb("up", *options, runtime=tmp_path, variables=there_is_none)
    assert done.returncode == ExitCode.VIOLATED
    assert "found by the discovery server of ROS_DISCOVERY_SERVER=127.0.0.1:9" in done.stdout


def test_a_second_interrupt_kills_what_does_not_end(tmp_path: Path, fresh_domain: int) -> None:
    manifest = pair(
        tmp_path,
        fresh_domain,
        misbehave="deactivate:hang",
        edit={"nodes/talker/timeouts": {"deactivate_s": 60, "shutdown_s": 60}},
    )
    with up(manifest, runtime=tmp_path) as run:
        run.until("system", reached="active")
        run.note_segments()
        run.signal(signal.SIGINT)
        run.until("log", line="about to hang in deactivate")
        run.signal(signal.SIGINT)
        assert run.finish() == ExitCode.INTERRUPTED
        ends = {each["process"]: each["detail"] for each in run.of_kind("process")}
        assert ends["talker"] == "killed by SIGKILL"
        run.assert_nothing_left()


def _logs_of_a_run_before(tmp_path: Path, system: str) -> Path:
    dead = 2**22 + 1  # more than any pid
    folder = tmp_path / "log" / f"2020-01-01-00-00-00-000000-host-{dead}-{system}"
    folder.mkdir(parents=True)
    (folder / "talker.log").write_text("of a run before\n")
    return folder


@pytest.mark.thorough
def test_logs_of_old_runs_of_the_same_system_go_when_it_is_started(
    tmp_path: Path, fresh_domain: int
) -> None:
    keeping = {"LIFECYCLE_KEEP_LOGS": "1"}
    old = _logs_of_a_run_before(tmp_path, "pair")
    other = _logs_of_a_run_before(tmp_path, "other")
    with up(pair(tmp_path, fresh_domain), runtime=tmp_path, variables=keeping) as run:
        run.until("system", reached="active")
        assert not old.exists()
        run.signal(signal.SIGINT)
        assert run.finish() == ExitCode.INTERRUPTED
    assert other.is_dir()


def test_a_process_that_dies_in_a_step_ends_the_run_and_is_named_with_its_last_words(
    tmp_path: Path, fresh_domain: int
) -> None:
    with up(pair(tmp_path, fresh_domain, misbehave="activate:kill"), runtime=tmp_path) as run:
        assert run.finish() == ExitCode.BRING_UP_FAILED
        failure = run.of_kind("failure")[0]
        assert failure["rule"] == "run.process-died"
        assert failure["subject"] == "/talker"
        assert failure["message"] == (
            f"cannot keep '/talker' running: pid {run.pid_of('talker')} died while activating: "
            "killed by SIGKILL"
        )
        assert Path(failure["log"]).read_text().splitlines()[-1] == "about to kill in activate"
        assert run.verdict["verdict"] == "violated"
        assert run.verdict["findings"][0]["rule"] == "run.process-died"
        assert run.verdict["run"] == {
            "reason": "failed: /talker (run.process-died)",
            "reached": "verified",
            "exit_code": ExitCode.BRING_UP_FAILED,
        }
        run.assert_gate_held()
        run.assert_nothing_left()


def test_keep_going_reports_the_death_and_the_verdict_and_goes_on_but_is_no_success(
    tmp_path: Path, fresh_domain: int
) -> None:
    with up(pair(tmp_path, fresh_domain), "--keep-going", runtime=tmp_path) as run:
        run.until("system", reached="active")
        run.note_segments()
        before = len(run.events)
        os.kill(run.pid_of("talker"), signal.SIGKILL)
        run.until("failure", rule="run.process-died")
        died_s = time.monotonic()
        # A judgement that was under way may see the death a moment before it is reported.
        verdict = run.until_found("graph.missing-node", "/talker", since=before)
        assert verdict["verdict"] == "violated"
        # Not as late as participants are waited for that may be on their way into the graph.
        assert time.monotonic() - died_s < 2.0
        run.signal(signal.SIGTERM)
        assert run.finish() == ExitCode.BRING_UP_FAILED
        assert run.verdict["run"]["reason"] == "terminated; failed: /talker (run.process-died)"
        rules = [each["rule"] for each in run.verdict["findings"]]
        assert (rules[0], rules.count("run.process-died")) == ("run.process-died", 1)
        run.assert_nothing_left()
    history = verb("history", runtime=tmp_path).stdout
    assert "process talker: exited" in history
    assert "killed by SIGKILL" in history
    assert "    + violated graph.missing-node: " in history


def test_status_and_down_talk_to_a_running_supervisor(tmp_path: Path, fresh_domain: int) -> None:
    manifest = pair(tmp_path, fresh_domain)
    with up(manifest, runtime=tmp_path) as run:
        run.until("system", reached="active")
        run.note_segments()
        told = json.loads(verb("status", "pair", "--format", "json", runtime=tmp_path).stdout)
        assert told["phase"] == "active"
        probe = verb("status", "pair", "--probe", "ready", runtime=tmp_path)
        assert (probe.returncode, probe.stdout, probe.stderr) == (0, "", "")
        assert told["verdict"] == "ok"
        states = {each["node"]: (each["state"], each["matched"]) for each in told["nodes"]}
        assert states == {"/talker": ("active", 1), "/listener": ("active", 1)}
        down = verb("down", str(manifest), runtime=tmp_path)
        assert (down.returncode, down.stderr) == (ExitCode.OK, "")
        assert run.finish() == ExitCode.OK
        run.assert_nothing_left()
    gone = verb("down", str(manifest), runtime=tmp_path)
    assert gone.returncode == ExitCode.USAGE
    assert gone.stderr == (
        f"cannot find a running system 'pair@{fresh_domain}'; running: none; "
        "start it: lifecycle up MANIFEST\n"
    )


def test_the_next_up_sweeps_what_a_killed_supervisor_left(
    tmp_path: Path, fresh_domain: int
) -> None:
    manifest = pair(tmp_path, fresh_domain, misbehave="configure:fork")
    with up(manifest, runtime=tmp_path) as killed:
        killed.until("system", reached="active")
        killed.note_segments()
        os.kill(killed.pid_of("talker"), signal.SIGSTOP)
        killed.signal(signal.SIGKILL)
        killed.process.wait(30)
        assert marked(killed.mark) != []
        with up(manifest, "--stop-after", "0", runtime=tmp_path) as following:
            assert following.finish() == ExitCode.OK
            assert any(
                each["message"].startswith(
                    f"cleaned up after supervisor {killed.process.pid}, which was killed"
                )
                for each in following.of_kind("notice")
            )
            following.assert_nothing_left()
        killed.assert_nothing_left()


def test_a_plain_command_is_started_verified_and_ended(tmp_path: Path, fresh_domain: int) -> None:
    code = (
        "import rclpy; from rclpy.node import Node; from std_msgs.msg import String\n"
        "rclpy.init(); node = Node('x'); node.create_publisher(String, 'chatter', 10)\n"
        "rclpy.spin(node)"
    )
    edit = {
        "nodes/talker/run": {"command": [sys.executable, "-c", code]},
        "nodes/talker/name": "talker",  # what its code calls 'x'
        "nodes/talker/managed": False,
        "nodes/talker/interface": {
            "publishers": [{"name": "/chatter", "type": "std_msgs/msg/String"}]
        },
    }
    with up(pair(tmp_path, fresh_domain, edit=edit), "--stop-after", "0", runtime=tmp_path) as run:
        run.until("system", reached="active")
        run.note_segments()
        assert run.finish() == ExitCode.OK
        assert run.verdict["verdict"] in {"ok", "unverifiable"}
        run.assert_nothing_left()


_HANGS_IN_FAST_DDS = """
import threading
import lifecycle.supervisor.run.up as run
from lifecycle.cli import program
from lifecycle.supervisor.nodes.observer_participant import ObserverParticipant
run.LEAVE_S = 1.0
ObserverParticipant.destroy = lambda self: threading.Event().wait()
raise SystemExit(program())
"""


@pytest.mark.thorough
def test_a_run_that_hangs_on_leaving_the_graph_ends_with_its_verdict_and_report(
    tmp_path: Path, fresh_domain: int
) -> None:
    report = tmp_path / "verdict.json"
    arguments = ["up", pair(tmp_path, fresh_domain), "--stop-after", "0", "--report", report]
    mark = uuid.uuid4().hex
    done = subprocess.run(
        [sys.executable, "-c", _HANGS_IN_FAST_DDS, *map(str, arguments), "--format", "json"],
        cwd=ROOT,
        env=environment(tmp_path, mark),
        capture_output=True,
        text=True,
        timeout=BOUND_S,
        check=False,
    )
    assert (done.returncode, done.stderr) == (ExitCode.OK, "")
    assert json.loads(done.stdout.splitlines()[-1])["verdict"] == "ok"
    assert json.loads(report.read_text())["verdict"] == "ok"
    assert left_of(mark) == []


@pytest.mark.thorough
@pytest.mark.parametrize("range_", ["subnet", "localhost"])
def test_where_something_else_has_the_port_of_discovery_a_system_is_not_begun_and_says_so(
    tmp_path: Path, fresh_domain: int, range_: str
) -> None:
    report = tmp_path / "verdict.json"
    manifest = pair(tmp_path, fresh_domain, edit={"discovery/range": range_})
    port = participant_ports(fresh_domain, 0).discovery_multicast
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", port))
        options = ("--until", "verified", "--report", str(report))
        done = verb("up", str(manifest), *options, runtime=tmp_path)
    if range_ == "localhost":  # where nobody needs it
        assert done.returncode == ExitCode.OK, done.stdout
        return
    assert done.returncode == ExitCode.BRING_UP_FAILED, done.stdout
    assert f"cannot discover nodes of this host in domain {fresh_domain}: UDP port {port}" in (
        done.stderr
    )
    assert "process talker" not in done.stdout
    assert json.loads(report.read_text())["verdict"] == "unverifiable"
    again = verb("up", str(manifest), "--until", "verified", runtime=tmp_path)
    assert again.returncode == ExitCode.OK, again.stdout


_OTHER_PORTS = """<?xml version="1.0" encoding="UTF-8" ?>
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <participant profile_name="theirs" is_default_profile="true">
    <rtps><port><portBase>7600</portBase></port></rtps>
  </participant>
</profiles>
"""


@pytest.mark.thorough
def test_a_system_whose_profile_chooses_other_ports_needs_no_port_of_others(
    tmp_path: Path, fresh_domain: int
) -> None:
    manifest = pair(tmp_path, fresh_domain, edit={"discovery/range": "subnet"})
    profile = tmp_path / "ports.xml"
    profile.write_text(_OTHER_PORTS)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", participant_ports(fresh_domain, 0).discovery_multicast))
        done = verb(
            "up",
            *(str(manifest), "--until", "verified"),
            runtime=tmp_path,
            variables={"FASTRTPS_DEFAULT_PROFILES_FILE": str(profile)},
        )
    assert done.returncode == ExitCode.OK, done.stdout


_NOBODY = "54321"
"""A user without any other process."""

_LIMITED = str(54400 + int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")))
"""Likewise, and each test process has another one: limits of processes are counted per user."""

_READS_ALL = "+dac_read_search,+dac_override"
"""Capabilities to use this installation all the same; the limit holds without CAP_SYS_RESOURCE."""


def limited(*options: str) -> tuple[str, ...]:
    """Return the beginning of a command line for whom a limit of processes holds: not root."""
    if os.getuid() != 0:
        return ("prlimit", *options)
    if shutil.which("setpriv") is None:
        pytest.skip("root has no limit of processes, and setpriv is not installed")
    user = ("setpriv", "--reuid", _LIMITED, "--clear-groups", "--inh-caps", _READS_ALL)
    return (*user, "--ambient-caps", _READS_ALL, "prlimit", *options)


@pytest.mark.parametrize("processes", [1, 2, 3, 4, 12])
def test_without_room_for_its_threads_a_system_is_not_begun_and_says_so(
    tmp_path: Path, fresh_domain: int, processes: int
) -> None:
    through = limited(f"--nproc={processes}")
    with up(pair(tmp_path, fresh_domain), runtime=tmp_path, through=through) as run:
        assert run.process.wait(BOUND_S) == ExitCode.BRING_UP_FAILED
        last = run.said().splitlines()[-1]
        assert last.startswith(
            (
                "cannot start the fork server: ",
                *(
                    f"cannot start {what} that this needs: a limit of processes, threads or memory "
                    "is reached"
                    for what in ("the thread", "the 24 threads")
                ),
            )
        )
        assert left_of(run.mark) == []
        assert list((tmp_path / "lifecycle").glob("*")) == []


@pytest.mark.thorough
@pytest.mark.parametrize("whom", ["supervisor", "all"])
def test_at_the_limit_of_processes_a_system_is_taken_down_all_the_same(
    tmp_path: Path, fresh_domain: int, whom: str
) -> None:
    with up(pair(tmp_path, fresh_domain), runtime=tmp_path, through=limited("--nproc=4096")) as run:
        run.until("system", reached="active")
        run.note_segments()
        processes = marked(run.mark) if whom == "all" else [psutil.Process(run.process.pid)]
        for each in processes:
            subprocess.run([*limited("--nproc=1:1", "--pid"), str(each.pid)], check=True)
        began = time.monotonic()
        run.signal(signal.SIGTERM)
        assert run.finish() == ExitCode.OK
        assert time.monotonic() - began < 5.0
        assert run.of_kind("notice") == []
        run.assert_nothing_left()
        assert list((tmp_path / "lifecycle").glob("*")) == []


def _foreign(path: Path) -> None:
    if os.getuid() != 0:
        pytest.skip("only root can give a directory away")
    path.mkdir(mode=0o700)
    os.chown(path, int(_NOBODY), -1)


def _with_a_file(path: Path) -> None:
    path.mkdir(mode=0o700)
    (path / "control").mkdir()


_IN_PLACE: dict[str, Callable[[Path], None]] = {
    "it is a symbolic link": lambda path: path.symlink_to(path.parent),
    "it is not a directory": Path.touch,
    f"it belongs to user {_NOBODY}, and this is user {os.getuid()}": _foreign,
    "it holds 'control', and was no run's": _with_a_file,
}


@pytest.mark.thorough
@pytest.mark.parametrize("what", _IN_PLACE)
def test_what_is_in_the_place_of_the_run_directory_is_named_and_left_alone(
    tmp_path: Path, fresh_domain: int, what: str
) -> None:
    root = tmp_path / "lifecycle"
    root.mkdir(mode=0o700)
    path = root / f"pair@{fresh_domain}"
    _IN_PLACE[what](path)
    before = path.lstat()
    report = tmp_path / "verdict.json"
    done = verb("up", str(pair(tmp_path, fresh_domain)), "--report", str(report), runtime=tmp_path)
    said = (
        f"cannot use {str(path)!r} as run directory: {what}; it must be a directory of this user "
        "that others cannot write; remove it, or set XDG_RUNTIME_DIR to such a directory"
    )
    assert (done.returncode, done.stdout, done.stderr) == (ExitCode.USAGE, "", f"{said}\n")
    assert json.loads(report.read_text())["run"]["reason"] == said
    after = path.lstat()
    assert (after.st_ino, after.st_mode, after.st_mtime) == (
        before.st_ino,
        before.st_mode,
        before.st_mtime,
    )


def test_systemd_is_notified_once_the_system_is_verified_and_active(
    tmp_path: Path, fresh_domain: int
) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(BOUND_S)
        variables = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "500000"}
        with up(pair(tmp_path, fresh_domain), runtime=tmp_path, variables=variables) as run:
            sent: list[str] = []
            while "READY=1" not in sent:
                sent += manager.recv(4096).decode().split("\n")
            assert "WATCHDOG=1" in sent
            run.until("system", reached="active")
            run.assert_gate_held()
            run.signal(signal.SIGTERM)
            while "STOPPING=1" not in sent:
                sent += manager.recv(4096).decode().split("\n")
            assert run.finish() == ExitCode.OK


@pytest.mark.thorough
def test_a_publisher_serves_one_by_tcp_and_another_by_shared_memory(
    tmp_path: Path, fresh_domain: int
) -> None:
    """What moves to a connection is still discovered by who stays on its own participant."""
    port = first_port()
    manifest = pair(tmp_path, fresh_domain, edit={"discovery/first_port": port})
    document = yaml.safe_load(manifest.read_text())
    document["nodes"]["beside"] = document["nodes"]["listener"]
    document["links"][0]["transport"] = "tcpv4"
    manifest.write_text(yaml.safe_dump(document))
    with up(manifest, "--until", "verified", runtime=tmp_path) as run:
        assert run.finish() == ExitCode.OK
        (*_, last) = run.of_kind("verdict")
        assert {each["effective_transport"] for each in last["verdict"]["flows"]} == {
            "tcpv4",
            "shm",
        }
        run.assert_nothing_left()
