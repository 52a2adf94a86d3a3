"""How soon a participant that comes late knows the endpoints of those that were there before it."""

from __future__ import annotations

import ctypes
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from rclpy.node import Node
from std_msgs.msg import String

from lifecycle.middleware import (
    FlowParticipant,
    GraphObserver,
    ask_for_endpoints_soon,
    resend_endpoints_soon,
)
from lifecycle.middleware.fastdds import endpoint_discovery
from lifecycle.middleware.fastdds.local_readers import builtin_reader
from tests.ros.node.edp_heartbeats import heartbeat_periods_s

_LATECOMER = Path(__file__).with_name("latecomer.py")
_TRIES = 9
_FAST_DDS_S = 0.1
"""How long Fast DDS waits by itself before it resends, `edp_nack_response_delay`."""


def _known_after_s(observer: GraphObserver) -> float:
    command = [sys.executable, str(_LATECOMER), str(observer.domain_id), "/early"]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stdout.readline() == "there\n"
        observer.announce_ourselves()
        process.stdin.write("\n")
        process.stdin.flush()
        return float(process.stdout.readline())


@pytest.mark.alone  # beside others two of nine tries are slow by themselves
@pytest.mark.thorough
def test_who_comes_late_knows_our_endpoints_sooner_than_fast_dds_would_have_it(
    fresh_domain: int,
) -> None:
    with GraphObserver(fresh_domain) as observer:
        observer.node.create_publisher(String, "/early", 1)
        soon: list[float] = []
        later: list[float] = []
        for _ in range(_TRIES):
            for known_s, delay_s in ((later, _FAST_DDS_S), (soon, endpoint_discovery.SOON_S)):
                with observer.node.handle:
                    assert resend_endpoints_soon(observer.node.handle.pointer, delay_s)
                known_s.append(_known_after_s(observer))
    # Where both announce themselves at the same time nobody has to ask. Without the most, which may
    # be of something that was lost: 0.09 and 0.18 s.
    assert sorted(soon)[-2] < 0.75 * sorted(later)[-2], (soon, later)


def test_nothing_is_changed_where_a_writer_is_laid_out_otherwise(
    fresh_domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    with FlowParticipant("_other", "/", fresh_domain) as other, other.node.handle:
        pointer = other.node.handle.pointer
        monkeypatch.setattr(endpoint_discovery, "_TIMES_AT", endpoint_discovery._TIMES_AT - 8)
        assert not resend_endpoints_soon(pointer)
        monkeypatch.undo()
        monkeypatch.setattr(endpoint_discovery, "_KEEP_DURATION_AT", 928 - 8)
        monkeypatch.setattr(endpoint_discovery, "_SEND_BUFFER_AT", 952 - 8)
        assert not resend_endpoints_soon(pointer)
        monkeypatch.undo()
        assert resend_endpoints_soon(pointer)
        monkeypatch.setattr(endpoint_discovery, "participant_of", lambda _: None)
        # With another RMW: Fast DDS is not even loaded.
        monkeypatch.setattr(endpoint_discovery, "_functions", lambda: pytest.fail("loaded"))
        assert not resend_endpoints_soon(pointer)


@pytest.mark.parametrize(
    ("participants", "period_s"), [(0, 1), (1, 1), (39, 1), (40, 2), (100, 5), (5000, 30)]
)
def test_heartbeats_come_the_less_often_the_more_participants_there_are(
    fresh_domain: int, participants: int, period_s: int
) -> None:
    with FlowParticipant("_other", "/", fresh_domain) as other, other.node.handle:
        pointer = other.node.handle.pointer
        assert resend_endpoints_soon(pointer, participants=participants)
        assert heartbeat_periods_s(pointer) == [period_s, period_s]
        # Also what was changed before is known, and changed back.
        assert resend_endpoints_soon(pointer)
        assert heartbeat_periods_s(pointer) == [1, 1]


_READER_BYTES = 1024
"""More than sizeof(StatefulReader) is read nowhere; its times are among the first."""


def times_ms_of(rcl_node: int) -> set[tuple[int, int]]:
    """Return what the built-in readers have of these times: initial request, answer."""
    found = set()
    for entity in endpoint_discovery._READERS:
        reader = builtin_reader(rcl_node, entity)
        assert reader is not None
        data = ctypes.string_at(ctypes.addressof(reader), _READER_BYTES)
        for ask_ms, answer_ms in ((70, 10), (20, 9), (5, 5)):
            times = struct.pack("<iIiI", 0, ask_ms * 10**6, 0, answer_ms * 10**6)
            found |= {(ask_ms, answer_ms)} if times in data else set()
    return found


def test_a_new_participant_is_soon_asked_by_itself(
    make_node: Callable[..., Node], monkeypatch: pytest.MonkeyPatch
) -> None:
    node = make_node("asking")
    with node.handle:
        pointer = node.handle.pointer
        assert times_ms_of(pointer) == {(70, 10)}
        with monkeypatch.context() as other:
            other.setattr(endpoint_discovery, "builtin_reader", lambda *_: None)
            assert not ask_for_endpoints_soon(pointer)
        with monkeypatch.context() as other:
            other.setattr(endpoint_discovery, "_reader_functions", lambda: None)
            assert not ask_for_endpoints_soon(pointer)
        assert times_ms_of(pointer) == {(70, 10)}
        assert ask_for_endpoints_soon(pointer, 0.02)
        assert times_ms_of(pointer) == {(20, 9)}
        assert ask_for_endpoints_soon(pointer)
        assert times_ms_of(pointer) == {(5, 5)}


def test_an_observer_asks_soon(fresh_domain: int) -> None:
    with GraphObserver(fresh_domain) as observer, observer.node.handle:
        assert times_ms_of(observer.node.handle.pointer) == {(5, 5)}


@pytest.mark.parametrize(
    ("participants", "delay_s"), [(0, 0.005), (2, 0.005), (20, 0.02), (50, 0.05), (200, 0.05)]
)
def test_what_was_unannounced_resends_once_the_others_had_time_to_ask(
    participants: int, delay_s: float
) -> None:
    assert endpoint_discovery.endpoints_made_s(participants) == pytest.approx(delay_s)
