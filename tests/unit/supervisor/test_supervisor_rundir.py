"""The run directory: one supervisor each, safe from others, reachable however deep it is."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from lifecycle.errors import UsageError
from lifecycle.supervisor.remote import find_run, running
from lifecycle.supervisor.rundir import (
    AlreadyRunningError,
    ChildRecord,
    RunDirectory,
    read_record,
    run_name,
    runtime_root,
)
from lifecycle.supervisor.server import Ask, ControlServer, ask
from lifecycle.supervisor.status import SystemStatus
from tests.unit.supervisor.fakes import plan_of, planned_node

STATUS = SystemStatus(
    system="robot",
    domain_id=30,
    phase="active",
    verdict=None,
    supervisor=1,
    elapsed_s=1.5,
    nodes=(),
)


def test_a_second_supervisor_of_one_system_is_refused_with_the_pid_of_the_first(
    tmp_path: Path,
) -> None:
    first = RunDirectory.acquire(tmp_path, "robot@30", "abc")
    record = read_record(first.path)
    assert record is not None
    with pytest.raises(AlreadyRunningError) as caught:
        RunDirectory.acquire(tmp_path, "robot@30", "def")
    assert str(caught.value) == (
        f"cannot bring up 'robot@30': another supervisor (pid {record.supervisor.pid}) runs it "
        "already; end it first: lifecycle down robot@30"
    )
    RunDirectory.acquire(tmp_path, "robot@31", "def").release()
    first.release()
    RunDirectory.acquire(tmp_path, "robot@30", "def").release()


def test_what_a_killed_supervisor_wrote_is_found_by_the_next(tmp_path: Path) -> None:
    killed = RunDirectory.acquire(tmp_path, "robot@30", "abc", domain_id=30)
    child = ChildRecord(name="camera", pid=17, start_ticks=4)
    killed.record((child,))
    record = (killed.path / "record.json").read_bytes()
    killed.release()
    (killed.path / "record.json").write_bytes(record)
    following = RunDirectory.acquire(tmp_path, "robot@30", "def")
    assert following.previous is not None
    assert following.previous.run_id == "abc"
    assert following.previous.children == (child,)
    assert following.previous.domain_id == 30
    following.release()
    assert RunDirectory.acquire(tmp_path, "robot@30", "ghi").previous is None


def test_a_directory_that_others_can_write_is_refused(tmp_path: Path) -> None:
    root = tmp_path / "open"
    root.mkdir()
    root.chmod(0o777)
    with pytest.raises(UsageError, match="that others cannot write; remove it, or set XDG"):
        RunDirectory.acquire(root, "robot@30", "abc")


def test_the_root_is_the_users_runtime_directory_or_one_of_its_own_in_tmp(tmp_path: Path) -> None:
    assert runtime_root({"XDG_RUNTIME_DIR": str(tmp_path)}) == tmp_path / "lifecycle"
    assert runtime_root({"XDG_RUNTIME_DIR": "/no/such"}).name.startswith("lifecycle-")


def test_a_run_is_named_by_system_domain_and_machine() -> None:
    plan = plan_of(planned_node("a"))
    assert run_name(plan) == "robot@30"
    assert run_name(plan, "base") == "robot@30.base"


def test_a_word_finds_its_run_or_says_what_runs(tmp_path: Path) -> None:
    held = [RunDirectory.acquire(tmp_path, name, "abc") for name in ("arm@1", "arm@2", "base@1")]
    assert running(tmp_path) == ("arm@1", "arm@2", "base@1")
    assert find_run(tmp_path, "base") == tmp_path / "base@1"
    assert find_run(tmp_path, "arm@2") == tmp_path / "arm@2"
    with pytest.raises(UsageError, match="cannot tell which 'arm' is meant; running: arm@1, arm@2"):
        find_run(tmp_path, "arm")
    with pytest.raises(UsageError) as caught:
        find_run(tmp_path, "leg")
    assert str(caught.value) == (
        "cannot find a running system 'leg'; running: arm@1, arm@2, base@1; "
        "start it: lifecycle up MANIFEST"
    )
    for each in held:
        each.release()
    assert running(tmp_path) == ()


def test_the_control_socket_answers_and_tells_of_the_end_however_deep_it_lies(
    tmp_path: Path,
) -> None:
    deep = tmp_path / ("d" * 80) / ("e" * 80)
    deep.mkdir(parents=True)

    async def test() -> None:
        asked = asyncio.Event()
        server = ControlServer(deep / "control", lambda: STATUS, asked.set)
        await server.open()
        loop = asyncio.get_running_loop()
        answer = await loop.run_in_executor(None, ask, deep / "control", Ask.STATUS, 5.0)
        assert answer is not None
        assert answer.status == STATUS
        down = loop.run_in_executor(None, ask, deep / "control", Ask.DOWN, 5.0)
        await asyncio.wait_for(asked.wait(), 5.0)
        await server.close(0)
        answer = await down
        assert answer is not None
        assert answer.exit_code == 0

    asyncio.run(test())
