"""A story as a script: an input, and what the reducer wants done then, in words.

`Play` answers each effect at once and well, unless `ways` says otherwise, and keeps what was asked:
`spawn camera`, `camera configure`, `look`, `program`, `signal camera 15`, `sweep camera`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from lifecycle.errors import ExitCode
from lifecycle.manifest.model import Condition, Restart, Supervision
from lifecycle.plan.model import Plan
from lifecycle.supervisor.control.protocol import ControlRequest
from lifecycle.supervisor.core import messages
from lifecycle.supervisor.core.advance import advance, phase_of
from lifecycle.supervisor.core.failure import exit_code_of
from lifecycle.supervisor.core.reduce import take
from lifecycle.supervisor.core.state import REACHES, Level, Order, Step, new_run
from lifecycle.supervisor.run.events import Event, Failure
from lifecycle.supervisor.run.options import UpOptions
from lifecycle.verify.verdict import Verdict
from tests.builders import plan_of, planned_node
from tests.unit.supervisor.core.world import verdict

E = TypeVar("E", bound=Event)

AGAIN = Supervision(restart=Restart.ON_FAILURE, restart_sec=1.0)
INTRUDER = ("graph.undeclared-node", "/intruder")
GONE = ("graph.missing-node", "/camera")


def chain(camera: Supervision = AGAIN, viewer: Supervision = AGAIN) -> Plan:
    """Return a system in which `viewer` waits for `camera` to be active."""
    return plan_of(
        planned_node("camera", supervision=camera),
        planned_node("viewer", supervision=viewer, after={"camera": Condition.ACTIVE}),
    )


CHAIN = chain(Supervision(), Supervision())
"""The same, in which nobody is started again."""


class Play:
    """One run; `ways`: what is asked → an error, "hang", "die" or "changed", for as long as so.

    Attributes:
        asked: since `said` was last called.
        story: all that was asked.
        events: all that was said.
        answers: to orders, by their number.
        found: the verdict of each look.
    """

    def __init__(self, plan: Plan, ways: Mapping[str, str] = {}, **options: Any) -> None:
        self.run = new_run(plan, UpOptions(**{"timeout_s": 30.0, **options}))
        self.ways = dict(ways)
        self.asked: list[str] = []
        self.story: list[str] = []
        self.events: list[Any] = []
        self.answers: dict[int, tuple[ExitCode, str]] = {}
        self.found: Verdict = verdict()
        self.wake_s = float("inf")
        self.now_s = 0.0
        self.held: list[Any] = []
        self.give(messages.Tick())

    def give(self, given: Any) -> list[str]:
        """Have something happen; return what is asked until all is quiet."""
        todo = self._step(given)
        while todo:
            answer = self._answer(todo.pop(0))
            if answer is not None:
                todo += self._step(answer)
        return self.said()

    def finish(self, what: str, error: str = "") -> list[str]:
        """Have something be answered that hangs; return what is asked then."""
        held = next(each for each in self.held if _words(each) == what)
        self.held.remove(held)
        self.ways[what] = error
        answer = self._answer(held)
        del self.ways[what]
        return self.give(answer)

    def said(self) -> list[str]:
        """Return what was asked, looks left out, and forget it."""
        asked, self.asked = self.asked, []
        return [each for each in asked if each != "look"]

    def wait(self, seconds: float) -> list[str]:
        """Let time pass, with a tick whenever one was asked for."""
        until_s = self.now_s + seconds
        found: list[str] = []
        while self.wake_s <= until_s:
            self.now_s = self.wake_s
            found += self.give(messages.Tick())
        self.now_s = until_s
        return [*found, *self.give(messages.Tick())]

    def order(self, ask: ControlRequest, **what: Any) -> list[str]:
        """Order something; its number is that of the orders before it."""
        number = len(self.answers) + len(self.run.orders) + (self.run.order is not None)
        return self.give(messages.Ordered(order=Order(**{"id": number, "ask": ask, **what})))

    def down(self) -> list[str]:
        return self.stop("lifecycle down", ExitCode.BRING_UP_FAILED)

    def stop(self, reason: str, code: ExitCode) -> list[str]:
        return self.give(messages.Stop(reason=reason, code=code))

    def die(self, process: str, status: int | None = None) -> list[str]:
        number = 11 if status is None else 0
        return self.give(
            messages.Exited(process=process, status=status, signal=number, text="gone")
        )

    def see(self, *found: tuple[str, str]) -> list[str]:
        """Have the next looks find this."""
        self.found = verdict(*found)
        return self.give(messages.Changed())

    def heard(self, kind: type[E]) -> list[E]:
        """Events of one kind."""
        return [each for each in self.events if isinstance(each, kind)]

    @property
    def failures(self) -> list[tuple[str, str]]:
        """The node, and what is said, of each failure."""
        return [(each.subject, each.message) for each in self.heard(Failure)]

    @property
    def reason(self) -> str:
        """Why the run ends."""
        assert self.run.ending is not None
        return self.run.ending.reason

    @property
    def phase(self) -> str:
        return phase_of(self.run)

    @property
    def code(self) -> int:
        """The exit code of the run, which is over."""
        assert self.run.is_over
        return int(exit_code_of(self.run))

    @property
    def levels(self) -> str:
        """How far all nodes are, `4 3`."""
        return " ".join(str(int(each.level)) for each in self.run.nodes.values())

    def _step(self, given: Any) -> list[Any]:
        self.events += take(self.run, self.now_s, given)
        self.wake_s = float("inf")
        todo = []
        for each in advance(self.run):
            if isinstance(each, messages.Wake):
                self.wake_s = each.at_s
            elif isinstance(each, messages.Answer):
                self.answers[each.order] = (each.code, each.error)
            else:
                self.asked.append(_words(each))
                self.story.append(_words(each))
                todo.append(each)
        return todo

    def _answer(self, effect: Any) -> Any:
        way = self.ways.get(_words(effect), "")
        if way == "hang":
            self.held.append(effect)
            return None
        if isinstance(effect, messages.Ask):
            node = self.run.nodes.get(effect.node)
            if node is None:  # it went while it was asked
                return messages.Changed()
            if way == "die":
                return messages.Exited(process=node.process, signal=11, text="gone")
            level = node.level if way else REACHES[effect.step]
            if not node.planned.managed and effect.step is Step.DEACTIVATE:
                level = Level.STARTED
            changed, error = way == "changed", "" if way == "changed" else way
            return messages.Replied(
                node=effect.node, number=effect.number, level=level, error=error, changed=changed
            )
        if isinstance(effect, messages.Signal):
            number = effect.number
            return messages.Exited(
                process=effect.process,
                status=None if number else 0,
                signal=number,
                text="gone",
                clean=number != 9,
            )
        return {
            messages.Spawn: lambda: messages.Spawned(process=effect.process, pid=1, error=way),
            messages.Sweep: lambda: messages.Swept(process=effect.process),
            messages.Look: lambda: messages.Verified(mark=effect.mark, verdict=self.found),
            messages.Program: lambda: messages.Programmed(number=effect.number, error=way),
            messages.Give: lambda: messages.Given(node=effect.node, error=way),
        }[type(effect)]()


def _words(effect: Any) -> str:
    name = type(effect).__name__.lower()
    if isinstance(effect, messages.Ask):
        return f"{effect.node} {effect.step.value}"
    if isinstance(effect, messages.Signal):
        return f"signal {effect.process} {effect.number}"
    if isinstance(effect, messages.Spawn | messages.Sweep):
        return f"{name} {effect.process}"
    if isinstance(effect, messages.Give):
        return f"give {effect.node}{'' if effect.values is None else f' {effect.values.now}'}"
    return name
