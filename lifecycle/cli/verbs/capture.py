"""`lifecycle capture`: write a manifest of what runs, gaps marked."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING

import click

from lifecycle.cli.common import output_option, say, write_text
from lifecycle.errors import ExitCode, UsageError
from lifecycle.printable import one_line

if TYPE_CHECKING:
    from lifecycle.export.captured import CapturedSystem


@click.command("capture")
@click.option(
    "--domain",
    type=click.IntRange(0, 232),
    metavar="N",
    help="ROS domain to look at; default: ROS_DOMAIN_ID, else 0.",
)
@output_option("manifest")
@click.option(
    "--nodl-dir",
    type=click.Path(file_okay=False, path_type=Path),
    metavar="DIR",
    help="Write each node's interface as a NoDL document there; the manifest refers to them.",
)
@click.option(
    "--attach",
    is_flag=True,
    help="Write nodes that others start; do not look how their processes were started.",
)
@click.option("--system", default="captured", show_default=True, help="Name to give the system.")
@click.option(
    "--wait",
    type=click.FloatRange(min=0, min_open=True),
    default=5.0,
    show_default=True,
    metavar="SECONDS",
    help="How long discovery may take to settle.",
)
def command(
    *,
    domain: int | None,
    output: Path | None,
    nodl_dir: Path | None,
    attach: bool,
    system: str,
    wait: float,
) -> int:
    """Write a manifest of whatever runs in a domain, started by anyone.

    Nodes of this host are written with the command line, folder and environment of their process,
    so that `lifecycle up` starts them again; all with the interfaces and QoS that discovery shows,
    and with the values of their parameters. What cannot be seen stands beside a comment: `# gap: …`
    The result passes `lifecycle check`, and `lifecycle verify` of the same system is ok. Exits with
    4 if no node is there.
    """
    from lifecycle.cli.verbs.init import schema_reference
    from lifecycle.export.manifest_yaml import SUFFIX, to_manifest, to_nodl
    from lifecycle.manifest.model import Discovery
    from lifecycle.plan.build import effective_domain, effective_range
    from lifecycle.supervisor.run.looking import capture_running

    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]*", system):
        raise UsageError(
            f"cannot name a system {system!r}; use letters, digits, '_' and '-', a letter first"
        )
    discovery = Discovery(domain_id=domain)
    captured = capture_running(
        system=system,
        domain_id=effective_domain(discovery, os.environ),
        discovery_range=effective_range(discovery, os.environ),
        wait_s=wait,
        attach=attach,
    )
    if not captured.nodes:
        say(
            f"no node; looked in ROS domain {captured.domain_id}, discovery range "
            f"{captured.discovery_range.value}\n"
            "nodes that only listed peers, a discovery server or shared memory lead to are not "
            "found so: `discovery: mode:` of their manifest says which; it is what to verify them "
            "by"
        )
        _say_gaps(captured)
        return ExitCode.VIOLATED
    base = Path.cwd() if output is None else output.parent
    references = {}
    if nodl_dir is not None:
        for node in captured.nodes:
            path = nodl_dir / f"{node.key}{SUFFIX}"
            write_text(path, to_nodl(node))
            references[node.key] = f"local://{os.path.relpath(path, base)}"
    schema = schema_reference(base)
    text = to_manifest(captured, references=references, schema=schema)
    if output is None:
        click.echo(text, nl=False)
    else:
        write_text(output, text)
    _say_gaps(captured)
    return ExitCode.OK


def _say_gaps(captured: CapturedSystem) -> None:
    for gap in captured.gaps:
        say(one_line(f"gap: {gap}"))
