"""A part of `make hostile`, as it is: in processes and domains of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.thorough

ROOT = Path(__file__).parents[2]
EVERY = {"files": 15, "names": 1, "servers": 16, "control": 5}
"""Which of a class's attacks are tried here: each so manieth."""


@pytest.mark.parametrize("name", EVERY)
def test_every_attack_is_handled(name: str) -> None:
    words = ("--class", name, "--every", str(EVERY[name]), "--here")
    done = subprocess.run(
        [sys.executable, "-m", "tests.hostile", *words],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    tried = [json.loads(line) for line in done.stdout.splitlines() if line.startswith('{"attack"')]
    assert len(tried) > 5
    assert [each for each in tried if each["why"]] == []
