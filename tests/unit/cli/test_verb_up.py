"""`lifecycle up` that is interrupted before there is anything to show."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from lifecycle.cli import common
from lifecycle.cli.verbs import up
from lifecycle.errors import ExitCode, UsageError

FORK_SERVER = "lifecycle.supervisor.processes.fork_server_main.ForkServerProcess"


class _NoForkServer:
    def __init__(self, **_: object) -> None:
        """Start nothing."""

    def close(self) -> None:
        """Nothing was started."""


@pytest.mark.parametrize(
    ("number", "reason", "exit_code"),
    [
        (signal.SIGINT, "interrupted", ExitCode.INTERRUPTED),
        (signal.SIGTERM, "terminated", ExitCode.TERMINATED),
        (signal.SIGHUP, "the terminal was closed", ExitCode.HUNG_UP),
    ],
)
def test_an_interrupt_while_the_manifest_is_read_is_told(
    number: int,
    reason: str,
    exit_code: ExitCode,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    manifest = tmp_path / "m.lifecycle.yaml"
    manifest.write_text("manifest_version: 1\nsystem: s\n")
    monkeypatch.setattr(FORK_SERVER, _NoForkServer)
    monkeypatch.setattr(common, "load_plan", lambda *_, **__: signal.raise_signal(number))
    report = tmp_path / "report.json"
    words = [str(manifest), "--report", str(report)]
    result = CliRunner().invoke(up.command, words, standalone_mode=False)
    assert result.return_value == exit_code
    assert json.loads(report.read_text())["run"]["exit_code"] == exit_code
    assert result.stderr == f"ended before anything was started: {reason}\n"
    assert result.stdout == ""


def test_a_report_that_cannot_be_written_is_refused_before_anything_is_started(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(
        FORK_SERVER,
        lambda: pytest.fail("it started"),
    )
    words = [str(tmp_path / "m.lifecycle.yaml"), "--report", str(tmp_path / "no" / "report.xml")]
    with pytest.raises(UsageError, match=r"cannot write report .*: No such file or directory"):
        CliRunner().invoke(up.command, words, standalone_mode=False, catch_exceptions=False)


def test_a_wrong_option_leaves_no_report_of_an_earlier_run(tmp_path: Path) -> None:
    report = tmp_path / "report.xml"
    report.write_text("<testsuites failures='0'/>")
    words = ["m.lifecycle.yaml", "--until", "tomorrow", "--report", str(report)]
    result = CliRunner().invoke(up.command, words)
    assert result.exit_code == ExitCode.USAGE
    assert report.read_text() == ""


@pytest.mark.parametrize(("verb", "is_ignored"), [("up", True), ("check", False)])
def test_a_signal_after_the_end_of_a_run_does_not_change_its_exit_code(
    verb: str, is_ignored: bool
) -> None:
    program = (
        "import os, signal, sys\n"
        "from lifecycle.cli import program\n"
        "os._exit = print\n"
        f"sys.argv = ['lifecycle', {verb!r}, 'missing.lifecycle.yaml']\n"
        "program()\n"
        "numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)\n"
        "ignored = {signal.getsignal(each) is signal.SIG_IGN for each in numbers}\n"
        f"sys.exit(ignored != {{{is_ignored}}})\n"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
