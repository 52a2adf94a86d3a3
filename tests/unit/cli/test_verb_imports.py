"""What a verb loads before it knows that there is anything to ask, and what that costs."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
HEAVY = (
    "asyncio",
    "jsonschema",
    "lifecycle.graph",
    "lifecycle.manifest",
    "lifecycle.middleware",
    "lifecycle.network",
    "lifecycle.node",
    "lifecycle.plan",
    "lifecycle.supervisor",
    "lifecycle.verify",
    "logging",
    "msgspec",
    "rclpy",
    "rich",
    "subprocess",
    "yaml",
)
BASELINE = ("-c", "import click")
TURNS = 3


def _run(environment: dict[str, str], *arguments: str) -> tuple[str, float]:
    """Return what a Python printed, and its CPU seconds."""
    with subprocess.Popen(
        [sys.executable, *arguments],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        assert process.stdout is not None
        printed = process.stdout.read()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    return printed, used.ru_utime + used.ru_stime


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """Of a user who runs nothing."""
    return {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["status"], "no system runs"),
        (["status", "arm"], "cannot find a running system 'arm'"),
        (["down", "arm"], "cannot find a running system 'arm'"),
        (["pause", "arm"], "cannot find a running system 'arm'"),
        (["--help"], "Usage: lifecycle"),
        (["down", "--help"], "Usage: lifecycle down"),
    ],
    ids=" ".join,
)
def test_a_verb_that_finds_nothing_to_ask_loads_no_room(
    words: list[str], said: str, environment: dict[str, str]
) -> None:
    program = (
        "import sys\n"
        "from lifecycle.cli import main\n"
        f"main({words!r})\n"
        f"print('loaded:', *sorted({set(HEAVY)!r} & set(sys.modules)))\n"
    )
    printed, _ = _run(environment, "-c", program)
    assert said in printed
    assert printed.splitlines()[-1] == "loaded:"


def test_status_of_nothing_costs_about_what_its_option_parser_costs(
    environment: dict[str, str],
) -> None:
    ratios: list[float] = []
    for _ in range(TURNS):
        _, floor = _run(environment, *BASELINE)
        _, ours = _run(environment, "-m", "lifecycle.cli", "status")
        ratios.append(ours / floor)
        # It was 4.5 while it loaded the verifier; one turn that nothing disturbed is enough.
        if ratios[-1] < 2.5:
            return
    pytest.fail(f"CPU seconds of `lifecycle status` / `import click`: {ratios}")
