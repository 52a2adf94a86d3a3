"""`lifecycle flows apply`, `diff` and `remove`: programming networks from verified flows.

Owns: their options and what they print. `with_subcommands` puts them behind `lifecycle flows`.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from lifecycle.cli.common import load_manifest, manifest_arguments, timeout_option
from lifecycle.errors import ExitCode, UsageError
from lifecycle.printable import lines

if TYPE_CHECKING:
    from lifecycle.plan import Plan
    from lifecycle.programming import Programmer, TargetChanges, TargetOptions, Treatment
    from lifecycle.verify import FlowReport, Verdict

F = TypeVar("F", bound=Callable[..., Any])

_TARGETS = ("nft", "tc", "nef", "camara")


class _WithSubcommands(click.Group):
    """`flows apply …` is a subcommand, `flows MANIFEST …` is the command itself."""

    def __init__(self, show: click.Command, subcommands: Sequence[click.Command]) -> None:
        super().__init__(
            show.name, params=[], help=show.help, commands=list(subcommands), add_help_option=True
        )
        self._show = show

    def make_context(
        self,
        info_name: str | None,
        args: list[str],
        parent: click.Context | None = None,
        **extra: Any,
    ) -> click.Context:
        """Choose by the first argument."""
        if args and args[0] in (*self.commands, "-h", "--help"):
            return super().make_context(info_name, args, parent=parent, **extra)
        return self._show.make_context(info_name, args, parent=parent, **extra)

    def format_usage(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Show the command's own usage first."""
        self._show.format_usage(ctx, formatter)
        formatter.write_usage(ctx.command_path, "apply|diff|remove ...")

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Show the command's own options, then the subcommands."""
        self._show.format_options(ctx, formatter)
        self.format_commands(ctx, formatter)

    def invoke(self, ctx: click.Context) -> Any:
        """Run what the context was made for; below another group, click does so itself."""
        return super().invoke(ctx) if ctx.command is self else ctx.command.invoke(ctx)


def with_subcommands(show: click.Command) -> click.Group:
    """Return `lifecycle flows`: `show`, and beside it apply, diff and remove."""
    return _WithSubcommands(show, (apply_command, diff_command, remove_command))


def target_options(function: F) -> F:
    """Add the options that say which networks to program; collect them with `chosen`."""
    return _which("--target", "Network to program; may be given several times.", function)


def program_options(function: F) -> F:
    """Add the same options to `lifecycle up`, where `--program` is `--target`."""
    return _which(
        "--program",
        "Program this network with the verified flows while active; may be given several times.",
        function,
    )


def _which(name: str, text: str, function: F) -> F:
    choice = click.option(name, "targets", type=click.Choice(_TARGETS), multiple=True, help=text)
    return choice(network_options(function))


def network_options(function: F) -> F:
    """Add the options that say where networks are."""
    for option in reversed(
        (
            click.option("--device", metavar="DEV", default="", help="tc: the device, eth0."),
            click.option(
                "--rate", metavar="RATE", default="", help="tc: rate of the link behind it, 20mbit."
            ),
            click.option(
                "--guarantee",
                "guarantees",
                metavar="CLASS=RATE",
                multiple=True,
                help="tc: rate of a class, ef=2mbit; above its burst peak.",
            ),
            click.option(
                "--queue",
                metavar="TIME",
                default="",
                help="tc: how long the queue of a class may become at that rate; else 50ms.",
            ),
            click.option(
                "--match",
                type=click.Choice(("flow", "mark")),
                default="flow",
                show_default=True,
                help="tc: look at 5-tuples, or at what is marked.",
            ),
            click.option(
                "--config",
                metavar="FILE",
                default="",
                help="nef, camara: where the server is and where the token is.",
            ),
        )
    ):
        function = option(function)
    return function


def chosen(
    targets: Iterable[str],
    *,
    device: str,
    rate: str,
    guarantees: Iterable[str],
    match: str,
    config: str,
    queue: str = "",
    option: str = "--target",
) -> tuple[TargetOptions, ...]:
    """Return the options of `target_options` as the supervisor takes them.

    Args:
        targets: kinds of networks.
        device: see `network_options`.
        rate: see `network_options`.
        guarantees: see `network_options`.
        match: see `network_options`.
        config: see `network_options`.
        queue: see `network_options`.
        option: what chose the targets, for messages.

    Raises:
        UsageError: they do not fit together.
    """
    from lifecycle.programming import TargetOptions, TcMatch, parse_queue, parse_rate

    kinds = tuple(dict.fromkeys(targets))
    if "tc" not in kinds and (device or rate or any(guarantees)):
        raise UsageError(f"cannot use --device, --rate or --guarantee without {option} tc")
    if queue and not rate:
        raise UsageError("cannot use --queue without --rate: how long it is follows from both")
    if config and not {"nef", "camara"} & set(kinds):
        raise UsageError(f"cannot use --config without {option} nef or camara")
    try:
        link_kbit = parse_rate(rate) if rate else None
        queue_ms = parse_queue(queue) if queue else None
        guaranteed_kbit = {name: parse_rate(text) for name, text in map(_guarantee, guarantees)}
    except ValueError as error:
        raise UsageError(str(error)) from error
    return tuple(
        TargetOptions(
            kind=kind,
            device=device if kind == "tc" else "",
            link_kbit=link_kbit,
            guaranteed_kbit=guaranteed_kbit,
            match=TcMatch(match),
            queue_ms=queue_ms if kind == "tc" else None,
            settings=config if kind in ("nef", "camara") else "",
        )
        for kind in kinds
    )


def treatment_options(function: F) -> F:
    """Add the options that say what flows get beyond the manifest; collect with `treatment_of`."""
    function = click.option(
        "--flow-labels", is_flag=True, help="Give each IPv6 flow a flow label of its own."
    )(function)
    return click.option(
        "--dscp-from-5qi",
        "mapping",
        metavar="NAME|FILE",
        default="",
        help="Mark flows that have a 5QI and no DSCP by this mapping.",
    )(function)


def treatment_of(*, mapping: str, flow_labels: bool) -> Treatment:
    """Return the options of `treatment_options` as the supervisor takes them.

    Raises:
        UsageError: no such mapping, or its file cannot be used.
    """
    from lifecycle.network import dscp_mapping, parse_mapping
    from lifecycle.programming import Treatment

    if not mapping:
        return Treatment(label_flows=flow_labels)
    try:
        file = Path(mapping)
        found = parse_mapping(file.read_bytes()) if file.is_file() else dscp_mapping(mapping)
    except (OSError, ValueError) as error:
        raise UsageError(str(error)) from error
    return Treatment(mapping=found, label_flows=flow_labels)


def apply(
    plan: Plan,
    flows: Sequence[FlowReport],
    options: Sequence[TargetOptions],
    *,
    dry_run: bool,
    treatment: Treatment | None = None,
) -> int:
    """Program the networks with the verified flows, and say what was done.

    What is made stays until `remove`, or until the system is brought down.
    """
    from lifecycle.programming import PartlyError

    programmer = _open(plan, options, treatment)
    try:
        if dry_run:
            click.echo(programmer.dry_run(flows), nl=False)
        else:
            try:
                _show(programmer.update(flows), done=True)
            except PartlyError as error:
                if error.done:
                    error.hint = f"take back what was done: lifecycle flows remove {_spell(plan)}"
                raise
        _show_left_out(programmer)
    finally:
        programmer.release()
    return ExitCode.OK


def diff(
    plan: Plan,
    flows: Sequence[FlowReport],
    options: Sequence[TargetOptions],
    *,
    treatment: Treatment | None = None,
) -> int:
    """Say what `apply` would do.

    Returns:
        VIOLATED if a network is not as the verified flows want it.
    """
    programmer = _open(plan, options, treatment)
    try:
        changes = programmer.diff(flows)
        _show(changes, done=False)
        _show_left_out(programmer)
    finally:
        programmer.release()
    return ExitCode.VIOLATED if any(each.pending for each in changes) else ExitCode.OK


def remove(plan: Plan) -> int:
    """Remove everything of the system from every network that it was applied to."""
    changes = _open(plan, ()).close()
    if changes:
        _show(changes, done=True)
    else:
        click.echo(f"nothing of system {plan.system} is in any network")
    return ExitCode.OK


@click.command("apply")
@manifest_arguments
@target_options
@treatment_options
@click.option("--dry-run", is_flag=True, help="Print what would be sent; check it if possible.")
@timeout_option(5.0, "How long flows that are not complete may still become so.")
def apply_command(
    *,
    manifest: str,
    assignments: tuple[str, ...],
    targets: tuple[str, ...],
    dry_run: bool,
    timeout: float,
    mapping: str,
    flow_labels: bool,
    **rest: Any,
) -> int:
    """Program networks with the verified flows of a running system.

    Only flows whose verdict is ok; only what is ours is touched; a second time changes nothing.
    """
    options = _some(chosen(targets, **rest))
    treatment = treatment_of(mapping=mapping, flow_labels=flow_labels)
    plan, verdict = _judged(manifest, assignments, timeout)
    done = apply(plan, verdict.flows, options, dry_run=dry_run, treatment=treatment)
    return done or _exit_code(verdict)


@click.command("diff")
@manifest_arguments
@target_options
@treatment_options
@timeout_option(5.0, "How long flows that are not complete may still become so.")
def diff_command(
    *,
    manifest: str,
    assignments: tuple[str, ...],
    targets: tuple[str, ...],
    timeout: float,
    mapping: str,
    flow_labels: bool,
    **rest: Any,
) -> int:
    """Compare networks with the verified flows; exits with 4 where they differ."""
    options = _some(chosen(targets, **rest))
    treatment = treatment_of(mapping=mapping, flow_labels=flow_labels)
    plan, verdict = _judged(manifest, assignments, timeout)
    return diff(plan, verdict.flows, options, treatment=treatment) or _exit_code(verdict)


@click.command("remove")
@manifest_arguments
def remove_command(manifest: str, assignments: tuple[str, ...]) -> int:
    """Remove from networks everything that was applied for a system, running or not."""
    return remove(_plan(manifest, assignments))


def _some(options: tuple[TargetOptions, ...]) -> tuple[TargetOptions, ...]:
    if not options:
        raise UsageError(f"cannot program no network; give --target {'|'.join(_TARGETS)}")
    return options


def _guarantee(text: str) -> tuple[str, str]:
    name, equals, rate = text.partition("=")
    if not (name and equals and rate):
        raise ValueError(f"cannot read guarantee {text!r}; write CLASS=RATE, ef=2mbit")
    return name, rate


def _plan(manifest: str, assignments: tuple[str, ...]) -> Plan:
    from lifecycle.plan import build_plan

    return build_plan(load_manifest(manifest, assignments).manifest)


def _judged(manifest: str, assignments: tuple[str, ...], timeout_s: float) -> tuple[Plan, Verdict]:
    from lifecycle.supervisor import judge_running

    seen = judge_running(_plan(manifest, assignments), timeout_s=timeout_s, strict=False)
    if seen.where:
        click.echo(lines(seen.where), err=True)
    return seen.plan, seen.verdict


def _exit_code(verdict: Verdict) -> int:
    from lifecycle.cli.verbs.verify import exit_code

    return exit_code(verdict, strict=False)


def _spell(plan: Plan) -> str:
    return shlex.quote(plan.manifest_path)


def _open(
    plan: Plan, options: Sequence[TargetOptions], treatment: Treatment | None = None
) -> Programmer:
    from lifecycle.programming import open_programmer

    return open_programmer(plan, options, environment=os.environ, treatment=treatment)


def _show(changes: Iterable[TargetChanges], *, done: bool) -> None:
    for each in changes:
        click.echo(each.render(done=done))


def _show_left_out(programmer: Programmer) -> None:
    """On stderr, beside a ruleset or bodies that go to a file."""
    for each in programmer.left_out:
        click.echo(lines(f"left out: {each}"), err=True)
