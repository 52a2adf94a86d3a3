"""What a network flow of one's own costs: `python benchmarks/unique_flows.py [COUNT]`.

Makes COUNT (default 20) endpoints of each kind in a process of its own and prints, per endpoint,
the time to make it, resident memory, threads and sockets, each as a ratio to the plain kind too.
Traffic stays on loopback; the domain is ROS_DOMAIN_ID, else 99.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

KINDS = {
    "plain subscription": "subscription",
    "subscription, strictly unique": "unique_subscription",
    "the same on its own participant": "participant_subscription",
    "plain publisher": "publisher",
    "publisher on its own participant": "participant",
    "the same, marked with a DSCP": "marked_participant",
    "the same, UDP only, 1400 B datagrams": "udp_participant",
}
BASELINE = {
    "unique_subscription": "subscription",
    "participant_subscription": "subscription",
    "participant": "publisher",
    "marked_participant": "publisher",
    "udp_participant": "publisher",
}


@dataclasses.dataclass(frozen=True)
class Cost:
    """Per endpoint; `make_ms` is the median."""

    make_ms: float
    rss_kib: float
    threads: float
    sockets: float


def usage() -> tuple[int, int, int]:
    resident = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")
    sockets = 0
    for descriptor in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):
            sockets += str(descriptor.readlink()).startswith("socket:")
    return resident // 1024, len(list(Path("/proc/self/task").iterdir())), sockets


def measure(kind: str, count: int) -> NoReturn:
    """Print the cost of one kind as JSON, and leave."""
    import rclpy
    from rclpy.node import Node
    from std_msgs.msg import String

    from lifecycle.manifest.qos import QosProfile
    from lifecycle.middleware.fastdds.nfe import create_subscription
    from lifecycle.middleware.fastdds.participant import FlowParticipant
    from lifecycle.middleware.process.control import leave_and_exit
    from lifecycle.network.nfe import UniqueRequirement

    context = rclpy.Context()
    context.init(args=[])
    node, qos = Node("bench", context=context), QosProfile()
    participants: list[FlowParticipant] = []
    strictly = UniqueRequirement.STRICTLY_REQUIRED

    def subscription(number: int, unique: UniqueRequirement) -> object:
        return create_subscription(node, String, f"/t{number}", print, qos, unique=unique)

    def participant(number: int, **options: Any) -> FlowParticipant:
        name = f"_bench_flow_{number}"
        made = FlowParticipant(name, "/", context.get_domain_id(), **options)
        participants.append(made)
        return made

    def publisher(number: int, **options: Any) -> object:
        return participant(number, **options).create_publisher(String, f"/t{number}", qos)

    def listener(number: int) -> object:
        made = participant(number)
        return made.create_subscription(String, f"/t{number}", print, qos, unique=strictly)

    make: Callable[[int], object] = {
        "subscription": lambda number: subscription(number, UniqueRequirement.NOT_REQUIRED),
        "unique_subscription": lambda number: subscription(number, strictly),
        "participant_subscription": listener,
        "publisher": lambda number: node.create_publisher(String, f"/t{number}", 10),
        "participant": publisher,
        "marked_participant": lambda number: publisher(number, dscp=46),
        "udp_participant": lambda number: publisher(
            number, dscp=46, transports=("udpv4",), max_datagram_bytes=1400
        ),
    }[kind]
    kept = [make(count)]  # type supports and libraries are loaded by the first
    before = usage()
    took_ms = []
    for number in range(count):
        began = time.perf_counter()
        kept.append(make(number))
        took_ms.append((time.perf_counter() - began) * 1000)
    used = [(after - start) / count for after, start in zip(usage(), before, strict=True)]
    cost = Cost(statistics.median(took_ms), *used)
    print(json.dumps(dataclasses.asdict(cost)), flush=True)
    leave_and_exit(0, participants=participants, nodes=[node], contexts=[context], deadline_s=10)


def main() -> int:
    if sys.argv[1:2] == ["--kind"]:
        measure(sys.argv[2], int(sys.argv[3]))
    count = sys.argv[1] if sys.argv[1:] else "20"
    environment = {
        "ROS_DOMAIN_ID": "99",
        **os.environ,
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    costs = {}
    for kind in KINDS.values():
        done = subprocess.run(
            [sys.executable, __file__, "--kind", kind, count],
            env=environment,
            check=True,
            stdout=subprocess.PIPE,
            text=True,
        )
        costs[kind] = Cost(**json.loads(done.stdout))
    print(f"{'per endpoint':38}{'ms':>8}{'KiB RSS':>10}{'threads':>9}{'sockets':>9}   time ratio")
    for title, kind in KINDS.items():
        cost = costs[kind]
        ratio = cost.make_ms / costs[BASELINE[kind]].make_ms if kind in BASELINE else 1.0
        print(
            f"{title:38}{cost.make_ms:8.2f}{cost.rss_kib:10.0f}{cost.threads:9.1f}"
            f"{cost.sockets:9.1f}   {ratio:.1f} x"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
