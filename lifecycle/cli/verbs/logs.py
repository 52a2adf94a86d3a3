"""`lifecycle logs`: what the processes of a run wrote."""

from __future__ import annotations

import collections
import contextlib
import os
import re
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

import click

from lifecycle.cli.standard_streams import echo_while_read
from lifecycle.errors import ExitCode, UsageError
from lifecycle.printable import log_line

_LOOK_S = 0.2
"""So often is looked for new lines and files."""


@click.command("logs")
@click.argument("node", required=False, metavar="[NODE]")
@click.option("-f", "--follow", is_flag=True, help="Go on with what is written, until Ctrl-C.")
@click.option(
    "--system",
    default="",
    metavar="NAME",
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

    NODE is a process or a node: of one that shares its process, the lines of its logger. While its
    run lasts, --follow waits for the first line.
    The files are in ROS_LOG_DIR, else ~/.ros/log, where `latest` leads to those of the run that
    began last.
    """
    from lifecycle.supervisor.processes.logs import ros_log_root, runs_of

    root = ros_log_root(os.environ)
    runs = runs_of(root, system)
    if not runs:
        of = f" of {system!r}" if system else ""
        raise UsageError(
            f"cannot find a run{of} in {str(root)!r}", hint="its logs are where ROS_LOG_DIR says"
        )
    for line in _lines(runs[0], node, count, follow=follow):
        echo_while_read(line)
    return ExitCode.OK


_RCL_LINE = re.compile(rb"(?:\x1b\[[\d;]*m)*\[[A-Z]+\] \[[\d.]+\] \[([^\]]+)\]: ")
"""How rcutils writes a line of a logger, unless RCUTILS_CONSOLE_OUTPUT_FORMAT says otherwise."""


def _files(run: Path, node: str | None) -> tuple[list[Path], str]:
    """Return the files to show, and of which logger; empty for all of their lines."""
    files = sorted(run.glob("*.log"))
    if node is None:
        return files, ""
    wanted = node.strip("/").replace("/", ".")
    found = [each for each in files if _is_of(each.stem, wanted)]
    return (found, "") if found else (files, wanted)


def _is_of(name: str, wanted: str) -> bool:
    return wanted in (name, name.rpartition(".")[2])


def _of(lines: Iterable[bytes], logger: str) -> Iterator[bytes]:
    """Yield lines of a logger, or of its children."""
    for line in lines:
        found = _RCL_LINE.match(line) if logger else None
        name = found[1].decode("utf-8", "replace") if found else ""
        while name and not _is_of(name, logger):
            name = name.rpartition(".")[0]
        if name or not logger:
            yield line


def _lines(run: Path, node: str | None, count: int | None, *, follow: bool) -> Iterator[str]:
    """Yield the lines that are there; following, also those to come, of files that begin later too.

    Raises:
        UsageError: nothing is there, and none is to come.
    """
    from lifecycle.supervisor.processes.logs import is_running

    read = _whole_lines if follow else iter
    opened: dict[Path, BinaryIO] = {}
    first, is_there = True, False
    with contextlib.ExitStack() as kept:
        while True:
            runs = follow and is_running(run)
            files, logger = _files(run, node)
            several = node is None or (len(files) > 1 and not logger)
            for path in files:
                file = opened.get(path)
                lines = [] if file is None else list(_of(read(file), logger))
                if file is None or _is_another(file, path):  # it is new, or was rotated
                    file = opened[path] = kept.enter_context(path.open("rb"))
                    new = _of(read(file), logger)
                    lines += collections.deque(new, count) if first else new
                is_there |= bool(lines)
                for line in lines:
                    text = log_line(line.decode("utf-8", "replace").rstrip("\n"))
                    yield f"{path.stem} | {text}" if several else text
            first = first and not files
            if not runs and not (is_there if logger else files) and node is not None:
                there = ", ".join(each.stem for each in files) or "none"
                raise UsageError(
                    f"cannot find the log of {node!r} in {str(run)!r}; there are: {there}",
                    hint="a node that shares a process is in that process's log",
                )
            if not follow or not (runs or files):
                return
            time.sleep(_LOOK_S)


def _whole_lines(file: BinaryIO) -> Iterator[bytes]:
    """Yield lines up to the last that is complete."""
    while (line := file.readline()).endswith(b"\n"):
        yield line
    file.seek(-len(line), os.SEEK_CUR)


def _is_another(file: BinaryIO, path: Path) -> bool:
    try:
        return not os.path.samestat(os.fstat(file.fileno()), path.stat())
    except OSError:
        return False
