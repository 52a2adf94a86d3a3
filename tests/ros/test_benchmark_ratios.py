"""What we cost beside a floor and plain rclpy has not grown by a factor.

The figures are in docs/performance.md. Bounds are about twice what was measured: a regression by a
factor is noticed, a busy machine is not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import pytest
import rclpy

from benchmarks import bring_up, data_path
from benchmarks.measuring import FLOOR, OURS, Row, Used

pytestmark = pytest.mark.alone

TURNS = 3
NODES = 5
BOUNDS: dict[str, tuple[Callable[[Used], float], float]] = {
    "CPU seconds until all are active": (lambda used: used.cpu_s, 9.0),
    "PSS": (lambda used: used.pss_mib, 4.4),
    "threads": (lambda used: used.threads, 2.2),
}


def test_five_nodes_come_up_for_a_bounded_multiple_of_the_floor(fresh_domain: int) -> None:
    ratios: list[dict[str, float]] = []
    for _ in range(TURNS):
        ours, floor = (
            bring_up.measure(
                name, NODES, "single", fresh_domain, bring_up.Findings(), range_="localhost"
            )
            for name in (OURS, FLOOR)
        )
        ratios.append({what: of(ours) / of(floor) for what, (of, _) in BOUNDS.items()})
        # One turn in which nothing else got in the way is enough.
        if all(ratios[-1][what] <= bound for what, (_, bound) in BOUNDS.items()):
            return
    bounds = {what: bound for what, (_, bound) in BOUNDS.items()}
    pytest.fail(f"ours / floor, {NODES} nodes: {ratios}; bounds: {bounds}")


@pytest.fixture
def _entered(fresh_domain: int) -> Iterator[None]:
    rclpy.init(domain_id=fresh_domain)
    yield
    rclpy.try_shutdown()


@pytest.mark.parametrize(
    ("measure", "bounds"),
    [
        (
            data_path.publish,
            {
                "publish, ns": 2.0,
                "publish by name, ns": 2.0,
                "publish while inactive, ns": 0.1,
            },
        ),
        (data_path.message, {"message received, µs of CPU": 3.0}),
    ],
    ids=["publish", "message"],
)
@pytest.mark.usefixtures("_entered")
def test_a_message_costs_about_what_it_costs_in_rclpy(
    measure: Callable[[int], list[Row]], bounds: dict[str, float]
) -> None:
    ratios: list[dict[str, float | None]] = []
    for _ in range(TURNS):
        ratios.append({each.what: each.ratio for each in measure(1)})
        if all((ratios[-1][what] or math.inf) <= bound for what, bound in bounds.items()):
            return
    pytest.fail(f"ours / rclpy: {ratios}; bounds: {bounds}")
