"""A running system of nodes that know nothing of us, for the tests of verbs that look at it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

import pytest

from tests.ros.supervisor.running import ROOT

_END_S = 20.0


@pytest.fixture(scope="module")
def foreign(domain_id: int) -> Iterator[int]:
    """The domain that it runs in; see foreign_system.py."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.ros.cli.foreign_system"],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == "ready\n"
        yield domain_id
    finally:
        process.terminate()
        try:
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait(_END_S)
        process.stdout.close()
