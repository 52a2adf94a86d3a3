"""Where cgroups are, what is refused, and what they say of their processes; without a kernel's."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from lifecycle.manifest import Position, Resources, Run, RunKind
from lifecycle.plan import PlannedProcess
from lifecycle.run_directory import ChildRecord, RunDirectory, read_record
from lifecycle.supervisor.processes.cgroup import (
    CgroupError,
    ProcessCgroup,
    RunCgroup,
    own_cgroup,
    pids_left,
    remove_left,
)
from lifecycle.supervisor.processes.process import ProcessExit
from lifecycle.supervisor.processes.usage import CgroupUse, resource_use

AT = Position(file="robot.lifecycle.yaml", line=7, column=12)
FIX = (
    "start it where it is: `Delegate=yes` in its systemd unit, or "
    f"`systemd-run{' --user' if os.geteuid() else ''} --scope -p Delegate=yes lifecycle up ...`"
)


def process(name: str = "arm", **limits: int) -> PlannedProcess:
    run = Run(kind=RunKind.COMMAND, command=("arm",), resources=Resources(at=AT, **limits))
    return PlannedProcess(name=name, machine="", run=run, nodes=(name,), argv=("arm",))


class Recorder:
    """Notes a run's cgroup; and a fork server that has started nothing."""

    run_id = "ab12"

    def __init__(self) -> None:
        self.noted: list[tuple[str, tuple[str, ...]]] = []

    pid = 0

    def family(self) -> frozenset[int]:
        return frozenset()

    def note_cgroup(self, path: str, controllers: Sequence[str]) -> None:
        self.noted.append((path, tuple(controllers)))


def proc(tmp_path: Path, groups: str, *mounts: str) -> Path:
    """Write what a process has in /proc of itself."""
    folder = tmp_path / "proc"
    folder.mkdir()
    (folder / "cgroup").write_text(groups)
    lines = ["23 1 254:0 / / rw,relatime shared:1 - ext4 /dev/root rw", *mounts]
    (folder / "mountinfo").write_text("".join(f"{each}\n" for each in lines))
    return folder


def mount(root: str, place: Path, kind: str = "cgroup2") -> str:
    escaped = str(place).replace(" ", "\\040")
    return f"41 31 0:38 {root} {escaped} rw,nosuid shared:9 master:2 - {kind} cgroup rw"


def shown(place: Path) -> Path:
    """Make a cgroup."""
    place.mkdir(parents=True)
    (place / "cgroup.procs").write_text("")
    return place


@pytest.mark.parametrize(
    ("groups", "root", "place"),
    [
        ("0::/user.slice/run-1.scope\n", "/", "user.slice/run-1.scope"),
        ("0::/\n", "/", "."),
        ("12:pids:/a\n4:memory:/b\n1:name=systemd:/c\n0::/d\n", "/", "d"),
        ("0::/docker/f00/init\n", "/docker/f00", "init"),
        ("0::/docker/f00\n", "/docker/f00", "."),
    ],
)
def test_the_own_cgroup_is_found_by_what_the_kernel_says(
    tmp_path: Path, groups: str, root: str, place: str
) -> None:
    unified = tmp_path / "sys fs" / "unified"
    own = shown(unified / place)
    v1 = shown(tmp_path / "v1" / place)
    folder = proc(
        tmp_path,
        groups,
        mount("/", tmp_path / "v1", "cgroup"),
        mount("/other", v1),
        mount(root, unified),
    )
    assert own_cgroup(folder) == own


def test_of_several_mounts_one_that_can_be_written_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed, open_ = shown(tmp_path / "closed"), shown(tmp_path / "open")
    # As of a mount that is read-only, for root as well.
    monkeypatch.setattr(os, "access", lambda path, _: Path(path) != closed)
    assert own_cgroup(proc(tmp_path, "0::/\n", mount("/", closed), mount("/", open_))) == open_


@pytest.mark.parametrize(
    ("groups", "message"),
    [
        ("4:memory:/b\n1:name=systemd:/c\n", "this kernel has no cgroup v2"),
        ("0::/a\n", "no cgroup2 file system shows its cgroup '/a'"),
        ("0::/../a\n", "no cgroup2 file system shows its cgroup '/../a'"),
    ],
)
def test_where_there_is_no_own_cgroup_it_is_said(tmp_path: Path, groups: str, message: str) -> None:
    shown(tmp_path / "unified")
    shown(tmp_path / "a")
    with pytest.raises(CgroupError) as raised:
        own_cgroup(proc(tmp_path, groups, mount("/", tmp_path / "unified")))
    assert raised.value.message == message


def test_a_controller_that_is_not_delegated_is_named_with_what_is(tmp_path: Path) -> None:
    own = shown(tmp_path / "own")
    (own / "cgroup.controllers").write_text("cpuset cpu pids\n")
    recorder = Recorder()
    asking = [process("eye", tasks_max=20), process("arm", memory_max_mib=64, cpu_weight=50)]
    with pytest.raises(CgroupError) as raised:
        RunCgroup(own, recorder).prepare(asking, recorder)
    assert str(raised.value) == (
        "robot.lifecycle.yaml:7:12: cannot give process 'arm' a cgroup for its 'run.resources': "
        f"the controller 'memory' is not delegated to cgroup {str(own)!r} of this supervisor; "
        f"available there: cpu, cpuset, pids; {FIX}"
    )
    assert recorder.noted == []
    assert sorted(each.name for each in own.iterdir()) == ["cgroup.controllers", "cgroup.procs"]


def test_a_cgroup_in_which_none_can_be_made_is_refused(tmp_path: Path) -> None:
    own = tmp_path / "gone"
    with pytest.raises(CgroupError) as raised:
        RunCgroup(own, Recorder()).prepare([process()], Recorder())
    assert str(raised.value) == (
        "robot.lifecycle.yaml:7:12: cannot give process 'arm' a cgroup for its 'run.resources': "
        f"cgroup {str(own)!r} of this supervisor is not delegated to it: No such file or "
        f"directory; {FIX}"
    )


def test_the_cgroup_of_a_run_is_in_its_record_before_it_is_made(tmp_path: Path) -> None:
    directory = RunDirectory.acquire(tmp_path / "runs", "robot@0", "ab12")
    try:
        child = ChildRecord(name="arm", pid=os.getpid(), start_ticks=1)
        directory.record((child,))
        directory.note_cgroup("/sys/fs/cgroup/a/lifecycle-ab12", ["cpu", "pids"])
        record = read_record(directory.path)
        assert record is not None
        assert (record.cgroup, record.controllers) == (
            "/sys/fs/cgroup/a/lifecycle-ab12",
            ("cpu", "pids"),
        )
        assert record.children == (child,)
        # It stays in what is written later.
        directory.record(())
        record = read_record(directory.path)
        assert record is not None
        assert record.cgroup == "/sys/fs/cgroup/a/lifecycle-ab12"
    finally:
        directory.release()


def test_only_the_cgroup_of_the_run_itself_is_looked_at_and_removed(tmp_path: Path) -> None:
    others, own = shown(tmp_path / "lifecycle-cd34"), shown(tmp_path / "lifecycle-ab12")
    for each in (others, own):
        (each / "cgroup.procs").write_text("41\n42\n")
    (tmp_path / "no cgroup" / "lifecycle-ab12").mkdir(parents=True)
    assert pids_left(str(own), "ab12") == {41, 42}
    for path in (others, tmp_path, tmp_path / "no cgroup" / "lifecycle-ab12", tmp_path / "gone"):
        assert pids_left(str(path), "ab12") == frozenset()
        remove_left(str(path), ["pids"], "ab12")
    assert others.is_dir()
    assert (tmp_path / "no cgroup" / "lifecycle-ab12").is_dir()
    (own / "cgroup.procs").unlink()


@pytest.mark.parametrize(
    ("events", "limits", "why"),
    [
        ("low 0\noom 2\noom_kill 1\n", {"memory_max_mib": 64}, "memory_max_mib 64"),
        ("low 0\noom 0\noom_kill 1\n", {"memory_max_mib": 64}, "what the machine has"),
        ("low 0\noom 1\noom_kill 1\n", {"tasks_max": 64}, "what the machine has"),
        ("low 0\noom 2\noom_kill 0\n", {"memory_max_mib": 64}, ""),
        (None, {"memory_max_mib": 64}, ""),
    ],
)
def test_an_end_for_want_of_memory_is_said_to_be_one(
    tmp_path: Path, events: str | None, limits: dict[str, int], why: str
) -> None:
    if events is not None:
        (tmp_path / "memory.events").write_text(events)
    said = ProcessCgroup(tmp_path, Resources(at=AT, **limits)).explain()
    if not why:
        assert said == ""
        return
    assert said == f"out of memory, {why}: the kernel killed 1 of its processes"
    assert str(ProcessExit(signal=9, why=said)) == f"killed by SIGKILL ({said})"


def test_an_end_once_no_more_tasks_could_be_started_says_so(tmp_path: Path) -> None:
    group = ProcessCgroup(tmp_path, Resources(at=AT, tasks_max=5))
    assert group.explain() == ""
    (tmp_path / "pids.events").write_text("max 0\n")
    assert group.explain() == ""
    (tmp_path / "pids.events").write_text("max 2\n")
    assert group.explain() == "its tasks_max 5 was reached"
    assert ProcessCgroup(tmp_path, Resources(at=AT)).explain() == ""


def test_what_a_cgroup_uses_is_what_the_kernel_counts(tmp_path: Path) -> None:
    def use() -> CgroupUse | None:
        found = resource_use(os.getpid(), tmp_path)
        assert found is not None
        return found.cgroup

    assert use() is None
    (tmp_path / "cpu.stat").write_text("usage_usec 1250000\nuser_usec 1000000\n")
    assert use() == CgroupUse(cpu_s=1.25)
    (tmp_path / "memory.current").write_text("4096\n")
    (tmp_path / "pids.current").write_text("3\n")
    assert use() == CgroupUse(cpu_s=1.25, memory_bytes=4096, tasks=3)
    found = resource_use(os.getpid())
    assert found is not None
    assert found.cgroup is None


def test_nothing_of_it_is_loaded_until_a_manifest_asks_for_resources() -> None:
    module = "lifecycle.supervisor.processes.cgroup"
    code = (
        "import sys, lifecycle.supervisor.run.up, lifecycle.supervisor.control.client\n"
        f"print({module!r} in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout == "False\n"
