"""What is outside of a run: all others of its domain, limits of its process, other namespaces.

Who is announced is there, and says that it leaves. Where there is too little of a resource the
command says so, with how much it needs, and ends by itself; no process is left.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable

import pytest

from tests.outside.case import OK, Case
from tests.outside.cases.healthy import PAIR
from tests.outside.running import GRACE_S, LIFECYCLE, PROGRAMS, Run

LEAST_LEASE_S = 10.0


def _announced(during: Callable[[Run], None], *, at_most: int) -> Callable[[Run], None]:
    """Tell a story, and compare who was announced with who left, once the command has ended."""

    def story(run: Run) -> None:
        if os.geteuid() != 0:
            pytest.skip("packets of loopback are root's to read")
        assert run.process is not None
        capture = run.program(str(PROGRAMS / "announced.py"))
        during(run)
        run.process.wait(run.case.within_s)
        time.sleep(0.3)  # until what was sent last is read
        said, _ = capture.communicate("", GRACE_S)
        leases: dict[str, set[float]] = {}
        left: set[str] = set()
        for each in map(json.loads, said.splitlines()):
            if each["lease_s"] is None:
                left.add(each["prefix"])
            else:
                leases.setdefault(each["prefix"], set()).add(each["lease_s"])
                left.discard(each["prefix"])
        print({prefix: (sorted(of), prefix in left) for prefix, of in leases.items()})
        assert leases, "nothing was captured"
        assert not leases.keys() - left, f"did not leave: {leases.keys() - left} of {leases}"
        assert min(min(each) for each in leases.values()) >= LEAST_LEASE_S, leases
        assert len(leases) <= at_most, f"{len(leases)} participants: {leases}"

    return story


def _nothing(_: Run) -> None:
    """The command ends by itself."""


def _interrupted(run: Run) -> None:
    run.until_active()
    run.signal(signal.SIGINT)


def _early(run: Run) -> None:
    run.until("process", process="talker", state="running")
    run.signal(signal.SIGTERM)


def _restarted(run: Run) -> None:
    run.until_active()
    assert run.lifecycle("restart", "{}", "/talker").returncode == 0


def _observed(run: Run) -> None:
    run.until_active()
    for words in (("verify", "{}", "--timeout", "20"), ("graph", "{}", "--format", "json")):
        done = run.lifecycle(*words)
        assert done.returncode == 0, done.stdout + done.stderr
    run.signal(signal.SIGINT)


def _under(
    before: str, says: str, *words: str, code: int = 6, through: tuple[str, ...] = ()
) -> Callable[[Run], None]:
    """Run another command in a shell that has set a limit; it says why it refuses."""

    def story(run: Run) -> None:
        done = _through(run, (*through, "bash", "-c", f'{before} && exec "$@"', "bash"), *words)
        said = done.stdout + done.stderr
        assert done.returncode == code, f"exit code {done.returncode}\n{said}"
        assert says in said, said
        assert "Traceback" not in said, said

    return story


def _through(run: Run, through: tuple[str, ...], *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*through, str(LIFECYCLE), *(str(run.manifest) if w == "{}" else w for w in words)],
        cwd=run.directory,
        env=run.environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def _may_unshare(*options: str) -> bool:
    words = ["unshare", *options, "true"]
    return (
        shutil.which("unshare") is not None
        and subprocess.run(words, check=False, capture_output=True).returncode == 0
    )


def _mounted(size: str, *words: str) -> Callable[[Run], None]:
    def story(run: Run) -> None:
        if not _may_unshare("-m", "--propagation", "private"):
            pytest.skip("only root has a mount namespace of its own")
        mount = f"mount -t tmpfs -o size={size} tmpfs /dev/shm"
        own = ("unshare", "-m", "--propagation", "private")
        _under(mount, "'/dev/shm' has", *words, through=own)(run)

    return story


def _in_another_time(run: Run) -> None:
    """Kill the supervisor, and ask for the status where the clock of the boot is another."""
    options = ("-T", "--boottime", "86400", "--monotonic", "86400")
    if not _may_unshare(*options):
        pytest.skip("only root has a time namespace of its own")
    run.until_active()
    pids = sorted(run.pid_of(each) for each in ("talker", "listener"))
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)  # they would leave with their supervisor
    run.signal(signal.SIGKILL)
    assert run.process is not None
    run.process.wait(GRACE_S)
    try:
        here = run.lifecycle("status", "pair")
        there = _through(run, ("unshare", *options), "status", "pair")
    finally:
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
    assert all(str(pid) in here.stdout + here.stderr for pid in pids), here
    assert (there.returncode, there.stdout, there.stderr) == (
        here.returncode,
        here.stdout,
        here.stderr,
    )


_UP = ("up", "{}", "--strict", "--stop-after", "0.3", "--timeout", "20")
_VERIFY = ("verify", "{}", "--timeout", "1")
_ENDED = "a run that ends leaves no participant to its lease: "

CASES = (
    Case(
        attack=f"{_ENDED}after 0.2 s of being active",
        manifest=PAIR,
        verb=("up", "--strict", "--stop-after", "0.2"),
        story=_announced(_nothing, at_most=6),
        verdict=OK,
        quick=True,
    ),
    Case(
        attack=f"{_ENDED}by Ctrl-C",
        manifest=PAIR,
        verb=("up", "--strict"),
        story=_announced(_interrupted, at_most=6),
        exit_code=130,
    ),
    Case(
        attack=f"{_ENDED}before the gate",
        manifest=PAIR,
        verb=("up", "--strict"),
        story=_announced(_early, at_most=6),
        exit_code=143,
    ),
    Case(
        attack=f"{_ENDED}after 5 s",
        manifest=PAIR,
        verb=("up", "--strict", "--stop-after", "5"),
        story=_announced(_nothing, at_most=6),
        verdict=OK,
    ),
    Case(
        attack=f"{_ENDED}a node was restarted",
        manifest=PAIR,
        verb=("up", "--strict", "--stop-after", "5"),
        story=_announced(_restarted, at_most=20),
        verdict=OK,
    ),
    Case(
        attack=f"{_ENDED}it was verified and shown from beside",
        manifest=PAIR,
        verb=("up", "--strict"),
        story=_announced(_observed, at_most=12),
        exit_code=130,
    ),
    *(
        Case(
            attack=f"{limit} is too little for {words[0]}, which says how much it needs",
            manifest=PAIR,
            verb=("plan",),
            story=_under(limit, says, *words),
        )
        for limit, says, words in (
            ("ulimit -n 24", "ulimit -n 52", _UP),
            ("ulimit -n 48", "ulimit -n 52", _UP),
            ("ulimit -v 760000", "ulimit -v", _UP),
            ("ulimit -v 800000", "ulimit -v", _UP),
            ("ulimit -v 500000", "ulimit -v", _VERIFY),
        )
    ),
    *(
        Case(
            attack=f"/dev/shm of 4 KiB is too little for {words[0]}, which says how much it needs",
            manifest=PAIR,
            verb=("plan",),
            story=_mounted("4k", *words),
        )
        for words in (_UP, _VERIFY)
    ),
    *(
        Case(
            attack=f"{limit} is enough",
            manifest=PAIR,
            verb=("plan",),
            story=_under(limit, "ended after it was active", *_UP, code=0),
        )
        for limit in ("ulimit -n 64", "ulimit -v 1500000")
    ),
    Case(
        attack="status of a killed supervisor is the same in another time namespace",
        manifest=PAIR,
        verb=("up", "--strict"),
        story=_in_another_time,
        exit_code=-9,
    ),
)
