"""Scopes of systemd: what a process and all that it starts may use together, `run.resources`.

Owns: whether there is a service manager to ask, and the words before a command that has it limit
it (systemd-run(1), systemd.resource-control(5)). Must not import rclpy.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules import rule
from lifecycle.verify.verdict import Finding

if TYPE_CHECKING:
    from lifecycle.manifest.model import Resources
    from lifecycle.plan.model import PlannedProcess


def why_unlimited() -> str:
    """Return why no process can have a scope here; empty if they can."""
    folder = "/run"
    if os.geteuid():
        folder = os.environ.get("XDG_RUNTIME_DIR") or f"/run/user/{os.geteuid()}"
    if not Path("/run/systemd/system").is_dir():  # sd_booted(3)
        return "systemd does not run here"
    if shutil.which("systemd-run") is None:
        return "there is no systemd-run here"
    if not Path(folder, "systemd", "private").exists():
        return f"this user has no service manager here ({folder}/systemd)"
    return ""


def scope(resources: Resources | None) -> tuple[str, ...]:
    """Return the words before a command that limit it; none where nothing is to, or can be.

    The command replaces systemd-run: it has its pid, descriptors, session and environment.
    """
    properties = () if resources is None else resources.properties()
    if not properties or why_unlimited():
        return ()
    user = ("--user",) if os.geteuid() else ()
    limits = (f"--property={each}" for each in properties)
    return ("systemd-run", "--scope", "--quiet", "--collect", *user, *limits, "--")


def unlimited(processes: Iterable[PlannedProcess]) -> tuple[Finding, ...]:
    """Return an unverifiable finding for each of these processes that nothing limits as declared.

    Args:
        processes: of this host.
    """
    limited = [
        (each.name, each.run.resources)
        for each in processes
        if each.run.resources is not None and each.run.resources.properties()
    ]
    why = why_unlimited() if limited else ""
    return tuple(
        rule("declaration.unproven").finding(
            outcome=Outcome.UNVERIFIABLE,
            subject=name,
            expected=f"limited: {', '.join(resources.properties())}",
            observed="run.resources",
            message=f"cannot limit the resources of process {name!r}: {why}",
            at=resources.at,
            hint="start lifecycle where systemd runs, or limit the whole container",
        )
        for name, resources in limited
        if why
    )
