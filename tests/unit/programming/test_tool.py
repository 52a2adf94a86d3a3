"""What programs say, in one sentence; and what people are told beside the changes."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from lifecycle.programming.host import HostTool, demand
from lifecycle.programming.nft import NftTarget
from lifecycle.programming.target import (
    ChangeKind,
    FlowChange,
    Means,
    ProgrammingError,
    TargetChanges,
)
from lifecycle.programming.tc import parse_queue, parse_rate
from tests.unit.programming.fakes import FakeTool, Waited, failed
from tests.unit.programming.samples import ledger_in, rule

NO_TABLE = failed("Error: No such file or directory\nlist table inet flowqos_robot\n")


@pytest.mark.parametrize(
    ("stderr", "message"),
    [
        (
            "Operation not permitted (you must be root)\nnetlink: Error: cache",
            (
                "cannot mark: 'nft -f -' needs CAP_NET_ADMIN in this network namespace; "
                "run this command as root, or give it that capability: in a container --cap-add "
                "NET_ADMIN, in a systemd unit AmbientCapabilities=CAP_NET_ADMIN"
            ),
        ),
        (
            "Error: Specified qdisc kind is unknown.\n",
            "cannot mark: 'nft -f -' says 'Error: Specified qdisc kind is unknown.'",
        ),
        (
            "\n  syntax error, unexpected newline\n",
            "cannot mark: 'nft -f -' says 'syntax error, unexpected newline'",
        ),
        ("", "cannot mark: 'nft -f -' says 'exit code 1'"),
    ],
)
def test_a_refusal_is_told_as_what_it_is(stderr: str, message: str) -> None:
    with pytest.raises(ProgrammingError) as caught:
        asyncio.run(demand(FakeTool(("nft", failed(stderr))), ["nft", "-f", "-"], doing="mark"))

    assert str(caught.value) == message


def test_a_program_that_is_not_installed_is_told_with_its_package(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(ProgrammingError) as caught:
        asyncio.run(HostTool(("nft-of-nowhere",)).run(["nft"]))

    assert str(caught.value) == (
        "cannot run 'nft-of-nowhere': it is not installed; "
        "install it: apt-get install nft-of-nowhere"
    )


def test_programs_read_stdin_and_speak_english() -> None:
    code = "import os, sys; print(sys.stdin.read(), os.environ['LC_ALL'])"

    done = asyncio.run(HostTool().run([sys.executable, "-c", code], stdin="x"))

    assert done.stdout == "x C\n"


def test_a_write_that_failed_is_not_taken_for_done(tmp_path: Path) -> None:
    ledger = ledger_in(tmp_path)
    tool = FakeTool(("nft list", NO_TABLE), ("nft -f", failed("Error: no memory")))
    target = Waited(NftTarget(None, Means(ledger), tool))

    with pytest.raises(ProgrammingError, match="no memory"):
        target.apply([rule()])

    assert target.plan([rule()]).pending
    assert ledger.read().targets == ()


@pytest.mark.parametrize(
    ("read", "text", "value"),
    [
        (parse_rate, "20mbit", 20_000),
        (parse_rate, "512kbit", 512),
        (parse_rate, "1Gbit", 1_000_000),
        (parse_rate, "2000bit", 2),
        (parse_queue, "50ms", 50.0),
        (parse_queue, "1.5s", 1500.0),
        (parse_queue, "500us", 0.5),
    ],
)
def test_rates_in_kbit_and_times_in_ms_are_read_as_tc_spells_them(
    read: Callable[[str], float], text: str, value: float
) -> None:
    assert read(text) == value


@pytest.mark.parametrize("text", ["", "50", "0ms", "-1ms", "1e3ms", "1.0000ms", "٣ms", "50kbit"])
def test_what_is_no_time_is_refused(text: str) -> None:
    with pytest.raises(ValueError) as caught:
        parse_queue(text)

    assert str(caught.value) == (f"cannot use queue {text!r}; use a number and us, ms or s: 50ms")


@pytest.mark.parametrize("text", ["", "20", "20mbps", "-1kbit", "500bit", "1e3kbit", "٣kbit"])
def test_what_is_no_rate_is_refused(text: str) -> None:
    with pytest.raises(ValueError) as caught:
        parse_rate(text)

    assert str(caught.value) == (
        f"cannot use rate {text!r}; use a number and kbit, mbit or gbit: 20mbit"
    )


def test_changes_read_as_a_list_with_their_counts() -> None:
    changes = TargetChanges(
        target="tc on eth0",
        changes=(
            FlowChange(kind=ChangeKind.CREATE, key="/a", what="udp x"),
            FlowChange(kind=ChangeKind.UPDATE, key="/b", what="udp y", detail="moved"),
            FlowChange(kind=ChangeKind.DELETE, key="/c", what=""),
            FlowChange(kind=ChangeKind.KEEP, key="/d", what="udp z"),
        ),
        left_out=("/e: why",),
    )

    assert changes.render() == (
        "tc on eth0: 1 to create, 1 to update, 1 to delete, 1 unchanged\n"
        "  + /a: udp x\n"
        "  ~ /b: udp y (moved)\n"
        "  - /c\n"
        "  = /d: udp z\n"
        "  left out: /e: why"
    )
    assert changes.render(done=True).startswith(
        "tc on eth0: 1 created, 1 updated, 1 deleted, 1 unchanged\n"
    )
