"""Programmer, ledger, orphans and keeper, without any network."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path

import pytest
from msgspec.structs import replace

from lifecycle.errors import UsageError
from lifecycle.programming import ledger as ledger_module
from lifecycle.programming.ledger import Entry, Ledger, LedgerFile, TargetRecord, owner_is_dead
from lifecycle.programming.programmer import (
    Programmer,
    remove_programmed,
    route_source,
    route_sources,
    sweep_orphans,
)
from lifecycle.programming.rules import flow_rules
from lifecycle.programming.target import (
    ChangeKind,
    Means,
    PartlyError,
    ProgrammingError,
    read_targets,
)
from lifecycle.verify.outcome import Outcome
from tests.builders import nfe
from tests.unit.programming.fakes import FakeTarget, Waited
from tests.unit.programming.flow_samples import plan, report
from tests.unit.programming.samples import ledger_in, nef_settings, rule, settings_file
from tests.unit.programming.servers import NefServer


def programmer(tmp_path: Path, *targets: FakeTarget) -> Waited:
    return Waited(Programmer(plan(), targets, Means(ledger_in(tmp_path))))


def test_flows_are_programmed_once_and_again_only_when_they_change(tmp_path: Path) -> None:
    target = FakeTarget()
    programs = programmer(tmp_path, target)

    (first,) = programs.update([report()])
    again = programs.update([report()])
    (moved,) = programs.update([report(source=(nfe("0.0.0.0", 45001),))])

    assert [each.kind for each in first.changes] == [ChangeKind.CREATE]
    assert again == ()
    assert [each.kind for each in moved.changes] == [ChangeKind.UPDATE]
    assert target.rules[0].source_port == 45001
    assert target.applied == 2


def test_another_plan_gives_the_same_flows_another_treatment(tmp_path: Path) -> None:
    target = FakeTarget()
    programs = programmer(tmp_path, target)
    programs.update([report()], hold=True)
    before = plan()
    camera = before.node("camera")
    video = replace(camera.endpoints[0], five_qi=82)
    camera = replace(camera, endpoints=(video, *camera.endpoints[1:]))

    programs.replan(replace(before, nodes=(camera, *before.nodes[1:])))
    (changed,) = programs.update([report()], hold=True)

    assert [each.kind for each in changed.changes] == [ChangeKind.UPDATE]
    assert [each.five_qi for each in target.rules] == [82]


def test_a_flow_that_is_not_verified_is_not_programmed_and_the_reason_is_kept(
    tmp_path: Path,
) -> None:
    target = FakeTarget()
    programs = programmer(tmp_path, target)

    programs.update([report(outcome=Outcome.UNVERIFIABLE)])

    assert target.rules == ()
    assert programs.left_out == (
        "/robot/video /robot/camera → /viewer: not verified: its verdict is unverifiable",
    )


def test_while_a_node_restarts_its_rule_is_held_and_then_moved(tmp_path: Path) -> None:
    target = FakeTarget()
    programs = programmer(tmp_path, target)
    programs.update([report()], hold=True)

    programs.update([report(outcome=Outcome.VIOLATED, source=())], hold=True)
    held = target.rules
    (moved,) = programs.update([report(source=(nfe("0.0.0.0", 46000),))], hold=True)
    programs.update([], hold=True)

    assert [each.source_port for each in held] == [45000]
    assert [each.kind for each in moved.changes] == [ChangeKind.UPDATE]
    assert target.rules == ()


def test_a_rule_is_held_although_a_target_failed_meanwhile(tmp_path: Path) -> None:
    target = FakeTarget()
    programs = programmer(tmp_path, target)
    programs.update([report()], hold=True)
    unsure = report(outcome=Outcome.VIOLATED, source=())
    target.fails = "out of reach"
    with pytest.raises(ProgrammingError):
        programs.update([report(source=(nfe("0.0.0.0", 46000),))], hold=True)
    target.fails = ""

    programs.update([unsure], hold=True)

    assert [each.source_port for each in target.rules] == [46000]
    programs.update([], hold=True)
    assert target.rules == ()


def test_without_hold_an_unverified_flow_loses_its_rule(tmp_path: Path) -> None:
    target = FakeTarget()
    programs = programmer(tmp_path, target)
    programs.update([report()])

    programs.update([report(outcome=Outcome.VIOLATED)])

    assert target.rules == ()


def test_one_target_that_fails_does_not_keep_another_from_being_programmed(
    tmp_path: Path,
) -> None:
    broken, sound = FakeTarget("broken"), FakeTarget("sound")
    broken.fails = "cannot do it"
    programs = programmer(tmp_path, broken, sound)

    with pytest.raises(PartlyError) as caught:
        programs.update([report()])
    what = "/robot/video /robot/camera → /viewer udp 10.77.0.2"
    assert str(caught.value) == (
        "cannot make 1 of 2 changes to targets:\n"
        "  cannot do it\n"
        "done all the same:\n"
        "sound: 1 created, 0 unchanged\n"
        f"  + {what}: {sound.rules[0].describe()}"
    )
    assert len(sound.rules) == 1
    broken.fails = ""
    programs.update([report()])
    assert len(broken.rules) == 1


def test_all_failures_are_told_together(tmp_path: Path) -> None:
    targets = [FakeTarget(), FakeTarget()]
    for each, text in zip(targets, ("cannot one", "cannot two"), strict=True):
        each.fails = text

    with pytest.raises(PartlyError) as caught:
        programmer(tmp_path, *targets).update([report()])

    assert str(caught.value) == "cannot make 2 of 2 changes to targets:\n  cannot one\n  cannot two"


def test_the_source_address_is_what_this_host_sends_from_where_it_is_the_publishers() -> None:
    here = plan(robot="127.0.0.1")
    sources = route_sources(here)
    camera, viewer = here.nodes

    assert sources(camera, "127.0.0.9") == "127.0.0.9"
    assert sources(viewer, "127.0.0.9") == ""
    assert route_source("127.0.0.1") == "127.0.0.1"
    (found,) = flow_rules(
        [report(destination=(nfe("127.0.0.9", 7001),))],
        plan(robot="", operator=""),
        source_address=route_sources(plan(robot="", operator="")),
    ).rules
    assert found.describe() == "udp 127.0.0.9:45000 → 127.0.0.9:7001"


def test_a_ledger_keeps_targets_apart_and_vanishes_with_the_last_entry(tmp_path: Path) -> None:
    ledger = ledger_in(tmp_path)
    entry = Entry(key="k", what="w")
    one = TargetRecord(target="nft", scope="t", entries=(entry,))
    other = TargetRecord(target="tc", scope="eth0", entries=(entry,))

    ledger.put(one)
    ledger.put(other)
    assert ledger.find(one) == one
    ledger.put(replace(one, entries=()))
    assert ledger.read().targets == (other,)
    ledger.put(replace(other, entries=()))

    assert not (tmp_path / "run" / "robot@7" / "programmed.json").exists()


def test_a_ledger_that_cannot_be_read_is_never_taken_for_an_empty_one(tmp_path: Path) -> None:
    ledger = ledger_in(tmp_path)
    file = tmp_path / "run" / "robot@7" / "programmed.json"
    file.write_text("{")

    with pytest.raises(ProgrammingError, match=f"cannot read ledger '{file}'.*remove that by hand"):
        ledger.read()


def test_a_directory_that_others_can_write_holds_no_ledger(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run").chmod(0o777)

    with pytest.raises(UsageError, match="others can write it"):
        ledger_in(tmp_path)


def test_two_processes_never_program_one_system_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ledger = ledger_in(tmp_path)
    monkeypatch.setattr(ledger_module, "_LOCK_S", 0.0)

    async def twice() -> None:
        async with ledger.locked():
            with pytest.raises(ProgrammingError, match="another process"):
                async with Ledger(tmp_path / "run" / "robot@7", "robot").locked():
                    pass

    asyncio.run(twice())


def test_a_ledger_of_a_living_supervisor_is_no_orphan_and_of_a_dead_one_is(
    tmp_path: Path,
) -> None:
    ledger_in(tmp_path)
    owned = Ledger(tmp_path / "run" / "robot@7", "robot", owned=True)
    owned.put(TargetRecord(target="nft", scope="t", entries=(Entry(key="k", what="w"),)))
    file = owned.read()

    assert file.owner is not None
    assert file.owner.pid == os.getpid()
    assert not owner_is_dead(file)
    dead = replace(file.owner, start_ticks=file.owner.start_ticks + 1)
    assert owner_is_dead(replace(file, owner=dead))
    assert owner_is_dead(replace(file, boot_id="another boot"))
    assert not owner_is_dead(LedgerFile())


def orphan(tmp_path: Path, server: NefServer, *, dead: bool) -> Path:
    """A run directory whose ledger lists one subscription."""
    ledger = ledger_in(tmp_path)
    file = settings_file(tmp_path, nef=nef_settings(server.url))
    directory = tmp_path / "run" / "robot@7"
    owned = Ledger(directory, "robot", owned=dead)
    targets = Means(owned)
    Waited(read_targets(["nef"], {"config": file})[0].open(targets)).apply([rule()])
    if dead:
        written = ledger.read()
        assert written.owner is not None
        owner = replace(written.owner, start_ticks=1)
        text = ledger_module.to_json(replace(written, owner=owner))
        (directory / "programmed.json").write_bytes(text)
    return directory


def test_what_a_dead_run_left_at_a_server_is_swept_by_the_next(tmp_path: Path) -> None:
    with NefServer() as server:
        directory = orphan(tmp_path, server, dead=True)

        reports: list[str] = []

        asyncio.run(sweep_orphans(directory.parent, reports.append))

        assert [each.partition("\n")[0] for each in reports] == [
            (
                f"left by a killed supervisor: nef at {server.url}/3gpp-as-session-with-qos/v1/"
                "robots: 1 deleted, 0 unchanged"
            )
        ]
        assert server.subscriptions == {}
        assert not (directory / "programmed.json").exists()


def test_what_somebody_applied_by_hand_is_not_swept_but_goes_down_with_the_system(
    tmp_path: Path,
) -> None:
    with NefServer() as server:
        directory = orphan(tmp_path, server, dead=False)

        asyncio.run(sweep_orphans(directory.parent, pytest.fail))
        assert len(server.subscriptions) == 1
        asyncio.run(remove_programmed(directory))
        assert server.subscriptions == {}


def test_an_orphan_that_cannot_be_removed_is_told_and_stays_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with NefServer() as server:
        directory = orphan(tmp_path, server, dead=True)
        monkeypatch.delenv("TEST_TOKEN")

        reports: list[str] = []

        asyncio.run(sweep_orphans(directory.parent, reports.append))

        assert "environment variable TEST_TOKEN: it is empty or not set" in reports[0]
        assert (directory / "programmed.json").exists()
