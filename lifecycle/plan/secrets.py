"""Redacts environment variables that hold secrets, by their names, from what is shown or recorded.

Owns: which names those are, and what is written in place of a value. Whatever leaves the supervisor
and the processes that it starts, on a terminal, on disk or on the network, goes through here. Pure.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

from msgspec.structs import replace

from lifecycle.plan.model import Plan

REDACTED = "(redacted)"

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
    nodes = tuple(
        replace(
            node,
            run=replace(node.run, environment=_redacted(node.run.environment)),
        )
        if _has_secrets(node.run.environment)
        else node
        for node in plan.nodes
    )
    processes = tuple(
        replace(
            process,
            environment=_redacted(process.environment),
            run=replace(process.run, environment=_redacted(process.run.environment)),
        )
        if _has_secrets((*process.environment, *process.run.environment))
        else process
        for process in plan.processes
    )
    if nodes == plan.nodes and processes == plan.processes:
        return plan
    return replace(plan, nodes=nodes, processes=processes)


def _has_secrets(variables: Iterable[tuple[str, str]]) -> bool:
    return any(shown(name, value) != value for name, value in variables)


def _redacted(variables: Iterable[tuple[str, str]]) -> tuple[tuple[str, str], ...]:
    return tuple((name, shown(name, value)) for name, value in variables)
