"""What a process tree uses, CPU, memory and threads, and the table that benchmarks print.

Owns: `run`, which runs a program until it says that all is active, measures its whole tree and ends
it by SIGINT, and `render`, the table as text or as in docs/performance.md.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import queue
import select
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import psutil

from lifecycle.middleware.process.shared_memory import sweep

ROOT = Path(__file__).resolve().parents[1]
GONE_S = 60.0


class FailedError(Exception):
    """Something that was to be measured did not work."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Used:
    """What one run took, of a whole process tree.

    Attributes:
        active_s: from the command to all nodes being active.
        cpu_s: user and system time until then.
        pss_mib: proportional set size then, MiB.
        threads: then.
        gone_s: from SIGINT until the last process has ended.
    """

    active_s: float
    cpu_s: float
    pss_mib: float
    threads: float
    gone_s: float


def run(
    command: Sequence[str],
    *,
    is_active: Callable[[str], bool],
    variables: Mapping[str, str],
    bound_s: float,
) -> Used:
    """Run a program until it is active, measure, and end it.

    Args:
        command: its command line.
        is_active: whether a line of its standard output says that all nodes are.
        variables: set in its environment.
        bound_s: it must be active so soon.

    Raises:
        FailedError: it was not, or something of it lives `GONE_S` after SIGINT.
    """
    with tempfile.TemporaryDirectory() as directory, tempfile.TemporaryFile("w+") as errors:
        private = {"XDG_RUNTIME_DIR": directory, "ROS_LOG_DIR": directory}
        began = time.monotonic()
        process = subprocess.Popen(
            command,
            cwd=ROOT,
            env={**os.environ, **private, **variables},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        )
        with process, _ended(process):
            last = _until_active(process, is_active, began + bound_s)
            active_s = time.monotonic() - began
            pids = tree(process.pid)
            cpu_s = sum(map(cpu_of, pids))
            if last is not None:
                errors.seek(0)
                raise FailedError(
                    f"{last} after {active_s:.1f} s: {_tail(errors.read()) or 'no message'}"
                )
            pss_mib, threads = sum(map(pss_of, pids)), sum(map(threads_of, pids))
            with contextlib.ExitStack() as stack:
                ends = [stack.enter_context(_pidfd(pid)) for pid in pids]
                asked = time.monotonic()
                process.send_signal(signal.SIGINT)
                _until_gone([each for each in ends if each is not None], asked + GONE_S)
                gone_s = time.monotonic() - asked
    return Used(
        active_s=active_s, cpu_s=cpu_s, pss_mib=pss_mib, threads=float(threads), gone_s=gone_s
    )


def end_on_sigterm() -> None:
    """Have SIGTERM end this program as Ctrl-C does, so that it ends what it has started."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)


def tree(pid: int) -> list[int]:
    """Return a process and all that descends from it."""
    try:
        return [pid, *(each.pid for each in psutil.Process(pid).children(recursive=True))]
    except psutil.NoSuchProcess:
        return []


def cpu_of(pid: int) -> float:
    """Return user and system time of a process and of its ended children, in seconds.

    /proc has its own in ticks of 10 ms; its clock, clock_getcpuclockid(3), has it in nanoseconds.
    """
    try:
        own = time.clock_gettime((~pid << 3) | 2)
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    except (OSError, ProcessLookupError):
        return 0.0
    return own + (int(fields[13]) + int(fields[14])) / os.sysconf("SC_CLK_TCK")


def pss_of(pid: int) -> float:
    """Return the proportional set size of a process, in MiB."""
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="utf-8").splitlines():
            if line.startswith("Pss:"):
                return int(line.split()[1]) / 1024
    return 0.0


def threads_of(pid: int) -> int:
    """Return the number of threads of a process."""
    try:
        return sum(1 for _ in Path(f"/proc/{pid}/task").iterdir())
    except OSError:
        return 0


def _until_active(
    process: subprocess.Popen[str], is_active: Callable[[str], bool], deadline: float
) -> str | None:
    """Wait for the line; return why it did not come, else None."""
    lines: queue.Queue[str] = queue.Queue()
    assert process.stdout is not None
    stream = process.stdout

    def read() -> None:
        for line in stream:
            lines.put(line)
        lines.put("")

    threading.Thread(target=read, daemon=True).start()
    while True:
        try:
            line = lines.get(timeout=max(0.0, deadline - time.monotonic()))
        except queue.Empty:
            return "not active"
        if not line:
            return f"ended with exit code {process.wait()}"
        if is_active(line):
            return None


@contextlib.contextmanager
def _ended(process: subprocess.Popen[str]) -> Iterator[None]:
    """Kill whatever is left of a program's tree, and remove its shared memory for the next run."""
    seen: list[psutil.Process] = []
    try:
        yield
    finally:
        with contextlib.suppress(psutil.NoSuchProcess):
            seen = psutil.Process(process.pid).children(recursive=True)
        process.kill()
        for each in seen:
            with contextlib.suppress(psutil.NoSuchProcess):
                each.kill()
        psutil.wait_procs(seen, timeout=GONE_S)
        sweep()


@contextlib.contextmanager
def _pidfd(pid: int) -> Iterator[int | None]:
    try:
        descriptor = os.pidfd_open(pid)
    except ProcessLookupError:
        yield None
        return
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _until_gone(ends: list[int], deadline: float) -> None:
    poll = select.poll()
    for each in ends:
        poll.register(each, select.POLLIN)
    left = len(ends)
    while left:
        ended = poll.poll(max(0.0, deadline - time.monotonic()) * 1000)
        if not ended:
            raise FailedError(f"{left} processes are left {GONE_S:.0f} s after SIGINT")
        for descriptor, _ in ended:
            poll.unregister(descriptor)
        left -= len(ended)


def _tail(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1][:200] if lines else ""


@dataclasses.dataclass(frozen=True, slots=True)
class Row:
    """One line of the table.

    Attributes:
        what: is measured, with its unit.
        values: by column; what is missing was not measured, text says why.
        ratio: ours to the floor or to plain rclpy; None where one of them is missing.
    """

    what: str
    values: Mapping[str, float | str]
    ratio: float | None = None


COLUMNS = ("launch_ros", "Popen + services", "lifecycle", "floor, plain rclpy")
OURS, FLOOR = COLUMNS[2], COLUMNS[3]


def row(what: str, values: Mapping[str, float | str], *, inverse: bool = False) -> Row:
    """Return a line with its ratio; `inverse` where more is better."""
    ours, floor = values.get(OURS), values.get(FLOOR)
    if isinstance(ours, str) or isinstance(floor, str) or not ours or not floor:
        return Row(what, values)
    return Row(what, values, floor / ours if inverse else ours / floor)


def render(rows: Sequence[Row], *, markdown: bool = False) -> str:
    """Return the table, aligned or as in docs/performance.md, with the columns that have values."""
    columns = [each for each in COLUMNS if any(each in row.values for row in rows)]
    cells = [["", *columns, "ratio"]]
    cells += [
        [
            each.what,
            *(cell(each.values.get(column)) for column in columns),
            "" if each.ratio is None else f"{each.ratio:.2f}",
        ]
        for each in rows
    ]
    return aligned(cells, markdown=markdown)


def aligned(cells: Sequence[Sequence[str]], *, markdown: bool = False) -> str:
    """Return lines of cells as a table; the first line is its head."""
    if markdown:
        lines = [f"| {' | '.join(line)} |" for line in cells]
        return "\n".join([lines[0], "|---" * len(cells[0]) + "|", *lines[1:]])
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join(
        line[0].ljust(widths[0])
        + "".join(text.rjust(width + 2) for text, width in zip(line[1:], widths[1:], strict=True))
        for line in cells
    )


def cell(value: float | str | None) -> str:
    """Return a value with three digits or so."""
    if value is None:
        return ""
    if isinstance(value, str):
        return value
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"
