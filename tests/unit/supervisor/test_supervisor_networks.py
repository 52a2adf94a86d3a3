"""When a run programs networks, with a programmer that only notes what it is asked."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from msgspec.structs import replace

from lifecycle.errors import BringUpError, ExitCode
from lifecycle.plan.model import Plan
from lifecycle.programming.programmer import open_programmer
from lifecycle.programming.target import (
    ChangeKind,
    FlowChange,
    Program,
    ProgrammingError,
    TargetChanges,
    read_targets,
)
from lifecycle.run_directory import OWN_CHILD, RunDirectory, new_run_id, run_name
from lifecycle.supervisor.connections.networks import Networks, open_networks
from lifecycle.supervisor.control.protocol import down
from lifecycle.supervisor.processes.fork_server import reap_adopted
from lifecycle.supervisor.run.events import Emitter, Notice, VerdictChanged
from lifecycle.supervisor.run.options import UpOptions
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import FlowReport, Stage, Verdict
from tests.unit.programming.flow_samples import plan, report
from tests.unit.programming.samples import nef_settings, settings_file
from tests.unit.programming.servers import TOKEN, NefServer
from tests.unit.supervisor.fakes import verdict_of

_BOUND_S = 5.0
REAL_TIME = True


class FakePrograms:
    """A Programmer that notes what it is asked, and fails as often as told.

    Args:
        left_out: why its target can do nothing for these flows, if so.
    """

    def __init__(self, *left_out: str) -> None:
        self._left_out = left_out
        self.seen: list[tuple[str, ...]] = []
        self.fail = 0
        self.plans: list[Plan] = []
        self.asked = asyncio.Event()

    async def update(
        self, flows: Sequence[FlowReport], *, hold: bool, within_s: float | None
    ) -> tuple[TargetChanges, ...]:
        assert hold
        topics = tuple(each.topic for each in flows)
        if topics in self.seen:
            return ()
        if self.fail:
            self.fail -= 1
            self.asked.set()
            raise ProgrammingError(
                "cannot write nft table inet flowqos_s: 'nft -f -' needs CAP_NET_ADMIN in this "
                "network namespace",
                hint="run this command as root",
            )
        self.seen.append(topics)
        self.asked.set()  # last: who is woken looks at `seen`
        change = FlowChange(kind=ChangeKind.CREATE, key="k", what="w")
        changes = () if self._left_out else (change,)
        return (TargetChanges(target="fake", changes=changes, left_out=self._left_out),)

    async def renew(self, *, within_s: float | None) -> float | None:
        return None

    def replan(self, plan: Plan) -> None:
        self.plans.append(plan)


def verdict(*topics: str) -> Verdict:
    flows = tuple(report(each) for each in topics)
    return replace(verdict_of(Outcome.OK), flows=flows)


def heard(*topics: str) -> VerdictChanged:
    return VerdictChanged(stage=Stage.ACTIVE, verdict=verdict(*topics))


class Notices:
    """An emitter, and the notices that went through it."""

    def __init__(self) -> None:
        self.emit = Emitter()
        self.said: list[str] = []
        self.emit.listen(self._take)

    def _take(self, event: object) -> None:
        if isinstance(event, Notice):
            self.said.append(event.message)


async def test_a_flow_that_a_target_can_do_nothing_for_is_said_once(tmp_path: Path) -> None:
    notices = Notices()
    networks = Networks(
        "s", tmp_path, notices.emit, FakePrograms("/a: it never leaves its machine")
    )
    await networks.begin(verdict("/a"))
    await networks.begin(verdict("/a", "/b"))
    await asyncio.sleep(0)
    assert notices.said == ["fake: 0 unchanged\n  left out: /a: it never leaves its machine"]
    await networks.close(asyncio.Event())


async def test_flows_are_programmed_at_the_gate_followed_afterwards_and_removed_in_the_end(
    tmp_path: Path,
) -> None:
    notices, programs = Notices(), FakePrograms()
    networks = Networks("s", tmp_path, notices.emit, programs)
    notices.emit(heard("/before"))
    await networks.begin(verdict("/gate"))
    assert programs.seen == [("/gate",)]
    networks.replan(plan())
    assert programs.plans == [plan()]
    programs.asked.clear()
    notices.emit(heard("/later"))
    await programs.asked.wait()
    await networks.close(asyncio.Event())
    notices.emit(heard("/after"))
    await asyncio.sleep(0)
    assert programs.seen == [("/gate",), ("/later",)]
    assert notices.said[0] == "fake: 1 created, 0 unchanged\n  + k: w"


async def test_a_first_failure_ends_the_run_and_names_the_privilege(tmp_path: Path) -> None:
    programs = FakePrograms()
    programs.fail = 1
    networks = Networks("s", tmp_path, Emitter(), programs)
    with pytest.raises(BringUpError) as caught:
        await networks.begin(verdict("/gate"))
    await networks.close(asyncio.Event())
    assert caught.value.exit_code is ExitCode.BRING_UP_FAILED
    assert str(caught.value) == (
        "cannot program networks for 's': cannot write nft table inet flowqos_s: 'nft -f -' needs "
        "CAP_NET_ADMIN in this network namespace; run this command as root"
    )
    assert programs.seen == []


async def test_a_later_failure_is_a_notice_and_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lifecycle.supervisor.connections.networks._AGAIN_S", (0.001, 0.01))
    notices, programs = Notices(), FakePrograms()
    networks = Networks("s", tmp_path, notices.emit, programs)
    await networks.begin(verdict("/gate"))
    programs.fail = 1
    notices.emit(heard("/later"))
    programs.asked.clear()  # before each look: what is asked after it wakes us
    while programs.seen[-1:] != [("/later",)]:
        await programs.asked.wait()
        programs.asked.clear()
    await networks.close(asyncio.Event())
    said = [each.partition(":")[0] for each in notices.said]
    assert said[:2] == ["fake", "cannot write nft table inet flowqos_s"]


async def test_without_program_nothing_is_programmed(tmp_path: Path) -> None:
    notices = Notices()
    networks = Networks("s", tmp_path, notices.emit)
    await networks.begin(verdict("/gate"))
    notices.emit(heard("/later"))
    await networks.close(asyncio.Event())
    assert notices.said == []
    assert list(tmp_path.iterdir()) == []  # noqa: ASYNC240


class Applied:
    """A NEF subscription that somebody, or a supervisor, made for a run."""

    def __init__(self, directory: Path, server: NefServer) -> None:
        self.server = server
        settings = nef_settings(server.url, devices=["10.77.0.1"])
        given = {"config": settings_file(directory, nef=settings)}
        self.options = Program(read_targets(["nef"], given))
        self.root = directory / "lifecycle"
        self.environment = {"XDG_RUNTIME_DIR": str(directory)}

    def apply(self, *, owned: bool = False) -> Path:
        programmer = open_programmer(
            plan(), self.options, environment=self.environment, owned=owned
        )
        asyncio.run(programmer.update([report()]))
        return self.root / run_name(plan())


@pytest.fixture
def applied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Applied]:
    """A server that takes subscriptions, and a token for it."""
    monkeypatch.setenv("TEST_TOKEN", TOKEN)
    with NefServer() as server:
        yield Applied(tmp_path, server)


@pytest.mark.parametrize("may", [True, False])
def test_what_somebody_applied_by_hand_goes_with_the_system_or_stays_listed(
    applied: Applied, may: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    notices = Notices()
    directory = applied.apply()
    assert len(applied.server.subscriptions) == 1
    if not may:
        monkeypatch.delenv("TEST_TOKEN")

    async def close() -> None:
        await Networks("s", directory, notices.emit).close(asyncio.Event())

    asyncio.run(close())
    said = "1 deleted, 0 unchanged" if may else "TEST_TOKEN: it is empty or not set"
    assert said in notices.said[0]
    assert len(applied.server.subscriptions) == (not may)
    assert (directory / "programmed.json").exists() is not may


def test_down_of_a_dead_supervisors_run_removes_what_it_programmed(applied: Applied) -> None:
    directory = applied.apply(owned=True)
    assert down(directory, _BOUND_S) is ExitCode.OK
    assert applied.server.subscriptions == {}
    assert not (directory / "programmed.json").exists()


def test_before_it_programs_a_run_removes_what_dead_runs_left_even_its_own(
    applied: Applied,
) -> None:
    notices = Notices()
    path = applied.apply(owned=True)
    ledger = path / "programmed.json"
    ledger.write_text(ledger.read_text().replace(f'"pid":{os.getpid()}', '"pid":1'))
    directory = RunDirectory.acquire(path.parent, path.name, new_run_id())
    try:
        for options, left in ((UpOptions(), 1), (UpOptions(program=applied.options), 0)):
            open_networks(plan(), options, directory, notices.emit, environment=applied.environment)
            assert len(applied.server.subscriptions) == left
    finally:
        directory.release()
    assert notices.said[0].startswith("left by a killed supervisor: nef at ")


def test_a_program_that_somebody_waits_for_is_not_buried_as_an_orphan() -> None:
    with OWN_CHILD:
        child = subprocess.Popen([sys.executable, "-c", "raise SystemExit(3)"])
        os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
        reap_adopted(())
        assert child.wait(_BOUND_S) == 3
