"""Which nodes come to be configured before anybody is connected.

Owns: that question, which a negotiation asks before it waits: what it waits for must not in turn
wait for a connection. Pure.
"""

from __future__ import annotations

from lifecycle.manifest.model import Condition
from lifecycle.supervisor.nodes.system import System


def configured_before_any_connect(system: System) -> frozenset[str]:
    """Return the keys of this supervisor's managed nodes that no `after:` holds behind a connect.

    A managed node's start waits for `started` alone and its configure for `configured`; but the
    start of a plain node waits for any condition, and whoever stands on it waits with it.
    """
    held: dict[str, bool] = {}

    def is_held(key: str) -> bool:
        if key in held or key not in system.nodes:
            return held.get(key, False)
        held[key] = False  # `after` has no cycles; a second visit ends here
        planned = system.nodes[key].planned
        for after in planned.after:
            waits = not planned.managed or after.condition in (
                Condition.STARTED,
                Condition.CONFIGURED,
            )
            target = system.nodes.get(after.node)
            managed = target is None or target.planned.managed
            beyond = after.condition in (Condition.CONNECTED, Condition.ACTIVE) and managed
            if waits and (beyond or is_held(after.node)):
                held[key] = True
        return held[key]

    return frozenset(
        key for key, node in system.nodes.items() if node.planned.managed and not is_held(key)
    )
