"""What an idle managed node of ours has beyond rclpy's, and what each part of it costs.

    python benchmarks/node_cost.py [--nodes 4] [--runs 3] [--domain 72]

Every node is active, has one publisher and a process of its own, and does nothing. Compared are

- spawned: each process is a Python of its own; ours by `lifecycle.run`, rclpy's by `rclpy.spin`
- forked: from one process that has imported what all of them need; ours by `lifecycle up`, rclpy's
  by a fork server as small as it can be, with the same type supports loaded

PSS shares a page among those that have it, so both kinds are measured with equally many nodes side
by side; USS is what ends with the process. Medians over nodes and runs, and ratios ours to rclpy's.
Below, the price of single parts: many of each are made on one node of one process.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import gc
import importlib
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import psutil
import yaml

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script, only its own directory is there

from benchmarks.bring_up import manifest

ROOT = Path(__file__).resolve().parents[1]
BOUND_S = 60.0
SETTLE_S = 3.0
"""Discovery announces each participant twenty times in its first 2 s."""

MANY = 20
MIB = 1 << 20


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """Of one node's process."""

    pss_mib: float
    uss_mib: float
    threads: float
    services: float


def plain_node(name: str) -> object:
    """Make rclpy's managed node and activate it."""
    from rclpy.lifecycle import LifecycleNode
    from std_msgs.msg import String

    node = LifecycleNode(name)
    node.create_lifecycle_publisher(String, f"out_{name}", 10)
    node.trigger_configure()
    node.trigger_activate()
    return node


def be_plain(name: str) -> None:
    import rclpy

    rclpy.init()
    node = plain_node(name)
    # At once: several share the pipe.
    os.write(1, f"up {os.getpid()}\n".encode())
    rclpy.spin(node)


def be_ours(name: str) -> None:
    from std_msgs.msg import String

    import lifecycle

    class Ours(lifecycle.LifecycleNode):
        def __init__(self) -> None:
            super().__init__(name, lifecycle="auto")
            self.declare_publisher(f"out_{name}", String)

    def say(line: str) -> None:
        if line.endswith(" active"):
            print(f"up {os.getpid()}", flush=True)

    lifecycle.run(Ours, arguments=[], say=say)


def fork_plain(nodes: int) -> None:
    """Fork plain nodes from a process that has imported what they need, and wait for its end."""
    from lifecycle.node.host.host import preload

    # The same list as ours, so that both share as much.
    preload()
    importlib.import_module("rclpy.lifecycle")
    gc.collect()
    gc.freeze()
    children = []
    for index in range(nodes):
        child = os.fork()
        if not child:
            with contextlib.suppress(KeyboardInterrupt):
                be_plain(f"node_{index}")
            os._exit(0)
        children.append(child)
    with contextlib.suppress(KeyboardInterrupt):
        signal.pause()
    for child in children:
        os.kill(child, signal.SIGINT)
    for child in children:
        os.waitpid(child, 0)


@contextlib.contextmanager
def running(*command: str) -> Iterator[subprocess.Popen[str]]:
    """Run a program, end it by SIGINT, and kill what does not end."""
    process = subprocess.Popen(
        [sys.executable, *command], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.communicate(timeout=BOUND_S)
        except subprocess.TimeoutExpired:
            process.kill()


def pids_of(process: subprocess.Popen[str], nodes: int) -> list[int]:
    """Return the pids that a program's lines report, as soon as it reported so many."""
    assert process.stdout is not None
    found: list[int] = []
    while len(found) < nodes:
        line = process.stdout.readline()
        if not line:
            raise SystemExit(f"cannot measure: {process.args!r} ended")
        if line.startswith("up "):
            found.append(int(line.split()[1]))
    return found


def hosted_pids(process: subprocess.Popen[str]) -> list[int]:
    """Return the pids of `lifecycle up`'s hosts, once the system is active."""
    assert process.stdout is not None
    found: dict[str, int] = {}
    for line in process.stdout:
        event = json.loads(line)
        if event.get("event") == "process" and event.get("pid"):
            found[event["process"]] = event["pid"]
        if event.get("event") == "system" and event["reached"] == "active":
            return list(found.values())
    raise SystemExit("cannot measure: lifecycle up ended")


def measure(pids: Sequence[int], services: Mapping[str, int]) -> list[Cost]:
    """Read what each process has."""
    count = statistics.median(services.values()) if services else 0
    found = []
    for pid in pids:
        process = psutil.Process(pid)
        memory = process.memory_full_info()
        found.append(
            Cost(
                pss_mib=memory.pss / MIB,
                uss_mib=memory.uss / MIB,
                threads=process.num_threads(),
                services=count,
            )
        )
    return found


def services_of(domain_id: int, nodes: int) -> dict[str, int]:
    """Return how many services each node offers, as discovery shows it."""
    from lifecycle.middleware.rcl.graph import GraphObserver

    with GraphObserver(domain_id) as graph:
        names = [f"/node_{index}" for index in range(nodes)]
        deadline_s = time.monotonic() + BOUND_S
        while not all(graph.services_of(name) for name in names):
            if time.monotonic() > deadline_s:
                raise SystemExit("cannot measure: a node is not in the graph")
            time.sleep(0.05)
        time.sleep(0.5)
        return {name: len(graph.services_of(name)) for name in names}


def spawned(role: str, nodes: int, domain_id: int) -> list[Cost]:
    with contextlib.ExitStack() as stack:
        processes = [
            stack.enter_context(running(__file__, "--role", role, "--name", f"node_{index}"))
            for index in range(nodes)
        ]
        pids = [pid for process in processes for pid in pids_of(process, 1)]
        time.sleep(SETTLE_S)
        return measure(pids, services_of(domain_id, nodes))


def forked_plain(nodes: int, domain_id: int) -> list[Cost]:
    with running(__file__, "--role", "fork", "--nodes", str(nodes)) as process:
        pids = pids_of(process, nodes)
        time.sleep(SETTLE_S)
        return measure(pids, services_of(domain_id, nodes))


def forked_ours(nodes: int, domain_id: int) -> list[Cost]:
    with tempfile.TemporaryDirectory() as directory:
        os.environ["XDG_RUNTIME_DIR"] = directory
        file = Path(directory) / "cost.lifecycle.yaml"
        file.write_text(
            yaml.safe_dump(manifest(nodes, "single", domain_id, "localhost")), encoding="utf-8"
        )
        with running("-m", "lifecycle", "up", str(file), "--format", "json") as process:
            pids = hosted_pids(process)
            time.sleep(SETTLE_S)
            return measure(pids, services_of(domain_id, nodes))


def parts() -> dict[str, tuple[float, int]]:
    """Return the price of each part: KiB of memory of its own, and threads."""
    import rclpy
    from rclpy.lifecycle import LifecycleNode
    from std_msgs.msg import String
    from std_srvs.srv import Trigger

    from lifecycle.middleware.services.supervisor_topics import AlivePublisher

    rclpy.init()
    node = LifecycleNode("parts")
    makers: dict[str, Callable[[int], object]] = {
        "service": lambda i: node.create_service(Trigger, f"service_{i}", lambda _, r: r),
        "publisher": lambda i: node.create_publisher(String, f"out_{i}", 10),
        "subscription": lambda i: node.create_subscription(String, f"in_{i}", print, 10),
        "timer": lambda _: node.create_timer(1.0, print),
        "liveliness (runs alone)": lambda i: AlivePublisher(node, f"/alive_{i}"),
    }
    kept, found = [], {}
    process = psutil.Process()
    for name, make in makers.items():
        kept.append(make(MANY))  # what is loaded once
        memory, threads = process.memory_full_info().uss, process.num_threads()
        kept += [make(index) for index in range(MANY)]
        grown = process.memory_full_info().uss - memory
        found[name] = grown / MANY / 1024, round((process.num_threads() - threads) / MANY)
    print(json.dumps(found), flush=True)
    os._exit(0)


def compare(runs: int, nodes: int, domain_id: int) -> None:
    """Print the table."""
    kinds: dict[str, Callable[[], list[Cost]]] = {
        "spawned, rclpy": lambda: spawned("plain", nodes, domain_id),
        "spawned, ours": lambda: spawned("ours", nodes, domain_id),
        "forked, rclpy": lambda: forked_plain(nodes, domain_id),
        "forked, ours": lambda: forked_ours(nodes, domain_id),
    }
    found: dict[str, list[Cost]] = {name: [] for name in kinds}
    for _ in range(runs):
        for name, run in kinds.items():
            found[name] += run()
    fields = [field.name for field in dataclasses.fields(Cost)]
    print(f"{nodes} idle managed nodes side by side, medians over {runs} runs, of one node\n")
    print(f"{'':18}" + "".join(f"{field:>11}" for field in fields))
    for way in ("spawned", "forked"):
        medians = {
            whose: [
                statistics.median(getattr(each, field) for each in found[f"{way}, {whose}"])
                for field in fields
            ]
            for whose in ("rclpy", "ours")
        }
        for whose, values in medians.items():
            print(f"{way + ', ' + whose:18}" + "".join(f"{value:11.1f}" for value in values))
        ratios = [
            f"{ours / theirs:11.2f}"
            for ours, theirs in zip(medians["ours"], medians["rclpy"], strict=True)
        ]
        print(f"{'  ratio':18}" + "".join(ratios))
    priced = subprocess.check_output(
        [sys.executable, __file__, "--role", "parts"], cwd=ROOT, text=True
    )
    print(f"\n{'price of one':36}{'KiB':>8}{'threads':>9}")
    for name, (kib, threads) in json.loads(priced).items():
        print(f"{name:36}{kib:8.0f}{threads:9}")


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure what an idle managed node costs.")
    parser.add_argument("--nodes", type=int, default=4)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--domain", type=int, default=72)
    parser.add_argument("--role", choices=("plain", "ours", "fork", "parts"))
    parser.add_argument("--name", default="node_0")
    options = parser.parse_args()
    if options.role == "plain":
        with contextlib.suppress(KeyboardInterrupt):
            be_plain(options.name)
    elif options.role == "ours":
        be_ours(options.name)
    elif options.role == "fork":
        fork_plain(options.nodes)
    elif options.role == "parts":
        parts()
    else:
        os.environ["ROS_DOMAIN_ID"] = str(options.domain)
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        with tempfile.TemporaryDirectory() as logs:
            os.environ["ROS_LOG_DIR"] = logs
            compare(options.runs, options.nodes, options.domain)


if __name__ == "__main__":
    main()
