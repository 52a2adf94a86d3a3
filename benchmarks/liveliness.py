"""How soon a silent node is noticed, how soon its healing, and whether loss alarms anybody.

Two hosts (network namespaces) on a switch, each with `lifecycle up --machine`. Faults are made one
after the other: a process is stopped, its executor hangs in three ways, it is killed, the link is
cut. What is measured is the time from the fault to the event in the supervisor's JSON output, both
by the machine's one clock, read where the line arrives. Then packets are dropped at random, on the
way in at both hosts, and every alarm is counted.

    python benchmarks/liveliness.py [--repeat 5] [--outage 25] [--minutes 10] [--loss 30]

`--outage` is for how long the long cut lasts: above 20 s DDS has forgotten the other host. Needs
root and nft.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import yaml

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script, only its own directory is there

from tests.net.hosts import Host, Hosts, lacking

DOMAIN = 7
UP_S = 40.0
HANGS_S = 1.6
SHORT_S = 4.0
REST_S = 1.0
LOSS = """table ip liveliness {{
  chain in {{
    type filter hook prerouting priority -300; policy accept;
    iifname "e0" numgen random mod 100 < {percent} counter drop
  }}
}}
"""


class Machine:
    """One `lifecycle up`, and when each of its events came."""

    def __init__(self, host: Host, name: str, manifest: Path, runtime: Path) -> None:
        self.name = name
        self.host = host
        self._events: list[tuple[float, dict[str, Any]]] = []
        self._arrived = threading.Condition()
        self.process = subprocess.Popen(
            host.command(
                *(sys.executable, "-m", "lifecycle", "up", str(manifest)),
                *("--machine", name, "--format", "json", "--keep-going"),
                guarded=True,
            ),
            env=host.environment(runtime),
            stdout=subprocess.PIPE,
            text=True,
        )
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            now = time.monotonic()
            with self._arrived:
                self._events.append((now, json.loads(line)))
                self._arrived.notify_all()

    def mark(self) -> int:
        """Return how many events came so far."""
        return len(self._events)

    def until(self, since: int, within_s: float, **fields: object) -> tuple[float, dict[str, Any]]:
        """Return the first event after `since` with these fields, and when it came."""
        deadline = time.monotonic() + within_s
        with self._arrived:
            while True:
                for at, event in self._events[since:]:
                    if all(event.get(name) == value for name, value in fields.items()):
                        return at, event
                if not self._arrived.wait(max(0.0, deadline - time.monotonic())):
                    raise SystemExit(f"{self.name}: no {fields} within {within_s:g} s")

    def count(self, since: int, kind: str) -> int:
        """Count the events of a kind after `since`."""
        return sum(event.get("event") == kind for _, event in self._events[since:])

    def pid(self, process: str) -> int:
        """Return the pid of a process."""
        return next(
            int(event["pid"])
            for _, event in reversed(self._events)
            if event.get("event") == "process" and event["process"] == process
        )

    def end(self) -> None:
        """End it as a person would."""
        self.process.send_signal(signal.SIGINT)
        self.process.wait(UP_S)


def manifest(directory: Path, left: Host, right: Host) -> Path:
    """Write the system: a node that hangs and a quiet one on each machine."""
    file = directory / "liveliness.lifecycle.yaml"
    nodes = {
        f"{what}_{machine}": {
            "run": {
                "python": f"benchmarks.liveliness_nodes:{what.capitalize()}",
                "environment": {"HANG_FILE": str(directory / f"hang_{machine}")},
            },
            "machine": machine,
        }
        for machine in ("a", "b")
        for what in ("hanging", "quiet")
    }
    document = {
        "manifest_version": 1,
        "system": "liveliness",
        "discovery": {"domain_id": DOMAIN, "range": "subnet"},
        "machines": {"a": {"address": left.ipv4}, "b": {"address": right.ipv4}},
        "nodes": nodes,
    }
    file.write_text(yaml.safe_dump(document))
    return file


@contextlib.contextmanager
def running() -> Iterator[tuple[Machine, Machine, Path]]:
    """Yield both machines, with the system active, and the directory of the hang files."""
    with tempfile.TemporaryDirectory() as name, Hosts() as hosts:
        directory = Path(name)
        left, right = hosts.bridged("a", "b")
        file = manifest(directory, left, right)
        machines = [
            Machine(host, name, file, directory / f"run_{name}")
            for host, name in ((left, "a"), (right, "b"))
        ]
        for each in machines:
            each.until(0, UP_S, event="system", reached="active")
        for each, other in zip(machines, ("b", "a"), strict=True):
            each.until(0, UP_S, event="connection", machine=other, established=True)
        yield machines[0], machines[1], directory
        for each in machines:
            each.end()


Fault = Callable[[Machine, Machine, Path], Iterator[tuple[str, float]]]
"""Makes one fault, and yields what was measured: name and seconds."""


def stop(here: Machine, there: Machine, directory: Path) -> Iterator[tuple[str, float]]:
    """SIGSTOP and SIGCONT."""
    del directory
    pid, since, far = here.pid("quiet_a"), here.mark(), there.mark()
    began = time.monotonic()
    os.kill(pid, signal.SIGSTOP)
    yield "noticed", here.until(since, 5, event="silent", node="/quiet_a")[0] - began
    yield "other host", there.until(far, 5, event="silent", node="/quiet_a")[0] - began
    time.sleep(REST_S)
    ended = time.monotonic()
    os.kill(pid, signal.SIGCONT)
    yield "healed", here.until(since, 5, event="alive", node="/quiet_a")[0] - ended
    yield "other host healed", there.until(far, 5, event="alive", node="/quiet_a")[0] - ended


def hang(way: str) -> Fault:
    """A callback that does not come back in time."""

    def fault(here: Machine, there: Machine, directory: Path) -> Iterator[tuple[str, float]]:
        since, far = here.mark(), there.mark()
        part = directory / "part"
        part.write_text(f"{way} {HANGS_S}", encoding="ascii")
        part.rename(directory / "hang_a")
        at, _ = here.until(since, 5, event="silent", node="/hanging_a")
        remote, _ = there.until(far, 5, event="silent", node="/hanging_a")
        healed, _ = here.until(since, 5, event="alive", node="/hanging_a")
        far_healed, _ = there.until(far, 5, event="alive", node="/hanging_a")
        # What a locked interpreter printed before it hung comes late; the text says when it was.
        began = _when(here, since, "hangs")
        yield "noticed", at - began
        yield "other host", remote - began
        yield "healed", healed - _when(here, since, "is back")
        yield "other host healed", far_healed - _when(here, since, "is back")

    return fault


def cut(outage_s: float) -> Fault:
    """The link goes down and up."""

    def fault(here: Machine, there: Machine, directory: Path) -> Iterator[tuple[str, float]]:
        del directory
        since, far = here.mark(), there.mark()
        began = time.monotonic()
        here.host.ip("link", "set", "e0", "down")
        yield "noticed", here.until(since, 5, event="silent", node="/quiet_b")[0] - began
        yield "other host", there.until(far, 5, event="silent", node="/quiet_a")[0] - began
        time.sleep(outage_s)
        ended = time.monotonic()
        here.host.ip("link", "set", "e0", "up")
        yield "healed", here.until(since, 15, event="alive", node="/quiet_b")[0] - ended
        yield "other host healed", there.until(far, 15, event="alive", node="/quiet_a")[0] - ended
        yield "verdict ok", _ok(here, ended) - ended

    return fault


def kill(here: Machine, there: Machine, directory: Path) -> Iterator[tuple[str, float]]:
    """SIGKILL, of a node; the last fault: nobody starts it again."""
    del directory, there
    since = here.mark()
    began = time.monotonic()
    os.kill(here.pid("quiet_a"), signal.SIGKILL)
    at, _ = here.until(since, 5, event="process", process="quiet_a", state="exited")
    yield "noticed", at - began


def _when(machine: Machine, since: int, word: str) -> float:
    for _, event in machine._events[since:]:  # noqa: SLF001 - its own module
        if event.get("event") == "log" and event["line"].startswith(word):
            return float(event["line"].removeprefix(word))
    raise SystemExit(f"the node did not say that it {word}")


def _ok(machine: Machine, after: float) -> float:
    """Return when the verdict was ok, at last."""
    deadline = time.monotonic() + 15
    while time.monotonic() < deadline:
        verdicts = [
            (at, event)
            for at, event in machine._events  # noqa: SLF001 - its own module
            if event.get("event") == "verdict" and at > after
        ]
        if verdicts and verdicts[-1][1]["verdict"]["verdict"] == "ok":
            return verdicts[-1][0]
        time.sleep(0.01)
    raise SystemExit("the verdict was not ok again within 15 s")


def faults(repeat: int, outage_s: float) -> None:
    """Make every fault and print the table."""
    cases: list[tuple[str, Fault, int]] = [
        ("SIGSTOP", stop, repeat),
        *((f"hung: {way}", hang(way), repeat) for way in ("sleep", "busy", "locked")),
        (f"link cut for {SHORT_S:g} s", cut(SHORT_S), repeat),
    ]
    if outage_s > 0:
        cases.append((f"link cut for {outage_s:g} s", cut(outage_s), max(1, repeat // 2)))
    cases.append(("SIGKILL", kill, 1))
    columns = ("noticed", "other host", "healed", "other host healed", "verdict ok")
    print("seconds, median (worst)")
    print(f"{'fault':22}" + "".join(f"{column:>19}" for column in columns))
    with running() as (here, there, directory):
        for name, fault, times in cases:
            measured: dict[str, list[float]] = {}
            for _ in range(times):
                for what, seconds in fault(here, there, directory):
                    measured.setdefault(what, []).append(seconds)
                time.sleep(REST_S)
            cells = (
                f"{statistics.median(found):.3f} ({max(found):.3f})"
                if (found := measured.get(column))
                else ""
                for column in columns
            )
            print(f"{name:22}" + "".join(f"{cell:>19}" for cell in cells), flush=True)


def lossy(minutes: float, percent: int) -> None:
    """Drop packets for so long, and count alarms."""
    with running() as (here, there, _):
        since, far = here.mark(), there.mark()
        for machine in (here, there):
            machine.host.run("nft", "-f", "-", stdin=LOSS.format(percent=percent))
        time.sleep(minutes * 60)
        dropped = [
            machine.host.run("nft", "list", "table", "ip", "liveliness").split("packets ")[1]
            for machine in (here, there)
        ]
        alarms = here.count(since, "silent") + there.count(far, "silent")
        lost = here.count(since, "connection") + there.count(far, "connection")
        for machine in (here, there):
            machine.host.run("nft", "delete", "table", "ip", "liveliness")
    counts = " and ".join(each.split()[0] for each in dropped)
    print(
        f"{percent} % loss in both directions for {minutes:g} minutes ({counts} packets dropped): "
        f"{alarms} false alarms, {lost} connection events"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure detection, healing and false alarms.")
    parser.add_argument("--repeat", type=int, default=5, help="of each fault; 0 makes none")
    parser.add_argument("--outage", type=float, default=25.0, help="seconds; 0 leaves it out")
    parser.add_argument("--minutes", type=float, default=10.0, help="of loss; 0 leaves it out")
    parser.add_argument("--loss", type=int, default=30, help="percent")
    options = parser.parse_args()
    if reason := lacking():
        raise SystemExit(reason)
    if options.repeat:
        faults(options.repeat, options.outage)
    if options.minutes:
        lossy(options.minutes, options.loss)


if __name__ == "__main__":
    main()
