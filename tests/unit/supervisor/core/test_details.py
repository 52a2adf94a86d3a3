"""What one line of the reducer does, where no longer story depends on it."""

from __future__ import annotations

import random
from typing import Any

import pytest
from msgspec.structs import replace

from lifecycle.errors import ExitCode
from lifecycle.manifest.model import (
    Authority,
    EndpointKind,
    OnFailure,
    Quantity,
    Restart,
    RunKind,
    Supervision,
)
from lifecycle.supervisor.control.protocol import ControlRequest
from lifecycle.supervisor.core import messages
from lifecycle.supervisor.core.failure import ALSO_S
from lifecycle.supervisor.core.state import Level
from lifecycle.supervisor.run.events import (
    GateOpened,
    Notice,
    RestartScheduled,
    SystemReached,
    VerdictChanged,
)
from tests.builders import HERE, plan_of, planned_endpoint, planned_node
from tests.unit.supervisor.core.playbook import AGAIN, CHAIN, INTRUDER, Play, chain
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
    play.give(messages.Changed())
    play.events.clear()
    play.run.decided_s = None
    play.wait(20.0)
    assert [each.message for each in play.heard(Notice)] == [f"measured: {decides.describe()}"]
    (said,) = play.heard(VerdictChanged)
    assert said.verdict.measured == (decides, silent)


@pytest.mark.parametrize("paused_s", [1.0, 11.0])
def test_data_are_measured_anew_after_a_pause_however_long_it_was(paused_s: float) -> None:
    play = measuring_play(stop_after_s=2.0)
    play.order(ControlRequest.PAUSE)
    play.wait(paused_s)
    play.order(ControlRequest.RESUME)
    play.wait(9.0)
    assert play.phase == "measuring"
    play.wait(2.5)
    assert play.phase == "active"
    play.wait(2.0)
    assert play.code == 0


def test_a_run_that_ends_paused_before_its_data_were_measured_is_no_success() -> None:
    play = measuring_play(stop_after_s=2.0)
    play.order(ControlRequest.PAUSE)
    play.wait(11.0)
    assert play.phase == "paused"
    play.wait(2.0)
    assert (play.code, play.reason) == (5, "done, but its data were not measured")


def measuring_play(**options: Any) -> Play:
    """A system that is up, and whose one declared number needs longer than it has."""
    rate = (Quantity(name="rate_hz", value=9, at=HERE),)
    image = planned_endpoint(EndpointKind.PUBLISHER, "image", quantities=rate)
    camera = replace(planned_node("camera"), endpoints=(image,))
    play = Play(plan_of(camera), ways={"look": "hang"}, **options)
    decided = measured("ok", random.Random(1))
    undecided = replace(decided.bounds[0], outcome="measuring", decides_in_s=0.5)
    play.found = replace(play.found, measured=(replace(decided, bounds=(undecided,)),))
    play.ways.clear()
    play.finish("look")
    assert play.phase == "measuring"
    return play


def test_a_gate_is_judged_by_a_look_that_began_when_all_were_at_it() -> None:
    """A look that began before saw a system that was not whole."""
    play = Play(CHAIN, ways={"camera connect": "hang", "look": "hang"})
    held = [each for each in play.held if isinstance(each, messages.Look)]
    play.finish("camera connect")
    for look in held:
        play.give(messages.Verified(mark=look.mark, verdict=play.found))
    assert play.heard(GateOpened) == []


def test_a_node_that_failed_may_end_with_one_and_no_more_when_it_is_told_to_end() -> None:
    """Of a hosted node, a status above 1 says that it was not shut down in order."""
    for status, says in ((0, False), (1, False), (2, True)):
        play = Play(plan_of(planned_node("a")), ways={"signal a 0": "hang"})
        play.down()
        play.give(messages.Exited(process="a", status=status, text="gone"))
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
    play.give(messages.Saw(shown={"camera": frozenset({"publishes image"})}))
    assert play.run.mark > mark
    mark = play.run.mark
    play.give(messages.Saw(shown={"camera": frozenset({"publishes image"})}))
    assert play.run.mark == mark


def test_a_paused_system_that_is_taken_through_its_gate_in_vain_is_paused_still() -> None:
    play = Play(CHAIN)
    play.order(ControlRequest.PAUSE)
    play.ways |= {"viewer activate": "hang", "camera deactivate": "hang"}
    play.order(ControlRequest.RESUME)
    play.see(INTRUDER)
    play.wait(5.0)
    play.finish("viewer activate")
    play.wait(1.0)  # camera is active still, and nobody but us had it activated
    assert play.run.judged.verdict is not None
    assert {each.rule for each in play.run.judged.verdict.findings} == {INTRUDER[0]}
    play.finish("camera deactivate")
    assert play.phase == "paused"
    assert [code for code, _ in play.answers.values()] == [ExitCode.OK, ExitCode.VIOLATED]


def test_what_comes_back_to_a_gate_that_is_closed_is_judged_from_then() -> None:
    play = Play(chain())
    play.see(INTRUDER)
    play.wait(5.0)
    play.die("viewer")
    play.wait(1.1)  # it is started again after a second
    closed = "cannot activate"
    assert [each for each in play.heard(Notice) if each.message.startswith(closed)] == []
    play.wait(1.0)
    assert len([each for each in play.heard(Notice) if each.message.startswith(closed)]) == 1


def test_who_is_at_the_gate_while_the_run_fails_is_not_let_through() -> None:
    play = Play(plan_of(planned_node("a"), planned_node("b")), ways={"look": "hang"})
    play.die("a")
    play.held.pop()
    play.give(messages.Verified(mark=play.run.mark, verdict=play.found))
    play.wait(ALSO_S)
    assert play.run.ending is not None
    assert "b activate" not in play.story
    assert play.heard(GateOpened) == []


def test_a_plain_process_that_is_started_again_opens_no_gate_for_anybody() -> None:
    plain = planned_node("log", kind=RunKind.COMMAND, managed=False, supervision=AGAIN)
    play = Play(plan_of(planned_node("camera"), plain))
    play.die("log", 1)
    play.wait(2.0)
    assert len(play.heard(RestartScheduled)) == 1
    assert [each.nodes for each in play.heard(GateOpened)] == [("/camera",)]


def test_a_component_is_loaded_once_its_container_is_there() -> None:
    part = planned_node("part", kind=RunKind.COMMAND, process="")
    run = replace(part.run, component="parts/Part", container="host")
    host = planned_node("host", kind=RunKind.COMMAND, managed=False)
    play = Play(plan_of(host, replace(part, run=run)), ways={"host start": "hang"})
    assert play.story == ["spawn host", "host start"]
    assert "part start" in play.finish("host start")


def test_no_node_is_wired_before_those_are_configured_that_come_early() -> None:
    hang = {"a configure": "hang", "b configure": "hang"}
    plan = plan_of(planned_node("a"), planned_node("b"))
    negotiated = replace(plan.data_layer, authority=Authority.SUPERVISOR)
    play = Play(replace(plan, data_layer=negotiated), ways=hang)
    play.run.early = frozenset({"b"})
    assert "a wire" not in play.finish("a configure")
    assert "a wire" in play.finish("b configure")


def test_who_stays_down_of_those_that_come_early_holds_up_nobodys_wiring() -> None:
    plan = plan_of(planned_node("a", supervision=AGAIN), planned_node("b"))
    negotiated = replace(plan.data_layer, authority=Authority.SUPERVISOR)
    play = Play(replace(plan, data_layer=negotiated), keep_going=True, stop_after_s=60.0)
    play.run.early = frozenset({"b"})
    play.die("b")
    play.die("a")
    assert "a wire" in play.wait(5.0)
    assert play.run.nodes["a"].level is Level.ACTIVE


def test_a_node_of_others_that_was_disconnected_is_wired_anew() -> None:
    plan = plan_of(planned_node("a", kind=RunKind.ATTACH), planned_node("b"))
    wired = replace(plan.data_layer, authority=Authority.SUPERVISOR)
    play = Play(replace(plan, data_layer=wired))
    assert play.order(ControlRequest.RESTART).count("a wire") == 1


def test_what_goes_down_with_two_that_failed_is_started_again_after_the_longer_time() -> None:
    alone = Supervision(restart=Restart.ON_FAILURE, restart_sec=5.0)
    every = replace(alone, restart_sec=1.0, on_failure=OnFailure.ALL)
    play = Play(plan_of(planned_node("a", supervision=alone), planned_node("b", supervision=every)))
    play.die("a")
    play.wait(0.5)
    play.die("b")
    assert {"spawn a", "spawn b"} & {*play.wait(4.0)} == {"spawn b"}
    assert "spawn a" in play.wait(1.0)


def test_how_often_others_activated_a_node_is_forgotten_once_it_passed_the_gate() -> None:
    play = Play(plan_of(planned_node("arm", managed=True, kind=RunKind.COMMAND)))
    for _ in range(2):
        play.order(ControlRequest.PAUSE)
        for _ in range(3):
            play.give(messages.Saw(levels={"arm": Level.ACTIVE}))
            assert play.levels == str(int(Level.CONNECTED))
        play.order(ControlRequest.RESUME)
    assert [code for code, _ in play.answers.values()] == [ExitCode.OK] * 4


def test_a_number_is_measured_for_ten_seconds_also_where_no_look_ends() -> None:
    rate = (Quantity(name="rate_hz", value=9, at=HERE),)
    data = planned_endpoint(EndpointKind.PUBLISHER, "data", quantities=rate)
    play = Play(plan_of(replace(planned_node("a"), endpoints=(data,))), ways={"a activate": "hang"})
    play.ways["look"] = "hang"
    play.finish("a activate")
    play.give(messages.Verified(mark=play.held.pop().mark, verdict=play.found))
    phases = []
    for _ in range(12):
        play.wait(1.0)
        phases.append(play.phase)
    assert set(phases[:9]) == {"measuring"}
    assert set(phases[10:]) == {"active"}


def test_nothing_is_decided_of_numbers_while_the_system_is_paused_or_a_process_is_away() -> None:
    rate = (Quantity(name="rate_hz", value=9, at=HERE),)
    data = planned_endpoint(EndpointKind.PUBLISHER, "data", quantities=rate)
    node = replace(planned_node("a", supervision=AGAIN), endpoints=(data,))
    play = Play(plan_of(node), ways={"a activate": "hang"}, stop_after_s=1.0)
    play.ways["look"] = "hang"
    play.finish("a activate")
    play.give(messages.Verified(mark=play.held.pop().mark, verdict=play.found))
    assert (play.phase, play.run.decided_s) == ("measuring", None)
    play.order(ControlRequest.PAUSE)
    del play.ways["look"]
    play.finish("look")
    play.wait(4.0)
    assert (play.phase, play.run.decided_s) == ("paused", None)
    play.order(ControlRequest.RESUME)
    assert (play.phase, play.run.decided_s) == ("active", 4.0)
