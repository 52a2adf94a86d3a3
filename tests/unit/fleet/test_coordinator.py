"""Policies of `lifecycle up --hosts`: who is started, followed and ended when, and what is said."""

from __future__ import annotations

import asyncio

import pytest

from lifecycle.errors import ExitCode
from lifecycle.fleet.asking import statuses, worst
from lifecycle.fleet.coordinator import Coordinator
from lifecycle.fleet.protocol import Do, Part
from tests.unit.fleet.fakes import CUT_S, VERSION, Supervisor, World
from tests.unit.supervisor.fakes import run


def _stop(running: Coordinator) -> None:
    running.stop("terminated", ExitCode.TERMINATED)


def _interrupt(running: Coordinator) -> None:
    running.stop("interrupted", ExitCode.INTERRUPTED)


def _leave(running: Coordinator) -> None:
    running.leave("the terminal was closed")


def test_all_are_started_become_active_and_are_ended_the_last_of_the_order_first() -> None:
    world = World()
    world.host("a", rank=0)
    world.host("b", rank=2, active_s=3.0, ends_s=2.0)
    world.host("c", rank=1)
    assert run(world.run(at=(10.0, _stop))) is ExitCode.OK
    assert [world.states(each) for each in "abc"] == [["connected", "started", "ended"]] * 3
    assert world.ended == ["b", "c", "a"]
    (active,) = world.of("active")
    assert list(active["hosts"]) == ["a", "b", "c"]
    assert active["elapsed_s"] == pytest.approx(3.0, abs=0.1)
    (end,) = world.of("end")
    assert end["exit_codes"] == {"a": 0, "b": 0, "c": 0}
    assert all(each.channel is not None and each.channel.is_closed for each in world.hosts.values())


def test_nothing_is_started_where_one_host_cannot_be_reached() -> None:
    world = World()
    world.host("a")
    world.host("b", stderr="Permission denied (publickey).", exit_code=255)
    assert run(world.run()) is ExitCode.BRING_UP_FAILED
    assert world.states("b") == ["failed"]
    assert world.of("host", "b")[0]["message"] == "Permission denied (publickey)."
    assert world.hosts["a"].starts == 0


def test_a_host_that_never_answers_is_given_up_in_time() -> None:
    world = World()
    world.host("a")
    world.host("b", is_cut=True, heals_s=None)
    assert run(world.run()) is ExitCode.BRING_UP_FAILED
    assert world.states("b") == ["failed"]


def test_a_signal_while_hosts_are_asked_ends_at_once() -> None:
    world = World()
    world.host("a", is_cut=True, heals_s=None)
    assert run(world.run(at=(2.0, _interrupt))) is ExitCode.INTERRUPTED
    assert world.of("end")[0]["elapsed_s"] < 3


def test_another_version_is_an_error_of_that_host_with_the_next_step() -> None:
    world = World()
    world.host("a", version="0.9")
    assert run(world.run()) is ExitCode.BRING_UP_FAILED
    (failed,) = world.of("host", "a")
    assert failed["message"] == "its lifecycle is version 0.9, and here it is 1.2.3"
    assert failed["hint"] == "install the same version on all hosts"


def test_one_that_is_refused_ends_those_that_were_started() -> None:
    world = World()
    world.host("a")
    world.host("b", refuses="it runs already, with another manifest")
    assert run(world.run()) is ExitCode.BRING_UP_FAILED
    assert world.states("a") == ["connected", "started", "ended"]
    assert world.ended == ["a"]


def test_one_that_fails_during_bring_up_ends_the_others() -> None:
    world = World()
    world.host("a", active_s=None)
    world.host("b", active_s=None, fails_s=2.0)
    assert run(world.run()) is ExitCode.BRING_UP_FAILED
    (end,) = world.of("end")
    assert end["exit_codes"] == {"a": ExitCode.TERMINATED, "b": ExitCode.BRING_UP_FAILED}
    assert end["elapsed_s"] < 5


def test_what_is_not_active_in_time_is_named_and_ended() -> None:
    world = World()
    world.host("a")
    world.host("b", active_s=None)
    assert run(world.run()) is ExitCode.BRING_UP_FAILED
    (ending,) = world.of("ending")
    assert ending["reason"] == "not active on all hosts within 30 s: b (started)"
    assert world.ended == ["a", "b"]


@pytest.mark.parametrize(("keep_going", "ended_s"), [(False, 5.5), (True, 20.5)])
def test_one_that_fails_while_active_ends_all_unless_they_are_to_keep_going(
    keep_going: bool, ended_s: float
) -> None:
    world = World()
    world.host("a")
    world.host("b", fails_s=5.0)
    code = run(world.run(keep_going=keep_going, at=(20.0, _stop)))
    assert code is ExitCode.BRING_UP_FAILED
    assert world.of("end")[0]["elapsed_s"] == pytest.approx(ended_s, abs=0.5)


def test_a_host_that_a_person_takes_down_is_no_failure() -> None:
    world = World()
    world.host("a")
    world.host("b")

    async def main() -> ExitCode:
        def down() -> None:
            supervisor = world.hosts["b"].supervisor
            assert supervisor is not None
            supervisor.terminate()

        asyncio.get_running_loop().call_later(5.0, down)
        return await world.run(at=(20.0, _stop))

    assert run(main()) is ExitCode.OK
    assert world.of("end")[0]["elapsed_s"] > 20


def test_what_a_killed_supervisor_left_is_ended_with_the_others() -> None:
    world = World()
    world.host("a")
    world.host("b")

    async def main() -> ExitCode:
        def kill() -> None:
            supervisor = world.hosts["b"].supervisor
            assert supervisor is not None
            supervisor.kill()

        asyncio.get_running_loop().call_later(5.0, kill)
        return await world.run()

    assert run(main()) is ExitCode.BRING_UP_FAILED
    assert world.of("host", "b")[-1]["message"] == "killed by signal 9"
    assert world.of("ending")[0]["reason"] == "the supervisor of b failed"
    assert [each.downs for each in world.hosts.values()] == [0, 1]
    assert world.ended == ["a"]


def test_an_active_system_is_ended_after_the_time_that_was_asked_for() -> None:
    world = World()
    world.host("a")
    assert run(world.run(stop_after_s=2.0)) is ExitCode.OK
    assert world.of("ending")[0]["reason"] == "done"


@pytest.mark.parametrize("until", ["connected", "verified"])
@pytest.mark.parametrize("is_cut", [False, True])
def test_what_is_not_to_become_active_waits_on_each_host_for_all_and_then_ends(
    until: str, is_cut: bool
) -> None:
    world = World()
    world.host("a", reaches=until, active_s=1.0)
    # What it said while its link was cut is lost; its status shows it.
    cut = {"cut_at": Do.START, "heals_s": CUT_S + 3} if is_cut else {}
    world.host("b", reaches=until, active_s=3.0, **cut)
    assert run(world.run(until=until)) is ExitCode.OK
    (reached,) = world.of("reached")
    assert (reached["reached"], [*reached["hosts"]]) == (until, ["a", "b"])
    assert reached["elapsed_s"] >= 3.0
    assert world.of("active") == []
    assert world.of("end")[0]["exit_codes"] == {"a": 0, "b": 0}


def test_what_runs_already_is_not_ended_for_having_been_verified() -> None:
    async def test() -> None:
        world = World()
        for name in "ab":
            world.host(name)
        running = world.hosts["a"].supervisor = Supervisor(world.hosts["a"])
        running.activate()
        assert await world.run(until="verified") is ExitCode.BRING_UP_FAILED
        assert "a" not in world.ended
        assert world.of("host", "a")[-1]["message"] == (
            "its supervisor runs already, and is left as it is"
        )

    run(test())


@pytest.mark.parametrize(
    ("at_s", "by", "code"),
    [
        (0.5, _interrupt, ExitCode.INTERRUPTED),
        (5.0, _interrupt, ExitCode.INTERRUPTED),
        (0.5, _stop, ExitCode.TERMINATED),
        (5.0, _stop, ExitCode.OK),
    ],
)
def test_signals_end_all_as_they_end_a_run_on_one_host(at_s: float, by, code: ExitCode) -> None:  # type: ignore[no-untyped-def]
    world = World()
    world.host("a")
    world.host("b")
    assert run(world.run(at=(at_s, by))) is code
    assert sorted(world.ended) == ["a", "b"]


def test_a_terminal_that_closes_leaves_all_running_and_says_how_to_go_on() -> None:
    world = World()
    world.host("a")
    assert run(world.run(at=(5.0, _leave))) is ExitCode.HUNG_UP
    assert world.ended == []
    left = world.of("host", "a")[-1]
    assert left["state"] == "left"
    assert "lifecycle up m.yaml --hosts" in left["hint"]
    assert "lifecycle down m.yaml --hosts" in left["hint"]


def test_what_runs_is_followed_and_ended_as_if_it_had_been_started() -> None:
    world = World()
    for name in "ab":
        world.host(name)

    async def main() -> tuple[ExitCode, ExitCode]:
        first = await world.run(at=(5.0, _leave))
        world.said.clear()
        return first, await world.run(at=(5.0, _stop))

    assert run(main()) == (ExitCode.HUNG_UP, ExitCode.OK)
    assert world.states("a") == ["connected", "attached", "ended"]
    assert [each.starts for each in world.hosts.values()] == [1, 1]
    assert world.of("active")[0]["elapsed_s"] < 1


def test_what_ran_before_is_not_ended_because_another_host_fails() -> None:
    world = World()
    world.host("a")

    async def main() -> ExitCode:
        await world.run(at=(5.0, _leave))
        world.host("b", active_s=None, fails_s=1.0)
        return await world.run()

    assert run(main()) is ExitCode.BRING_UP_FAILED
    assert world.ended == ["b"]


@pytest.mark.parametrize(
    ("order", "at_s"), [(Do.START, None), (None, 0.5), (None, 5.0), (Do.END, None)]
)
def test_a_cut_link_ends_no_supervisor_and_starts_none_twice(
    order: Do | None, at_s: float | None
) -> None:
    """It is cut as the supervisor starts, while it comes up, while active, and as it is to end."""
    world = World()
    world.host("a", cut_at=order, active_s=2.0, heals_s=CUT_S + 3.0)
    world.host("b", active_s=2.0)

    async def main() -> ExitCode:
        if at_s is not None:
            asyncio.get_running_loop().call_later(at_s, world.hosts["a"].cut)
        return await world.run(at=(25.0, _stop))

    assert run(main()) is ExitCode.OK
    assert world.hosts["a"].starts == 1
    assert sorted(world.ended) == ["a", "b"]
    assert "cut" in world.states("a")
    assert world.states("b") == ["connected", "started", "ended"]
    if order is None:
        assert world.states("a") == ["connected", "started", "cut", "healed", "ended"]
        (healed,) = (each for each in world.of("host", "a") if each["state"] == "healed")
        assert healed["lost_s"] > 2


def test_a_cut_is_said_in_time_and_not_once_its_connection_is_closed() -> None:
    world = World()
    world.host("a", closes_s=5.0)
    world.host("b")
    found: list[str] = []

    async def main() -> ExitCode:
        loop = asyncio.get_running_loop()
        loop.call_later(5.0, world.hosts["a"].cut)
        # What came last came up to a heartbeat before.
        loop.call_later(5.0 + CUT_S, lambda: found.extend(world.states("a")))
        return await world.run(at=(40.0, _stop))

    assert run(main()) is ExitCode.OK
    assert found == ["connected", "started", "cut"]
    assert world.states("a") == ["connected", "started", "cut", "healed", "ended"]


def test_a_host_that_is_cut_off_for_good_is_named_in_the_end_and_runs_on() -> None:
    world = World()
    world.host("a", heals_s=None)
    world.host("b")

    async def main() -> ExitCode:
        asyncio.get_running_loop().call_later(5.0, world.hosts["a"].cut)
        return await world.run(at=(20.0, _stop))

    assert run(main()) is ExitCode.BRING_UP_FAILED
    assert world.ended == ["b"]
    left = world.of("host", "a")[-1]
    assert left["message"] == "its supervisor still runs: its link is cut"
    assert left["hint"] == "on that host: lifecycle down patrol@7.a"
    assert world.of("end")[0]["exit_codes"] == {"a": None, "b": 0}


def test_one_that_ended_while_its_link_was_cut_is_a_failure_that_is_said() -> None:
    world = World()
    world.host("a", fails_s=7.0)

    async def main() -> ExitCode:
        asyncio.get_running_loop().call_later(5.0, world.hosts["a"].cut)
        return await world.run(at=(60.0, _stop))

    assert run(main()) is ExitCode.BRING_UP_FAILED
    ended = world.of("host", "a")[-1]
    assert ended["message"] == "its supervisor ended while the link was cut"
    assert ended["hint"].startswith("what happened: lifecycle history patrol")


def test_a_supervisor_that_does_not_end_is_not_waited_for_forever() -> None:
    world = World()
    world.host("a", ends_s=None)
    assert run(world.run(at=(5.0, _stop))) is ExitCode.BRING_UP_FAILED
    assert "it did not end within 90 s" in world.of("host", "a")[-1]["message"]


def test_clocks_that_differ_are_measured_and_said_once() -> None:
    world = World()
    world.host("a", ahead_s=2.5, way_s=0.02)
    world.host("b", ahead_s=0.004)
    run(world.run(at=(20.0, _stop)))
    (first,) = world.of("clock", "a")
    assert first["offset_s"] == pytest.approx(2.5, abs=0.001)
    assert first["uncertainty_s"] == pytest.approx(0.02, abs=0.001)
    assert first["round_trips"] == 8
    assert first["differs"] is True
    (second,) = world.of("clock", "b")
    assert second["differs"] is False


def test_a_clock_that_jumps_is_said_again() -> None:
    world = World()
    world.host("a")

    async def main() -> None:
        def jump() -> None:
            world.hosts["a"].ahead_s = -1.0

        asyncio.get_running_loop().call_later(5.0, jump)
        await world.run(at=(40.0, _stop))

    run(main())
    assert world.of("clock", "a")[-1]["offset_s"] == pytest.approx(-1.0, abs=0.01)


@pytest.mark.parametrize("set_s", [3600.0, -3600.0])
def test_a_clock_of_ours_that_is_set_makes_no_difference_that_there_is_not(set_s: float) -> None:
    world = World()
    world.host("a")

    async def main() -> None:
        asyncio.get_running_loop().call_later(5.0, setattr, world, "sets_s", set_s)
        await world.run(at=(60.0, _stop))

    run(main())
    offsets_s = [each["offset_s"] for each in world.of("clock", "a")]
    assert offsets_s == [pytest.approx(0.0, abs=0.01), pytest.approx(-set_s, abs=0.01)]


@pytest.mark.parametrize(
    ("codes", "expected"),
    [
        ((), ExitCode.OK),
        ((0, 143), ExitCode.TERMINATED),
        ((143, 4), ExitCode.VIOLATED),
        ((4, 6), ExitCode.BRING_UP_FAILED),
        ((7, 0), ExitCode.SUPERVISION_GAVE_UP),
        ((0, 99), ExitCode.INTERNAL),
    ],
)
def test_the_worst_exit_code_is_the_one_of_all(codes: tuple[int, ...], expected: ExitCode) -> None:
    assert worst(codes) is expected


def test_every_host_is_asked_how_it_is_and_one_that_does_not_say_is_an_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def test() -> None:
        world = World()
        monkeypatch.setattr("time.time", lambda: world.now_s)  # of the loop that jumps
        world.host("a", ahead_s=2.5)
        world.host("b")
        world.host("c", stderr="Connection refused", exit_code=255)
        world.host("d", version="0.9")
        world.host("e", refuses="cannot ask 'patrol@7.e': its supervisor does not answer")
        world.host("f", is_cut=True, heals_s=None)
        world.hosts["a"].supervisor = Supervisor(world.hosts["a"])
        parts = [Part(name=f"patrol@7.{e}", machine=e, manifest="", files=()) for e in "abcdef"]
        found = await statuses(parts, world.hosts, version=VERSION)
        assert [each.host for each in found] == [*"abcdef"]
        assert found[0].status == {"phase": "active"}
        assert found[0].clock is not None
        assert found[0].clock.offset_s == pytest.approx(2.5, abs=0.01)
        assert [each.is_absent for each in found] == [False, True, False, False, False, False]
        assert [each.message for each in found[1:]] == [
            "no supervisor runs there",
            "Connection refused",
            f"its lifecycle is version 0.9, and here it is {VERSION}",
            "cannot ask 'patrol@7.e': its supervisor does not answer",
            "no answer in time",
        ]
        assert all(each.status is None for each in found[1:])
        channels = [each.channel for each in world.hosts.values()]
        assert all(each is not None and each.is_closed for each in channels)

    run(test())
