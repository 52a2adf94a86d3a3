"""`lifecycle up`: start, configure, connect, verify, and only then activate."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from lifecycle.cli import common
from lifecycle.cli.report import ReportFile, report_option
from lifecycle.errors import ExitCode

if TYPE_CHECKING:
    from pathlib import Path

    from lifecycle.cli.up_output import RunOutput
    from lifecycle.supervisor.run.options import UpResult


@click.command("up")
@common.manifest_arguments
@common.format_option("text", "json")
@click.option(
    "--until",
    type=click.Choice(["connected", "verified", "active"]),
    default="active",
    show_default=True,
    help="Bring it so far, report, and shut down (an active system is held until told to end).",
)
@click.option(
    "--stop-after",
    type=click.FloatRange(min=0),
    metavar="SECONDS",
    help="Hold it so long, then shut down; no success if it ended before, or was violated.",
)
@common.timeout_option(
    None,
    "For everything from the first start to the system being active.",
    default="30, and 1 for each process",
)
@report_option
@click.option("--strict", is_flag=True, help="What cannot be verified keeps the gate closed.")
@common.machine_option("Run only this machine's nodes; default: all whose address is this host's.")
@click.option(
    "--keep-going",
    is_flag=True,
    help="Report a process that dies, but do not take the others down.",
)
@click.option(
    "--except",
    "without",
    multiple=True,
    metavar="NODE",
    shell_complete=common.completing("nodes"),
    help="Do not start it, but wait for it: `lifecycle run MANIFEST NODE --manual`, in a debugger. "
    "May be given several times.",
)
@click.option(
    "--adopt",
    is_flag=True,
    help="Nodes that run already are verified in place and not started; found active, they stay so "
    "in the end, too.",
)
@click.option(
    "--domain",
    type=click.IntRange(0, 232),
    metavar="ID",
    help="The domain, in the place of the manifest's.",
)
@common.network_options(
    "--program",
    "targets",
    help_="Program this network with the verified flows while active; may be given several times.",
    multiple=True,
)
def command(
    *,
    manifest: str,
    assignments: tuple[str, ...],
    format_: str,
    until: str,
    stop_after: float | None,
    timeout: float | None,
    report: Path | None,
    strict: bool,
    machine: str,
    keep_going: bool,
    without: tuple[str, ...],
    adopt: bool,
    domain: int | None,
    targets: tuple[str, ...],
    **rest: Any,
) -> int:
    """Bring a system up: start, configure, connect, verify, and only then activate.

    MANIFEST is a file, or PACKAGE FILE, as `ros2 launch` takes it; so it is for other verbs.

    Ctrl-C ends it in reverse order (exit 130), a second one kills. SIGTERM, SIGHUP and `lifecycle
    down` do so too: exit 0 if it was verified and as far up as was asked for, else 143, 129 and 6.
    If a process dies, the others are taken down and the exit code is 6.

    --program tells networks which flows were verified before anything is activated, and takes it
    back in the end.
    """
    from lifecycle.supervisor.processes.fork_server_main import ForkServerProcess
    from lifecycle.supervisor.run.signals import Ended, Ending

    is_program = bool(click.get_current_context().obj)
    try:
        with (
            # The reported result of the run is final, and the interpreter takes a moment to end.
            Ending(is_last=is_program) as ending,
            ReportFile(report, strict=strict) as written,
            ending.unmasked(),
        ):
            program = common.read_networks(targets, rest, option="--program")
            # It imports while we do and read the manifest. Nothing that is started has a token.
            process = ForkServerProcess(
                without=program.token_variables if program else frozenset(),
                programs=program is not None,
            )
            try:
                plan = common.load_plan(manifest, assignments, machine=machine, domain_id=domain)
                if without:
                    from lifecycle.plan.build import started_by_others

                    plan = started_by_others(plan, without)
                written.begin(plan)
                from lifecycle.cli.up_output import output
                from lifecycle.supervisor.control.status import ended_early
                from lifecycle.supervisor.run.options import Until, UpOptions
                from lifecycle.supervisor.run.up import up

                options = UpOptions(
                    until=Until(until),
                    stop_after_s=stop_after,
                    timeout_s=timeout,
                    strict=strict,
                    machine=machine,
                    keep_going=keep_going,
                    adopt=adopt,
                    program=program,
                )
                with output(format_) as listener, ending.noted():

                    def conclude(result: UpResult) -> ExitCode:
                        return _finished(result, listener, written)

                    try:
                        return up(
                            plan,
                            options,
                            listener,
                            process=process,
                            ending=ending,
                            on_start=listener.watch,
                            conclude=conclude,
                        ).exit_code
                    except Ended as ended:
                        return conclude(ended_early(ended.reason, ended.exit_code))
            finally:
                process.close()
    except Ended as ended:
        common.say(f"ended before anything was started: {ended.reason}")
        return ended.exit_code


def _finished(result: UpResult, listener: RunOutput, written: ReportFile) -> ExitCode:
    """Write and show how a run ended; return its exit code, no success without its report."""
    unwritten = written.end(result.verdict, result.plan)
    listener.finish(result)
    return result.exit_code or unwritten
