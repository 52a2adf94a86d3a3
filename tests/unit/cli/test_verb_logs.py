"""`lifecycle logs`, where logs are found, and which are kept."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import pytest
from click.testing import CliRunner

from lifecycle.cli.verbs.logs import command
from lifecycle.errors import UsageError
from lifecycle.supervisor.processes.logs import begin_logs, runs_of

GONE = 2**22 + 1
"""More than any pid, proc(5)."""


def run(root: Path, day: int, system: str = "pair", pid: int = GONE, **logs: str) -> Path:
    folder = root / f"2026-11-{day:02}-10-00-00-000000-my-host-{pid}-{system}"
    folder.mkdir(parents=True)
    for name, text in logs.items():
        (folder / f"{name}.log").write_text(text)
    return folder


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    return tmp_path


def shown(*words: str) -> list[str]:
    result = CliRunner().invoke(command, words, standalone_mode=False, catch_exceptions=False)
    return result.stdout.splitlines()


def test_all_logs_of_the_latest_run_are_shown_each_line_with_its_process(root: Path) -> None:
    run(root, 1, talker="old\n")
    run(root, 2, talker="one\n\ntwo\n", listener="three\x1b[2J\n")
    assert shown() == [
        "listener | three\\x1b[2J",
        "talker | one",
        "talker | ",
        "talker | two",
    ]
    assert shown("talker", "-n", "1") == ["two"]


def test_a_node_is_found_by_its_full_name_and_a_system_by_its_own(root: Path) -> None:
    run(root, 1, "arm-2-left", **{"robot.talker": "arm\n"})
    run(root, 2, talker="pair\n")
    assert shown("/robot/talker", "--system", "arm-2-left") == ["arm"]


def test_of_a_node_that_shares_a_process_the_lines_of_its_logger_are_shown(root: Path) -> None:
    camera = "[INFO] [1.5] [robot.camera]: one"
    lens = "[WARN] [1.6] [robot.camera.lens]: two"
    battery = "[INFO] [1.7] [robot.battery]: three"
    run(root, 1, sensors=f"{camera}\nprinted\n{lens}\n{battery}\n", lidar=f"{camera}x\n")
    for name in ("/robot/camera", "camera", "robot.camera"):
        assert shown(name) == [f"{camera}x", camera, lens]
    assert shown("camera", "-n", "1") == [f"{camera}x", lens]
    assert shown("battery") == [battery]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nobody"], "cannot find the log of 'nobody'"),
        (["--system", "other"], "cannot find a run of 'other'"),
    ],
)
def test_what_is_not_there_is_said_with_what_is(root: Path, words: list[str], message: str) -> None:
    run(root, 1, talker="one\n")
    done = subprocess.run(
        [sys.executable, "-m", "lifecycle", "logs", *words],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(message)


@contextlib.contextmanager
def followed(*words: str) -> Iterator[tuple[subprocess.Popen[str], IO[str]]]:
    """Follow logs until the end of the block, and then interrupt it."""
    command = [sys.executable, "-m", "lifecycle", "logs", *words, "-f"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as following:
        assert following.stdout is not None
        yield following, following.stdout
        following.send_signal(signal.SIGINT)
        assert following.wait(30) == 130


def test_what_is_written_is_followed(root: Path) -> None:
    folder = run(root, 1, talker="one\n")
    with followed("talker") as (_, shown_now):
        assert shown_now.readline() == "one\n"
        with (folder / "talker.log").open("a") as log:
            log.write("two\n")
        assert shown_now.readline() == "two\n"


def test_a_log_that_does_not_exist_yet_is_waited_for_while_its_run_lasts(root: Path) -> None:
    folder = run(root, 1, pid=os.getpid())
    for words, line in ((["talker"], "one\n"), ([], "talker | one\n")):
        with followed(*words) as (following, shown_now):
            with pytest.raises(subprocess.TimeoutExpired):
                following.wait(1.5 if words else 0.1)
            (folder / "talker.log").write_text("one\n")
            assert shown_now.readline() == line
    over = run(root, 2)
    assert shown("-f") == []
    with pytest.raises(UsageError, match="cannot find the log of 'talker'"):
        shown("talker", "-f")
    assert over.is_dir()


def test_the_latest_run_is_linked_and_old_ones_of_its_system_go(root: Path) -> None:
    alive = run(root, 1, pid=os.getpid(), talker="alive\n")
    foreign = run(root, 2, talker="kept\n")
    (foreign / "bag.db3").write_text("somebody's")
    old, kept, other = run(root, 3, talker="old\n"), run(root, 4), run(root, 1, "other")
    new = root / f"2026-11-05-10-00-00-000000-my-host-{os.getpid()}-pair"
    begin_logs({"LIFECYCLE_KEEP_LOGS": "2"}, new, "pair")
    assert (root / "latest").resolve() == new
    assert runs_of(root, "pair") == [new, kept, foreign, alive]
    assert other.is_dir()
    assert not old.exists()


def test_the_run_that_began_last_is_the_newest_also_after_the_clock_was_set_back(
    root: Path,
) -> None:
    later = run(root, 4, talker="before\n")
    begun = run(root, 2, talker="after\n")
    begin_logs({"LIFECYCLE_KEEP_LOGS": "1"}, begun, "pair")
    assert runs_of(root, "pair") == [begun]
    assert not later.exists()


def test_a_directory_named_latest_that_is_no_link_stays(root: Path) -> None:
    (root / "latest").mkdir()
    begin_logs({}, root / f"2026-11-05-10-00-00-000000-h-{GONE}-pair", "pair")
    assert not (root / "latest").is_symlink()
