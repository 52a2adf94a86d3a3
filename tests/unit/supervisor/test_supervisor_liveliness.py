"""Silent nodes: what becomes of what is noticed, without processes, ROS or waiting."""

from __future__ import annotations

import asyncio
import socket

import pytest

from lifecycle.manifest.model import Timeouts
from lifecycle.middleware.process.busy_sign import BusySign
from lifecycle.supervisor.nodes.liveliness import Cause, SilenceMonitor
from lifecycle.supervisor.processes.control_channel import ChannelClosedError, ControlChannel
from lifecycle.supervisor.run.events import (
    Emitter,
    Event,
)
from tests.builders import planned_node
from tests.unit.supervisor.fakes import host_spec


class Ears:
    """A liveliness with everything it told."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self.changes = 0
        emit = Emitter()
        emit.listen(self.events.append)
        self.liveliness = SilenceMonitor(emit)
        self.liveliness.listen(self._changed)

    def _changed(self) -> None:
        self.changes += 1

    @property
    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]


def test_a_silent_node_is_told_once_and_alive_when_its_last_cause_is_gone() -> None:
    ears = Ears()
    ears.liveliness.note(["/camera"], Cause.STOPPED, "it was stopped")
    ears.liveliness.note(["/camera"], Cause.HUNG, "it hangs")
    ears.liveliness.note(["/camera"], Cause.STOPPED, "")
    assert ears.kinds == ["silent"]
    ears.liveliness.note(["/camera"], Cause.HUNG, "")
    assert ears.kinds == ["silent", "alive"]
    assert ears.liveliness.silent == {}
    assert ears.changes == 4


def test_who_hangs_may_come_back_and_who_is_stopped_or_lost_is_out_of_reach() -> None:
    ears = Ears()
    for node, cause in (("/a", Cause.HUNG), ("/b", Cause.STOPPED), ("/c", Cause.LOST)):
        ears.liveliness.note([node], cause, "it is")
    reached = {node: not ears.liveliness.is_out_of_reach(node) for node in ("/a", "/b", "/c", "/d")}
    assert reached == {"/a": True, "/b": False, "/c": False, "/d": True}


def test_a_process_that_was_killed_while_it_was_busy_does_not_hang() -> None:
    """Its nodes may run again in another one, when the limit of the first is over."""

    async def test() -> None:
        node = planned_node("camera", timeouts=Timeouts(silent_s=0.05))
        told: asyncio.Queue[bool] = asyncio.Queue()
        channel = ControlChannel(host_spec(node), lambda _: None, told.put_nowait)
        theirs = await channel.open()
        _, descriptors, _, _ = socket.recv_fds(theirs, 1, 1)
        sign = BusySign(*descriptors)
        sign.begin()
        theirs.close()
        with pytest.raises(ChannelClosedError):
            await asyncio.wait_for(channel.ready(), 10)
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(told.get(), 10 * sign.limit_s)
        sign.close()
        await channel.close()

    asyncio.run(test())
