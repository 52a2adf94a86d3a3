"""First contacts over TCP, of which Fast DDS 2.14 loses one now and then.

Owns: `reaches_active`, `up_by_tcp` and `restarts_by_tcp`. One of two participants that meet is then
never heard by the other (docs/nine_systems.md has the figures). That is ours only so far: the gate
must hold, and `up` must say who is not heard. Whoever runs the system starts it again, and so do
tests of what comes after.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from lifecycle.errors import ExitCode
from tests.ros.supervisor.running import Up, up, verb

TRIES = 3
NOT_HEARD = frozenset(
    (
        "config.missing-report",
        "flow.wrong-medium",
        "graph.missing-node",
        "graph.unattributed-endpoint",
        "graph.unmatched-client",
        "graph.unmatched-flow",
        "graph.unmatched-link",
        "run.deadline",
        "state.unverifiable",
        "state.wrong-state",
    )
)
"""What a supervisor finds where one participant does not hear another."""


def reaches_active(run: Up) -> bool:
    """Wait until a system is active; False if it ended because somebody was not heard."""
    try:
        run.until("system", reached="active")
    except AssertionError:
        if run.process.poll() is None:
            raise
        rules = {each["rule"] for each in run.verdict["findings"]}
        if not rules or rules - NOT_HEARD:
            raise
        run.assert_gate_held()
        return False
    return True


@contextlib.contextmanager
def up_by_tcp(manifest: Path, *options: str, runtime: Path) -> Iterator[Up]:
    """Bring a system up whose participants are connected by TCP; it is active then."""
    for _ in range(TRIES):
        with up(manifest, *options, runtime=runtime) as run:
            if reaches_active(run):
                yield run
                return
    pytest.fail(f"no first contact in {TRIES} tries")


def restarts_by_tcp(run: Up, runtime: Path, *node: str) -> None:
    """Restart the system, or one node of it, and see it active again."""
    for _ in range(TRIES):
        done = verb("restart", "pair", *node, runtime=runtime)
        if done.returncode == ExitCode.OK:
            assert done.stderr == ""
            run.until("system", reached="active")
            return
        assert done.returncode in (ExitCode.VIOLATED, ExitCode.UNVERIFIABLE), done.stderr
        assert any(rule in done.stderr for rule in NOT_HEARD), done.stderr
    pytest.fail(f"no first contact in {TRIES} restarts")
