"""Names that no file can have: 300 characters where 255 are allowed. None is a bug of lifecycle."""

from __future__ import annotations

from pathlib import Path

import pytest

from lifecycle.cli import main
from lifecycle.errors import ExitCode

LONG = "x" * 300

MANIFEST = """\
manifest_version: 1
system: long
nodes:
  one:
    run: {run}
    interface: {{publishers: [{{name: out, type: {type}}}]}}
"""


@pytest.mark.parametrize("verb", ["check", "plan"])
@pytest.mark.parametrize(
    ("run", "type_"),
    [
        (f'{{python: "{LONG}:A"}}', "std_msgs/msg/String"),
        (f'{{python: "a.{LONG}:A"}}', "std_msgs/msg/String"),
        (f"{{command: [{LONG}]}}", "std_msgs/msg/String"),
        (f"{{command: [./{LONG}/x]}}", "std_msgs/msg/String"),
        (f"{{command: [python3, {LONG}]}}", "std_msgs/msg/String"),
        (f"{{command: [python3, one.py], working_directory: {LONG}}}", "std_msgs/msg/String"),
        (f"{{package: {LONG}, executable: one}}", "std_msgs/msg/String"),
        (f"{{package: std_msgs, executable: {LONG}}}", "std_msgs/msg/String"),
        ('{python: "one:A"}', f"std_msgs/msg/{LONG}"),
        ('{python: "one:A"}', f"{LONG}/msg/String"),
    ],
)
def test_a_manifest_may_hold_names_that_no_file_can_have(
    verb: str, run: str, type_: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("m.lifecycle.yaml").write_text(MANIFEST.format(run=run, type=type_))
    assert main([verb, "m.lifecycle.yaml"]) in (ExitCode.OK, ExitCode.MANIFEST_INVALID)


@pytest.mark.parametrize(
    "words",
    [
        ("check", LONG),
        ("history", LONG),
        ("logs", LONG),
        ("init", LONG),
        ("graph", "m.lifecycle.yaml", "--output", f"{LONG}.svg"),
        ("export", "systemd", "m.lifecycle.yaml", "--output", LONG),
        ("export", "sros2", "m.lifecycle.yaml", "--output", LONG),
    ],
    ids=lambda words: " ".join(words)[:16],
)
def test_a_command_line_may_hold_names_that_no_file_can_have(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("m.lifecycle.yaml").write_text(
        MANIFEST.format(run='{python: "one:A"}', type="std_msgs/msg/String")
    )
    assert main(list(words)) not in (ExitCode.OK, ExitCode.INTERNAL)
