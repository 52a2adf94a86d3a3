"""The reducer decides as the session does, in the stories of these files."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

STORIES = Path(__file__).parents[1]
TIMEOUT_S = 300.0


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["session", "session_held", "restart_policy", "modes"])
def test_the_reducer_differs_from_the_session_only_where_that_is_listed(name: str) -> None:
    plugin = "tests.unit.supervisor.core.shadow_stories"
    story = STORIES / f"test_supervisor_{name}.py"
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:xdist", "-p", plugin, str(story)],
        cwd=Path(__file__).parents[4],
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    # A story may miss a time of its own on a busy machine; that is its own test's matter.
    assert done.returncode in (0, 1), done.stdout + done.stderr
    assert " passed" in done.stdout
    assert "the reducer differs" not in done.stdout, done.stdout
