"""Which running system a verb is about, and giving it an order.

Owns: `TARGET [name:=value …]` of `down`, `status` and the verbs that order something.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import click

from lifecycle.cli.common import timeout_option
from lifecycle.errors import ExitCode

F = TypeVar("F", bound=Callable[..., Any])


def target_arguments(function: F) -> F:
    """Add `TARGET [NAME:=VALUE …]` and `--machine` to a verb."""
    function = click.option(
        "--machine", default="", metavar="NAME", help="As it was given to `lifecycle up`."
    )(function)
    function = click.argument("assignments", nargs=-1, metavar="[NAME:=VALUE]...")(function)
    return click.argument("target", metavar="TARGET")(function)


def target_run(
    environment: Mapping[str, str], target: str, assignments: tuple[str, ...], machine: str
) -> Path:
    """Return the run directory that a word means: a manifest's, or a system's by name.

    Raises:
        UsageError: no such run.
        ManifestError: the manifest cannot be loaded, so that its domain is not known.
    """
    from lifecycle.supervisor.remote import find_run
    from lifecycle.supervisor.rundir import run_name, runtime_root

    root = runtime_root(environment)
    if not Path(target).is_file():
        return find_run(root, target)
    from lifecycle.cli.common import load_manifest
    from lifecycle.plan import build_plan

    plan = build_plan(load_manifest(target, assignments, quiet=True).manifest)
    return find_run(root, run_name(plan, machine))


def order_timeout(function: F) -> F:
    """Add `--timeout` to a verb that orders something."""
    return timeout_option(60.0, "How long to wait for it.")(function)


def give_order(  # noqa: PLR0917 - in the order of the command line
    verb: str,
    target: str,
    assignments: tuple[str, ...],
    machine: str,
    timeout: float,
    node: str = "",
) -> int:
    """Have a running supervisor carry out an order; say why where it does not.

    Returns:
        Its exit code: 2 if the order does not fit what the system is doing, 4 or 5 if the gate
        stays closed, 6 if a step failed or took longer than `timeout` seconds.

    Raises:
        UsageError: no such run.
    """
    from lifecycle.supervisor.remote import order
    from lifecycle.supervisor.server import Ask

    path = target_run(os.environ, target, assignments, machine)
    try:
        answer = order(path, Ask(verb), timeout, node=node)
    except TimeoutError:
        click.echo(f"cannot {verb} {path.name!r} within {timeout:g} s; it is still at it", err=True)
        return ExitCode.BRING_UP_FAILED
    if answer.error:
        click.echo(answer.error, err=True)
    assert answer.exit_code is not None
    return answer.exit_code
