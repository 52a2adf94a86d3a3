"""Standard streams: nothing but what a verb prints, and no reader that anybody waits for."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from lifecycle.cli.standard_streams import EVENT_BYTES, LINE_BYTES, Writer

_PROGRAM = """
import os
from lifecycle.cli.standard_streams import own_streams
print("before")
own_streams()
os.write(1, b"a library\\n")
os.system("echo a child")
print("ours", flush=True)
os.write(1, b"again\\n")
"""
BOUND_S = 20.0


def test_what_libraries_and_children_print_goes_to_standard_error() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM], capture_output=True, text=True, check=True
    )
    assert done.stdout == "before\nours\n"
    assert done.stderr == "a library\na child\nagain\n"


def test_streams_that_are_closed_become_none_of_the_files_that_are_opened_later() -> None:
    program = (
        "from lifecycle.cli.standard_streams import own_streams\n"
        "settled = own_streams()\n"
        "print('nowhere')\n"
        "assert open('/dev/null').fileno() > 2\n"
        "raise SystemExit(settled(4))\n"
    )
    done = subprocess.run(
        ["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", sys.executable, "-c", program], check=False
    )
    assert done.returncode == 4


def _until(holds: Callable[[], object]) -> None:
    deadline = time.monotonic() + BOUND_S
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_log_lines_that_nobody_reads_are_dropped_and_counted_and_events_are_kept() -> None:
    read, write = os.pipe()
    fcntl.fcntl(write, fcntl.F_SETPIPE_SZ, 4096)
    writer = Writer(write, "standard output", marker=lambda text: f"<{text}>\n")
    line = "x" * 1023 + "\n"
    for number in range(2 * LINE_BYTES // 1024):
        writer.put(line, kept=False)
        if number % 256 == 0:
            writer.put(f"event {number}\n")
    with os.fdopen(read, "rb") as stream:
        said = []
        while not said or not said[-1].startswith("<"):
            said.append(stream.readline().decode())
        assert [each for each in said if each.startswith("event")] == [
            f"event {number}\n" for number in range(0, 2048, 256)
        ]
        dropped = 2048 - said.count(line)
        assert dropped > 900
        assert said[-1] == (
            f"<{dropped} lines are missing here: nobody read standard output in time>\n"
        )
        writer.put("the last\n")
        writer.close()
        os.close(write)
        assert stream.read() == b"the last\n"


def test_events_are_lost_where_there_are_more_than_anybody_could_want() -> None:
    read, write = os.pipe()
    told: list[str] = []
    writer = Writer(write, "it", marker=lambda text: f"<{text}>\n", say=told.append)
    size = EVENT_BYTES // 16
    for number in range(20):
        writer.put(f"{number}".ljust(size - 1) + "\n")
    began = time.monotonic()
    writer.close()  # bounded, though nobody reads
    assert time.monotonic() - began < BOUND_S / 2
    assert told == ["20 lines are missing at the end of it: nobody read it in time"]
    os.close(read)


def test_a_disk_that_is_full_for_a_while_loses_and_counts_what_came_meanwhile(
    tmp_path: Path,
) -> None:
    path = tmp_path / "out"
    file = os.open(path, os.O_WRONLY | os.O_CREAT)
    full = os.open("/dev/full", os.O_WRONLY)
    there = os.dup(file)
    told: list[str] = []
    writer = Writer(there, "standard output", marker=lambda text: f"<{text}>\n", say=told.append)
    writer.put("one\n")
    _until(lambda: path.read_text() == "one\n")
    os.dup2(full, there)
    writer.put("two\n")
    _until(lambda: told)
    writer.put("three\n", kept=False)
    _until(lambda: not writer._queue)
    os.dup2(file, there)
    writer.put("four\n")
    writer.close()
    assert path.read_text() == ("one\n<2 lines are missing here: No space left on device>\nfour\n")
    assert len(told) == 1
    for each in (file, full, there):
        os.close(each)
