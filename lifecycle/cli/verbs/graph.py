"""`lifecycle graph`: picture of what runs, beside what was declared."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

from lifecycle.cli import common
from lifecycle.cli.standard_streams import watched
from lifecycle.errors import ExitCode, UsageError

if TYPE_CHECKING:
    from lifecycle.export.picture import Picture
    from lifecycle.plan.model import Plan


@click.command("graph")
@common.target_arguments
@common.format_option("text", "mermaid", "svg", "html", "json")
@common.output_option("picture")
@click.option("--watch", is_flag=True, help="Draw it again at every change; Ctrl-C ends.")
@common.timeout_option(
    2.0,
    "How long what is not as declared may still become so, where no supervisor is asked.",
    or_0=True,
)
def command(
    *,
    target: str,
    assignments: tuple[str, ...],
    machine: str,
    format_: str,
    output: Path | None,
    watch: bool,
    timeout: float,
) -> int:
    """Draw the computational graph and the data layer graph as they run.

    TARGET is a manifest, or the name of a running system. A supervisor of it is asked; without one,
    whatever runs is looked at from outside. What is declared but missing is dashed and red, what is
    there but not declared dotted and orange; findings stand at what they name. With --watch, text
    is drawn again on the terminal, and a file is replaced in one piece.
    """
    if watch and output is None and format_ not in ("text", "json"):
        raise UsageError(
            f"cannot print one {format_} picture after another", hint="give --output FILE"
        )
    from lifecycle.export.picture_writers import WRITERS
    from lifecycle.supervisor.control.protocol import look
    from lifecycle.supervisor.run import looking

    plan: Plan | None = None
    if not common.is_manifest(target):
        path: Path | None = common.target_run(target, assignments, machine)
    else:
        plan = common.load_plan(target, assignments, quiet=True)
        path = looking.supervisor_of(os.environ, plan, machine)

    with watched(whole=watch and output is None and format_ == "text") as show:

        def draw(picture: Picture) -> None:
            text = common.json_of(picture) if format_ == "json" else WRITERS[format_](picture)
            if output is not None:
                common.write_text(output, text.rstrip("\n") + "\n")
            else:
                show(text)

        if path is not None:
            with common.asking(path):
                if not watch:
                    draw(looking.picture_of(look(path)))
                else:
                    for picture in looking.supervised_pictures(path):
                        draw(picture)
        elif plan is not None and watch:
            looking.follow_running(plan, lambda seen: draw(seen.picture))
        elif plan is not None:
            judged = looking.judge_running(plan, timeout_s=timeout, strict=False)
            draw(judged.picture)
            if judged.where:
                common.say(judged.where)
    if path is not None and watch:
        common.say(f"{path.name}: its supervisor has ended")
    return ExitCode.OK
