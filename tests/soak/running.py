"""One run of the soak's system, looked at from outside: events, control socket, graph, /proc.

Owns: `Watched`, a `lifecycle up` whose events have times; `Transitions`, what the nodes themselves
publish of their states; and `assert_gate_held`, the promise of the gate read from both.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from lifecycle_msgs.msg import TransitionEvent
from rclpy.executors import SingleThreadedExecutor

from lifecycle.middleware.rcl.graph import GraphObserver
from lifecycle.plan.model import ParticipantConnections
from lifecycle.supervisor.control.protocol import (
    ControlRequest,
    Question,
    SystemStatus,
    ask,
)
from tests.ros.supervisor.running import BOUND_S, Event, Up
from tests.shared_memory import owned_by
from tests.soak.system import COMPOSITION, NAME

ACTIVE = "active"


class NotAsPromisedError(AssertionError):
    """Something that was promised did not hold."""


class Watched(Up):
    """A `lifecycle up` whose events can be waited for together with their times."""

    def __init__(self, manifest: Path, *, runtime: Path) -> None:
        self.times: list[float] = []
        self._came = threading.Condition()
        super().__init__(manifest, runtime=runtime, variables={"PYTHONPATH": str(COMPOSITION)})

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            now = time.monotonic()
            event = json.loads(line)
            with self._came:
                self.times.append(now)
                self.events.append(event)
                self._came.notify_all()
        self._lines.put("")
        with self._came:
            self._came.notify_all()

    def wait(
        self,
        wanted: Callable[[Event], object],
        *,
        since: int,
        within_s: float,
        what: str,
    ) -> tuple[int, float]:
        """Return number and time of the first event that is wanted, after the first `since`."""
        deadline = time.monotonic() + within_s
        looked = since
        with self._came:
            while True:
                while looked < len(self.events):
                    if wanted(self.events[looked]):
                        return looked, self.times[looked]
                    looked += 1
                left_s = deadline - time.monotonic()
                if left_s <= 0:
                    raise NotAsPromisedError(f"no {what} within {within_s:g} s")
                self._came.wait(left_s)

    def close_streams(self) -> None:
        """Let go of a supervisor that ended."""
        for each in self._readers:
            each.join(BOUND_S)
        for stream in (self.process.stdout, self.process.stderr):
            assert stream is not None
            stream.close()

    def status(self) -> SystemStatus | None:
        """Ask over the control socket; None if nobody answers."""
        for path in (self.runtime / "lifecycle").glob(f"{NAME}@*/control"):
            with contextlib.suppress(OSError):
                answer = ask(path, Question(ask=ControlRequest.STATUS), BOUND_S)
                if answer is not None:
                    return answer.status
        return None


class Transitions:
    """What nodes publish of their states (`~/transition_event`), received by our own participant.

    It has no shared memory: Fast DDS lets go of another's port only when it next sends over shared
    memory, and what we hold open, a system that ends cannot remove.

    Attributes:
        seen: time, node and state of each change, in the order in which they came.
    """

    def __init__(self, domain_id: int, nodes: Iterable[str]) -> None:
        self.seen: list[tuple[float, str, str]] = []
        connections = ParticipantConnections(urls=("udpv4://127.0.0.1",))
        self._observer = GraphObserver(domain_id, connections)
        if owned_by((os.getpid(),)):
            raise AssertionError("the observer shares memory with what it judges")
        node = self._observer.node
        self._subscriptions = {
            name: node.create_subscription(
                TransitionEvent,
                f"{name}/transition_event",
                functools.partial(self._take, name),
                10,
            )
            for name in nodes
        }
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._thread = threading.Thread(target=self._executor.spin, name="transitions")
        self._thread.start()

    def _take(self, name: str, event: TransitionEvent) -> None:
        self.seen.append((time.monotonic(), name, event.goal_state.label))

    def not_received(self) -> list[str]:
        """Return the nodes of which nothing is received: they are not discovered, or not there."""
        subscriptions = self._subscriptions.items()
        return [name for name, each in subscriptions if not each.get_publisher_count()]

    def activated(self, since: float, until: float) -> list[tuple[float, str]]:
        """Return when which nodes became active between two times."""
        return [
            (at, node)
            for at, node, state in tuple(self.seen)
            if state == ACTIVE and since <= at <= until
        ]

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._thread.join()
        self._observer.destroy()


def assert_gate_held(events: Sequence[Event]) -> None:
    """Assert that the gate opened, and each activate request was sent, on a verdict that allows it.

    What changes behind an open gate is judged before each further request: a verdict that closes
    it may be followed by one that opens it again.

    Raises:
        NotAsPromisedError: one did not.
    """
    verdict: Event | None = None
    let_through: set[str] = set()
    for event in events:
        kind = event.get("event")
        if kind == "verdict":
            verdict = event["verdict"]
            continue
        requested = kind == "request" and event["operation"] == "activate"
        if kind != "gate" and not requested:
            continue
        if verdict is None or verdict["blocking"] or verdict["verdict"] == "violated":
            raise NotAsPromisedError(f"{event} came on {_short(verdict)}")
        if kind == "gate":
            let_through = set(event["nodes"])
        elif event["node"] not in let_through:
            raise NotAsPromisedError(f"{event} came without a gate that opened for it")


def assert_activated_on_request(
    run: Watched, transitions: Transitions, began: float, until: float, names: Iterable[str]
) -> None:
    """Assert that no node became active, by its own report, without a request of the supervisor.

    Raises:
        NotAsPromisedError: one did.
    """
    asked: dict[str, int] = {}
    for at, event in zip(tuple(run.times), tuple(run.events), strict=False):
        if event.get("event") == "request" and event["operation"] == "activate" and at <= until:
            asked[event["node"]] = asked.get(event["node"], 0) + 1
    became: dict[str, int] = {}
    for _, node in transitions.activated(began, until - 0.5):
        became[node] = became.get(node, 0) + 1
    for name in names:
        if became.get(name, 0) > asked.get(name, 0):
            raise NotAsPromisedError(
                f"{name} became active {became[name]} times, and was asked to "
                f"{asked.get(name, 0)} times"
            )


def _short(verdict: Any) -> str:
    if verdict is None:
        return "no verdict"
    found = [f"{each['rule']} of {each['subject']}" for each in verdict["findings"]]
    return f"verdict {verdict['verdict']}, blocking {verdict['blocking']}: {found}"
