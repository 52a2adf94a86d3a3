"""What is in examples/deploy/ fits this repository and, where it is installed, systemd."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
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
