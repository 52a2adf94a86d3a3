"""`lifecycle up` that is interrupted before there is anything to show."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from click.testing import CliRunner

from lifecycle.cli import verb_up
from lifecycle.errors import ExitCode


class _NoForerunner:
    def close(self) -> None:
        """Nothing was started."""


@pytest.mark.parametrize(
    ("number", "reason", "exit_code"),
    [
        (signal.SIGINT, "interrupted", ExitCode.INTERRUPTED),
        (signal.SIGTERM, "terminated", ExitCode.OK),
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
    monkeypatch.setattr("lifecycle.supervisor.run.Forerunner", _NoForerunner)
    monkeypatch.setattr(verb_up, "load_manifest", lambda *_: signal.raise_signal(number))
    result = CliRunner().invoke(verb_up.command, [str(manifest)], standalone_mode=False)
    assert result.return_value == exit_code
    assert result.stderr == f"ended before anything was started: {reason}\n"
    assert result.stdout == ""
