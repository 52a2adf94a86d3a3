"""Programs networks from verified flows: nftables and tc on this host, NEF and CAMARA over HTTP.

Owns: everything between flow reports and a network that treats those flows as declared. Targets
touch only what a ledger or a mark says is ours. Public: what is in `__all__`.
"""

from __future__ import annotations

from lifecycle.supervisor.programming.changes import Change, ChangeKind, Changes, Target
from lifecycle.supervisor.programming.errors import (
    HttpError,
    MissingFeatureError,
    NotOursError,
    PartlyError,
    PrivilegeError,
    ProgrammingError,
    SettingsError,
)
from lifecycle.supervisor.programming.keeper import Keeper
from lifecycle.supervisor.programming.orphans import Swept, remove_run, sweep_orphans
from lifecycle.supervisor.programming.programmer import (
    Programmer,
    Treatment,
    open_programmer,
)
from lifecycle.supervisor.programming.targets import KINDS, TargetOptions
from lifecycle.supervisor.programming.tc import parse_queue, parse_rate

__all__ = [
    "KINDS",
    "Change",
    "ChangeKind",
    "Changes",
    "HttpError",
    "Keeper",
    "MissingFeatureError",
    "NotOursError",
    "PartlyError",
    "PrivilegeError",
    "Programmer",
    "ProgrammingError",
    "SettingsError",
    "Swept",
    "Target",
    "TargetOptions",
    "Treatment",
    "open_programmer",
    "parse_queue",
    "parse_rate",
    "remove_run",
    "sweep_orphans",
]
