"""`lifecycle flows`: show, record and export flows; `apply` and `remove` program networks."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shlex
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lifecycle.cli import common
from lifecycle.cli.flow_tables import Record, render_flows, watched_flows
from lifecycle.cli.report import exit_code
from lifecycle.cli.standard_streams import watched
from lifecycle.errors import ExitCode, UsageError
from lifecycle.printable import count, lines
from lifecycle.programming import TARGETS
from lifecycle.run_directory import run_name, runtime_root
from lifecycle.verify.judge import not_ok
from lifecycle.verify.verdict import FlowReport, Verdict

if TYPE_CHECKING:
    from lifecycle.plan.model import Plan
    from lifecycle.programming.programmer import Programmer
    from lifecycle.programming.target import Program
    from lifecycle.supervisor.run.looking import JudgedSystem


def export(plan: Plan, flows: Sequence[FlowReport], program: Program) -> None:
    """Print flows as a network takes them; those that are not in it, and why, go to stderr.

    Raises:
        UsageError: it cannot be exported so.
    """
    programmer = _open(plan, program)
    try:
        text = programmer.export(flows)
    except ValueError as error:
        raise UsageError(str(error), hint=program.targets[0].target.hint) from error
    click.echo(text, nl=False)
    _show_left_out(programmer.left_out)


_timeout = common.timeout_option(5.0, "How long flows that are not complete may still become so.")


class _ShowsByDefault(click.Group):
    """`flows apply …` is a subcommand, `flows TARGET …` shows."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Take what names no subcommand for what to show."""
        known = args and args[0] in (*self.commands, "-h", "--help")
        return super().parse_args(ctx, args if known else ["show", *args])

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the options of showing, then the subcommands."""
        self.commands["show"].format_options(ctx, formatter)
        self.format_commands(ctx, formatter)


@click.group(
    "flows",
    cls=_ShowsByDefault,
    subcommand_metavar="TARGET [NAME:=VALUE]... | apply|remove MANIFEST ...",
)
def command() -> None:
    """Show every publisher → subscription pair of a running system.

    TARGET is a manifest, or the name of a system that a supervisor runs on this host.

    One line per network flow: rate, delay and loss as far as they are measured, its 5-tuple, on
    IPv6 its flow label, DSCP and TOS byte, how unique it is, what was required and the verdict.
    Beside a number is how much of its declared bound it is; `!` is not kept, `?` not decided.
    Exits as `lifecycle verify` does.
    """


@command.command("show", hidden=True)
@common.target_argument
@common.assignments_argument
@common.format_option("text", "json", "csv")
@click.option("--watch", is_flag=True, help="Show them again whenever they change; Ctrl-C ends.")
@click.option(
    "--record",
    type=click.Path(dir_okay=False, path_type=Path),
    metavar="FILE",
    help="Write what is measured into a CSV file, each second a row for each flow, until Ctrl-C.",
)
@_timeout
@common.network_options(
    "--export",
    "export_",
    help_="Print the verified flows as rules, settings or request bodies of another system "
    "instead.",
)
def _show(
    *,
    target: str,
    assignments: tuple[str, ...],
    format_: str,
    watch: bool,
    record: Path | None,
    timeout: float,
    export_: str | None,
    **rest: Any,
) -> int:
    from lifecycle.supervisor.run import looking

    if record is not None and (watch or export_ is not None):
        raise UsageError("cannot use --record with --watch or --export; run each by itself")
    if watch and export_ is not None:
        raise UsageError("cannot use --export with --watch; export once")
    # What is exported for a network takes what programming it takes.
    program = common.read_networks((export_,) if export_ else (), rest, option="--export")
    plan = _plan_of(target, assignments)
    if record is not None:
        with contextlib.closing(Record(record)) as written:
            try:
                over = _follow(plan, lambda verdict: written.add(verdict.measured))
            finally:
                common.say(f"{count(written.rows, 'row')} in {str(record)!r}")
    elif watch:
        with watched(whole=format_ == "text") as show:
            over = _follow(plan, lambda verdict: show(watched_flows(verdict, format_)))
    if record is not None or watch:
        common.say(over)
        return ExitCode.OK
    seen = looking.judge_running(plan, timeout_s=timeout, strict=False)
    seen = looking.with_supervisors_numbers(seen)
    for each in seen.notices:
        common.say(each)
    if program is not None:
        export(seen.plan, seen.verdict.flows, program)
    else:
        flows, measured = seen.verdict.flows, seen.verdict.measured
        click.echo(render_flows(flows, format_, measured, colour=sys.stdout.isatty()))
    return exit_code(seen.verdict, strict=False)


def _measuring(plan: Plan) -> Path | None:
    """Return the run of the supervisor on this host that measures a system; None without one."""
    from lifecycle.supervisor.run.looking import supervisor_of

    machine_of = {each.key: each.machine for each in plan.nodes}
    takes = sorted({machine_of[each.subscription] for each in plan.flows}) if plan.bounds else []
    found = (supervisor_of(os.environ, plan, each) for each in ("", *takes) if takes)
    return next((each for each in found if each is not None), None)


_EACH_S = 1.0
"""What is measured changes so often."""


def _follow(plan: Plan, take: Callable[[Verdict], None]) -> str:
    """Give each verdict as it changes, with what is measured; return why there are no more.

    Where no supervisor of this host measures, it is looked from outside until interrupted.
    """
    from lifecycle.supervisor.control.protocol import follow
    from lifecycle.supervisor.run.looking import follow_running

    path = _measuring(plan)
    if path is None:
        follow_running(plan, lambda seen: take(seen.verdict), each_s=_EACH_S)
        return "nothing more to see"
    with common.asking(path):
        for seen in follow(path):
            if seen.verdict is not None:
                take(seen.verdict)
    return f"{path.name}: its supervisor has ended"


def _plan_of(target: str, assignments: tuple[str, ...]) -> Plan:
    """Return the plan of a manifest, or that of a running system of this name."""
    if common.is_manifest(target) or target.endswith((".yaml", ".yml")):
        return common.load_plan(target, assignments)
    from lifecycle.supervisor.control.protocol import look

    path, _ = common.target_plan(target, assignments, "")
    with common.asking(path):
        return look(path).plan


def apply(plan: Plan, flows: Sequence[FlowReport], program: Program, *, dry_run: bool) -> bool:
    """Program the networks with the verified flows, and say what was done.

    What is made stays until `remove`, or until the system is brought down.

    Returns:
        Whether a network was, or in a dry run would be, changed.
    """
    from lifecycle.programming.target import PartlyError

    programmer = _open(plan, program)
    try:
        changes = asyncio.run(programmer.diff(flows) if dry_run else programmer.update(flows))
    except PartlyError as error:
        if error.done:
            path = shlex.quote(plan.manifest_path)
            error.hint = f"take back what was done: lifecycle flows remove {path}"
        raise
    for each in changes:
        click.echo(each.render(done=not dry_run))
    _show_left_out(programmer.left_out)
    return any(each.pending for each in changes)


def remove(plan: Plan) -> int:
    """Remove everything of the system from every network that it was applied to."""
    from lifecycle.programming.programmer import remove_programmed

    directory = runtime_root(os.environ) / run_name(plan, "")
    changes = asyncio.run(remove_programmed(directory))
    for each in changes:
        click.echo(each.render(done=True))
    if not changes:
        click.echo(f"nothing of system {plan.system} is in any network")
    return ExitCode.OK


@command.command("apply")
@common.manifest_arguments
@common.network_options(
    "--target",
    "targets",
    help_="Network to program; may be given several times.",
    multiple=True,
)
@click.option("--dry-run", is_flag=True, help="Say what would change; exits with 4 if anything.")
@_timeout
def _apply(
    *,
    manifest: str,
    assignments: tuple[str, ...],
    targets: tuple[str, ...],
    dry_run: bool,
    timeout: float,
    **rest: Any,
) -> int:
    """Program networks with the verified flows of a running system.

    Only flows whose verdict is ok; only what is ours is touched; a second time changes nothing.
    Where a manifest declares a delay, a rate or a loss, it is measured before and after.
    """
    program = common.read_networks(targets, rest, option="--target")
    if program is None:
        raise UsageError(f"cannot program no network; give --target {'|'.join(TARGETS)}")
    from lifecycle.supervisor.run.looking import judge_running, with_supervisors_numbers

    plan = common.load_plan(manifest, assignments)
    seen = judge_running(plan, timeout_s=timeout, strict=False)
    seen = with_supervisors_numbers(seen)
    for each in seen.notices:
        common.say(each)
    flows = seen.verdict.flows
    changed = apply(seen.plan, flows, program, dry_run=dry_run)
    if changed and dry_run:
        return ExitCode.VIOLATED
    if changed and plan.bounds:
        seen = _measured_again(seen)
    if code := exit_code(seen.verdict, strict=False):
        found = f"{seen.verdict.verdict.value}; {not_ok(seen.verdict)}"
        common.say(f"the system is {found}")
    return code


def _measured_again(seen: JudgedSystem) -> JudgedSystem:
    """Say what was measured before networks were changed, and after; return what is so after."""
    before = [each for each in seen.verdict.measured if each.bounds]
    if not before:
        machine = {each.full_name: each.machine for each in seen.plan.nodes}
        there = sorted({machine[each.subscription] for each in seen.verdict.flows} - {""})
        on = f" on {' and '.join(there)}" if there else ""
        common.say(f"what arrives is measured{on}: see `lifecycle status {seen.plan.system}` there")
        return seen
    common.say(f"measuring for {_FRESH_S:g} s what has changed")
    from lifecycle.supervisor.run.looking import with_supervisors_numbers

    time.sleep(_FRESH_S)
    for _ in range(_SETTLED_S):
        seen = with_supervisors_numbers(seen)
        if not any(each.violated for each in seen.verdict.measured):
            break
        time.sleep(1.0)
    now = {each.pair: each.describe() for each in seen.verdict.measured}
    for each in before:
        click.echo(lines(f"before: {each.describe()}"))
        click.echo(lines(f"after:  {now.get(each.pair, f'{each.name}: not measured')}"))
    return seen


_FRESH_S = 6.0
"""Then delays are of messages that came after a change: of the last 5 s, reported within 1 s."""

_SETTLED_S = 4
"""Seconds more for numbers that are not kept: they may be of a queue that was full before."""


@command.command("remove")
@common.manifest_arguments
def _remove(manifest: str, assignments: tuple[str, ...]) -> int:
    """Remove from networks everything that was applied for a system, running or not."""
    return remove(common.load_plan(manifest, assignments))


def _open(plan: Plan, program: Program) -> Programmer:
    from lifecycle.programming.programmer import open_programmer

    return open_programmer(plan, program, environment=os.environ)


def _show_left_out(flows: Iterable[str]) -> None:
    """On stderr, beside a ruleset or bodies that go to a file."""
    for each in flows:
        common.say(f"left out: {each}")
