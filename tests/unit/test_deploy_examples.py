"""What is in examples/deploy/ fits this repository and, where it is installed, systemd."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from click.testing import CliRunner

from lifecycle.cli import cli

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "examples/deploy"


def test_the_image_is_made_of_files_that_are_there_and_runs_a_verb() -> None:
    text = (DEPLOY / "Dockerfile").read_text()
    sources = [
        each
        for line in re.findall(r"^COPY (.*)$", text, re.MULTILINE)
        for each in line.split()[:-1]
    ]
    assert sources
    assert [each for each in sources if not (ROOT / each).exists()] == []
    (start,) = re.findall(r"^ENTRYPOINT (.*)$", text, re.MULTILINE)
    (manifest,) = re.findall(r"^CMD (.*)$", text, re.MULTILINE)
    assert json.loads(start) == ["lifecycle", "up"]
    (file,) = json.loads(manifest)
    assert (ROOT / file).exists()


@pytest.mark.parametrize("file", ["verify.yml", "lifecycle@.service"])
def test_the_commands_have_the_options_that_they_are_given(file: str) -> None:
    text = (DEPLOY / file).read_text()
    commands = re.findall(r"lifecycle (check|up) (.*)$", text, re.MULTILINE)
    assert commands
    for verb, options in commands:
        help_ = CliRunner().invoke(cli, [verb, "--help"]).output
        assert [each for each in re.findall(r"--[a-z-]+", options) if each not in help_] == []


def test_the_workflow_can_be_called() -> None:
    workflow = yaml.safe_load((DEPLOY / "verify.yml").read_text())
    assert workflow[True]["workflow_call"]["inputs"]["manifest"]["required"]


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not installed")
def test_systemd_finds_nothing_wrong_with_the_unit(tmp_path: Path) -> None:
    unit = (DEPLOY / "lifecycle@.service").read_text()
    program = tmp_path / "lifecycle"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    there = tmp_path / "lifecycle@arm.service"
    there.write_text(unit.replace("/opt/lifecycle/bin/lifecycle", str(program)))
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(there)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """A repository with a manifest that is sound and one that is not."""
    sound = (ROOT / "manifests/first_node.lifecycle.yaml").read_text()
    (tmp_path / "sound.lifecycle.yaml").write_text(sound)
    (tmp_path / "wrong.lifecycle.yaml").write_text(sound.replace("nodes:\n", "nods:\n", 1))
    return tmp_path


def _run(command: list[str], folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}:"
    environment = {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT), **variables}
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize(
    ("files", "code"), [(["sound"], 0), (["wrong", "sound"], 3), (["sound", "wrong"], 3)]
)
def test_the_hook_of_pre_commit_checks_each_manifest(
    repository: Path, files: list[str], code: int
) -> None:
    (hook,) = yaml.safe_load((ROOT / ".pre-commit-hooks.yaml").read_text())
    named = [f"{each}.lifecycle.yaml" for each in files]
    assert all(re.search(hook["files"], each) for each in named)
    assert _run([*shlex.split(hook["entry"]), *named], repository).returncode == code


@pytest.mark.parametrize(("pattern", "code"), [("sound.*", 0), ("*.lifecycle.yaml", 3)])
def test_the_action_checks_each_manifest_and_annotates(
    repository: Path, pattern: str, code: int
) -> None:
    action = yaml.safe_load((ROOT / "action.yml").read_text())
    script = action["runs"]["steps"][-1]["run"]
    options = action["inputs"]["options"]["default"]
    done = _run(["bash", "-c", script], repository, MANIFESTS=pattern, OPTIONS=options)
    assert done.returncode == code, done.stdout + done.stderr
    assert ("::error file=wrong.lifecycle.yaml" in done.stdout) == bool(code)
