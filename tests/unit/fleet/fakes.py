"""Hosts without ssh, supervisors or waiting, for the coordinator of `up --hosts`.

Owns: `FakeTransport`, whose agent and supervisor live in the loop of the test, and can be cut off.
"""

from __future__ import annotations

import asyncio
import dataclasses
import json
from collections.abc import Callable
from typing import Any

from lifecycle.codec import from_json, to_json
from lifecycle.errors import ExitCode
from lifecycle.fleet import coordinator
from lifecycle.fleet.coordinator import Coordinator, Place, Record
from lifecycle.fleet.protocol import PROTOCOL, Do, Order, Part, Said, Word
from lifecycle.fleet.transport import Closed

VERSION = "1.2.3"


class Supervisor:
    """What runs on a host, whoever is connected."""

    def __init__(self, host: FakeTransport) -> None:
        self._host = host
        self.is_active = False
        self.exit_code: int | None = None
        self._loop = asyncio.get_running_loop()
        for each in host.junk:
            self._loop.call_later(0.1, host.say, each)
        if host.active_s is not None:
            self._loop.call_later(host.active_s, self.activate)
        if host.fails_s is not None:
            self._loop.call_later(host.fails_s, self.end, ExitCode.BRING_UP_FAILED)

    def activate(self) -> None:
        if self.exit_code is None:
            self.is_active = True
            reached = self._host.reaches
            record = {"event": "system", "reached": reached, "elapsed_s": 1.0}
            self._host.say(json.dumps(record).encode())

    def end(self, code: int) -> None:
        if self.exit_code is None:
            self.exit_code = code
            self._host.world.ended.append(self._host.name)
            self._host.say(to_json(Said(agent=Word.ENDED, exit_code=code)))

    def kill(self) -> None:
        self.exit_code = -9
        self._host.say(to_json(Said(agent=Word.ENDED, signal=9)))

    def terminate(self) -> None:
        if self._host.ends_s is not None:
            code = ExitCode.OK if self.is_active else ExitCode.TERMINATED
            self._loop.call_later(self._host.ends_s, self.end, code)


class FakeChannel:
    """One connection."""

    def __init__(self, host: FakeTransport) -> None:
        self._host = host
        self._lines: asyncio.Queue[bytes] = asyncio.Queue()
        self.follows = self.is_closed = False

    def put(self, data: bytes) -> None:
        self._lines.put_nowait(data)

    def send(self, data: bytes) -> None:
        if not self._host.is_cut:
            self._host.ordered(self, from_json(data, Order))

    async def receive(self) -> bytes:
        data = await self._lines.get()
        if not data:
            raise EOFError
        return data

    async def close(self) -> Closed:
        self.is_closed = True
        if self._host.is_cut:
            await asyncio.sleep(self._host.closes_s)
        return Closed(exit_code=self._host.exit_code, text=self._host.stderr)


@dataclasses.dataclass(kw_only=True)
class FakeTransport:
    """One host.

    Attributes:
        active_s: from start to active, or what it `reaches`; None for never.
        fails_s: until its supervisor fails.
        ends_s: from the order to the end; None for never.
        way_s: of a line in each direction.
        ahead_s: its clock.
        cut_at: the order upon which the link is cut, as it comes.
        heals_s: how long after.
        closes_s: until a connection over a cut link is closed.
        junk: lines that its supervisor writes besides.
        stderr: of a connection that brings no agent; empty for one that does.
    """

    name: str
    world: World
    rank: int = 0
    version: str = VERSION
    active_s: float | None = 1.0
    reaches: str = "active"
    fails_s: float | None = None
    ends_s: float | None = 0.5
    way_s: float = 0.001
    ahead_s: float = 0.0
    cut_at: Do | None = None
    heals_s: float | None = 10.0
    closes_s: float = 0.0
    stderr: str = ""
    exit_code: int | None = 0
    refuses: str = ""
    supervisor: Supervisor | None = None
    is_cut: bool = False
    channel: FakeChannel | None = None
    starts: int = 0
    downs: int = 0
    junk: tuple[bytes, ...] = ()

    @property
    def destination(self) -> str:
        return f"op@{self.name}"

    async def open(self) -> FakeChannel:
        channel = FakeChannel(self)
        self.channel = channel
        if self.stderr:
            channel.put(b"")
        elif not self.is_cut:
            self.welcome()
        return channel

    def welcome(self) -> None:
        assert self.channel is not None
        self.channel.put(b"Welcome to " + self.name.encode())
        self.channel.put(to_json(Said(agent=Word.HELLO, version=self.version, protocol=PROTOCOL)))

    def explained(self, closed: Closed, noise: str) -> tuple[str, str]:
        return closed.text or "no answer in time", "try by hand"

    def say(self, data: bytes) -> None:
        channel = self.channel
        if channel is not None and channel.follows and not self.is_cut:
            asyncio.get_running_loop().call_later(self.way_s, channel.put, data)

    def cut(self) -> None:
        self.is_cut = True
        if self.heals_s is not None:
            asyncio.get_running_loop().call_later(self.heals_s, self.heal)

    def heal(self) -> None:
        """Have a connection that is being made come through, as TCP does."""
        self.is_cut = False
        if self.channel is not None and not self.channel.is_closed and not self.channel.follows:
            self.welcome()

    def ordered(self, channel: FakeChannel, order: Order) -> None:
        loop = asyncio.get_running_loop()
        if order.do is self.cut_at:
            self.cut_at = None
            loop.call_later(self.way_s, self.cut)
            # It is carried out, and its answer is lost.
            loop.call_later(2 * self.way_s, self._carry_out, channel, order)
        else:
            loop.call_later(self.way_s, self._carry_out, channel, order)

    def _carry_out(self, channel: FakeChannel, order: Order) -> None:
        said = self._answer(channel, order)
        if said is not None and not self.is_cut:
            asyncio.get_running_loop().call_later(self.way_s, channel.put, to_json(said))

    def _answer(self, channel: FakeChannel, order: Order) -> Said | None:
        if order.do is Do.PING:
            now_s = self.world.now_s + self.ahead_s
            self.world.is_set_s += self.world.sets_s
            self.world.sets_s = 0.0
            return Said(agent=Word.PONG, number=order.number, received_s=now_s, sent_s=now_s)
        if order.do is Do.END:
            if self.supervisor is not None:
                self.supervisor.terminate()
            return None
        if order.do is Do.STATUS:
            if self.refuses:
                return Said(agent=Word.REFUSED, message=self.refuses, hint="end it")
            if self.supervisor is None:
                return Said(agent=Word.ABSENT)
            return Said(agent=Word.STATUS, status={"phase": "active"})
        if order.do is Do.DOWN:
            self.downs += 1
            return Said(agent=Word.DONE, exit_code=0)
        if self.refuses:
            return Said(agent=Word.REFUSED, message=self.refuses, hint="end it")
        channel.follows = True
        if self.supervisor is not None and self.supervisor.exit_code is None:
            is_there = self.supervisor.is_active
            phase = "active" if is_there and self.reaches == "active" else "verifying"
            nodes = [{"reach": "connected" if is_there else "started"}]
            status = {"phase": phase, "verdict": "ok", "nodes": nodes}
            return Said(agent=Word.ATTACHED, pid=1, status=status)
        if order.do is Do.ATTACH:
            return Said(agent=Word.ABSENT)
        self.starts += 1
        self.supervisor = Supervisor(self)
        return Said(agent=Word.STARTED, pid=1)


class World:
    """All hosts of a test, and what the coordinator said.

    Attributes:
        ended: names of hosts in the order in which their supervisors ended.
        sets_s: by so much the coordinator's clock is set while its next ping is on its way.
    """

    def __init__(self) -> None:
        self.sets_s = self.is_set_s = 0.0
        self.hosts: dict[str, FakeTransport] = {}
        self.said: list[Record] = []
        self.ended: list[str] = []

    def host(self, name: str, **options: object) -> FakeTransport:
        self.hosts[name] = FakeTransport(name=name, world=self, **options)  # type: ignore[arg-type]
        return self.hosts[name]

    @property
    def now_s(self) -> float:
        return asyncio.get_running_loop().time()

    def coordinator(self, **options: Any) -> Coordinator:
        return Coordinator(
            "patrol",
            [
                Place(
                    Part(name=f"patrol@7.{name}", machine=name, manifest="m.yaml", files=()),
                    host,
                    host.rank,
                )
                for name, host in self.hosts.items()
            ],
            lambda _, record: self.said.append(record),
            version=VERSION,
            bring_up_s=30.0,
            again=("lifecycle up m.yaml --hosts", "lifecycle down m.yaml --hosts"),
            clock=lambda: self.now_s + self.is_set_s,
            **options,
        )

    async def run(
        self,
        *,
        at: tuple[float, Callable[[Coordinator], None]] | None = None,
        **options: Any,
    ) -> ExitCode:
        """Run a coordinator to its end; `at` is what happens so long after it began."""
        running = self.coordinator(**options)
        if at is not None:
            asyncio.get_running_loop().call_later(at[0], at[1], running)
        return await asyncio.wait_for(running.run(), 600)

    def states(self, host: str) -> list[str]:
        return [each["state"] for each in self.said if self._is(each, "host", host)]

    def of(self, kind: str, host: str = "") -> list[Record]:
        return [each for each in self.said if self._is(each, kind, host)]

    @staticmethod
    def _is(record: Record, kind: str, host: str) -> bool:
        return record.get("event") == kind and record["host"] == host


CUT_S = coordinator.CUT_S
