"""What it costs to count a message where it arrives: CPU time of this process, no DDS.

    python benchmarks/counting.py

A subscription's callback is called with a hundred thousand messages, as rclpy would call it, once
plain and once as a gate calls it; what was noted is counted in the same process. The least of seven
runs.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from lifecycle.measure.counter import Counter
from lifecycle.node.gate import counting

MESSAGES = 100_000
RUNS = 7


def main() -> None:
    """Measure, and print what counting adds to each message."""
    plain_us = min(_us(_plain) for _ in range(RUNS))
    counted_us = min(_us(_counted) for _ in range(RUNS))
    print(f"counting adds {counted_us - plain_us:.2f} µs to a message")


def _us(work: Callable[[], None]) -> float:
    began_s = time.process_time()
    work()
    return (time.process_time() - began_s) / MESSAGES * 1e6


def _take(_message: object, _info: object) -> None:
    """Do nothing, as a callback that is not what is measured."""


def _plain() -> None:
    for each in _infos():
        _take(None, each)


def _counted() -> None:
    # As if it were active for two seconds: what comes at first does not count.
    counter = Counter(time.monotonic_ns() - 2 * 10**9, time.time_ns() - 2 * 10**9)
    call = counting(_take, counter)
    for each in _infos():
        call(None, each)
    counter.count()


def _infos() -> list[dict[str, int]]:
    """What rclpy knows of messages that took 0.2 ms to arrive."""
    now_ns = time.time_ns()
    return [
        {
            "source_timestamp": now_ns - 300_000,
            "received_timestamp": now_ns - 100_000,
            "publication_sequence_number": number,
        }
        for number in range(1, MESSAGES + 1)
    ]


if __name__ == "__main__":
    main()
