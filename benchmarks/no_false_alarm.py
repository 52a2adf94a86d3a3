"""Whether measuring raises false alarms: two hosts for an hour at half of what each bound allows.

The publisher's clock is half a second ahead; one of 200 datagrams is lost, and the subscription's
node is busy for 50 ms now and then, so that callbacks begin so late.
Every violation of a measured rule is compared with what the subscription itself noted, by a clock
that both hosts share: it is false where the bound was kept.

    python benchmarks/no_false_alarm.py [--minutes 60]       # as root: hosts are namespaces

Prints each violation and what is true, and exits with 1 if one was false.
"""

from __future__ import annotations

import argparse
import itertools
import signal
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script, only its own directory is there

from tests.net.hosts import Hosts
from tests.net.other_clock import OtherClock
from tests.net.running import article, up_on
from tests.ros.supervisor.running import Up

DELAY_MS, LOSS, RATE_HZ, SILENCE_S = 60, 0.01, 25, 1.0
_WINDOW_S = 30.0
"""Before a violation, what is looked at."""

_LOSES = """
table inet lossy {
  chain out {
    type filter hook output priority 0
    meta l4proto udp numgen random mod 200 == 0 drop
  }
}
"""

_EDIT = {
    "nodes/n1/run": {"python": "benchmarks.no_false_alarm_nodes:Halting"},
    "nodes/n2/run": {"python": "benchmarks.no_false_alarm_nodes:Noting"},
    "links": [
        {
            "topic": "/video",
            "from": "n1",
            "to": "n2",
            "max_delay_ms": DELAY_MS,
            "loss": LOSS,
            "rate_hz": {"min": RATE_HZ, "max": 4 * RATE_HZ},
            "max_silence_s": SILENCE_S,
        },
        {"topic": "/battery", "from": "n1", "to": "n2"},
    ],
}


def truth(noted: Iterable[str], since_s: float) -> str:
    """Return what arrived since a time of the monotonic clock."""
    found = [tuple(map(float, each.split())) for each in noted]
    rows = [(at, delay) for at, delay in found if at >= since_s]
    if len(rows) < 2:
        return f"{len(rows)} messages"
    delays = sorted(delay for _, delay in rows)
    gap = max(after[0] - before[0] for before, after in itertools.pairwise(rows))
    span = rows[-1][0] - rows[0][0]
    return (
        f"{len(rows)} in {span:.1f} s ({(len(rows) - 1) / span:.1f} Hz), p99 "
        f"{delays[int(0.99 * len(delays))]:.1f} ms, longest silence {gap:.2f} s"
    )


def watch(up: Up, until_s: float, notes: Path) -> int:
    """Print violations of measured rules until a time; return how many there were."""
    seen, count, found = 0, 0, set[str]()
    while time.monotonic() < until_s:
        time.sleep(1.0)
        up.catch_up()
        verdicts = up.of_kind("verdict")
        for each in verdicts[seen:]:
            now = {
                finding["message"].split(":")[0] + finding["rule"]: finding["message"]
                for finding in each["verdict"]["findings"]
                if finding["rule"].startswith("flow.")
            }
            for key in now.keys() - found:
                count += 1
                rows = notes.read_text().splitlines()[:-1]
                print(time.strftime("%H:%M:%S"), now[key], flush=True)
                print("   true:", truth(rows, time.monotonic() - _WINDOW_S), flush=True)
            found = set(now)
        seen = len(verdicts)
    return count


def main() -> int:
    """Run it."""
    parser = argparse.ArgumentParser(description="Look for false alarms of measured rules.")
    parser.add_argument("--minutes", type=float, default=60.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name, Hosts() as hosts:
        directory = Path(name)
        a, b = hosts.bridged("A", "B")
        a.run("nft", "-f", "-", stdin=_LOSES)
        manifest = article(directory, a.ipv4, b.ipv4, edit=_EDIT)
        notes = directory / "notes"
        with (
            up_on(
                a,
                manifest,
                "--machine",
                "a",
                runtime=directory / "a",
                variables=OtherClock(directory / "clock", 0.5).variables,
            ) as up_a,
            up_on(
                b,
                manifest,
                "--machine",
                "b",
                runtime=directory / "b",
                variables={"NOTES": str(notes), "BUSY_S": "0.05"},
            ) as up_b,
        ):
            for up in (up_a, up_b):
                up.until("system", reached="active")
            count = watch(up_b, time.monotonic() + 60 * options.minutes, notes)
            rows = notes.read_text().splitlines()[:-1]
            print("all:", truth(rows, 0.0), flush=True)
            for up in (up_a, up_b):
                up.signal(signal.SIGTERM)
            print("exit codes", up_a.finish(), up_b.finish(), "violations", count)
    return int(count > 0)


if __name__ == "__main__":
    sys.exit(main())
