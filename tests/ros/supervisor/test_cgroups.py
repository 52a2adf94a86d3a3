"""Processes with `run.resources` on the real kernel: cgroups made, joined, counted and removed.

Whichever controllers are there: a kernel that has them in hierarchies of version 1 has none of them
in that of version 2, and yet groups and what they use of the processors.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest

from lifecycle.errors import ExitCode
from lifecycle.supervisor.processes.cgroup import CgroupError, own_cgroup
from tests.ros.supervisor.running import BOUND_S, ROOT, Up, left_of, marked, pair, up, verb

LIMITS = {
    "memory": ("memory.max", str(64 * 2**20)),
    "hugetlb": ("hugetlb.2MB.max", "0"),
    "pids": ("pids.max", "64"),
    "cpu": ("cpu.max", "50000 100000"),
}
"""By controller, a file and a limit that it takes."""

FIX = (
    "start it where it is: `Delegate=yes` in its systemd unit, or "
    f"`systemd-run{' --user' if os.geteuid() else ''} --scope -p Delegate=yes lifecycle up ...`"
)

THROUGH = ("sh", "-c", 'echo $$ > "$0/cgroup.procs" && exec "$@"')
"""Begins a command line, followed by a cgroup, that is run in it."""


@contextlib.contextmanager
def delegated() -> Iterator[Path]:
    """Make a cgroup that is delegated to who is started in it."""
    try:
        made = own_cgroup() / f"test-{uuid.uuid4().hex[:8]}"
        made.mkdir()
    except (CgroupError, OSError) as error:
        pytest.skip(f"needs a cgroup v2 in which groups can be made: {error}")
    try:
        yield made
    finally:
        left = below(made)
        for each in sorted(made.rglob("*/"), reverse=True):
            each.rmdir()
        made.rmdir()
        assert left == []


@pytest.fixture
def group() -> Iterator[Path]:
    """A cgroup that is delegated to who is started in it."""
    with delegated() as made:
        yield made


def below(group: Path) -> list[str]:
    """Return the groups in a group."""
    return sorted(str(each.relative_to(group)) for each in group.rglob("*") if each.is_dir())


def group_of(pid: int, group: Path) -> str:
    """Return in which group below `group` a process is; `.` for that itself."""
    lines = Path(f"/proc/{pid}/cgroup").read_text().splitlines()
    path = next(each[3:] for each in lines if each.startswith("0::"))
    return path.partition(group.name)[2].lstrip("/") or "."


def sleeps(run: Up) -> list[int]:
    """Return the pids of what the talker has left running."""
    return [each.pid for each in marked(run.mark) if each.name() == "sleep"]


def test_a_process_and_what_it_starts_have_a_group_that_is_counted_and_goes_with_them(
    tmp_path: Path, fresh_domain: int, group: Path
) -> None:
    edit = {
        "nodes/talker/run/resources": {},
        "nodes/talker/restart": "on-failure",
        "nodes/talker/restart_sec": 0.1,
    }
    manifest = pair(tmp_path, fresh_domain, misbehave="configure:fork", edit=edit)
    with up(manifest, runtime=tmp_path, through=(*THROUGH, str(group))) as run:
        run.until("system", reached="active")
        (name,) = {each.split("/")[0] for each in below(group)}
        assert name.startswith("lifecycle-")
        talker, (started,) = run.pid_of("talker"), sleeps(run)
        assert group_of(talker, group) == group_of(started, group) == f"{name}/process-talker"
        # Nothing is limited, so the supervisor and its other processes stay where they are.
        assert group_of(run.process.pid, group) == group_of(run.pid_of("listener"), group)

        status = verb("status", "pair", "--format", "json", runtime=tmp_path).stdout
        listening, talking = json.loads(status)["nodes"]
        if listening["node"] == "/talker":
            listening, talking = talking, listening
        assert talking["cgroup_cpu_s"] > 0
        assert listening["cgroup_cpu_s"] is None
        assert talking["cgroup_tasks"] is None or talking["cgroup_tasks"] > 1
        text = verb("status", "pair", runtime=tmp_path).stdout
        assert " s CPU" in next(each for each in text.splitlines() if each.startswith("/talker"))

        # What it leaves behind ends with it, also in a session of its own.
        seen = len(run.events)
        os.kill(talker, signal.SIGKILL)
        run.until("restarted")
        run.met("system", since=seen, reached="active")
        assert run.pid_of("talker") != talker
        assert group_of(run.pid_of("talker"), group) == f"{name}/process-talker"
        assert started not in sleeps(run)
        run.signal(signal.SIGTERM)
        assert run.finish() == ExitCode.OK
        run.assert_nothing_left()
    assert below(group) == []


@pytest.mark.parametrize("ends", ["down", "up"])
def test_what_a_killed_supervisor_leaves_is_removed_by_the_next(
    tmp_path: Path, fresh_domain: int, group: Path, ends: str
) -> None:
    edit = {"nodes/talker/run/resources": {}}
    manifest = pair(tmp_path, fresh_domain, misbehave="configure:fork", edit=edit)
    with (
        delegated() as other,
        up(manifest, runtime=tmp_path, through=(*THROUGH, str(group))) as run,
    ):
        run.until("system", reached="active")
        run.signal(signal.SIGKILL)
        run.finish()
        assert below(group) != []
        if ends == "down":
            done = verb("down", "pair", runtime=tmp_path)
            assert done.returncode == ExitCode.OK, done.stderr
        else:
            # Not in the same one: it has no processes while groups in it have controllers.
            through = (*THROUGH, str(other))
            with up(manifest, "--until", "connected", runtime=tmp_path, through=through) as again:
                assert again.finish() == ExitCode.OK
        assert below(group) == below(other) == []
        assert (group / "cgroup.subtree_control").read_text().split() == []
        assert left_of(run.mark) == []


def test_a_controller_that_is_not_there_is_refused_before_anything_is_started(
    tmp_path: Path, fresh_domain: int, group: Path
) -> None:
    there = (group / "cgroup.controllers").read_text().split()
    if "pids" in there:
        pytest.skip("the controller pids is delegated to this user's groups")
    manifest = pair(tmp_path, fresh_domain, edit={"nodes/talker/run/resources": {"tasks_max": 64}})
    line = next(
        number
        for number, text in enumerate(manifest.read_text().splitlines(), 1)
        if "resources:" in text
    )
    with up(manifest, runtime=tmp_path, through=(*THROUGH, str(group))) as run:
        assert run.finish() == ExitCode.USAGE
        assert run.of_kind("process") == []
        assert run.said() == (
            f"{manifest}:{line}:7: cannot give process 'talker' a cgroup for its 'run.resources': "
            f"the controller 'pids' is not delegated to cgroup {str(group)!r} of this supervisor; "
            f"available there: {', '.join(sorted(there)) or 'none'}; {FIX}\n"
        )
    assert below(group) == []


_LIMITED = """
import json, os, subprocess, sys
from pathlib import Path
from types import SimpleNamespace
from lifecycle.supervisor.processes.cgroup import CgroupError, RunCgroup, own_cgroup

name, file, text = sys.argv[1:4]
own = own_cgroup()
resources = SimpleNamespace(
    at=SimpleNamespace(file="a.lifecycle.yaml", line=5, column=7),
    controllers=lambda: {name}, settings=lambda: ((file, text),), memory_max_mib=None,
)
process = SimpleNamespace(name="a", run=SimpleNamespace(resources=resources))
noted = []
recorder = SimpleNamespace(run_id="1234", note_cgroup=lambda *words: noted.append(words))
# As a fork server with a process that has no resources.
helper = subprocess.Popen(["sh", "-c", "sleep 100 & echo $!; wait"], stdout=subprocess.PIPE)
node = int(helper.stdout.readline())
family = SimpleNamespace(pid=helper.pid, family=lambda: {node})

def where(pid):
    lines = Path(f"/proc/{pid}/cgroup").read_text().splitlines()
    path = next(each[3:] for each in lines if each.startswith("0::"))
    return path.partition(own.name)[2].lstrip("/") or "."

def enabled(path):
    return (path / "cgroup.subtree_control").read_text().split()

run = RunCgroup(own, recorder)
try:
    run.prepare([process], family)
except CgroupError as error:
    print(json.dumps({"error": str(error), "at": where("self"), "node": where(node)}))
    os.kill(node, 9)
    helper.wait()
    raise SystemExit(1)
try:
    group = run.make("a b", resources)
    again = run.make("a b", resources)
    inside = subprocess.Popen(["sh", "-c", 'echo 0 > "$0" && exec sleep 100', group.procs])
    while where(inside.pid) == where("self"):
        pass
    during = {
        "noted": [each[1] for each in noted],
        "own": enabled(own), "run": enabled(own / "lifecycle-1234"),
        "at": where("self"), "node": where(node), "inside": where(inside.pid),
        "again": again.path.name, "limit": (group.path / file).read_text().strip(),
    }
finally:
    left = run.close()
    inside.wait()
    after = {"own": enabled(own), "at": where("self"), "node": where(node)}
    os.kill(node, 9)
    helper.wait()
print(json.dumps({"during": during, "after": after, "left": left, "ended": inside.returncode}))
"""


@pytest.fixture
def controller(group: Path) -> Iterator[str]:
    """One that is delegated to the group, by us if need be."""
    there = (group / "cgroup.controllers").read_text().split()
    parent = group.parent / "cgroup.subtree_control"
    enabled = ""
    if not set(LIMITS) & set(there):
        known = (group.parent / "cgroup.controllers").read_text().split()
        if not set(LIMITS) & set(known):
            pytest.skip("the hierarchy of version 2 has no controller")
        enabled = next(each for each in LIMITS if each in known)
        try:
            parent.write_text(f"+{enabled}")
        except OSError as error:
            pytest.skip(f"needs a parent that can have controllers: {error}")
        there = [enabled]
    try:
        if (group / "cgroup.type").read_text() != "domain\n":
            # With this test's own processes, its parent can have threads below it only.
            pytest.skip("needs a parent without processes, or the root of the hierarchy")
        yield next(each for each in LIMITS if each in there)
    finally:
        if enabled:
            parent.write_text(f"-{enabled}")


def limited(group: Path, controller: str) -> tuple[int, dict[str, object]]:
    """Run the above in a group; return its exit code and what it saw."""
    done = subprocess.run(
        (*THROUGH, str(group), sys.executable, "-c", _LIMITED, controller, *LIMITS[controller]),
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        timeout=BOUND_S,
    )
    assert done.stdout, done.stderr
    return done.returncode, json.loads(done.stdout)


def test_a_supervisor_makes_room_for_limits_and_comes_back(group: Path, controller: str) -> None:
    code, seen = limited(group, controller)
    assert (code, seen["left"], seen["ended"]) == (0, "", -signal.SIGTERM)
    during = seen["during"]
    assert isinstance(during, dict)
    assert controller in during["own"]
    assert controller in during["run"]
    assert (during["at"], during["node"], during["inside"], during["again"]) == (
        "lifecycle-1234/supervisor",
        "lifecycle-1234/supervisor",
        "lifecycle-1234/process-a_b",
        "process-a_b.2",
    )
    assert during["limit"] == LIMITS[controller][1]
    # What is enabled was noted before.
    assert during["noted"][-1] == during["own"]
    assert seen["after"] == {"own": [], "at": ".", "node": "."}
    assert below(group) == []


def test_a_group_with_other_processes_can_have_no_limits_below_it(
    group: Path, controller: str
) -> None:
    with subprocess.Popen((*THROUGH, str(group), "sleep", "100")) as other:
        try:
            procs = group / "cgroup.procs"
            while str(other.pid) not in procs.read_text().split():
                assert other.poll() is None
            code, seen = limited(group, controller)
        finally:
            other.kill()
    assert (code, seen["at"], seen["node"]) == (1, ".", ".")
    assert seen["error"] == (
        "a.lifecycle.yaml:5:7: cannot give process 'a' a cgroup for its 'run.resources': cgroup "
        f"{str(group)!r} of this supervisor has other processes, too (pid {other.pid}), and then "
        f"none below it can have controllers; allowed is a cgroup of its own; {FIX}"
    )
    assert below(group) == []
