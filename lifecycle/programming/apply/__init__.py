"""Programs networks from verified flows: nftables and tc on this host, NEF and CAMARA over HTTP.

Owns: everything between flow reports and a network that treats those flows as declared. Targets
touch only what a ledger or a mark says is ours. Public: what is in `__all__`.
"""

from __future__ import annotations

from lifecycle.programming.apply.changes import ChangeKind, FlowChange, Target, TargetChanges
from lifecycle.programming.apply.errors import (
    HttpError,
    MissingFeatureError,
    NotOursError,
    PartlyError,
    PrivilegeError,
    ProgrammingError,
    SettingsError,
)
from lifecycle.programming.apply.programmer import (
    Programmer,
    Swept,
    Treatment,
    open_programmer,
    remove_run,
    sweep_orphans,
)
from lifecycle.programming.apply.targets import KINDS, TargetOptions
from lifecycle.programming.apply.tc import parse_queue, parse_rate

__all__ = [
    "KINDS",
    "ChangeKind",
    "FlowChange",
    "HttpError",
    "MissingFeatureError",
    "NotOursError",
    "PartlyError",
    "PrivilegeError",
    "Programmer",
    "ProgrammingError",
    "SettingsError",
    "Swept",
    "Target",
    "TargetChanges",
    "TargetOptions",
    "Treatment",
    "open_programmer",
    "parse_queue",
    "parse_rate",
    "remove_run",
    "sweep_orphans",
]
