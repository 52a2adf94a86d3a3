"""A host process and our end of its control socket."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import rclpy
from lifecycle_driver import Driver
from planning import planned

from lifecycle import codec
from lifecycle.manifest.model import DiscoveryRange, Run, RunKind
from lifecycle.node.host.control import Command, Event, HostSpec, Operation
from lifecycle.plan.model import PlannedNode

HERE = Path(__file__).parent


def hosted(name: str, class_: str, *endpoints: Any, **changes: Any) -> PlannedNode:
    run = Run(kind=RunKind.PYTHON, python=f"hosted:{class_}")
    return planned(name, *endpoints, **{"run": run, **changes})


class HostProcess:
    """A host and our end of its socket."""

    def __init__(
        self,
        domain_id: int,
        nodes: tuple[PlannedNode, ...],
        log: Path,
        **spec: Any,
    ) -> None:
        ours, theirs = socket.socketpair()
        ours.settimeout(30)
        self.log = log
        with log.open("w", encoding="utf-8") as written, theirs:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "lifecycle.node.host.host", str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                cwd=HERE,
                stdout=written,
                stderr=written,
            )
        self._control = ours
        self._reader = ours.makefile("rb")
        self._id = 0
        self.send(
            HostSpec(
                system="test",
                process="p",
                domain_id=domain_id,
                discovery_range=DiscoveryRange.LOCALHOST,
                nodes=nodes,
                **spec,
            )
        )

    def send(self, message: object) -> None:
        self._control.sendall(codec.to_json(message) + b"\n")

    def ask(self, node: str, operation: Operation, **fields: Any) -> int:
        self._id += 1
        self.send(Command(id=self._id, node=node, operation=operation, **fields))
        return self._id

    def read(self) -> Event:
        line = self._reader.readline()
        assert line, f"the host ended the channel; its log:\n{self.log.read_text()}"
        return codec.from_json(line, Event)

    def until(self, kind: str) -> tuple[Event, list[Event]]:
        """Return the next event of a kind and those before it."""
        before: list[Event] = []
        while (event := self.read()).kind != kind:
            before.append(event)
        return event, before

    def states(self, count: int) -> list[str]:
        """Return the next states that are told, whatever else is told in between."""
        return [self.until("state")[0].state for _ in range(count)]

    def do(self, node: str, operation: Operation, **fields: Any) -> Event:
        id_ = self.ask(node, operation, **fields)
        reply, _ = self.until("reply")
        assert reply.id == id_
        return reply

    def hang_up(self) -> None:
        self._control.shutdown(socket.SHUT_RDWR)

    def wait(self, timeout_s: float = 30.0) -> int:
        return self.process.wait(timeout_s)

    def close(self) -> None:
        """End the channel, which ends the host; one that is killed would leave shared memory."""
        self._reader.close()
        self._control.close()
        try:
            self.wait()
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


@contextlib.contextmanager
def driver_in(domain_id: int) -> Iterator[Driver]:
    """Yield a driver in another domain than the test session's."""
    context = rclpy.Context()
    context.init(args=[], domain_id=domain_id)
    driver = Driver(context)
    try:
        yield driver
    finally:
        driver.close()
        context.try_shutdown()
        context.destroy()
