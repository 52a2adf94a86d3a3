"""First contacts over TCP between hosts, of which Fast DDS 2.14 loses one now and then.

Owns: `reaches_active`. A supervisor starts its own nodes again that are not discovered, on fresh
ports, but not those of another host that it alone does not see (docs/nine_systems.md has the
figures). Then the gate must hold, and `up` must say who is missing. Whoever runs the system starts
it again, and so do tests of what comes after.
"""

from __future__ import annotations

from tests.ros.supervisor.running import Up

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
