"""`lifecycle up --hosts` over real ssh: all hosts of a system from one place, cut off and killed.

Host A has a part itself, which needs no ssh. The coordinator owns no supervisor: neither its death
nor a cut link ends one.
"""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from lifecycle.errors import ExitCode
from lifecycle.run_directory import is_held
from lifecycle.supervisor.control.client import status
from lifecycle.verify import Outcome
from tests.net.hosts import Hosts
from tests.net.running import article, run_directory
from tests.net.sshd import Ssh, lacking
from tests.ros.supervisor.running import BOUND_S, ROOT, Event, Up, left_of

pytestmark = pytest.mark.skipif(bool(lacking()), reason=lacking() or "-")

_ROOTED = f"cd {shlex.quote(str(ROOT))} && {shlex.quote(sys.executable)} -m lifecycle.cli"
REMOTE = (
    'touch "$XDG_RUNTIME_DIR/asked"; while test -e "$XDG_RUNTIME_DIR/hold"; do sleep 0.02; done; '
    f"{_ROOTED}"
)
"""A login shell that takes its time while a file is there."""

_STRING = "std_msgs/msg/String"
_STEPS = ("start_s", "configure_s", "connect_s", "activate_s", "deactivate_s")


class Fleet:
    """Hosts on one switch, an sshd on all but the first, and a manifest for them."""

    def __init__(self, hosts: Hosts, directory: Path, names: str) -> None:
        self.directory = directory
        self.hosts = dict(zip(names, hosts.bridged(*names.upper()), strict=True))
        self.ssh = Ssh(directory / "ssh")
        for name, host in self.hosts.items():
            host.environment(self.runtime(name))
            if name != "a":
                self.ssh.serve(host, self.runtime(name))
        self._stack = contextlib.ExitStack()

    def runtime(self, name: str) -> Path:
        return self.directory / name

    def manifest(self, more: Mapping[str, object] | None = None, **environment: str) -> Path:
        """Write the manifest of the article; further hosts have a subscriber, too.

        Args:
            more: values by path, see `article`.
            environment: of node n2.
        """
        folder = self.directory / "manifest"
        folder.mkdir(exist_ok=True)
        edit: dict[str, object] = {**(more or {})}
        edit |= {f"nodes/n2/run/environment/{key}": value for key, value in environment.items()}
        # On a busy machine a cut is said seconds later than it could be: no step is late by then.
        edit["nodes/n2/timeouts"] = dict.fromkeys(_STEPS, 25)
        addresses = [each.ipv4 for each in self.hosts.values()]
        for name, address in list(zip(self.hosts, addresses, strict=True))[2:]:
            edit[f"machines/{name}"] = {"address": address}
            edit[f"nodes/n_{name}"] = {
                "run": {"python": "tests.net.systems:Sink"},
                "machine": name,
                "interface": {
                    "subscriptions": [
                        {"name": topic, "type": _STRING, "qos": "sensor_data"}
                        for topic in ("video", "battery")
                    ]
                },
            }
        return article(folder, *addresses[:2], edit=edit)

    def up(self, manifest: Path, *options: str, remote: str = REMOTE) -> Up:
        up = Up(
            manifest,
            *("--hosts", "--remote-command", remote),
            *options,
            runtime=self.runtime("a"),
            through=self.hosts["a"].command(guarded=True),
            variables={**self.hosts["a"].environment(self.runtime("a"), {}), **self.ssh.variables},
        )
        self._stack.callback(up.close)
        return up

    def verb(self, name: str, manifest: Path, *options: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            self.hosts["a"].command(
                *(sys.executable, "-m", "lifecycle.cli", name, str(manifest)),
                *("--hosts", "--remote-command", REMOTE, *options),
            ),
            env={
                **self.hosts["a"].environment(self.runtime("a")),
                **self.ssh.variables,
            },
            capture_output=True,
            text=True,
            timeout=BOUND_S,
            check=False,
        )

    def runs(self, name: str) -> bool:
        return is_held(run_directory(self.runtime(name), name))

    def close(self) -> None:
        self._stack.close()


@pytest.fixture
def two(hosts: Hosts, tmp_path: Path) -> Iterator[Fleet]:
    with contextlib.closing(Fleet(hosts, tmp_path, "ab")) as fleet:
        yield fleet


@pytest.fixture
def three(hosts: Hosts, tmp_path: Path) -> Iterator[Fleet]:
    with contextlib.closing(Fleet(hosts, tmp_path, "abc")) as fleet:
        yield fleet


def _active(up: Up) -> Event:
    return up.until("active")


def _until_ok(fleet: Fleet, name: str) -> None:
    """Wait until a host's supervisor sees nothing wrong."""
    deadline = time.monotonic() + BOUND_S
    while (seen := status(run_directory(fleet.runtime(name), name))).verdict is not Outcome.OK:
        assert time.monotonic() < deadline, f"{name}: {seen.phase}: {seen.not_ok}"
        time.sleep(0.02)


def _until_runs(fleet: Fleet, name: str) -> None:
    """Wait until a host's supervisor has its run directory: it may be said to be started before."""
    deadline = time.monotonic() + BOUND_S
    while not fleet.runs(name):
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_three_hosts_come_up_and_are_ended_from_one_place(three: Fleet) -> None:
    up = three.up(three.manifest())
    assert up.until("hosts")["destinations"] == {
        "a": "this host",
        **{name: three.hosts[name].ipv4 for name in "bc"},
    }
    assert sorted(_active(up)["hosts"]) == ["a", "b", "c"]
    # The clocks of the hosts are one.
    clocks = {each["host"]: each for each in up.of_kind("clock")}
    assert sorted(clocks) == ["a", "b", "c"]
    assert all(not each["differs"] for each in clocks.values())
    assert all(abs(each["offset_s"]) <= each["uncertainty_s"] + 0.005 for each in clocks.values())
    assert {each["host"] for each in up.of_kind("gate")} == {"a", "b", "c"}
    for name in "abc":
        _until_ok(three, name)
    shown = three.verb("status", up.manifest, "--format", "json")
    assert shown.returncode == ExitCode.OK, shown.stderr
    found = json.loads(shown.stdout)
    assert (found["system"], found["verdict"]) == ("article", "ok")
    hosts = {each["host"]: each for each in found["hosts"]}
    assert [*hosts] == ["a", "b", "c"]
    assert {each["node"] for each in hosts["c"]["status"]["nodes"]} == {"/n_c"}
    assert {each["status"]["phase"] for each in hosts.values()} == {"active"}
    assert not any(each["clock"]["differs"] for each in hosts.values())
    up.signal(signal.SIGTERM)
    assert up.finish() == ExitCode.OK, up.said()
    end = up.events[-1]
    assert (end["event"], end["exit_codes"]) == ("end", {"a": 0, "b": 0, "c": 0})
    assert all("host" in each for each in up.events)
    assert left_of(up.mark) == []
    for name in "abc":
        assert [*(three.runtime(name) / "lifecycle").iterdir()] == []


def test_what_is_only_to_be_verified_waits_for_all_hosts_and_is_in_one_report(two: Fleet) -> None:
    report = two.directory / "report.json"
    up = two.up(two.manifest(), "--until", "verified", "--report", str(report))
    assert up.finish() == ExitCode.OK, (up.events[-1], up.said())
    (reached,) = up.of_kind("reached")
    assert (reached["reached"], sorted(reached["hosts"])) == ("verified", ["a", "b"])
    assert up.of_kind("gate") == []
    found = json.loads(report.read_text())
    assert found["verdict"] == "ok"
    assert found["run"] == {"reason": "done", "reached": "verified", "exit_code": 0}
    assert {name: each["verdict"] for name, each in found["machines"].items()} == {
        "a": "ok",
        "b": "ok",
    }
    assert len(found["flows"]) == 2
    assert left_of(up.mark) == []


HOLDS = {
    "starting": "START",
    "configuring": "CONFIGURE",
    "connecting": "CONNECT",
    "activating": "ACTIVATE",
    "restarting": "CONFIGURE",
    "ending": "DEACTIVATE",
}
"""What node /n2 of host B waits in for the file `go`, by stage."""


class Stage:
    """A bring-up that is held in one stage of host B, until `release`."""

    def __init__(self, fleet: Fleet, name: str) -> None:
        self.fleet, self.name = fleet, name
        self.go = fleet.directory / "go"
        self.shell = fleet.runtime("b") / "hold"
        held = {f"HOLD_{HOLDS[name]}_FILE": str(self.go)} if name in HOLDS else {}
        edit: dict[str, object] = {}
        if name == "restarting":
            self.go.touch()
            edit = {"nodes/n2/restart": "on-failure", "nodes/n2/restart_sec": 0.1}
        elif name == "verifying":
            edit = {"nodes/n1/run/environment/HOLD_CONFIGURE_FILE": str(self.go)}
        elif name == "asking":
            self.shell = fleet.runtime("c") / "hold"  # until it answers, no host is asked
        if name in {"ssh", "asking"}:
            self.shell.touch()
        self.manifest = fleet.manifest(edit, **held)

    def reach(self, up: Up) -> None:
        """Wait until host B is there."""
        if self.name == "ssh":
            deadline = time.monotonic() + BOUND_S
            while not self.shell.with_name("asked").exists():
                assert time.monotonic() < deadline
                time.sleep(0.02)
        elif self.name == "asking":
            up.until("host", host="b", state="connected")
        elif self.name == "beginning":
            up.until("host", host="b", state="started")
        elif self.name == "starting":
            up.until("process", host="b", state="starting")
        elif self.name == "verifying":
            up.until("system", host="b", reached="connected")
        elif self.name in {"configuring", "connecting", "activating"}:
            operation = HOLDS[self.name].lower()
            up.until("request", host="b", operation=operation)
        else:
            _active(up)
            since = up.catch_up()
            if self.name == "restarting":
                self.go.unlink()
                os.kill(up.pid_of("n2"), signal.SIGKILL)
                up.met("request", host="b", operation="configure", since=since)
            elif self.name == "ending":
                up.signal(signal.SIGTERM)
                up.until("request", host="b", operation="deactivate")

    def release(self) -> None:
        self.shell.unlink(missing_ok=True)
        self.go.touch()


def _nothing_left(fleet: Fleet, *ups: Up) -> None:
    for each in ups:
        assert left_of(each.mark, BOUND_S / 2) == []
    for name in fleet.hosts:
        assert [*(fleet.runtime(name) / "lifecycle").glob("*")] == []


@pytest.mark.parametrize("name", ["ssh", "asking", "beginning", *HOLDS, "verifying", "active"])
def test_a_host_that_is_cut_off_runs_on_and_is_followed_once_it_is_back(
    three: Fleet, name: str
) -> None:
    stage = Stage(three, name)
    up = three.up(stage.manifest)
    stage.reach(up)
    three.hosts["b"].ip("link", "set", "e0", "down")
    if name == "ssh":
        time.sleep(1)  # a connection that is being made is not said to be cut
    else:
        up.until("host", host="b", state="cut")
        if name == "asking":
            assert not three.runs("b")
        else:
            _until_runs(three, "b")  # on a busy machine it is cut off before it has a directory
    if name == "active":
        shown = three.verb("status", stage.manifest)
        assert shown.returncode == ExitCode.VIOLATED
        assert "unverifiable: b (" in shown.stdout
        assert "a | article: active" in shown.stdout
    three.hosts["b"].ip("link", "set", "e0", "up")
    stage.release()
    if name == "ending":
        assert up.finish() == ExitCode.OK, (up.events[-1], up.said())
        assert up.events[-1]["exit_codes"] == {"a": 0, "b": 0, "c": 0}
    else:
        state = "started" if name in {"ssh", "asking"} else "healed"
        healed = up.until("host", host="b", state=state)
        if state == "healed":
            assert healed["pid"] == up.met("host", host="b", state="started")["pid"]
        if name not in {"active", "restarting"}:
            up.met("active", host="")
        for each in "abc":
            _until_ok(three, each)
        up.signal(signal.SIGTERM)
        assert up.finish() == ExitCode.OK, (up.events[-1], up.said())
    assert len([each for each in up.of_kind("run") if each["host"] == "b"]) <= 1
    _nothing_left(three, up)


@pytest.mark.parametrize("name", ["ssh", "beginning", *HOLDS, "verifying", "active"])
def test_a_coordinator_that_is_killed_leaves_all_running_to_be_followed_and_ended(
    two: Fleet, name: str
) -> None:
    stage = Stage(two, name)
    first = two.up(stage.manifest)
    stage.reach(first)
    first.process.kill()  # nsenter and env became the coordinator by exec
    first.process.wait(BOUND_S)
    first.catch_up()
    if name == "ssh":
        assert not two.runs("a")
        stage.release()
        _nothing_left(two, first)
        return
    assert two.runs("b") or name == "beginning"
    stage.release()
    if name != "ending":
        # All were asked at once; it may be killed before it has said of host A that it started.
        started = (each for each in first.of_kind("host") if each["state"] == "started")
        pids = {each["host"]: each["pid"] for each in started}
        assert "b" in pids
        second = two.up(stage.manifest)
        attached = {each: second.until("host", state="attached") for each in "ab"}.values()
        assert pids.items() <= {each["host"]: each["pid"] for each in attached}.items()
        _active(second)
        if name == "active":
            second.signal(signal.SIGHUP)
            assert second.finish() == ExitCode.HUNG_UP
            assert two.runs("a")
            assert two.runs("b")
        else:
            for each in "ab":
                _until_ok(two, each)
            second.signal(signal.SIGTERM)
            assert second.finish() == ExitCode.OK, (second.events[-1], second.said())
        first = second
    done = two.verb("down", stage.manifest)
    assert done.returncode == ExitCode.OK, done.stderr
    _nothing_left(two, first)


def test_what_is_wrong_with_a_host_is_one_error_with_the_next_step(two: Fleet) -> None:
    manifest = two.manifest()

    def failed(remote: str = REMOTE) -> Event:
        up = two.up(manifest, remote=remote)
        found = up.until("host", host="b", state="failed")
        assert up.finish() == ExitCode.BRING_UP_FAILED
        assert up.of_kind("run") == []
        return found

    absent = failed("/opt/nowhere/lifecycle")
    assert "its shell cannot run '/opt/nowhere/lifecycle'" in absent["message"]
    assert "--remote-command" in absent["hint"]
    two.ssh.write_config("stranger")
    assert "Permission denied" in failed()["message"]
    two.ssh.write_config("user")
    (two.directory / "ssh" / "known_hosts").write_text("")
    assert "Host key verification failed" in failed()["message"]
