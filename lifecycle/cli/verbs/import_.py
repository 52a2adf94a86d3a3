"""`lifecycle import`: write a manifest from a ROS 2 launch file, gaps marked. Starts nothing."""

from __future__ import annotations

import contextlib
import re
import sys
from pathlib import Path

import click

from lifecycle.cli.common import output_option, parse_assignments, say, write_text
from lifecycle.errors import ExitCode, UsageError
from lifecycle.printable import one_line


@click.command("import")
@click.argument("launch_file", type=click.Path(path_type=Path), metavar="FILE.launch.(py|xml|yaml)")
@click.argument("assignments", nargs=-1, metavar="[NAME:=VALUE]...")
@output_option("manifest")
@click.option("--system", default="", help="Name to give the system; default: the file's.")
def command(
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

    folder = Path.cwd() if output is None else output.parent
    with contextlib.redirect_stdout(sys.stderr):  # what the file prints, and launch logs
        found = evaluate(launch_file, parse_assignments(assignments), folder=folder)
    if not found.nodes:
        raise UsageError(
            f"cannot import {str(launch_file)!r}: it describes no node with these arguments",
            hint="; ".join(found.gaps[:3]),
        )
    name = system or _name(launch_file)
    text = to_launched_manifest(
        found,
        source=launch_file.name,
        system=name,
        schema=schema_reference(folder),
    )
    for gap in gaps_of(found):
        say(one_line(f"gap: {gap}"))
    if output is None:
        click.echo(text, nl=False)
        return ExitCode.OK
    write_text(output, text)
    try:
        warnings = load(output).warnings
    except ManifestError as error:
        say(str(error))
        return ExitCode.MANIFEST_INVALID
    for each in warnings:
        say(str(each))
    return ExitCode.OK


def _name(path: Path) -> str:
    stem = path.name.partition(".")[0]
    stem = re.sub(r"[^A-Za-z0-9_-]", "_", stem)
    return stem if stem[:1].isalpha() else f"system_{stem}"
