"""`lifecycle apply`: another manifest for a running system, through the gate, or back."""

from __future__ import annotations

import os
from typing import Annotated

import click
from msgspec.structs import asdict

from lifecycle.cli import common
from lifecycle.codec import Count, says
from lifecycle.errors import ExitCode
from lifecycle.printable import lines
from lifecycle.supervisor.control.protocol import ChangedNodes

_SHOWN_S = 10.0
"""For a supervisor to say what would change: it only compares two plans."""

_SPARE_S = 30.0
"""For nodes to be taken down, beside the time that becoming active and going back may take."""


_OUTCOMES = ("applied", "unchanged", "would_apply", "refused", "rolled_back")


class ApplyReport(ChangedNodes, frozen=True, kw_only=True):
    """What became of a manifest that was applied (schemas/apply.v1.schema.json).

    Attributes:
        outcome: "applied"; "unchanged": it is what runs; "would_apply" of a dry run; "refused":
            nothing was touched; "rolled_back": it could not be applied, `error` says why, and what
            the system is since.
        exit_code: of the command.
        manifest: path of the one that was to be applied.
        revision: number of the manifest in force, 1 for the one that the run began with; 0 where it
            is not known.
        error: why it was not applied; else empty.
    """

    outcome: Annotated[str, says(enum=[*_OUTCOMES])]
    exit_code: Count
    system: str
    manifest: str
    revision: Count
    error: str = ""


@click.command("apply")
@click.argument("manifest", metavar="MANIFEST", shell_complete=common.completing("manifests"))
@common.assignments_argument
@common.machine_option("As it was given to `lifecycle up`.")
@click.option("--dry-run", is_flag=True, help="Say what would change; exits with 4 if anything.")
@common.timeout_option(
    60.0, "Until the system must be active by it; else it goes back to the manifest before."
)
@common.format_option("text", "json")
def command(
    *,
    manifest: str,
    assignments: tuple[str, ...],
    machine: str,
    dry_run: bool,
    timeout: float,
    format_: str,
) -> int:
    """Have a running system run by MANIFEST, and touch nothing that is the same in it.

    Nodes are added, removed, restarted where what differs reaches their process, and given
    parameters while they run; where only rules differ nothing is but judged again. What is new is
    activated only if the gate opens on the whole of the new manifest; all else stays active
    meanwhile. If anything fails the system goes back to the manifest before, and this exits with
    4 or 5 for a verdict, with 6 for a step. Exits with 2 where a running supervisor cannot take
    it, and with 0 once the system is active and verified by it.
    """
    plan = common.load_plan(manifest, assignments, machine=machine)
    from lifecycle.run_directory import find_run, run_name, run_roots
    from lifecycle.supervisor.control.protocol import ControlRequest, Question, order

    path = find_run(run_roots(os.environ), run_name(plan, machine))
    as_text = format_ == "text"
    question = Question(ask=ControlRequest.APPLY, plan=plan, dry_run=True)
    answer = order(path, question, _SHOWN_S)
    change = answer.change
    if answer.error or change is None:
        outcome = "refused"
    elif not change.differences:
        outcome = "unchanged"
    else:
        if as_text:
            what = {
                "added": change.added,
                "removed": change.removed,
                "restarted": change.restarted,
                "given parameters": change.parameters,
            }
            done = [f"{word}: {', '.join(names)}" for word, names in what.items() if names]
            done = done or ["no node is touched: what runs is judged by the new rules"]
            click.echo(lines("\n".join((*change.differences, *done))))
        outcome = "would_apply"
    if outcome == "would_apply" and not dry_run:
        question = Question(ask=ControlRequest.APPLY, plan=plan, timeout_s=timeout)
        answer = order(path, question, 2 * timeout + _SPARE_S)
        change = answer.change or change
        outcome = "applied"
        if answer.error:
            outcome = "refused" if answer.exit_code == ExitCode.USAGE else "rolled_back"
    report = ApplyReport(
        outcome=outcome,
        exit_code=answer.exit_code or ExitCode.OK,
        system=path.name,
        manifest=plan.manifest_path,
        error=answer.error,
        **asdict(change or ChangedNodes(revision=0)),
    )
    if not as_text:
        click.echo(common.json_of(report))
    elif report.error:
        common.say(report.error)
    elif outcome == "unchanged":
        click.echo(f"{report.manifest} is what {report.system} runs, revision {report.revision}")
    elif outcome == "applied":
        click.echo(
            f"{report.system} runs by {report.manifest}, verified, revision {report.revision}"
        )
    return report.exit_code
