"""Every `lifecycle` command of the README, run as written; the failing one prints what is shown."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.ros, pytest.mark.thorough]

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```console\n(.*?)```", README, flags=re.DOTALL)
COMMANDS = [
    shlex.split(line[2:], comments=True)
    for block in BLOCKS
    for line in block.splitlines()
    if line.startswith("$ lifecycle")
]
ENDING = [words for words in COMMANDS if words[1] not in {"run", "verify"}]
WAIT_S = 60


def command(words: list[str], domain_id: int) -> tuple[list[str], dict[str, str]]:
    return (
        [sys.executable, "-m", "lifecycle", *words[1:]],
        {**os.environ, "ROS_DOMAIN_ID": str(domain_id), "COLUMNS": "100"},
    )


@pytest.mark.parametrize("words", ENDING, ids=lambda words: words[1])
def test_a_command_that_ends_by_itself_ends_well(words: list[str], fresh_domain: int) -> None:
    line, environment = command(words, fresh_domain)
    result = subprocess.run(
        line, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=WAIT_S, check=False
    )
    assert result.returncode == 0, result.stdout + result.stderr


def test_verify_of_half_a_system_prints_what_the_readme_shows(fresh_domain: int) -> None:
    run = next(words for words in COMMANDS if words[1] == "run")
    line, environment = command(run, fresh_domain)
    node = subprocess.Popen(line, env=environment, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert node.stdout is not None
    try:
        for said in node.stdout:
            if said.strip() == "/talker: active":
                break
        else:
            pytest.fail("the talker ended before it was active")
        verify = next(words for words in COMMANDS if words[1] == "verify")
        # It waits 10 s by default for what is missing, and here something always is.
        line, environment = command([*verify, "--timeout", "4"], fresh_domain)
        result = subprocess.run(
            line, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False
        )
    finally:
        node.send_signal(signal.SIGTERM)
        node.communicate(timeout=30)
    assert result.returncode == 4, result.stderr
    shown = next(block for block in BLOCKS if block.startswith("$ lifecycle verify"))
    expected = shown.partition("\n")[2].replace("domain 0", f"domain {fresh_domain}")
    assert result.stdout.startswith(expected), result.stdout
    assert node.returncode == 0
