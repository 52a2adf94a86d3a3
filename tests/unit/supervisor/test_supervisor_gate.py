"""The gate: who gets a permit, and what it takes to send an activate request."""

from __future__ import annotations

import asyncio
import gc
from collections.abc import Awaitable, Callable, Coroutine

import pytest

from lifecycle.errors import BringUpError, ExitCode
from lifecycle.node.host.control import Operation
from lifecycle.supervisor.gate.gate import Gate, Permit, VerificationError, behind_s
from lifecycle.supervisor.nodes.driver import ServiceDriver
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Verdict
from tests.builders import planned_node
from tests.unit.supervisor.fakes import verdict_of


class ForeignNode:
    """The lifecycle services of a managed node that others started; remembers the requests."""

    def __init__(self) -> None:
        self.state = "inactive"
        self.requests: list[str] = []

    async def get_state(self, node: str, *, timeout_s: float) -> str:
        return self.state

    async def get_available_transitions(self, node: str, *, timeout_s: float) -> tuple[str, ...]:
        return ("activate", "cleanup", "shutdown")

    async def change_state(
        self,
        node: str,
        transition: str,
        *,
        timeout_s: float,
        before: Callable[[], Awaitable[None]] | None = None,
    ) -> bool:
        if before is not None:
            await before()
        self.requests.append(transition)
        self.state = "active"
        return True


async def test_a_foreign_node_gets_no_activate_request_without_a_permit_that_holds() -> None:
    node, gate = ForeignNode(), Gate(strict=False)
    driver = ServiceDriver(node, planned_node("b"))  # type: ignore[arg-type]
    permit = gate.judge(verdict_of(Outcome.OK))
    gate.close()
    with pytest.raises(BringUpError, match="cannot activate '/b' without a permit"):
        await driver.perform(Operation.ACTIVATE)
    with pytest.raises(BringUpError, match="the gate was closed again before this request"):
        await driver.perform(Operation.ACTIVATE, permit)
    assert node.requests == []
    await driver.perform(Operation.ACTIVATE, gate.judge(verdict_of(Outcome.OK)))
    assert node.requests == ["activate"]


def test_a_violated_verdict_closes_it_with_exit_code_4_and_every_finding() -> None:
    verdict = verdict_of(Outcome.VIOLATED, "graph.missing-node", "graph.qos-differs")
    with pytest.raises(VerificationError) as caught:
        Gate(strict=False).judge(verdict)
    assert caught.value.exit_code is ExitCode.VIOLATED
    assert caught.value.verdict is verdict
    assert str(caught.value) == (
        "cannot activate: the verdict is violated\n"
        "  graph.missing-node: graph.missing-node on /camera\n"
        "  graph.qos-differs: graph.qos-differs on /camera"
    )


def test_unverifiable_passes_unless_the_policy_or_strict_says_that_it_blocks() -> None:
    lenient = verdict_of(Outcome.UNVERIFIABLE, "state.unverifiable")
    Gate(strict=False).judge(lenient).check()
    for gate, verdict in (
        (Gate(strict=True), lenient),
        (
            Gate(strict=False),
            verdict_of(Outcome.UNVERIFIABLE, "state.unverifiable", blocking=True),
        ),
    ):
        with pytest.raises(VerificationError) as caught:
            gate.judge(verdict)
        assert caught.value.exit_code is ExitCode.UNVERIFIABLE


def test_a_permit_dies_with_the_gate() -> None:
    gate = Gate(strict=False)
    permit = gate.judge(verdict_of(Outcome.OK))
    gate.close()
    assert gate.permit is None
    with pytest.raises(BringUpError) as caught:
        permit.check()
    assert str(caught.value) == "cannot activate: the gate was closed again before this request"


def test_a_newer_verdict_replaces_the_permit_of_an_older_one() -> None:
    gate = Gate(strict=False)
    old = gate.judge(verdict_of(Outcome.OK))
    with pytest.raises(VerificationError):
        gate.judge(verdict_of(Outcome.VIOLATED, "graph.missing-node"))
    with pytest.raises(BringUpError):
        old.check()


def test_a_violated_verdict_closes_the_gate_even_if_it_says_that_nothing_blocks() -> None:
    with pytest.raises(VerificationError):
        Gate(strict=False).judge(verdict_of(Outcome.VIOLATED, "graph.missing-node", blocking=False))


def test_no_permit_can_be_made_past_a_gate_that_would_refuse_it_or_has_given_one() -> None:
    opened = Gate(strict=False)
    opened.judge(verdict_of(Outcome.OK))
    for gate, verdict in (
        (Gate(strict=False), verdict_of(Outcome.VIOLATED, "graph.missing-node")),
        (Gate(strict=True), verdict_of(Outcome.UNVERIFIABLE, "state.unverifiable")),
        (opened, verdict_of(Outcome.OK)),
    ):
        with pytest.raises(BringUpError) as caught:
            Permit(gate, verdict)
        assert str(caught.value) == (
            "cannot make a permit without an open gate; ask Gate.judge for one"
        )


class Changing:
    """A system that changes: its verdict, and those for each time that it is judged again."""

    def __init__(self, verdict: Verdict, *later: Verdict) -> None:
        self.latest = verdict
        self.changed = False
        self.begun = asyncio.Event()
        self.asked: list[frozenset[str]] = []
        self.deadline: float | None = None
        self.error: Exception | None = None
        self.given_up = False
        self._later = list(later)

    def is_current(self, verdict: Verdict) -> bool:
        return verdict is self.latest and not self.changed

    async def again(self, ahead: frozenset[str], deadline: float | None) -> Verdict:
        self.asked.append(ahead)
        self.deadline = deadline
        self.begun.set()
        try:
            await asyncio.sleep(0.01)
        except asyncio.CancelledError:
            self.given_up = True
            raise
        if self.error is not None:
            raise self.error
        self.changed = False
        self.latest = self._later.pop(0)
        return self.latest

    def gate(self, *, strict: bool = False) -> Gate:
        return Gate(strict=strict, judging=self)


def unverifiable() -> Verdict:
    return verdict_of(Outcome.UNVERIFIABLE, "state.unverifiable")


def run_quietly(main: Callable[[], Coroutine[object, object, None]]) -> None:
    """Run a test in which no task ends with an error that nobody took in."""
    reported: list[dict[str, object]] = []

    async def watched() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _, each: reported.append(each))
        await main()
        await asyncio.sleep(0)
        gc.collect()
        assert reported == []

    asyncio.run(watched())


async def test_a_verdict_of_the_moment_is_not_judged_again() -> None:
    system = Changing(verdict_of(Outcome.OK))
    permit = system.gate().judge(system.latest)
    await permit.use("/camera")
    assert system.asked == []


async def test_a_verdict_that_is_no_longer_the_latest_is_judged_again() -> None:
    system = Changing(verdict_of(Outcome.OK), newer := verdict_of(Outcome.OK))
    permit = system.gate().judge(verdict_of(Outcome.OK))
    await permit.use("/camera")
    assert system.asked == [frozenset()]
    assert permit.verdict is newer


async def test_who_asks_after_a_change_waits_for_one_judgement_that_knows_who_was_let_by() -> None:
    newer = verdict_of(Outcome.OK)
    system = Changing(verdict_of(Outcome.OK), newer)
    permit = system.gate().judge(system.latest)
    await permit.use("/camera")
    system.changed = True
    await asyncio.gather(*(permit.use(f"/viewer_{index}") for index in range(20)))
    assert system.asked == [frozenset({"/camera"})]
    assert permit.verdict is newer


def test_a_change_that_is_not_allowed_closes_the_gate_for_all_that_were_not_sent() -> None:
    async def main() -> None:
        system = Changing(
            verdict_of(Outcome.OK), verdict_of(Outcome.VIOLATED, "graph.undeclared-publisher")
        )
        gate = system.gate()
        permit = gate.judge(system.latest)
        system.changed = True
        refused = await asyncio.gather(
            permit.use("/camera"), permit.use("/viewer"), return_exceptions=True
        )
        with pytest.raises(VerificationError) as later:
            await permit.use("/radar")
        for error in (*refused, later.value):
            assert isinstance(error, VerificationError)
            assert error.exit_code is ExitCode.VIOLATED
            assert error.again
            assert str(error) == (
                "cannot activate: the system changed before every node was activated, "
                "and its verdict now is violated\n"
                "  graph.undeclared-publisher: graph.undeclared-publisher on /camera"
            )
        assert gate.permit is None
        assert len(system.asked) == 1

    run_quietly(main)


@pytest.mark.parametrize("deadline", [None, 31.0])
async def test_a_change_is_judged_until_the_deadline_of_what_the_gate_was_opened_for(
    deadline: float | None,
) -> None:
    system = Changing(verdict_of(Outcome.OK), verdict_of(Outcome.OK))
    permit = system.gate().judge(system.latest, deadline=deadline)
    system.changed = True
    await permit.use("/camera")
    assert system.deadline == deadline


def test_who_waits_too_long_for_a_verdict_is_given_the_one_that_keeps_the_gate_closed() -> None:
    async def main() -> None:
        system = Changing(verdict_of(Outcome.OK), verdict_of(Outcome.OK))
        permit = system.gate().judge(system.latest)
        permit.expire()  # nobody waits
        system.latest, system.changed = verdict_of(Outcome.VIOLATED, "run.silent-node"), True
        permit.expire()
        waits = asyncio.ensure_future(permit.use("/camera"))
        await system.begun.wait()
        with pytest.raises(VerificationError, match=r"run\.silent-node") as caught:
            permit.expire()
        assert caught.value.again
        await waits
        permit.expire()  # it is judged

    run_quietly(main)


@pytest.mark.parametrize("strict", [True, False])
def test_what_became_unverifiable_closes_a_gate_again_that_would_not_have_opened(
    strict: bool,
) -> None:
    async def main() -> None:
        system = Changing(verdict_of(Outcome.OK), unverifiable())
        gate = system.gate(strict=strict)
        permit = gate.judge(system.latest)
        system.changed = True
        if not strict:
            await permit.use("/camera")
            assert gate.permit is permit
            return
        with pytest.raises(VerificationError) as caught:
            await permit.use("/camera")
        assert caught.value.exit_code is ExitCode.UNVERIFIABLE
        assert gate.permit is None

    run_quietly(main)


def test_a_gate_that_is_closed_while_it_is_judged_again_lets_nobody_through() -> None:
    async def main() -> None:
        system = Changing(verdict_of(Outcome.OK), verdict_of(Outcome.OK))
        gate = system.gate()
        permit = gate.judge(system.latest)
        system.changed = True
        waits = asyncio.ensure_future(permit.use("/camera"))
        await system.begun.wait()
        gate.close()
        with pytest.raises(BringUpError, match="the gate was closed again"):
            await waits
        with pytest.raises(BringUpError, match="the gate was closed again"):
            await permit.use("/camera")
        assert system.given_up

    run_quietly(main)


def test_a_judgement_that_fails_fails_whoever_waits_for_it_and_may_be_tried_again() -> None:
    async def main() -> None:
        system = Changing(verdict_of(Outcome.OK), verdict_of(Outcome.OK))
        permit = system.gate().judge(system.latest)
        system.changed = True
        system.error = RuntimeError("cannot look")
        with pytest.raises(RuntimeError, match="cannot look"):
            await permit.use("/camera")
        system.error = None
        await permit.use("/camera")

    run_quietly(main)


def test_a_gate_that_opens_in_the_last_moment_leaves_time_to_activate() -> None:
    async def left() -> tuple[float, float]:
        now = asyncio.get_running_loop().time()
        return behind_s(now - 0.1), behind_s(now + 20.0)

    late, early = asyncio.run(left())
    assert late == 2.0
    assert 19.0 < early <= 20.0
