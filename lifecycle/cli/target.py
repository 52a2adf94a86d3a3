"""Which running system a verb is about, and giving it an order.

Owns: `TARGET [name:=value …]` of `down`, `status` and the verbs that order something.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from lifecycle.cli.common import load_manifest, timeout_option
from lifecycle.errors import ExitCode, UsageError
from lifecycle.printable import lines

if TYPE_CHECKING:
    from lifecycle.plan import Plan

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
    """Return the run directory that a target names: a manifest's, or a system's by name.

    A manifest that is no longer the one that runs is reported on stderr, and makes no difference.

    Raises:
        UsageError: no such run.
        ManifestError: the manifest cannot be loaded, so that its domain is not known.
    """
    path, plan = target_plan(environment, target, assignments, machine)
    if plan is not None:
        _say_differences(path, plan)
    return path


def _say_differences(path: Path, plan: Plan) -> None:
    from lifecycle.supervisor import differences

    if found := differences(path, plan):
        listed = "\n".join(found)
        click.echo(
            f"{plan.manifest_path} is not the manifest that {path.name} runs:\n{listed}", err=True
        )


def target_plan(
    environment: Mapping[str, str], target: str, assignments: tuple[str, ...], machine: str
) -> tuple[Path, Plan | None]:
    """Return the run directory that a target names, and the plan if it is a manifest.

    Raises:
        UsageError: no such run, or arguments for a system that is named.
        ManifestError: the manifest cannot be loaded.
    """
    from lifecycle.run_directory import run_name, runtime_root
    from lifecycle.supervisor import find_run

    root = runtime_root(environment)
    if not os.path.isfile(target):  # noqa: PTH113 - Path.is_file() raises for a name too long
        if assignments:
            raise UsageError(
                f"cannot use {' '.join(assignments)} with the running system {target!r}",
                hint="arguments belong to a manifest; name its file",
            )
        return find_run(root, target), None
    from lifecycle.plan import build_plan

    plan = build_plan(load_manifest(target, assignments, quiet=True).manifest)
    return find_run(root, run_name(plan, machine)), plan


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
    *,
    reload: bool = False,
) -> int:
    """Have a running supervisor carry out an order; say why where it does not.

    Args:
        verb: an order.
        target: a manifest, or a running system.
        assignments: `name:=value` of the manifest.
        machine: as it was given to `up`.
        timeout: seconds.
        node: for `restart`, one node; empty for all.
        reload: for `restart`, take the manifest as it is now.

    Returns:
        Its exit code: 2 if the order does not fit what the system is doing, 4 or 5 if the gate
        stays closed, 6 if a step failed or took longer than `timeout` seconds.

    Raises:
        UsageError: no such run, or no manifest to reload.
        ManifestError: the manifest cannot be loaded.
    """
    from lifecycle.supervisor import ControlRequest, Question, order

    path, plan = target_plan(os.environ, target, assignments, machine)
    if reload and plan is None:
        raise UsageError(
            f"cannot reload {target!r}: it is no manifest", hint="name the manifest's file"
        )
    if verb == "pause" and plan is not None:
        _say_differences(path, plan)
    if reload:
        load_manifest(target, assignments, quiet=True, machine=machine)
    question = Question(ask=ControlRequest(verb), node=node, plan=plan, reload=reload)
    try:
        answer = order(path, question, timeout)
    except TimeoutError:
        click.echo(f"cannot {verb} {path.name!r} within {timeout:g} s; it is still at it", err=True)
        return ExitCode.BRING_UP_FAILED
    if answer.error:
        click.echo(lines(answer.error), err=True)
    assert answer.exit_code is not None
    return answer.exit_code
