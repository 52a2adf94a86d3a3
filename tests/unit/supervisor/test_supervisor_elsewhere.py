"""Nodes that another supervisor brings up: how far they have come, and who waits for them."""

from __future__ import annotations

import asyncio
import contextlib

import pytest

from lifecycle.graph.loop import ended
from lifecycle.manifest.model import Condition
from lifecycle.supervisor.shell.looks import conditions
from lifecycle.verify.observation import Observation, ObservedNode
from tests.builders import configuration, planned_node

STARTED, CONFIGURED, CONNECTED, ACTIVE, HEALTHY = Condition


def _seen(state: str | None, *, connected: bool | None = None) -> Observation:
    reports = ()
    if connected is not None:
        reports = (configuration("/camera", state=state or "", connected=connected),)
    return Observation(
        nodes=(ObservedNode(full_name="/camera", state=state),), configurations=reports
    )


@pytest.mark.parametrize(
    ("observation", "reached"),
    [
        (Observation(), ()),
        (_seen(None), (STARTED,)),
        (_seen("unconfigured", connected=False), (STARTED,)),
        (_seen("inactive", connected=False), (STARTED, CONFIGURED)),
        (_seen("inactive", connected=True), (STARTED, CONFIGURED, CONNECTED)),
        # Without a report it is not one of our nodes, whose data layer is made in configure.
        (_seen("inactive"), (STARTED, CONFIGURED, CONNECTED)),
        # Nothing is asked of its health.
        (_seen("active"), (STARTED, CONFIGURED, CONNECTED, ACTIVE, HEALTHY)),
        (_seen("finalized", connected=False), (STARTED,)),
    ],
)
def test_a_remote_node_has_reached_what_is_seen_of_it(
    observation: Observation, reached: tuple[Condition, ...]
) -> None:
    found = conditions(planned_node("camera"), observation)
    assert tuple(each for each in Condition if each in found) == reached


async def test_a_task_that_loses_a_cancellation_is_ended_all_the_same() -> None:
    lost: list[None] = []

    async def deaf() -> None:
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.sleep(1000)
        lost.append(None)
        await asyncio.sleep(1000)

    task = asyncio.ensure_future(deaf())
    await asyncio.sleep(0)
    await ended(task)
    assert task.cancelled()
    assert lost == [None]
