"""Brings a system up behind the gate, watches it, and takes it down: processes, order, rollback.

Owns: everything between a plan and a running system. Public: `up` and what it takes and gives,
`status` and `down` of a running one, `judge_running` for a system that others run. Names
load on first use: the fork server, which is of this room, must start without the rest of it.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lifecycle.supervisor.control.client import down, find_run, running, status
    from lifecycle.supervisor.control.status import NodeStatus, SystemStatus
    from lifecycle.supervisor.run.attach import follow_running, judge_running
    from lifecycle.supervisor.run.events import Emitter, Event, Listener, to_record
    from lifecycle.supervisor.run.failure import ended_early
    from lifecycle.supervisor.run.options import Until, UpOptions, UpResult
    from lifecycle.supervisor.run.up import Forerunner, up

__all__ = [
    "Emitter",
    "Event",
    "Forerunner",
    "Listener",
    "NodeStatus",
    "SystemStatus",
    "Until",
    "UpOptions",
    "UpResult",
    "down",
    "ended_early",
    "find_run",
    "follow_running",
    "judge_running",
    "running",
    "status",
    "to_record",
    "up",
]

_HOME = {
    "Emitter": "run.events",
    "Event": "run.events",
    "Forerunner": "run.up",
    "Listener": "run.events",
    "NodeStatus": "control.status",
    "SystemStatus": "control.status",
    "Until": "run.options",
    "UpOptions": "run.options",
    "UpResult": "run.options",
    "down": "control.client",
    "ended_early": "run.failure",
    "find_run": "control.client",
    "follow_running": "run.attach",
    "judge_running": "run.attach",
    "running": "control.client",
    "status": "control.client",
    "to_record": "run.events",
    "up": "run.up",
}


def __getattr__(name: str) -> object:
    """Import the module that defines `name` (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
