"""Shell completion, as bash asks for it by click's own script."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from pathlib import Path

import click
import pytest

from lifecycle.cli import VERBS, cli

MANIFEST = """
manifest_version: 1
system: arm
arguments:
  rate: {default: "$(command touch ran)", description: frames per second}
  robot: {description: its name}
nodes:
  camera: {run: {attach: true}, namespace: /left}
  viewer: {rum: {attach: true}}
"""


@pytest.fixture
def place(tmp_path: Path) -> Path:
    (tmp_path / "arm.lifecycle.yaml").write_text(MANIFEST)
    (tmp_path / "notes.txt").write_text("")
    return tmp_path


def _asked(line: str, place: Path) -> list[str]:
    """Return kind and value of what is offered, in one word each."""
    program = (
        "import sys; from lifecycle.cli import program; code = program(); "
        "assert 'rclpy' not in sys.modules; sys.exit(code)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=place,
        env={
            **os.environ,
            "XDG_RUNTIME_DIR": str(place),
            "_LIFECYCLE_COMPLETE": "bash_complete",
            "COMP_WORDS": line,
            "COMP_CWORD": str(len(line.split(" ")) - 1),
        },
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr == ""
    return done.stdout.split()


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("lifecycle resu", ["plain,resume"]),
        ("lifecycle check --for", ["plain,--format"]),
        ("lifecycle check a", ["plain,arm.lifecycle.yaml"]),
        ("lifecycle check ./f", ["file,./f"]),
        ("lifecycle check notes", ["file,notes"]),
        ("lifecycle run arm.lifecycle.yaml ", ["plain,camera", "plain,viewer"]),
        ("lifecycle up arm.lifecycle.yaml r", ["plain,rate:=", "plain,robot:="]),
        ("lifecycle up nothing.lifecycle.yaml r", []),
    ],
)
def test_what_can_come_next_is_offered_and_nothing_is_run(
    line: str, offered: list[str], place: Path
) -> None:
    assert _asked(line, place) == offered
    assert not (place / "ran").exists()


@pytest.mark.parametrize("name", VERBS)
def test_the_help_of_a_verb_ends_with_an_example_that_the_verb_takes(name: str) -> None:
    context = click.Context(cli)
    verb = cli.get_command(context, name)
    assert verb is not None
    shown = verb.get_help(click.Context(verb, info_name=name, parent=context))
    program, *words = shlex.split(shown.rsplit("Example: ", 1)[1].split(" >")[0])
    assert (program, words[0]) == ("lifecycle", name)
    while isinstance(verb, click.Group) and words[1] in verb.commands:
        verb, words = verb.commands[words[1]], words[1:]
    verb.make_parser(click.Context(verb)).parse_args(words[1:])
