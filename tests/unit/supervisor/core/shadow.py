"""The reducer in the shadow of a session: the same inputs, and every difference of what is decided.

`Shadow` listens to a `SessionWorld`: what its events and its judge show becomes an input, and what
the reducer wants is only noted. Compared are activate requests, starts of processes and the exit
code, each by name and how often; not when. A step that the session has done already is answered at
once, and a process that the session ends counts as asked to end: so its limits, and which node is
not discovered, are the session's. Run by test_shadow.py; by hand: `python -m pytest -p no:xdist -p
tests.unit.supervisor.core.shadow_stories FILES`.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import Any

from lifecycle.errors import ExitCode
from lifecycle.supervisor.control.protocol import ControlRequest, ProcessState, Reach
from lifecycle.supervisor.core import effects, inputs
from lifecycle.supervisor.core.advance import SIGINT, SIGKILL, SIGTERM, advance
from lifecycle.supervisor.core.failure import exit_code_of
from lifecycle.supervisor.core.reduce import take
from lifecycle.supervisor.core.state import UP, Level, Options, Order, Step, new_run
from lifecycle.supervisor.run.events import Event, Failure, NodeChanged, ProcessChanged, RequestSent
from lifecycle.supervisor.run.options import Until, UpOptions

SIGNALS = (SIGINT, SIGTERM, SIGKILL)
_STATES = {"active": Level.ACTIVE, "finalized": Level.DOWN}


class Shadow:
    """Follows one session from its begin to its end.

    Args:
        session: not yet run.
        world: of it; `options` are what it was made with.
    """

    def __init__(self, session: Any, world: Any, options: UpOptions) -> None:
        self._session, self._system = session, world.system
        self._loop = asyncio.get_running_loop()
        self._began_s = self._loop.time()
        system = world.system
        timeout_s = options.bring_up_s(len(system.processes))
        until = {Until.ACTIVE: Level.ACTIVE}.get(options.until, Level.CONNECTED)
        bound = options.until is not Until.ACTIVE and options.stop_after_s is None
        self.run = new_run(
            system.plan,
            Options(
                until=until,
                verifies=options.until is Until.VERIFIED,
                hold_s=0.0 if bound else options.stop_after_s,
                timeout_s=timeout_s,
                gate_s=options.gate_s(timeout_s),
                strict=options.strict,
                keep_going=options.keep_going,
            ),
        )
        self.wants: Counter[str] = Counter()
        self.does: Counter[str] = Counter()
        self._orders = 0
        self._graph = world.graph
        self._stopping: set[str] = set()
        self._levels: dict[str, Level] = {}
        self._looked = self.run.mark
        self._look: effects.Look | None = None
        self._wake: asyncio.TimerHandle | None = None
        self._follow(world)
        self.give(inputs.Tick())

    def _follow(self, world: Any) -> None:
        """Have everything that the session learns be learnt here, too."""
        session = self._session
        world._emit.listen(self._on_event)
        judge, note = session._judge, world.graph.note
        look, stands, stop = judge._look, judge._stands, session.stop
        begin, ordered = world.networks.begin, session._holding.ordered

        async def look_too(stage: Any) -> Any:
            self._looked = self.run.mark
            return await look(stage)

        def stands_too(stage: Any, verdict: Any) -> None:
            stands(stage, verdict)
            self.give(inputs.Verified(mark=self._looked, verdict=verdict))

        def note_too() -> None:
            note()
            self.give(inputs.Changed())

        def stop_too(reason: str, code: ExitCode) -> None:
            stop(reason, code)
            hurries = code is ExitCode.INTERRUPTED
            self.give(inputs.Stop(reason=reason, code=int(code), hurries=hurries))

        async def begin_too(*args: Any) -> None:
            try:
                await begin(*args)
            except Exception as error:
                self.give(inputs.Programmed(error=str(error)))
                raise
            self.give(inputs.Programmed())

        async def ordered_too(order: Any) -> Any:
            number, self._orders = self._orders, self._orders + 1
            taken = order.ask is not ControlRequest.APPLY or not order.dry_run
            if taken:
                mine = Order(
                    id=number,
                    ask=order.ask,
                    node=order.node,
                    mode=order.mode,
                    plan=order.plan if order.ask is ControlRequest.APPLY else None,
                    timeout_s=order.timeout_s,
                )
                self.give(inputs.Ordered(order=mine))
            answer = await ordered(order)
            if taken:
                self.does[f"answer {order.ask.value} {answer.exit_code}"] += 1
            return answer

        judge._look, judge._stands, session.stop = look_too, stands_too, stop_too
        world.graph.note = world.graph._hosts.changed = note_too
        session._holding._stop = stop_too
        session._holding.ordered = session._ros_interface._order = ordered_too
        world.networks.begin = begin_too

    def give(self, given: Any) -> None:
        """Take an input, and note what is wanted."""
        now_s = self._loop.time() - self._began_s
        take(self.run, now_s, given)
        again: list[Any] = []
        at_s = float("inf")
        for each in advance(self.run):
            if isinstance(each, effects.Wake):
                at_s = each.at_s
            elif isinstance(each, effects.Spawn):
                self.wants[f"spawn {each.process}"] += 1
            elif isinstance(each, effects.Answer):
                self.wants[f"answer {self._asked(each.order)} {int(each.code)}"] += 1
            elif isinstance(each, effects.Ask):
                if each.step is Step.ACTIVATE:
                    self.wants[f"activate {self.run.nodes[each.node].name}"] += 1
                self._loop.call_soon(self._reply, each.node)
            elif isinstance(each, effects.Sweep):
                again.append(inputs.Swept(process=each.process))
            elif isinstance(each, effects.Look):
                self._look = each
            elif isinstance(each, effects.Prepare):
                again.append(inputs.Ready(error=self._session._fork_server.cannot_start))
            elif isinstance(each, effects.Give):
                again.append(inputs.Given(node=each.node, error=self._refused(each.node)))
        if self._wake is not None:
            self._wake.cancel()
        if at_s < float("inf"):
            self._wake = self._loop.call_at(self._began_s + at_s, lambda: self.give(inputs.Tick()))
        for each in again:
            self._loop.call_soon(self.give, each)
        if self._look is not None:
            self._loop.call_soon(self._answer_look)

    def _answer_look(self) -> None:
        """Answer a look with the session's verdict, where nothing changed for the session since."""
        judge, asked = self._session._judge, self._look
        if (
            asked is not None
            and self.run.judged.mark < asked.mark
            and judge.is_current(judge.latest)
        ):
            self._look = None
            self.give(inputs.Verified(mark=asked.mark, verdict=judge.latest))

    def _refused(self, key: str) -> str:
        """Return why a node does not take its parameters; empty if it does."""
        node = self.run.nodes[key]
        given = [f"{each.name}={each.value}" for each in node.planned.expected_parameters]
        refuses = self._graph.refuses
        live = self._graph.refuses_live.get(node.name, "")
        return live or (f"cannot set {refuses!r}" if refuses in given else "")

    def _asked(self, _: int) -> str:
        return "" if self.run.order is None else self.run.order.ask.value

    def _on_event(self, event: Event) -> None:
        if isinstance(event, ProcessChanged):
            self._on_process(event)
        elif isinstance(event, RequestSent):
            if event.operation.value == "activate":
                self.does[f"activate {event.node}"] += 1
        elif isinstance(event, NodeChanged):
            self._on_node(event)
        elif isinstance(event, Failure):
            node = self.run.node_named(event.subject)
            failed = event.rule in ("run.transition-failed", "run.start-failed", "run.not-wired")
            if node is not None and node.request is not None and failed:
                number = node.request.number
                self.give(
                    inputs.Replied(
                        node=node.key, number=number, level=node.level, error=event.message
                    )
                )

    def _on_process(self, event: ProcessChanged) -> None:
        if event.state is ProcessState.STARTING:
            self.does[f"spawn {event.process}"] += 1
            self._loop.call_soon(self.give, inputs.Spawned(process=event.process, pid=1))
        elif event.state is ProcessState.STOPPING:
            self._stopping.add(event.process)
        elif event.state is ProcessState.EXITED:
            for node in self.run.nodes_of(event.process):
                self._levels.pop(node.key, None)
            process = self.run.processes.get(event.process)
            if process is not None and event.process in self._stopping:
                self._stopping.discard(event.process)
                process.asked = max(process.asked, 0)
                process.sent = [*process.sent, *SIGNALS]
            end = self._system.processes[event.process].ended.result()
            self.give(
                inputs.Exited(
                    process=event.process,
                    status=end.status,
                    signal=end.signal or 0,
                    text=str(end),
                    clean=end.is_clean,
                    crash=end.is_crash,
                )
            )

    def _on_node(self, event: NodeChanged) -> None:
        node = self.run.node_named(event.node)
        if node is None or event.reach in (Reach.WAITING, Reach.STOPPED):
            return
        level = _STATES.get(event.state, Level.STARTED)
        if event.state == "inactive":
            level = Level.CONNECTED if event.connected else Level.CONFIGURED
        self._levels[node.key] = level
        if not self._reply(node.key):
            self.give(inputs.Saw(levels={node.key: level}))

    def _reply(self, key: str) -> bool:
        """Answer what the reducer asks of a node, if the session has brought it there."""
        node = self.run.nodes.get(key)
        request, level = None if node is None else node.request, self._levels.get(key)
        if node is None or request is None or level is None:
            return False
        goal = node.after(request.step)
        is_up = request.step in UP.values()
        if level < goal if is_up else level > goal:
            return False
        begun = level if request.step is Step.START and not node.process else goal
        self.give(inputs.Replied(node=key, number=request.number, level=begun))
        return True

    def differences(self, exit_code: int) -> list[str]:
        """Return what one did and the other did not, and another exit code."""
        if self._wake is not None:
            self._wake.cancel()
        asked = {key: n for key, n in self.wants.items() if not key.startswith("answer")}
        done = {key: n for key, n in self.does.items() if not key.startswith("answer")}
        found = [
            f"{key}: session {done.get(key, 0)}, reducer {asked.get(key, 0)}"
            for key in sorted(asked.keys() | done.keys())
            if asked.get(key, 0) != done.get(key, 0)
        ]
        if self.run.ending is None:
            return [*found, f"end: session {exit_code}, reducer goes on"]
        code = int(exit_code_of(self.run))
        why = f"exit code: session {exit_code}, reducer {code}; {self.run.ending.reason}"
        return found if code == exit_code else [*found, why]
