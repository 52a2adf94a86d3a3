"""`lifecycle capture` and `lifecycle import`: a manifest from what runs, or from a launch file.

Both mark gaps. `import` starts nothing.
"""

from __future__ import annotations

import contextlib
import os
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from lifecycle.cli.common import output_option, parse_assignments, write_text
from lifecycle.errors import ExitCode, UsageError
from lifecycle.printable import lines, one_line

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
    "--namespace",
    "namespaces",
    multiple=True,
    metavar="NAMESPACE",
    help="Take only nodes in or below it; may be given several times.",
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
    namespaces: tuple[str, ...],
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
    from lifecycle.export.manifest_yaml import to_manifest
    from lifecycle.manifest.model import Discovery
    from lifecycle.plan.build import effective_domain, effective_range
    from lifecycle.supervisor.run.looking import capture_running

    _check_name(system)
    discovery = Discovery(domain_id=domain)
    captured = capture_running(
        system=system,
        domain_id=effective_domain(discovery, os.environ),
        discovery_range=effective_range(discovery, os.environ),
        namespaces=namespaces,
        wait_s=wait,
        attach=attach,
    )
    if not captured.nodes:
        below = f" in or below {', '.join(namespaces)}" if namespaces else ""
        click.echo(
            f"no node{below}; looked in ROS domain {captured.domain_id}, discovery range "
            f"{captured.discovery_range.value}\n"
            "nodes that only listed peers, a discovery server or shared memory lead to are not "
            "found so: `discovery: mode:` of their manifest says which; it is what to verify them "
            "by",
            err=True,
        )
        _say_gaps(captured)
        return ExitCode.VIOLATED
    references = {} if nodl_dir is None else _write_nodl(captured, nodl_dir, output)
    schema = schema_reference(Path.cwd() if output is None else output.parent)
    text = to_manifest(captured, references=references, schema=schema)
    if output is None:
        click.echo(text, nl=False)
    else:
        write_text(output, text)
    _say_gaps(captured)
    return ExitCode.OK


def _say_gaps(captured: CapturedSystem) -> None:
    for gap in captured.gaps:
        click.echo(one_line(f"gap: {gap}"), err=True)


def _check_name(system: str) -> None:
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]*", system):
        raise UsageError(
            f"cannot name a system {system!r}; use letters, digits, '_' and '-', a letter first"
        )


def _write_nodl(captured: CapturedSystem, folder: Path, output: Path | None) -> dict[str, str]:
    """Write a document for each node; return what the manifest calls them, relative to itself."""
    from lifecycle.export.manifest_yaml import SUFFIX, to_nodl

    base = Path.cwd() if output is None else output.parent
    references = {}
    for node in captured.nodes:
        path = folder / f"{node.key}{SUFFIX}"
        write_text(path, to_nodl(node))
        references[node.key] = f"local://{os.path.relpath(path, base)}"
    return references


@click.command("import")
@click.argument("launch_file", type=click.Path(path_type=Path), metavar="FILE.launch.(py|xml|yaml)")
@click.argument("assignments", nargs=-1, metavar="[NAME:=VALUE]...")
@output_option("manifest")
@click.option("--system", default="", help="Name to give the system; default: the file's.")
def import_command(
    *, launch_file: Path, assignments: tuple[str, ...], output: Path | None, system: str
) -> int:
    """Write what a launch file describes as a manifest.

    The description is evaluated with the arguments that are given, and nothing that it describes is
    started; a launch file in Python is a program, and is run as one. What a manifest cannot say, or
    launch does not, stands beside a comment: `# gap: …`. Needs the `launch` package. A manifest
    that is written to a file is checked at once; what is found
    goes to stderr, and the exit code is 3 if it cannot be used.
    """
    from lifecycle.cli.launch_files import evaluate, gaps_of, to_launched_manifest
    from lifecycle.cli.verbs.init import schema_reference
    from lifecycle.manifest.diagnostics import ManifestError
    from lifecycle.manifest.loading import load

    with contextlib.redirect_stdout(sys.stderr):  # what the file prints, and launch logs
        found = evaluate(launch_file, parse_assignments(assignments))
    if not found.nodes:
        raise UsageError(
            f"cannot import {str(launch_file)!r}: it describes no node with these arguments",
            hint="; ".join(found.gaps[:3]),
        )
    name = system or _name(launch_file)
    folder = Path.cwd() if output is None else output.parent
    text = to_launched_manifest(
        found,
        source=launch_file.name,
        system=name,
        folder=folder,
        schema=schema_reference(folder),
    )
    for gap in gaps_of(found):
        click.echo(one_line(f"gap: {gap}"), err=True)
    if output is None:
        click.echo(text, nl=False)
        return ExitCode.OK
    write_text(output, text)
    try:
        warnings = load(output).warnings
    except ManifestError as error:
        click.echo(lines(str(error)), err=True)
        return ExitCode.MANIFEST_INVALID
    for each in warnings:
        click.echo(lines(str(each)), err=True)
    return ExitCode.OK


def _name(path: Path) -> str:
    stem = path.name.partition(".")[0]
    stem = re.sub(r"[^A-Za-z0-9_-]", "_", stem)
    return stem if stem[:1].isalpha() else f"system_{stem}"
