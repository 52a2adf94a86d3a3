"""`lifecycle logs`: what the processes of a run have written, and what they write now.

Owns: which run and which files are meant, and following them (tail(1), which waits for events of
the file system and survives rotation).
"""

from __future__ import annotations

import contextlib
import os
import queue
import re
import subprocess
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

import click

from lifecycle.cli.standard_streams import echo_while_read
from lifecycle.errors import ExitCode, UsageError
from lifecycle.printable import log_line

_LOOK_S = 0.5
"""So often files are looked for that have begun since."""

_HEAD = re.compile(r"==> (.*) <==\n")


@click.command("logs")
@click.argument("node", required=False, metavar="[NODE]")
@click.option("-f", "--follow", is_flag=True, help="Go on with what is written, until Ctrl-C.")
@click.option(
    "--system",
    default="",
    metavar="NAME",
    shell_complete=None,
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

    NODE is a node, or a process of several; while its run lasts, --follow waits for its first line.
    The files are in ROS_LOG_DIR, else ~/.ros/log, where `latest` leads to those of the run that
    began last.
    """
    from lifecycle.supervisor import ros_log_root, runs_of

    root = ros_log_root(os.environ)
    runs = runs_of(root, system)
    if not runs:
        of = f" of {system!r}" if system else ""
        raise UsageError(
            f"cannot find a run{of} in {str(root)!r}", hint="its logs are where ROS_LOG_DIR says"
        )
    shown = _followed if follow else _written
    for line in shown(runs[0], node, count):
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


def _written(run: Path, node: str | None, count: int | None) -> Iterator[str]:
    """Yield the lines that are there."""
    if files := _files(run, node):
        with _tail(files, count) as reading:
            yield from _lines(reading, several=len(files) > 1)


def _followed(run: Path, node: str | None, count: int | None) -> Iterator[str]:
    """Yield the lines that are there and those to come, of files that begin later, too.

    Raises:
        UsageError: nothing is there, and the run is over.
    """
    from lifecycle.supervisor import is_running

    lines: queue.SimpleQueue[str] = queue.SimpleQueue()
    followed: set[Path] = set()
    with contextlib.ExitStack() as tails:
        while True:
            runs = is_running(run)
            try:
                files = [each for each in _files(run, node) if each not in followed]
            except UsageError:
                if not runs:
                    raise
                files = []
            if files:
                last = None if followed else count
                reading = tails.enter_context(_tail(files, last, "-F"))
                tails.callback(reading.terminate)
                several = node is None or len(files) > 1
                threading.Thread(
                    target=_put, args=(lines, reading), kwargs={"several": several}, daemon=True
                ).start()
                followed.update(files)
            elif not runs and not followed:
                return
            with contextlib.suppress(queue.Empty):
                yield lines.get(timeout=_LOOK_S)


def _put(lines: queue.SimpleQueue[str], reading: subprocess.Popen[str], *, several: bool) -> None:
    for line in _lines(reading, several=several):
        lines.put(line)


def _tail(files: Sequence[Path], count: int | None, *options: str) -> subprocess.Popen[str]:
    last = "+1" if count is None else str(count)
    return subprocess.Popen(
        ["tail", "-v", "-n", last, *options, "--", *map(str, files)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        encoding="utf-8",
        errors="replace",
    )


def _lines(reading: subprocess.Popen[str], *, several: bool) -> Iterator[str]:
    """Yield lines of a tail, with the process before each where there are several."""
    assert reading.stdout is not None
    name, blank = "", False
    for line in reading.stdout:
        if head := _HEAD.fullmatch(line):
            name, blank = Path(head[1]).stem, False
            continue
        if blank:
            yield _shown(name, "", several=several)
        blank = line == "\n"  # tail puts one before each head but the first
        if not blank:
            yield _shown(name, line.rstrip("\n"), several=several)
    if blank:
        yield _shown(name, "", several=several)


def _shown(name: str, line: str, *, several: bool) -> str:
    text = log_line(line)
    return f"{name} | {text}" if several else text
