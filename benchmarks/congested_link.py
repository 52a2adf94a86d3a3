"""What unique network flows buy on a congested link, as in the article *Unique Network Flows*.

Three hosts (network namespaces): A – router – B. N1 on A publishes P1, 1 kB at 100 Hz, beside bulk
P2; N2 on B takes both. Where the router sends to B the link has 20 Mbit/s and 300 ms of buffer, and
the offered load is 112 % of it. Everything is the product's own: two `lifecycle up --machine`, and
on the router `lifecycle flows apply --target tc`, which makes its rules from verified flows. Only
the control, which has no rule, gets its bottleneck by hand: the same queue with one class.

    python benchmarks/congested_link.py

Needs root, and a kernel with sch_htb and cls_u32 or cls_flower. Takes about two minutes.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import os
import signal
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script, only its own directory is there

from benchmarks.congested_link_nodes import P1_BYTES, P2_BYTES, PERIOD_S
from tests.net.hosts import Host, Hosts, lacking

LINK_KBIT = 20_000
BUFFER_S = 0.3
LOAD = 1.12
HEADERS_BYTES = 14 + 20 + 8 + 20 + 12 + 24 + 16
"""Ethernet, IPv4, UDP, RTPS header, INFO_TS, DATA, CDR of a string (its length, padding)."""

GUARANTEE = "4mbit"
"""Of P1's class: above the peak of its bursts, or it queues behind itself."""

FRAME_BYTES = 1514
UP_S = 30.0
FILL_S = BUFFER_S / (LOAD - 1) + 0.5
"""Until the buffer is full: it fills with what is offered beyond what leaves."""

PYTHON = (sys.executable, "-m", "lifecycle")
DOMAIN = 7


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """One row of the table.

    Attributes:
        publishers: flow needs of N1.
        subscriptions: flow needs of N2.
        apply: options of `lifecycle flows apply --target tc`; None for a link without a rule.
        links: what the manifest declares of the two flows.
    """

    title: str
    publishers: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    subscriptions: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    apply: Sequence[str] | None = ()
    links: Sequence[Mapping[str, Any]] = ()


_FIRST = {"five_qi": 85}
_UNIQUE = {"unique": "strictly_required"}
_5QI = ("--guarantee", f"5qi85={GUARANTEE}")

CASES = (
    Case(
        # Both ask for the same: what is one flow can get one treatment only.
        title="shared flow, best possible rule",
        publishers={"p1": _FIRST, "p2": _FIRST},
        apply=("--guarantee", f"5qi85={LINK_KBIT - 1000}kbit"),
    ),
    Case(
        title="unique subscriptions, rule on the port",
        publishers={"p1": _FIRST},
        subscriptions={"p1": _UNIQUE, "p2": _UNIQUE},
        apply=_5QI,
    ),
    Case(
        title="own participant, 5-tuple rule",
        publishers={"p1": {**_FIRST, **_UNIQUE}},
        subscriptions={"p1": _UNIQUE},
        apply=_5QI,
    ),
    Case(
        title="own participant marked EF, DSCP rule",
        publishers={"p1": {"dscp": "EF"}},
        apply=("--match", "mark", "--guarantee", f"ef={GUARANTEE}"),
    ),
    Case(
        title="control: unique flows without a rule",
        publishers={"p1": _UNIQUE},
        subscriptions={"p1": _UNIQUE, "p2": _UNIQUE},
        apply=None,
    ),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Result:
    """What P1 got.

    Attributes:
        sent: messages of P1 in the measured time.
        delays_s: of those that arrived.
    """

    sent: int
    delays_s: tuple[float, ...]

    @property
    def median_ms(self) -> float:
        """Of what arrived."""
        return statistics.median(self.delays_s) * 1e3 if self.delays_s else float("nan")

    @property
    def loss(self) -> float:
        """Share of P1 that did not arrive."""
        return 1 - len(self.delays_s) / self.sent

    @property
    def within_5_ms(self) -> float:
        """Share of P1 that arrived within 5 ms."""
        return sum(each <= 0.005 for each in self.delays_s) / self.sent


def main(argv: Sequence[str] | None = None) -> int:
    """Measure every case and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=8.0, help="measured per case")
    parser.add_argument("--only", type=int, nargs="*", help="numbers of cases, from 1")
    options = parser.parse_args(argv)
    if why := lacking():
        print(f"not measured: {why}")
        return 0
    chosen = [CASES[number - 1] for number in options.only or range(1, len(CASES) + 1)]
    with contextlib.ExitStack() as stack:
        directory = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="congested_link")))
        hosts = stack.enter_context(Hosts())
        left, router, right = hosts.routed("A", "B")
        if missing := missing_features(router):
            print(f"not measured with this kernel: {missing}")
            return 0
        # The buffer of each class of the link, in frames.
        frames = int(LINK_KBIT * 1000 / 8 * BUFFER_S / FRAME_BYTES)
        router.ip("link", "set", "right", "txqueuelen", str(frames))
        print(
            f"link {LINK_KBIT / 1000:g} Mbit/s, buffer {BUFFER_S * 1e3:.0f} ms, load {LOAD:.0%}, "
            f"P1 {P1_BYTES} B at {1 / PERIOD_S:.0f} Hz, {options.seconds:g} s each\n"
        )
        print(f"{'flows':<42}{'P1 median':>12}{'P1 loss':>10}{'within 5 ms':>13}")
        for number, case in enumerate(chosen):
            place = directory / str(number)
            result = measure(case, left, router, right, directory=place, seconds=options.seconds)
            print(
                f"{case.title:<42}{result.median_ms:>9.2f} ms{result.loss:>10.1%}"
                f"{result.within_5_ms:>13.1%}",
                flush=True,
            )
    return 0


def missing_features(router: Host) -> str:
    """Say what the kernel lacks; empty if it has all that is needed."""
    try:
        run_tc(router, "qdisc add dev left root handle 1: htb default 1")
    except OSError:
        return "it has no sch_htb"
    try:
        place = "dev left parent 1: protocol ip pref 1"
        for each in ("u32 match u8 0 0", "flower ip_proto udp"):
            with contextlib.suppress(OSError):
                run_tc(router, f"filter add {place} {each} flowid 1:1")
                return ""
        return "it has neither cls_u32 nor cls_flower"
    finally:
        run_tc(router, "qdisc del dev left root")


def run_tc(host: Host, line: str) -> str:
    """Have a host run a line of tc(8), and return what that wrote.

    Raises:
        OSError: it failed.
    """
    return host.run("tc", *line.split())


def measure(
    case: Case, left: Host, router: Host, right: Host, *, directory: Path, seconds: float
) -> Result:
    """Bring the system up on both hosts, program the router, load the link and look at P1."""
    directory.mkdir()
    manifest = write_manifest(case, left.ipv4, right.ipv4, directory)
    with (
        brought_up(manifest, left, right, directory) as (one, other),
        rule(case, router, manifest, directory),
    ):
        (directory / "go").touch()
        time.sleep(FILL_S)  # the load itself is what is waited for
        began_ns = time.monotonic_ns()
        time.sleep(seconds)
        ended_ns = time.monotonic_ns()
        time.sleep(2 * BUFFER_S)  # what is on its way may still arrive
        for running in (one, other):
            running.send_signal(signal.SIGTERM)
        for running in (one, other):
            running.wait(UP_S)
    sent = [each for each in _read(directory, "sent") if began_ns <= each <= ended_ns]
    arrived = {stamp: at - stamp for stamp, at in _read(directory, "received")["p1"]}
    delays = tuple(arrived[stamp] / 1e9 for stamp in sent if stamp in arrived)
    return Result(sent=len(sent), delays_s=delays)


@contextlib.contextmanager
def brought_up(
    manifest: Path, left: Host, right: Host, directory: Path
) -> Iterator[tuple[Any, Any]]:
    """Run a supervisor on each host, until the system is active on both."""
    variables = {
        "CONGESTED_LINK_DIRECTORY": str(directory),
        "CONGESTED_LINK_BULK_PER_S": str(_bulk_per_s()),
    }
    with (
        up(left, manifest, "a", directory, {**variables, "ROS_STATIC_PEERS": right.ipv4}) as one,
        up(right, manifest, "b", directory, {**variables, "ROS_STATIC_PEERS": left.ipv4}) as other,
    ):
        for running in (one, other):
            until_active(running, directory)
        yield one, other


def _bulk_per_s() -> float:
    """Messages of P2 per second that make the load, P1 included."""
    p1 = (P1_BYTES + HEADERS_BYTES) * 8 / PERIOD_S
    return (LINK_KBIT * 1000 * LOAD - p1) / ((P2_BYTES + HEADERS_BYTES) * 8)


def _read(directory: Path, name: str) -> Any:
    return json.loads((directory / f"{name}.json").read_text())


def write_manifest(case: Case, left: str, right: str, directory: Path) -> Path:
    """Write the system of a case; return its path."""
    ends = [
        {"name": name, "type": "std_msgs/msg/String", "qos": "sensor_data"} for name in ("p1", "p2")
    ]
    nodes = "benchmarks.congested_link_nodes"
    document = {
        "manifest_version": 1,
        "system": "congested",
        "discovery": {"domain_id": DOMAIN, "range": "subnet"},
        "machines": {"a": {"address": left}, "b": {"address": right}},
        "nodes": {
            "n1": {
                "run": {"python": f"{nodes}:Source"},
                "machine": "a",
                "interface": {"publishers": ends},
                "flows": {"publishers": {key: dict(v) for key, v in case.publishers.items()}},
            },
            "n2": {
                "run": {"python": f"{nodes}:Sink"},
                "machine": "b",
                "interface": {"subscriptions": ends},
                "flows": {"subscriptions": {key: dict(v) for key, v in case.subscriptions.items()}},
            },
        },
        "links": [dict(each) for each in case.links],
    }
    path = directory / "congested.lifecycle.yaml"
    # Without aliases: a manifest may have few.
    path.write_text(yaml.safe_dump(json.loads(json.dumps(document))))
    return path


@contextlib.contextmanager
def up(
    host: Host, manifest: Path, machine: str, directory: Path, variables: Mapping[str, str]
) -> Iterator[Any]:
    """Run `lifecycle up` for one machine on its host; it is ended whatever happens."""
    runtime = directory / machine
    environment = {**host.environment(runtime), **variables}
    arguments = ("up", str(manifest), "--machine", machine, "--format", "json")
    with (directory / f"{machine}.log").open("w") as log:
        running = host.popen(*PYTHON, *arguments, env=environment, stdout=log, stderr=log)
        try:
            yield running
        finally:
            if running.poll() is None:
                running.send_signal(signal.SIGTERM)
                with contextlib.suppress(Exception):
                    running.wait(UP_S)
                running.kill()
                running.wait()


def until_active(running: Any, directory: Path) -> None:
    """Wait until both supervisors say that the system is active."""
    deadline = time.monotonic() + UP_S
    logs = [directory / f"{machine}.log" for machine in "ab"]
    while not all('"reached":"active"' in log.read_text() for log in logs):
        if running.poll() is not None or time.monotonic() > deadline:
            tails = "\n".join(log.read_text()[-2000:] for log in logs)
            raise RuntimeError(f"cannot bring the system up:\n{tails}")
        time.sleep(0.05)


@contextlib.contextmanager
def rule(case: Case, router: Host, manifest: Path, directory: Path) -> Iterator[None]:
    """Have the link, with the rules that the product makes for it or without any."""
    if case.apply is None:
        # One class: what is queued is treated alike.
        rate = f"rate {LINK_KBIT}kbit ceil {LINK_KBIT}kbit quantum {2 * FRAME_BYTES}"
        run_tc(router, "qdisc add dev right root handle 1: htb default 1")
        run_tc(router, f"class add dev right parent 1: classid 1:1 htb {rate}")
        try:
            yield
        finally:
            run_tc(router, "qdisc del dev right root")
        return
    environment = router.environment(directory / "router")
    program = ("--target", "tc", "--device", "right", "--rate", f"{LINK_KBIT}kbit", *case.apply)
    flows(router, environment, directory, "apply", str(manifest), *program)
    try:
        yield
    finally:
        flows(router, environment, directory, "remove", str(manifest))


def flows(host: Host, environment: Mapping[str, str], directory: Path, *arguments: str) -> None:
    """Run `lifecycle flows`."""
    with (directory / "flows.log").open("a") as log:
        running = host.popen(
            *PYTHON, "flows", *arguments, env=dict(environment), stdout=log, stderr=log
        )
        if running.wait(UP_S) != os.EX_OK:
            raise RuntimeError(
                f"cannot {arguments[0]} flows:\n{(directory / 'flows.log').read_text()}"
            )


if __name__ == "__main__":
    sys.exit(main())
