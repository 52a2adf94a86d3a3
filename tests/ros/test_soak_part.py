"""Three rounds of `make soak`: a manifest applied, a supervisor killed, the clock set."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.thorough, pytest.mark.alone]

ROOT = Path(__file__).parents[2]


def test_three_rounds_of_a_seed_come_out_as_expected() -> None:
    words = ("--seed", "10968", "--rounds", "3")
    soak = subprocess.Popen(
        [sys.executable, "-m", "tests.soak", *words],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        said, _ = soak.communicate(timeout=110)
    finally:
        if soak.poll() is None:
            os.killpg(soak.pid, signal.SIGINT)  # it ends what it started
            soak.communicate(timeout=30)
    assert soak.returncode == 0, said
    assert "3 rounds as expected" in said
