"""`lifecycle logs`: what the processes of a run have written, and what they write now.

Owns: which run and which files are meant, and following them (tail(1), which waits for events of
the file system and survives rotation).
"""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path

import click

from lifecycle.cli.common import completing
from lifecycle.cli.standard_streams import echo_while_read
from lifecycle.errors import ExitCode, UsageError
from lifecycle.printable import log_line

_HEAD = re.compile(r"==> (.*) <==\n")


@click.command("logs")
@click.argument("node", required=False, metavar="[NODE]", shell_complete=completing("logged"))
@click.option("-f", "--follow", is_flag=True, help="Go on with what is written, until Ctrl-C.")
@click.option(
    "--system",
    default="",
    metavar="NAME",
    shell_complete=completing("logged_systems"),
    help="Of this system; default: of any.",
)
@click.option(
    "-n",
    "--lines",
    "count",
    type=click.IntRange(min=0),
    metavar="N",
    help="Only the last N lines of each; default: all.",
)
def command(*, node: str | None, follow: bool, system: str, count: int | None) -> int:
    """Show what the processes of the latest run have written; of NODE, or of all.

    NODE is a node, or a process of several. The files are in ROS_LOG_DIR, else ~/.ros/log, where
    `latest` leads to those of the run that began last.
    """
    from lifecycle.supervisor import ros_log_root, runs_of

    root = ros_log_root(os.environ)
    runs = runs_of(root, system)
    if not runs:
        of = f" of {system!r}" if system else ""
        raise UsageError(
            f"cannot find a run{of} in {str(root)!r}", hint="its logs are where ROS_LOG_DIR says"
        )
    files = _files(runs[0], node)
    for line in _lines(files, count=count, follow=follow):
        echo_while_read(line)
    return ExitCode.OK


def _files(run: Path, node: str | None) -> list[Path]:
    files = sorted(run.glob("*.log"))
    if node is None:
        return files
    wanted = node.strip("/").replace("/", ".")
    found = [each for each in files if wanted in (each.stem, each.stem.rpartition(".")[2])]
    if not found:
        there = ", ".join(each.stem for each in files) or "none"
        raise UsageError(
            f"cannot find the log of {node!r} in {str(run)!r}; there are: {there}",
            hint="a node that shares a process is in that process's log",
        )
    return found


def _lines(files: Sequence[Path], *, count: int | None, follow: bool) -> Iterator[str]:
    """Yield lines, with the process before each where there are several."""
    if not files:
        return
    last = "+1" if count is None else str(count)
    tail = ["tail", "-v", "-n", last, *(["-F"] if follow else []), "--"]
    name = ""
    with subprocess.Popen(
        [*tail, *map(str, files)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        encoding="utf-8",
        errors="replace",
    ) as reading:
        assert reading.stdout is not None
        blank = False
        try:
            for line in reading.stdout:
                if head := _HEAD.fullmatch(line):
                    name, blank = Path(head[1]).stem, False
                    continue
                if blank:
                    yield _shown(name, "", len(files))
                blank = line == "\n"  # tail puts one before each head but the first
                if not blank:
                    yield _shown(name, line.rstrip("\n"), len(files))
            if blank:
                yield _shown(name, "", len(files))
        finally:
            reading.terminate()


def _shown(name: str, line: str, files: int) -> str:
    text = log_line(line)
    return text if files == 1 else f"{name} | {text}"
