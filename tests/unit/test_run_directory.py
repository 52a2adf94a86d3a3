"""The run directory: one supervisor each, safe from others, reachable however deep it is."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import fcntl
import os
import socket
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from lifecycle import run_directory
from lifecycle.cli import main
from lifecycle.errors import ExitCode, UsageError
from lifecycle.run_directory import (
    LEDGER_NAME,
    ChildRecord,
    RunDirectory,
    find_run,
    read_record,
    run_name,
    run_roots,
    running,
    runtime_root,
    short_path,
    start_ticks,
)
from lifecycle.supervisor.control import protocol
from lifecycle.supervisor.control.protocol import (
    ControlRequest,
    Question,
    SystemStatus,
    ask,
    status,
)
from lifecycle.supervisor.control.server import ControlServer
from tests.builders import plan_of, planned_node

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
    with pytest.raises(UsageError) as caught:
        RunDirectory.acquire(tmp_path, "robot@30", "def")
    assert str(caught.value) == (
        f"cannot bring up 'robot@30': another supervisor (pid {record.supervisor.pid}) runs it "
        "already; end it first: lifecycle down robot@30"
    )
    RunDirectory.acquire(tmp_path, "robot@31", "def").release()
    first.release()
    RunDirectory.acquire(tmp_path, "robot@30", "def").release()


def test_who_looks_whether_a_supervisor_runs_does_not_keep_one_from_starting(
    tmp_path: Path,
) -> None:
    """A probe of a service manager, say, each few seconds, in the moment of a start."""
    (tmp_path / "robot@0").mkdir(mode=0o700)
    (tmp_path / "robot@0/lock").touch(mode=0o600)
    with (tmp_path / "robot@0/lock").open("r+") as looking:
        fcntl.flock(looking, fcntl.LOCK_SH)
        assert running(tmp_path) == ()
        release = threading.Timer(0.03, fcntl.flock, (looking, fcntl.LOCK_UN))
        release.start()
        RunDirectory.acquire(tmp_path, "robot@0", "r").release()
        release.join()


def test_a_supervisor_that_is_starting_is_not_said_to_have_died(tmp_path: Path) -> None:
    directory = RunDirectory.acquire(tmp_path, "robot@0", "r")
    with pytest.raises(UsageError) as caught:
        status(directory.path)
    directory.release()
    assert caught.value.message == (
        f"cannot ask 'robot@0': its supervisor (pid {os.getpid()}) is just starting or ending"
    )


def test_what_a_killed_supervisor_wrote_is_found_by_the_next(tmp_path: Path) -> None:
    killed = RunDirectory.acquire(tmp_path, "robot@30", "abc")
    killed.record({os.getpid(): "camera"})
    record = (killed.path / "record.json").read_bytes()
    killed.release()
    killed.path.mkdir(mode=0o700)
    (killed.path / "record.json").write_bytes(record)
    following = RunDirectory.acquire(tmp_path, "robot@30", "def")
    assert following.previous is not None
    assert following.previous.run_id == "abc"
    ticks = start_ticks(os.getpid())
    child = ChildRecord(name="camera", pid=os.getpid(), start_ticks=ticks or 0)
    assert following.previous.children == (child,)
    following.release()
    assert RunDirectory.acquire(tmp_path, "robot@30", "ghi").previous is None


def test_a_directory_that_others_can_write_is_refused(tmp_path: Path) -> None:
    root = tmp_path / "open"
    root.mkdir()
    root.chmod(0o777)
    with pytest.raises(UsageError, match=r"others can write it; .* remove it, or set XDG"):
        RunDirectory.acquire(root, "robot@30", "abc")


def test_a_run_directory_is_removed_at_the_end(tmp_path: Path) -> None:
    directory = RunDirectory.acquire(tmp_path, "robot@30", "abc")
    (directory.path / "profiles.xml").touch()
    directory.release()
    directory.release()
    assert list(tmp_path.iterdir()) == []


def test_a_run_directory_that_lists_what_is_programmed_stays(tmp_path: Path) -> None:
    directory = RunDirectory.acquire(tmp_path, "robot@30", "abc")
    (directory.path / LEDGER_NAME).touch()
    directory.release()
    assert [each.name for each in directory.path.iterdir()] == [LEDGER_NAME]
    RunDirectory.acquire(tmp_path, "robot@30", "def").release()


@pytest.mark.parametrize("place", ["lifecycle", "lifecycle/robot@30"])
def test_a_link_in_the_place_of_a_run_directory_is_refused_and_not_followed(
    tmp_path: Path, place: str
) -> None:
    remote_nodes = tmp_path / "elsewhere"
    remote_nodes.mkdir(mode=0o700)
    link = tmp_path / place
    link.parent.mkdir(mode=0o700, exist_ok=True)
    link.symlink_to(remote_nodes)
    with pytest.raises(UsageError) as caught:
        RunDirectory.acquire(tmp_path / "lifecycle", "robot@30", "abc")
    assert str(caught.value) == (
        f"cannot use {str(link)!r} as run directory: it is a symbolic link; it must be a directory "
        "of this user that others cannot write; remove it, or set XDG_RUNTIME_DIR to such a "
        "directory"
    )
    assert list(remote_nodes.iterdir()) == []


@pytest.mark.parametrize("place", ["lifecycle", "lifecycle/robot@30"])
def test_a_file_in_the_place_of_a_run_directory_is_refused(tmp_path: Path, place: str) -> None:
    (tmp_path / place).parent.mkdir(mode=0o700, exist_ok=True)
    (tmp_path / place).touch()
    with pytest.raises(UsageError, match="it is not a directory"):
        RunDirectory.acquire(tmp_path / "lifecycle", "robot@30", "abc")
    if (tmp_path / "lifecycle").is_dir():
        assert running(tmp_path / "lifecycle") == ()


def test_a_link_in_the_place_of_the_lock_is_not_followed(tmp_path: Path) -> None:
    directory = tmp_path / "robot@30"
    directory.mkdir(mode=0o700)
    (directory / "lock").symlink_to(tmp_path / "precious")
    with pytest.raises(UsageError, match=r"cannot use .*lock' as run directory: Too many levels"):
        RunDirectory.acquire(tmp_path, "robot@30", "abc")
    assert not (tmp_path / "precious").exists()


def test_another_users_runtime_directory_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    uid = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: uid + 1)
    if uid == 0:  # root is trusted with any directory above ours
        os.chown(tmp_path, 12345, -1)
    with pytest.raises(UsageError, match=r"belongs to user \d+, and this is user \d+"):
        runtime_root({"XDG_RUNTIME_DIR": str(tmp_path)})
    with pytest.raises(UsageError, match=r"belongs to user \d+, and this is user \d+"):
        RunDirectory.acquire(tmp_path / "lifecycle", "robot@30", "abc")
    assert list(tmp_path.iterdir()) == []


def test_a_runtime_directory_that_everybody_can_write_is_refused_unless_it_is_sticky(
    tmp_path: Path,
) -> None:
    tmp_path.chmod(0o777)
    with pytest.raises(UsageError, match="everybody can write"):
        runtime_root({"XDG_RUNTIME_DIR": str(tmp_path)})
    tmp_path.chmod(0o1777)
    assert runtime_root({"XDG_RUNTIME_DIR": str(tmp_path)}) == tmp_path / "lifecycle"


def test_the_root_is_the_users_runtime_directory_or_one_of_its_own_in_tmp(tmp_path: Path) -> None:
    assert runtime_root({"XDG_RUNTIME_DIR": str(tmp_path)}) == tmp_path / "lifecycle"
    assert runtime_root({"XDG_RUNTIME_DIR": "/no/such"}).name.startswith("lifecycle-")


def test_a_run_is_named_by_system_domain_and_machine() -> None:
    plan = plan_of(planned_node("a"))
    assert run_name(plan) == "robot@30"
    assert run_name(plan, "base") == "robot@30.base"


def test_a_word_finds_its_run_or_says_what_runs(tmp_path: Path) -> None:
    held = [RunDirectory.acquire(tmp_path, name, "abc") for name in ("arm@1", "arm@2", "base@1")]
    assert [each.name for each in running(tmp_path)] == ["arm@1", "arm@2", "base@1"]
    assert find_run([tmp_path], "base") == tmp_path / "base@1"
    assert find_run([tmp_path], "arm@2") == tmp_path / "arm@2"
    with pytest.raises(UsageError, match="cannot tell which 'arm' is meant; running: arm@1, arm@2"):
        find_run([tmp_path], "arm")
    with pytest.raises(UsageError) as caught:
        find_run([tmp_path], "leg")
    assert str(caught.value) == (
        "cannot find a running system 'leg'; running: arm@1, arm@2, base@1"
    )
    for each in held:
        each.release()
    assert running(tmp_path) == ()


def test_root_asks_the_runs_of_services_and_uses_none_of_their_directories(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """systemd starts a supervisor as a user of its own, in a directory of its own."""
    monkeypatch.setattr(run_directory, "_SERVICES", (f"{tmp_path}/*/lifecycle".lstrip("/"),))
    monkeypatch.setattr(os, "getuid", lambda: 0)
    (tmp_path / "mine").mkdir(mode=0o700)
    environment = {"XDG_RUNTIME_DIR": str(tmp_path / "mine")}
    services = [tmp_path / name / "lifecycle" for name in ("arm", "leg")]
    held = [RunDirectory.acquire(root, f"{root.parent.name}@1", "abc") for root in services]
    also = RunDirectory.acquire(runtime_root(environment), "arm@1", "abc")
    roots = run_roots(environment)
    assert roots == (tmp_path / "mine/lifecycle", *services)
    assert find_run(roots, "leg") == services[1] / "leg@1"
    with pytest.raises(UsageError, match=f"running: {tmp_path}/mine/lifecycle/arm@1, {tmp_path}"):
        find_run(roots, "arm")  # of the same name in two places: said by their places
    assert find_run(roots, str(services[0] / "arm@1")) == services[0] / "arm@1"
    for each in (*held, also):
        each.release()
    monkeypatch.setattr(os, "getuid", lambda: 12345)
    assert run_roots({"XDG_RUNTIME_DIR": "/no/such"}) == (Path("/tmp/lifecycle-12345"),)


def test_the_control_socket_answers_and_tells_of_the_end_however_deep_it_lies(
    tmp_path: Path,
) -> None:
    deep = tmp_path / ("d" * 80) / ("e" * 80)
    deep.mkdir(parents=True)

    async def test() -> None:
        asked = asyncio.Event()
        session = SimpleNamespace(status=lambda: STATUS, stop=lambda *_: asked.set())
        server = ControlServer(deep / "control", session)  # type: ignore[arg-type]
        await server.open()
        loop = asyncio.get_running_loop()
        answer = await loop.run_in_executor(
            None, ask, deep / "control", Question(ask=ControlRequest.STATUS), 5.0
        )
        assert answer is not None
        assert answer.status == STATUS
        down = loop.run_in_executor(
            None, ask, deep / "control", Question(ask=ControlRequest.DOWN), 5.0
        )
        await asyncio.wait_for(asked.wait(), 5.0)
        await server.close(0)
        answer = await down
        assert answer is not None
        assert answer.exit_code == 0

    asyncio.run(test())


class _Stranger:
    """Listens where a supervisor would, and answers each question in its own way.

    Args:
        answer: sent again and again, until the client goes away.
        pause_s: after each time; None closes the connection after the first.
    """

    def __init__(self, root: Path, answer: bytes, pause_s: float | None) -> None:
        self.directory = RunDirectory.acquire(root, "pair@7", "abc")
        self._answer = answer
        self._pause_s = pause_s
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        with short_path(self.directory.socket_path) as name:
            self._socket.bind(name)
        self._socket.listen()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        while True:
            try:
                client, _ = self._socket.accept()
            except OSError:
                return
            with client, contextlib.suppress(OSError):
                client.recv(1 << 16)
                client.sendall(self._answer)
                while self._pause_s is not None:
                    time.sleep(self._pause_s)
                    client.sendall(self._answer)

    def __enter__(self) -> None:
        """It listens already."""

    def __exit__(self, *_: object) -> None:
        self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        self._thread.join()
        self.directory.release()


_STRANGE = {
    "no JSON": (b"220 mail.example.org ESMTP\n", None, "Expected `object`, got `int`"),
    "deep": (b"[" * 100000 + b"\n", None, ""),
    "no text": (b"\xff\xfe\n", None, "JSON is malformed"),
    "of another type": (b'{"status": 3, "exit_code": "x"}\n', None, "Expected"),
    "empty": (b"{}\n", None, "it has no "),
    "endless": (b"x" * 65536, 0.0, "bytes without an end"),
}


@pytest.mark.parametrize("which", _STRANGE)
@pytest.mark.parametrize("verb", ["status", "pause", "down"])
def test_a_strange_answer_on_the_control_socket_is_one_clear_error(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    which: str,
    verb: str,
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(protocol, "_LARGEST_ANSWER", 1 << 20)
    answer, pause_s, why = _STRANGE[which]
    with _Stranger(tmp_path / "lifecycle", answer, pause_s):
        assert main([verb, "pair"]) == ExitCode.USAGE
    said = capsys.readouterr().err
    assert said.startswith("cannot understand the answer of 'pair@7': ")
    assert why in said
    assert said.endswith(
        "; use the version of lifecycle that started it, or end the process that listens at "
        f"{tmp_path}/lifecycle/pair@7/control\n"
    )


def test_an_answer_that_never_ends_is_not_waited_for(tmp_path: Path) -> None:
    with _Stranger(tmp_path, b"[", 0.02), pytest.raises(TimeoutError):
        ask(tmp_path / "pair@7" / "control", Question(ask=ControlRequest.STATUS), 0.3)


def test_a_directory_that_was_no_runs_is_left_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "arm@1"
    path.mkdir(mode=0o700)
    (path / "thesis.tex").touch()
    with pytest.raises(UsageError, match=r"it holds 'thesis\.tex', and was no run's; it must be"):
        RunDirectory.acquire(tmp_path, "arm@1", "abc")
    assert [each.name for each in path.iterdir()] == ["thesis.tex"]


def test_a_record_that_is_no_file_is_none(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "record.json")
    assert read_record(tmp_path) is None
    (tmp_path / "record.json").unlink()
    (tmp_path / "record.json").symlink_to("/dev/zero")
    assert read_record(tmp_path) is None


def test_a_full_disk_is_said_before_anything_is_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def record(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(RunDirectory, "record", record)
    with pytest.raises(UsageError) as refused:
        RunDirectory.acquire(tmp_path / "lifecycle", "arm@7", "id")
    assert str(refused.value) == (
        f"cannot write in run directory '{tmp_path}/lifecycle/arm@7': No space left on device; "
        "make room there, or set XDG_RUNTIME_DIR to another directory"
    )
    assert not (tmp_path / "lifecycle/arm@7").exists()
