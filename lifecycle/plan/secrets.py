"""Redacts environment variables that hold secrets, by their names, from what is shown or recorded.

Owns: which names those are, and what is written in place of a value. Whatever leaves the supervisor
and the processes that it starts, on a terminal, on disk or on the network, goes through here. Pure.
"""

from __future__ import annotations

import re
from typing import TypeVar

from msgspec.structs import replace

from lifecycle.manifest.model import Run
from lifecycle.plan.model import Plan, PlannedProcess

REDACTED = "(redacted)"

_Started = TypeVar("_Started", Run, PlannedProcess)

_SECRET = re.compile(
    "TOKEN|SECRET|PASSW|PASSPHRASE|(^|_)PASS(_|$)|_PWD$|CREDENTIAL|PRIVATE|COOKIE"
    "|(API|ACCESS)_?KEY|(^|_)KEYS?$|AUTH(?!OR)",
    re.IGNORECASE,
)

_PASSWORD_IN_URL = re.compile(r"(?<=://)([^/?#@\s:]*):[^/@\s]+(?=@)")
"""RFC 3986 section 3.2.1, `user:password@`."""


def shown(variable: str, value: str) -> str:
    """Return the value of an environment variable as it may be shown."""
    if _SECRET.search(variable):
        return REDACTED
    return _PASSWORD_IN_URL.sub(rf"\1:{REDACTED}", value)


def without_secrets(plan: Plan) -> Plan:
    """Return `plan` without values of environment variables whose names say they are secret."""
    nodes = tuple(replace(each, run=_redacted(each.run)) for each in plan.nodes)
    processes = tuple(replace(_redacted(each), run=_redacted(each.run)) for each in plan.processes)
    return replace(plan, nodes=nodes, processes=processes)


def _redacted(of: _Started) -> _Started:
    return replace(
        of, environment=tuple((name, shown(name, value)) for name, value in of.environment)
    )
