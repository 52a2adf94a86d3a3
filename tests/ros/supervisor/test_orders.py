"""`lifecycle pause`, `resume` and `restart` of a running system, on real DDS."""

from __future__ import annotations

import contextlib
import json
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from std_srvs.srv import Trigger

from lifecycle.errors import ExitCode
from tests.ros.stranger import stranger
from tests.ros.supervisor.running import BOUND_S, ENOUGH, Up, pair, up, verb
from tests.ros.supervisor.test_parameters import ARM


def requests(run: Up, since: int) -> list[tuple[str, str]]:
    """Node and operation of every request after the first `since` events."""
    return [
        (each["node"], each["operation"])
        for each in run.events[since:]
        if each.get("event") == "request" and each["operation"] != "get_configuration"
    ]


def phases(runtime: Path) -> tuple[str, dict[str, str]]:
    """Phase of the system and state of each node, as `lifecycle status` shows them."""
    told = verb("status", "pair", "--format", "json", runtime=runtime)
    status = json.loads(told.stdout)
    return status["phase"], {each["node"]: each["state"] for each in status["nodes"]}


def resume(runtime: Path) -> None:
    """Resume as soon as the gate allows it: who has left is seen a little later."""
    deadline = time.monotonic() + BOUND_S
    while (done := verb("resume", "pair", runtime=runtime)).returncode != ExitCode.OK:
        assert "graph.undeclared-node" in done.stderr
        assert time.monotonic() < deadline


def assert_no_activate_before_a_new_gate(run: Up, since: int) -> None:
    kinds = [
        "activate" if each.get("operation") == "activate" else each.get("event")
        for each in run.events[since:]
    ]
    assert "gate" in kinds
    assert "activate" in kinds
    assert kinds.index("gate") < kinds.index("activate")


def test_a_paused_system_is_silent_and_resumes_only_through_the_gate(
    tmp_path: Path, fresh_domain: int
) -> None:
    with up(pair(tmp_path, fresh_domain), runtime=tmp_path) as run:
        run.until("system", reached="active")
        begun = len(run.events)
        paused = verb("pause", "pair", runtime=tmp_path)
        assert (paused.returncode, paused.stderr) == (ExitCode.OK, "")
        run.until("system", reached="paused")
        assert requests(run, begun) == [("/listener", "deactivate"), ("/talker", "deactivate")]
        assert phases(tmp_path) == ("paused", {"/talker": "inactive", "/listener": "inactive"})

        again = verb("pause", "pair", runtime=tmp_path)
        assert again.returncode == ExitCode.USAGE
        assert again.stderr == (
            "cannot pause 'pair': it is paused; only an active system can be paused\n"
        )

        begun = len(run.events)
        # Its full name will do as well as its key.
        assert verb("restart", "pair", "/talker", runtime=tmp_path).returncode == ExitCode.OK
        run.until("system", reached="connected")
        run.until("system", reached="paused")
        assert "activate" not in [operation for _, operation in requests(run, begun)]
        assert phases(tmp_path) == ("paused", {"/talker": "inactive", "/listener": "inactive"})

        begun = len(run.events)
        resumed = verb("resume", str(tmp_path / "pair.lifecycle.yaml"), runtime=tmp_path)
        assert (resumed.returncode, resumed.stderr) == (ExitCode.OK, "")
        run.until("system", reached="active")
        assert_no_activate_before_a_new_gate(run, begun)
        assert phases(tmp_path) == ("active", {"/talker": "active", "/listener": "active"})
        again = verb("resume", "pair", runtime=tmp_path)
        assert again.returncode == ExitCode.USAGE
        assert again.stderr == (
            "cannot resume 'pair': it is active; only a paused system can be resumed\n"
        )
        assert verb("down", "pair", runtime=tmp_path).returncode == ExitCode.OK
        assert run.finish() == ExitCode.OK
        run.assert_nothing_left()


def test_what_is_paused_or_restarted_stays_at_the_gate_of_a_system_that_is_not_ok(
    tmp_path: Path, fresh_domain: int
) -> None:
    with up(pair(tmp_path, fresh_domain), runtime=tmp_path) as run:
        run.until("system", reached="active")
        assert verb("pause", "pair", runtime=tmp_path).returncode == ExitCode.OK
        run.until("system", reached="paused")
        begun = len(run.events)
        with stranger(fresh_domain):
            run.until_found("graph.undeclared-node", since=begun)
            refused = verb("resume", "pair", runtime=tmp_path)
            assert refused.returncode == ExitCode.VIOLATED
            assert refused.stderr.startswith("cannot activate: the verdict is violated\n")
            assert "graph.undeclared-node" in refused.stderr
            assert phases(tmp_path)[0] == "paused"
            run.until("notice")
            assert requests(run, begun) == []
        resume(tmp_path)
        assert phases(tmp_path)[0] == "active"

        begun = run.catch_up()
        with stranger(fresh_domain):
            run.until_found("graph.undeclared-node", since=begun)
            refused = verb("restart", "pair", "talker", runtime=tmp_path)
            assert refused.returncode == ExitCode.VIOLATED
            assert phases(tmp_path) == ("held", {"/talker": "inactive", "/listener": "active"})
        resume(tmp_path)
        assert phases(tmp_path) == ("active", {"/talker": "active", "/listener": "active"})


LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Panel:
    """A node of someone who has no shell on the robot.

    Attributes:
        statuses: received so far.
        diagnostics: likewise.
    """

    def __init__(self, domain_id: int) -> None:
        self.statuses: list[Any] = []
        self.diagnostics: list[Any] = []
        self._ends = contextlib.ExitStack()
        self.node = self._ends.enter_context(stranger(domain_id, "rqt_panel"))
        self._executor = SingleThreadedExecutor(context=self.node.context)
        self._executor.add_node(self.node)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self.diagnostics.append, 10)

    def __enter__(self) -> Panel:  # noqa: PYI034 - typing.Self is not in Python 3.10
        return self

    def __exit__(self, *_: object) -> None:
        self._ends.close()

    def subscribe_status(self) -> None:
        """Receive what was published last, and what will be."""
        topic = "/lifecycle/pair/status"
        self.node.create_subscription(String, topic, self.statuses.append, LATCHED)

    def until(self, holds: Callable[[], object]) -> None:
        """Spin until something holds."""
        deadline = time.monotonic() + BOUND_S
        while not holds():
            assert time.monotonic() < deadline, (self.statuses[-1:], self.diagnostics[-1:])
            self._executor.spin_once(timeout_sec=0.1)

    def call(self, name: str) -> tuple[bool, str]:
        """Call a service of the supervisor."""
        client = self.node.create_client(Trigger, f"/lifecycle/pair/{name}")
        self.until(client.service_is_ready)
        answer = client.call_async(Trigger.Request())
        self.until(answer.done)
        return answer.result().success, answer.result().message


@pytest.mark.thorough
def test_a_panel_on_the_network_pauses_and_ends_the_system_where_it_may(
    tmp_path: Path, fresh_domain: int
) -> None:
    edit = {
        "policy/ros_interface": "full",
        "modes": {"normal": {}, "quiet": {"inactive": ["talker"]}},
        "nodes/talker/run/no_new_privileges": True,
        "nodes/talker/run/limits": {"nofile": 200},
    }
    manifest = pair(tmp_path, fresh_domain, edit=edit)
    with Panel(fresh_domain) as panel, up(manifest, runtime=tmp_path) as run:
        run.until("system", reached="active")
        assert panel.call("pause") == (True, "paused")
        # Who comes later gets what was published last.
        panel.subscribe_status()
        panel.until(lambda: panel.statuses and '"phase":"paused"' in panel.statuses[-1].data)
        panel.until(lambda: panel.diagnostics)
        assert [each.name for each in panel.diagnostics[-1].status] == [
            "pair: /listener",
            "pair: /talker",
        ]
        assert panel.call("resume") == (True, "active")
        success, status = panel.call("get_status")
        assert (success, json.loads(status)["verdict"]) == (True, "ok")
        talker, listener = (Path(f"/proc/{run.pid_of(each)}") for each in ("talker", "listener"))
        assert "NoNewPrivs:\t1" in (talker / "status").read_text()
        assert "NoNewPrivs:\t0" in (listener / "status").read_text()
        assert re.search(r"Max open files +200 +200 ", (talker / "limits").read_text())
        assert panel.call("mode/quiet") == (True, "active")
        assert json.loads(panel.call("get_status")[1])["mode"] == "quiet"
        assert panel.call("down")[0]
        assert run.finish() == ExitCode.OK
        run.assert_gate_held()


@pytest.mark.thorough
def test_without_being_asked_it_only_says_how_it_is_and_nobody_says_it_in_its_place(
    tmp_path: Path, fresh_domain: int
) -> None:
    array = "diagnostic_msgs/msg/DiagnosticArray"
    edit = {
        "nodes/monitor": {
            "run": {"python": "tests.ros.supervisor.systems:Monitor"},
            "interface": {"subscriptions": [{"name": "/diagnostics", "type": array}]},
        }
    }
    manifest = pair(tmp_path, fresh_domain, edit=edit)
    with Panel(fresh_domain) as panel, up(manifest, runtime=tmp_path) as run:
        run.until("system", reached="active")
        # A node of the system reads what its supervisor says.
        run.until("log", line="diagnosed pair: /talker as active")
        assert json.loads(panel.call("get_status")[1])["phase"] == "active"
        services = {name for name, _ in panel.node.get_service_names_and_types()}
        assert {each for each in services if each.startswith("/lifecycle/")} == {
            "/lifecycle/pair/get_status"
        }
        judged = verb("verify", str(manifest), *ENOUGH, runtime=tmp_path)
        assert judged.returncode == ExitCode.OK, judged.stdout
        assert "_lifecycle_observer" not in judged.stdout
        assert run.of_kind("verdict")[-1]["verdict"]["verdict"] == "ok"
        begun = run.catch_up()
        false = [
            panel.node.create_publisher(String, "/lifecycle/pair/status", LATCHED),
            panel.node.create_publisher(DiagnosticArray, "/diagnostics", 10),
        ]
        run.until_verdict(
            lambda verdict: (
                [(each["rule"], each["node"]) for each in verdict["findings"]]
                == [("graph.undeclared-publisher", "/rqt_panel")] * len(false)
            ),
            since=begun,
        )
        panel.until(
            lambda: (
                [
                    each.name
                    for latest in panel.diagnostics[-1:]
                    for each in latest.status
                    if each.level == DiagnosticStatus.ERROR and "rqt_panel" in each.message
                ]
                == ["pair: graph.undeclared-publisher"]
            )
        )


def test_one_node_restarts_while_the_other_stays_active_and_both_through_the_same_gate(
    tmp_path: Path, fresh_domain: int
) -> None:
    with up(pair(tmp_path, fresh_domain), runtime=tmp_path) as run:
        run.until("system", reached="active")
        old, kept = run.pid_of("talker"), run.pid_of("listener")
        begun = len(run.events)
        restarted = verb("restart", "pair", "talker", runtime=tmp_path)
        assert (restarted.returncode, restarted.stderr) == (ExitCode.OK, "")
        run.until("system", reached="active")
        assert [each for each in requests(run, begun) if each[0] == "/listener"] == []
        assert [operation for _, operation in requests(run, begun)] == [
            "deactivate",
            "disconnect",
            "cleanup",
            "shutdown",
            "configure",
            "connect",
            "activate",
        ]
        assert_no_activate_before_a_new_gate(run, begun)
        assert run.pid_of("talker") != old
        assert run.pid_of("listener") == kept
        assert phases(tmp_path) == ("active", {"/talker": "active", "/listener": "active"})
        manifest = tmp_path / "pair.lifecycle.yaml"
        judged = verb("verify", str(manifest), *ENOUGH, runtime=tmp_path)
        assert judged.returncode == ExitCode.OK, judged.stdout

        old = {run.pid_of("talker"), run.pid_of("listener")}
        begun = run.catch_up()
        restarted = verb("restart", "pair", runtime=tmp_path)
        assert (restarted.returncode, restarted.stderr) == (ExitCode.OK, "")
        run.until("system", reached="active")
        reached = [e["reached"] for e in run.events[begun:] if e.get("event") == "system"]
        assert reached == ["connected", "verified", "active"]
        assert_no_activate_before_a_new_gate(run, begun)
        assert not old & {run.pid_of("talker"), run.pid_of("listener")}
        run.met("log", since=begun, line="heard hello")
        run.note_segments()
        assert verb("down", "pair", runtime=tmp_path).returncode == ExitCode.OK
        assert run.finish() == ExitCode.OK
        run.assert_nothing_left()


@pytest.mark.thorough
@pytest.mark.parametrize("orders", [("pause", "resume"), ("restart",)], ids="-".join)
def test_what_becomes_active_again_must_be_what_was_verified(
    tmp_path: Path, fresh_domain: int, orders: tuple[str, ...]
) -> None:
    flag = tmp_path / "unmark"
    edit = {
        "nodes/talker/flows": {"publishers": {"chatter": {"dscp": "EF"}}},
        "nodes/talker/run/environment/MISBEHAVE_IF": str(flag),
    }
    manifest = pair(tmp_path, fresh_domain, misbehave="activate:unmark", edit=edit)
    with up(manifest, runtime=tmp_path) as run:
        run.until("system", reached="active")
        begun = len(run.events)
        flag.touch()
        *before, last = orders
        for order in before:
            assert verb(order, "pair", runtime=tmp_path).returncode == ExitCode.OK
        refused = verb(last, "pair", runtime=tmp_path)
        assert refused.returncode == ExitCode.VIOLATED
        assert "flow.dscp-not-applied" in refused.stderr
        # It was active before anybody could know: the run is over, not held.
        assert run.finish() == ExitCode.VIOLATED
        assert_no_activate_before_a_new_gate(run, begun)
        reached = [each.get("reached") for each in run.events[begun:]]
        assert "active" not in reached
        assert run.verdict["run"]["reason"].startswith(
            "what became active is not what was verified; "
        )


@pytest.fixture(scope="module")
def active(tmp_path_factory: pytest.TempPathFactory, shared_domain: int) -> Iterator[Up]:
    """An active pair for tests that change nothing of it."""
    directory = tmp_path_factory.mktemp("active")
    with up(pair(directory, shared_domain), runtime=directory) as run:
        run.until("system", reached="active")
        yield run
        assert phases(directory) == ("active", {"/talker": "active", "/listener": "active"})
        run.signal(signal.SIGTERM)
        assert run.finish() == ExitCode.OK


def test_orders_that_name_nothing_are_refused(active: Up, shared_domain: int) -> None:
    refusals = {
        ("restart", "pair", "talkre"): (
            "cannot restart 'talkre': this supervisor runs no such node; "
            "it runs: /listener, /talker\n"
        ),
        ("restart", "pair", "talker", "listener"): (
            "cannot restart talker, listener at once; name one node, or none\n"
        ),
        ("pause", "pear"): (
            f"cannot find a running system 'pear'; running: pair@{shared_domain}\n"
        ),
    }
    for words, said in refusals.items():
        refused = verb(*words, runtime=active.runtime)
        assert (refused.returncode, refused.stderr) == (ExitCode.USAGE, said)


def test_a_second_up_of_the_same_system_is_refused(active: Up, shared_domain: int) -> None:
    manifest = pair(active.runtime, shared_domain)
    second = verb("up", str(manifest), runtime=active.runtime)
    assert second.returncode == ExitCode.USAGE
    assert second.stderr == (
        f"cannot bring up 'pair@{shared_domain}': another supervisor "
        f"(pid {active.process.pid}) runs it already; "
        f"end it first: lifecycle down pair@{shared_domain}\n"
    )


@pytest.mark.thorough
def test_a_changed_manifest_is_neither_restarted_nor_resumed_in_silence(
    tmp_path: Path, fresh_domain: int
) -> None:
    manifest = pair(tmp_path, fresh_domain)
    with up(manifest, runtime=tmp_path) as run:
        run.until("system", reached="active")
        begun = len(run.events)
        pair(tmp_path, fresh_domain, edit={"nodes/talker/log_level": "warn"})
        said = (
            f"{manifest}:{line_of(manifest, '  talker:')}:3: nodes.talker.log_level: "
            'was not set, is "warn"\n'
        )
        take = f"take the new one: lifecycle apply {manifest}"
        for words in (("restart",), ("restart", "listener")):
            refused = verb(words[0], str(manifest), *words[1:], runtime=tmp_path)
            assert refused.returncode == ExitCode.USAGE
            assert refused.stderr == (
                f"cannot restart 'pair': its manifest is not the one that runs:\n{said}"
                f"{take}; or keep what runs: lifecycle restart pair\n"
            )
        assert requests(run, begun) == []

        status = verb("status", str(manifest), runtime=tmp_path)
        assert status.returncode == ExitCode.OK
        notice = f"{manifest} is not the manifest that pair@{fresh_domain} runs:\n{said}"
        assert status.stderr == notice
        paused = verb("pause", str(manifest), runtime=tmp_path)
        assert (paused.returncode, paused.stderr) == (ExitCode.OK, notice)
        resumed = verb("resume", str(manifest), runtime=tmp_path)
        assert resumed.returncode == ExitCode.USAGE
        assert resumed.stderr == (
            f"cannot resume 'pair': its manifest is not the one that runs:\n{said}"
            f"{take}; or keep what runs: lifecycle resume pair\n"
        )
        assert verb("resume", "pair", runtime=tmp_path).returncode == ExitCode.OK

        listener, talker = run.pid_of("listener"), run.pid_of("talker")
        taken = verb("apply", str(manifest), runtime=tmp_path)
        assert (taken.returncode, taken.stderr) == (ExitCode.OK, "")
        run.catch_up()
        assert run.pid_of("listener") == listener
        assert run.pid_of("talker") != talker
        again = verb("restart", str(manifest), "listener", runtime=tmp_path)
        assert (again.returncode, again.stderr) == (ExitCode.OK, "")
        down = verb("down", str(manifest), runtime=tmp_path)
        assert (down.returncode, down.stderr) == (ExitCode.OK, "")
        run.assert_nothing_left()


def line_of(manifest: Path, start: str) -> int:
    lines = manifest.read_text().splitlines()
    return next(number for number, line in enumerate(lines, 1) if line.startswith(start))


def test_what_a_running_supervisor_cannot_take_is_refused_with_the_reason(
    active: Up, shared_domain: int
) -> None:
    directory, domain_id = active.runtime, shared_domain
    end = "; end it and start it anew: lifecycle down, then lifecycle up\n"
    edit = {"discovery/range": "subnet", "policy/ros_interface": "full"}
    manifest = pair(directory, domain_id, edit=edit)
    refused = verb("apply", str(manifest), runtime=directory)
    assert refused.returncode == ExitCode.USAGE
    assert refused.stderr == (
        f"cannot apply {manifest} to 'pair' while it runs: a running supervisor cannot "
        'change this:\ndiscovery.range: was "localhost", is "subnet"\n'
        'policy.ros_interface: was "read_only", is "full"' + end
    )
    pair(directory, domain_id + 1)
    refused = verb("restart", str(manifest), runtime=directory)
    assert refused.returncode == ExitCode.USAGE
    assert refused.stderr.startswith(
        f"cannot find a running system 'pair@{domain_id + 1}'; running: pair@{domain_id}"
    )


@pytest.mark.thorough
def test_a_parameter_file_that_changed_is_not_taken_in_silence(
    tmp_path: Path, fresh_domain: int
) -> None:
    parameters = tmp_path / "talker.yaml"
    parameters.write_text("/talker: {ros__parameters: {rate: 1}}\n")
    edit = {
        "nodes/talker/parameter_files": ["talker.yaml"],
        "nodes/talker/interface/parameters": {"rate": {"type": "int", "default_value": 1}},
    }
    manifest = pair(tmp_path, fresh_domain, edit=edit)
    with up(manifest, runtime=tmp_path) as run:
        run.until("system", reached="active")
        parameters.write_text("/talker: {ros__parameters: {rate: 2}}\n")
        for words in ((str(manifest),), ("pair",), ("pair", "talker")):
            refused = verb("restart", *words, runtime=tmp_path)
            assert refused.returncode == ExitCode.USAGE
            assert "nodes.talker.parameter_files: was [" in refused.stderr
        assert verb("restart", "pair", "listener", runtime=tmp_path).returncode == ExitCode.OK
        taken = verb("apply", str(manifest), runtime=tmp_path)
        assert (taken.returncode, taken.stderr) == (ExitCode.OK, "")
        assert verb("restart", "pair", runtime=tmp_path).returncode == ExitCode.OK


@pytest.mark.thorough
def test_a_mode_takes_a_node_out_and_another_brings_it_back_through_the_gate(
    tmp_path: Path, fresh_domain: int
) -> None:
    quiet = {
        "inactive": ["talker"],
        "parameters": {"listener": {"gain": 0.5}, "arm": {"gain": 2.0}},
    }
    arm = {"run": {"command": [sys.executable, ARM]}, "managed": False, "endpoints": "open"}
    gain = {"gain": {"type": "double", "default_value": 1.0}}
    edit = {
        "modes": {"normal": {}, "quiet": quiet, "stuck": {"parameters": {"arm": {"joints": [1]}}}},
        "nodes/listener/interface/parameters": gain,
        "nodes/arm": {**arm, "parameters": {"gain": 1.0, "joints": ["a", "b"]}},
    }
    with up(pair(tmp_path, fresh_domain, edit=edit), runtime=tmp_path) as run:
        run.until("system", reached="active")
        since = len(run.events)
        assert verb("mode", "pair", "quiet", runtime=tmp_path).returncode == ExitCode.OK
        entered = run.met("mode", since=since)
        assert entered["inactive"] == ["/talker"]
        assert entered["parameters"] == ["/arm", "/listener"]
        refused = verb("mode", "pair", "stuck", runtime=tmp_path)
        assert refused.returncode == ExitCode.BRING_UP_FAILED
        assert "'stuck': cannot set parameter 'joints' of '/arm': it says" in refused.stderr
        status = verb("status", "pair", runtime=tmp_path)
        assert status.returncode == ExitCode.OK
        assert "pair: active, mode quiet, verdict ok" in status.stdout
        since = len(run.events)
        assert verb("mode", "pair", "normal", runtime=tmp_path).returncode == ExitCode.OK
        assert run.met("gate", since=since)["nodes"] == ["/talker"]
        assert verb("mode", "pair", "loud", runtime=tmp_path).returncode == ExitCode.USAGE
        assert verb("down", "pair", runtime=tmp_path).returncode == ExitCode.OK
        assert run.finish() == ExitCode.OK
        run.assert_gate_held()


@pytest.mark.thorough
@pytest.mark.parametrize("shown_by", ["check", "diagnostics"])
def test_health_holds_who_waits_for_it_and_has_consequences_when_it_is_lost(
    tmp_path: Path, fresh_domain: int, shown_by: str
) -> None:
    mood = tmp_path / "mood"
    edit: dict[str, Any] = {
        "nodes/talker/run": {
            "python": "tests.ros.supervisor.systems:Moody",
            "environment": {"MOOD": str(mood)},
        },
        "nodes/talker/health": {"check": True, "interval_s": 0.1},
        "nodes/listener/after": {"talker": "healthy"},
        "on_violation": {"node.unhealthy": "deactivate"},
    }
    said = "in a mood"
    if shown_by == "diagnostics":
        said = "'talker: mood': in a mood"
        edit["nodes/talker/run"]["python"] = "tests.ros.supervisor.systems:Diagnosed"
        edit["nodes/talker/health"] = {"diagnostics": ["talker: *"]}
        edit["nodes/talker/interface/publishers"] = [
            {"name": "chatter", "type": "std_msgs/msg/String"},
            {"name": "diagnostics", "type": "diagnostic_msgs/msg/DiagnosticArray"},
        ]
    with up(pair(tmp_path, fresh_domain, edit=edit), runtime=tmp_path) as run:
        run.until("node", node="/talker", reach="active")
        deadline = time.monotonic() + BOUND_S
        waits = f"waits to activate until /talker is healthy: {said}"
        while waits not in (status := verb("status", "pair", runtime=tmp_path).stdout):
            assert time.monotonic() < deadline, status
        mood.touch()
        run.until("node", node="/listener", reach="active")
        run.until("system", reached="active")
        mood.unlink()
        taken = run.until("consequence")
        assert (taken["rule"], taken["nodes"]) == ("node.unhealthy", ["/talker"])
        assert taken["message"] == f"node /talker is not healthy: {said}"
        mood.touch()
        assert verb("resume", "pair", runtime=tmp_path).returncode == ExitCode.OK
        run.until("system", reached="active")


def test_a_supervisor_that_stands_still_is_named_and_ordered_nothing(
    tmp_path: Path, fresh_domain: int
) -> None:
    with up(pair(tmp_path, fresh_domain), runtime=tmp_path) as run:
        run.until("system", reached="active")
        run.signal(signal.SIGSTOP)
        try:
            for order in ("down", "pause"):
                done = verb(order, "pair", runtime=tmp_path)
                assert done.returncode == ExitCode.USAGE
                pid = run.process.pid
                assert f"its supervisor (pid {pid}) does not answer" in done.stderr
                assert f"kill -CONT {pid}" in done.stderr
        finally:
            run.signal(signal.SIGCONT)
        assert phases(tmp_path)[0] == "active"
        assert verb("down", "pair", runtime=tmp_path).returncode == ExitCode.OK
