"""Signals to `lifecycle up` at every stage and at moments between, one or several."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import threading

from lifecycle.errors import ExitCode
from tests.hostile.attack import (
    BOUND_S,
    Attack,
    Attacks,
    HostileClass,
    Place,
    Unhandled,
    check,
    ended,
    started,
)
from tests.ros.supervisor.running import pair

INT, TERM, HUP = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
STAGES = {
    "the first word": b"",
    "a process runs": b'"event":"process"',
    "a node is inactive": b'"state":"inactive"',
    "the verdict": b'"event":"verdict"',
    "the gate": b'"event":"gate"',
    "active": b'"reached":"active"',
    "stopping": b'"state":"stopping"',
}
"""A part of the line after which a signal is sent."""

ENDS = (
    *(ExitCode.OK, ExitCode.INTERRUPTED, ExitCode.TERMINATED, ExitCode.HUNG_UP),
    *(ExitCode.BRING_UP_FAILED, ExitCode.VIOLATED),
)


def _signalled(
    after: bytes | float, numbers: tuple[int, ...], misbehave: str, place: Place
) -> None:
    folder = place.folder()
    manifest = pair(folder, place.domain, misbehave=misbehave)
    words = ("up", str(manifest), "--format", "json", "--stop-after", "1")
    with started(*words, runtime=folder) as (process, mark):
        if isinstance(after, float):
            timer = threading.Event()
            timer.wait(after)
        else:
            _reach(process, after)
        for number in numbers:
            process.send_signal(number)
        done = ended(process, mark, folder, limit_s=BOUND_S)
    # Before anything has begun a signal ends any program, without a word of ours.
    began = not isinstance(after, float) or after >= 1.0 or bool(done.out + done.err)
    if not began and (done.code < 0 or (done.code == ExitCode.INTERRUPTED and INT in numbers)):
        return
    check(done, *map(int, ENDS))
    # At a moment of its own a signal may come when the verdict has been written: that stands.
    if done.code == 0 and INT in numbers and not (isinstance(after, float) and _says_ok(done.out)):
        raise Unhandled("interrupted, and it says ok")


def _says_ok(out: str) -> bool:
    """Whether the last line is a verdict, of a run that ended well."""
    lines = out.splitlines()
    end = json.loads(lines[-1]) if lines else {}
    return bool(end.get("verdict") == "ok" and end["run"]["exit_code"] == ExitCode.OK)


def _reach(process: subprocess.Popen[bytes], mark: bytes) -> None:
    assert process.stdout is not None
    for line in process.stdout:
        if mark in line:
            return


def attacks(rng: random.Random) -> list[Attack]:
    found = Attacks()

    def add(name: str, *arguments: object) -> None:
        found.add(name, _signalled, *arguments)

    for stage, mark in STAGES.items():
        for number in (INT, TERM, HUP):
            add(f"{stage}: {number.name}", mark, (number,), "")
        add(f"{stage}: SIGINT twice", mark, (INT, INT), "")
    add(
        "a node that hangs while it is deactivated: SIGINT",
        b'"reached":"active"',
        (INT,),
        "deactivate:hang",
    )
    add(
        "a node that hangs while it is deactivated: SIGINT twice",
        b'"reached":"active"',
        (INT, INT),
        "deactivate:hang",
    )
    add(
        "a node that hangs while it is configured: SIGTERM",
        b'"operation":"configure"',
        (TERM,),
        "configure:hang",
    )
    for _ in range(10):
        after = round(rng.uniform(0.0, 2.5), 2)
        numbers = tuple(rng.choices((INT, TERM, HUP), k=rng.randint(1, 4)))
        names = " ".join(signal.Signals(each).name for each in numbers)
        add(f"after {after} s: {names}", after, numbers, "")
    return found


CLASS = HostileClass(name="signals", attacks=attacks, limit_s=400.0)
