"""What one line of the reducer does, where no longer story depends on it."""

from __future__ import annotations

import random

import pytest
from msgspec.structs import replace

from lifecycle.errors import ExitCode
from lifecycle.manifest.model import Restart, RunKind, Supervision
from lifecycle.supervisor.control.protocol import ControlRequest
from lifecycle.supervisor.core import effects, inputs
from lifecycle.supervisor.core.state import Level
from lifecycle.supervisor.run.events import (
    GateOpened,
    Notice,
    RestartScheduled,
    SystemReached,
    VerdictChanged,
)
from tests.builders import plan_of, planned_node
from tests.unit.supervisor.core.playbook import CHAIN, INTRUDER, Play, chain
from tests.unit.supervisor.core.world import measured


def test_a_bring_up_that_is_late_gives_what_is_started_again_its_whole_time_once_more() -> None:
    play = Play(chain(), ways={"camera configure": "hang"}, timeout_s=3.0)
    play.wait(3.5)
    assert len(play.heard(RestartScheduled)) == 1
    play.wait(2.0)  # it was started again after a second
    assert len(play.heard(RestartScheduled)) == 1
    play.wait(4.0)
    assert len(play.heard(RestartScheduled)) == 2


def test_what_was_measured_is_said_once_when_it_is_decided() -> None:
    plan = plan_of(planned_node("camera"), planned_node("viewer"))
    play = Play(plan)
    decides = measured("ok", random.Random(1))
    silent = replace(decides, topic="/other", bounds=())
    play.found = replace(play.found, measured=(decides, silent))
    play.give(inputs.Changed())
    play.events.clear()
    play.run.decided_s = None
    play.wait(20.0)
    assert [each.message for each in play.heard(Notice)] == [f"measured: {decides.describe()}"]
    (said,) = play.heard(VerdictChanged)
    assert said.verdict.measured == (decides, silent)


def test_a_gate_is_judged_by_a_look_that_began_when_all_were_at_it() -> None:
    """A look that began before saw a system that was not whole."""
    play = Play(CHAIN, ways={"camera connect": "hang", "look": "hang"})
    held = [each for each in play.held if isinstance(each, effects.Look)]
    play.finish("camera connect")
    for look in held:
        play.give(inputs.Verified(mark=look.mark, verdict=play.found))
    assert play.heard(GateOpened) == []


def test_a_node_that_failed_may_end_with_one_and_no_more_when_it_is_told_to_end() -> None:
    """Of a hosted node, a status above 1 says that it was not shut down in order."""
    for status, says in ((0, False), (1, False), (2, True)):
        play = Play(plan_of(planned_node("a")), ways={"signal a 0": "hang"})
        play.down()
        play.give(inputs.Exited(process="a", status=status, text="gone"))
        assert bool(play.run.deaths) == says, status


def test_what_is_started_again_later_than_a_bring_up_may_take_has_its_time_from_then() -> None:
    slow = Supervision(restart=Restart.ON_FAILURE, restart_sec=10.0)
    play = Play(chain(slow), ways={"camera configure": "hang"}, timeout_s=3.0)
    play.wait(12.0)
    assert (play.run.failures, len(play.heard(RestartScheduled))) == ([], 1)
    play.ways.clear()
    play.wait(2.0)
    assert [each.reached for each in play.heard(SystemReached)][-1] == "active"


def test_what_a_node_shows_is_a_change_of_the_system() -> None:
    play = Play(CHAIN)
    mark = play.run.mark
    play.ways["look"] = "hang"
    play.give(inputs.Saw(shown={"camera": frozenset({"publishes image"})}))
    assert play.run.mark > mark
    mark = play.run.mark
    play.give(inputs.Saw(shown={"camera": frozenset({"publishes image"})}))
    assert play.run.mark == mark


@pytest.mark.parametrize("times", [1, 2, 3])
def test_a_node_that_others_activate_is_deactivated_and_after_three_times_left(times: int) -> None:
    play = Play(plan_of(planned_node("arm", managed=True, kind=RunKind.COMMAND)))
    play.order(ControlRequest.PAUSE)
    assert play.levels == str(int(Level.CONNECTED))
    for _ in range(times):
        play.give(inputs.Saw(levels={"arm": Level.ACTIVE}))
    assert play.story.count("arm deactivate") == 1 + min(times, 3)


def test_a_paused_system_that_is_taken_through_its_gate_in_vain_is_paused_still() -> None:
    play = Play(CHAIN)
    play.order(ControlRequest.PAUSE)
    play.ways["viewer activate"] = "hang"
    play.order(ControlRequest.RESUME)
    play.see(INTRUDER)
    play.wait(5.0)
    play.finish("viewer activate")
    assert play.phase == "paused"
    assert [code for code, _ in play.answers.values()] == [ExitCode.OK, ExitCode.VIOLATED]
