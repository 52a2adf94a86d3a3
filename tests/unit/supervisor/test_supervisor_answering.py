"""Nodes that are in no host of ours are asked before the gate, and moved by others meanwhile."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from lifecycle.errors import BringUpError
from lifecycle.graph.loop import ended
from lifecycle.manifest.model import RunKind
from lifecycle.node.host.control import Operation
from lifecycle.supervisor.core.state import Level
from lifecycle.supervisor.nodes.driver import ActiveError, ChangedError, ServiceDriver
from lifecycle.supervisor.nodes.liveliness import ANSWER_S, SHOWN_S, TRIES, Answering
from lifecycle.supervisor.run.events import Notice
from tests.builders import plan_of, planned_node
from tests.unit.supervisor.fakes import FakeForkServer, World
from tests.unit.supervisor.session_world import FakeParticipant


class _Node:
    """A plain node that answers from a moment on, or serves nothing."""

    def __init__(self, *, from_s: float = 0.0, shows: bool = True, is_sure: bool = False) -> None:
        self.from_s = from_s
        self.shows = shows
        self.is_sure = is_sure
        self.asked_s: list[float] = []

    async def answers(
        self, node: str, *, managed: bool, timeout_s: float, repeat: bool = False
    ) -> bool | None:
        del node, managed, repeat
        loop = asyncio.get_running_loop()
        self.asked_s.append(loop.time())
        if not self.shows:
            return None
        await asyncio.sleep(min(timeout_s, max(0.0, self.from_s - loop.time())))
        return loop.time() >= self.from_s

    def serves_parameters(self, node: str) -> bool | None:
        del node
        return False if self.is_sure else None


async def _before_the_gate(
    tmp_path: Path, node: _Node, timeout_s: float = 60.0
) -> tuple[bool, float, list[str], list[str]]:
    """Ask once; return whether that took any time, how much, findings and notices."""
    world = World(plan_of(planned_node("base", kind=RunKind.ATTACH, managed=False)), tmp_path)
    system = world.system
    system.present = frozenset({"/base"})
    system.nodes["base"].core.level = Level.STARTED
    answering = Answering(system, node)
    asking = asyncio.ensure_future(answering.follow())
    loop = asyncio.get_running_loop()
    began_s = loop.time()
    node.from_s += began_s
    waited = await answering.asked(timeout_s)
    took_s = loop.time() - began_s
    found = [each.rule for each in system.liveliness.findings()]
    assert found or not await answering.asked(timeout_s), "it was asked again for nothing"
    await ended(asking)
    return waited, took_s, found, [each.message for each in world.heard(Notice)]


@pytest.mark.parametrize(
    ("from_s", "timeout_s", "known_s", "expected"),
    [
        (0.0, 60.0, 0.0, []),
        (2.0, 60.0, 2.0, []),
        (100.0, 60.0, TRIES * ANSWER_S, ["run.not-answering"]),
        (100.0, 2.0, 2.0, ["run.not-answering"]),
    ],
)
async def test_a_node_is_waited_for_until_it_answers_within_two_requests_and_the_time(
    tmp_path: Path, from_s: float, timeout_s: float, known_s: float, expected: list[str]
) -> None:
    node = _Node(from_s=from_s)
    waited, took_s, found, notices = await _before_the_gate(tmp_path, node, timeout_s)
    assert waited
    assert known_s <= took_s < known_s + 0.5
    assert found == expected
    assert len(notices) == len(expected)


@pytest.mark.parametrize(("is_sure", "least_s"), [(True, 0.0), (False, SHOWN_S)])
async def test_a_node_that_serves_nothing_is_named_and_not_found(
    tmp_path: Path, is_sure: bool, least_s: float
) -> None:
    node = _Node(shows=False, is_sure=is_sure)
    _, took_s, found, notices = await _before_the_gate(tmp_path, node)
    assert least_s <= took_s < least_s + 0.5
    assert found == []
    assert notices == ["'/base' serves no parameters: whether it hangs is not seen"]


class Foreign(FakeParticipant):
    """Node `/b`, which others started, and what it was asked."""

    def __init__(self, state: str, *moved_to: str) -> None:
        self.hosts = FakeForkServer()
        super().__init__(self.hosts)
        self.others["/b"] = state
        self.services.moved_to = [*moved_to]

    async def perform(self, operation: Operation, *, holds: bool | None = None) -> str:
        """Have it driven; return its state. `holds`: the permit, if there is one, does."""

        async def permit() -> None:
            if not holds:
                raise ChangedError("the gate closed again")

        driver = ServiceDriver(self.services, planned_node("b"))  # type: ignore[arg-type]
        given = None if holds is None else permit
        return (await driver.perform(operation, given)).state


async def test_a_foreign_node_gets_no_activate_request_without_a_permit_that_holds() -> None:
    node = Foreign("inactive")
    with pytest.raises(BringUpError, match="cannot activate '/b' without a permit"):
        await node.perform(Operation.ACTIVATE)
    with pytest.raises(ChangedError):
        await node.perform(Operation.ACTIVATE, holds=False)
    assert node.hosts.log == []
    await node.perform(Operation.ACTIVATE, holds=True)
    assert node.hosts.log == ["/b activate"]


@pytest.mark.parametrize(
    ("state", "operation", "reached"),
    [("active", Operation.DEACTIVATE, "inactive"), ("inactive", Operation.ACTIVATE, "active")],
)
async def test_a_node_that_somebody_moves_back_meanwhile_is_asked_again(
    state: str, operation: Operation, reached: str
) -> None:
    node = Foreign(state, state)
    assert await node.perform(operation, holds=True) == reached
    assert node.hosts.log == [f"/b {operation.value}"] * 2


async def test_whoever_moves_it_each_time_is_named_and_no_request_is_sent_that_cannot_be() -> None:
    node = Foreign("active", *["active"] * 9)
    with pytest.raises(ActiveError, match="activated again by its own code or another client"):
        await node.perform(Operation.DEACTIVATE)
    node = Foreign("active", "unconfigured")
    with pytest.raises(BringUpError, match="others moved it, and it is unconfigured"):
        await node.perform(Operation.DEACTIVATE)
    assert node.hosts.log == ["/b deactivate"]
