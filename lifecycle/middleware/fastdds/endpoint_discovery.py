"""Endpoint discovery (EDP) of Fast DDS: how soon a participant sends, and asks for, endpoints.

Owns: the nack response delay and the heartbeat period of a participant's two built-in EDP writers
(DDSI-RTPS §8.5.4), that they resend without a heartbeat to everybody, and the times of its two
built-in readers.

A participant that is discovered after its endpoints were made is asked for them: the other one
receives a heartbeat, requests what it lacks 10 ms later, and Fast DDS 2.14 waits 100 ms before it
resends (`edp_nack_response_delay`, EDPSimple.cpp). No profile and no variable changes that. It was
a quarter of the time in which a small system comes up, and is part of each restart: a participant
sends `ros_discovery_info`, the names of its nodes, to readers that it has discovered. The delay is
Fast DDS's own setting of a writer, changed by its own function; where the writer is not laid out as
in 2.14.5 nothing is done.

A heartbeat that comes before its participant was discovered is lost. Then a reader asks by itself,
after 70 ms (`initialAcknackDelay`), which no setting changes either.

With each 106 kB that a writer has sent it sends a heartbeat to all that it knows. What it resends
to many is counted again with each message (`last_processed` in
StatefulWriter::deliver_sample_to_network), so that soon each message has such a heartbeat: of
570,000 datagrams by which fifty nodes discovered each other 300,000 were heartbeats. The count is
begun with 1 GiB here; the periodic heartbeat remains.

While one reader has not acknowledged something, a writer sends that heartbeat to all of them, each
second, and all of them answer. A hundred participants on one host are 40,000 datagrams a second
then, more than two processors can do, so that nothing is acknowledged any more. The period follows
the number of participants: with 75 of them two thirds of the datagrams remain. What is lost is sent
again that much later.
"""

from __future__ import annotations

import ctypes
import functools
from typing import Any

from lifecycle.middleware.fastdds.local_readers import (
    RTPS,
    builtin_reader,
    guid_prefix,
    virtual_functions,
)
from lifecycle.middleware.fastdds.settings import fast_dds_function, participant_of

SOON_S = 0.005
"""Fast DDS's own delay of writers of topics."""

ENDPOINTS_MADE_S = 0.02
"""Of a participant whose endpoints are just being made: requests that come meanwhile are answered
together."""

_SHARE_S = 0.001
_LONGEST_S = 0.05
"""Two processors discover one participant in a share; the limit is for those of a large system that
are found later."""

_PARTICIPANTS_A_SECOND = 20
_MAX_HEARTBEAT_S = 30
"""The heartbeat period is a second for so many participants, Fast DDS's own, to 30 for 600."""

_WRITERS = (b"\x00\x00\x03\xc2", b"\x00\x00\x04\xc2")
"""EntityIds of the built-in writers of publications and subscriptions, DDSI-RTPS table 9.1."""

_READERS = (b"\x00\x00\x03\xc7", b"\x00\x00\x04\xc7")
"""EntityIds of the built-in readers of the same."""

_ANSWERED_S = 0.009
"""To a heartbeat they answer after 10 ms. Fast DDS changes times only where that is another one."""

_TIMES_AT = 592
"""Where StatefulWriter has its WriterTimes in Fast DDS 2.14.5, see `_is_known`."""

_KEEP_DURATION_AT = 928
_SEND_BUFFER_AT = 952
"""Where it has `keep_duration_`, infinite, and `sendBufferSize_`, which the socket has, and after
that how much is left of it."""

_INFINITE_S, _INFINITE_NS = 0x7FFFFFFF, 0xFFFFFFFF
_LARGEST_SOCKET_BUFFER = 1 << 26
_NEVER = 1 << 30


class Duration(ctypes.Structure):
    """Duration_t of DDSI-RTPS as Fast DDS has it in memory."""

    _fields_ = (("seconds", ctypes.c_int32), ("nanoseconds", ctypes.c_uint32))


class _WriterTimes(ctypes.Structure):
    # fastrtps/rtps/attributes/WriterAttributes.h; its destructor is virtual.
    _fields_ = (
        ("virtual", ctypes.c_void_p),
        ("initial_heartbeat_delay", Duration),
        ("heartbeat_period", Duration),
        ("nack_response_delay", Duration),
        ("nack_suppression_duration", Duration),
    )


class _ReaderTimes(ctypes.Structure):
    # fastrtps/rtps/attributes/ReaderAttributes.h; its destructor is virtual, and never called.
    _fields_ = (
        ("virtual", ctypes.c_void_p),
        ("initial_acknack_delay", Duration),
        ("heartbeat_response_delay", Duration),
    )


def endpoints_made_s(participants: int) -> float:
    """Return how soon one that was unannounced resends: once most of the others have asked.

    Args:
        participants: how many are announced together, ≥ 0.

    Returns:
        Seconds, for `resend_endpoints_soon`.
    """
    return min(max(SOON_S, participants * _SHARE_S), _LONGEST_S)


def resend_endpoints_soon(rcl_node: int, delay_s: float = SOON_S, *, participants: int = 1) -> bool:
    """Have the participant of a node resend soon, when asked, which endpoints it has.

    Args:
        rcl_node: address of the rcl_node_t.
        delay_s: seconds, 0.001–0.1; requests that come within it are answered together.
        participants: how many make their endpoints at the same time, ≥ 0; heartbeats follow it.

    Returns:
        Whether it will; False with another RMW, another version, or static endpoint discovery.
    """
    participant = participant_of(rcl_node)
    functions = _functions() if participant else None
    if participant is None or functions is None:
        return False
    find_writer, update_times = functions
    if not (prefix := guid_prefix(participant)):
        return False
    changed = 0
    for entity in _WRITERS:
        writer = find_writer(ctypes.create_string_buffer(prefix + entity, len(prefix + entity)))
        if not writer:
            continue
        times = _WriterTimes.from_buffer_copy(
            ctypes.string_at(writer + _TIMES_AT, ctypes.sizeof(_WriterTimes))
        )
        if not _is_known(times):
            continue
        times.nack_response_delay = Duration(0, round(delay_s * 1e9))
        period_s = max(1, min(participants // _PARTICIPANTS_A_SECOND, _MAX_HEARTBEAT_S))
        times.heartbeat_period = Duration(period_s, 0)
        update_times(writer, ctypes.byref(times))
        changed += _resend_without_heartbeats(writer)
    return changed == len(_WRITERS)


def ask_for_endpoints_soon(rcl_node: int, delay_s: float = SOON_S) -> bool:
    """Have the participant of a node soon ask a new one for its endpoints, by itself.

    Args:
        rcl_node: address of the rcl_node_t.
        delay_s: seconds, 0.001–0.07, after it has discovered one of which it has received no
            heartbeat; then after twice, four times as long.

    Returns:
        Whether it will; False with another RMW, another version, or static endpoint discovery.
    """
    update_times, virtual = _reader_functions() or (None, None)
    if update_times is None:
        return False
    answer_s = min(delay_s, _ANSWERED_S)
    times = _ReaderTimes(0, Duration(0, round(delay_s * 1e9)), Duration(0, round(answer_s * 1e9)))
    changed = 0
    for entity in _READERS:
        reader = builtin_reader(rcl_node, entity)
        if reader is not None and reader.virtual == virtual:
            update_times(ctypes.addressof(reader), ctypes.byref(times))
            changed += 1
    return changed == len(_READERS)


def _resend_without_heartbeats(writer: int) -> bool:
    """Have a writer count from 1 GiB until its next heartbeat to all; False if it is none known."""
    kept = Duration.from_address(writer + _KEEP_DURATION_AT)
    size = ctypes.c_uint32.from_address(writer + _SEND_BUFFER_AT)
    left = ctypes.c_int32.from_address(writer + _SEND_BUFFER_AT + ctypes.sizeof(size))
    is_known = (
        (kept.seconds, kept.nanoseconds) == (_INFINITE_S, _INFINITE_NS)
        and 0 < size.value <= _LARGEST_SOCKET_BUFFER
        and left.value <= size.value
    )
    if is_known:
        size.value = left.value = _NEVER
    return is_known or size.value == _NEVER


def _is_known(times: _WriterTimes) -> bool:
    """Whether these are the times of an EDP writer, also after they were changed here."""
    heartbeats, suppression = times.heartbeat_period, times.nack_suppression_duration
    initial, response = times.initial_heartbeat_delay, times.nack_response_delay
    return (
        bool(times.virtual)
        and (initial.seconds, initial.nanoseconds) == (0, 12_000_000)
        and heartbeats.nanoseconds == 0
        and 1 <= heartbeats.seconds <= _MAX_HEARTBEAT_S
        and (suppression.seconds, suppression.nanoseconds) == (0, 10_000_000)
        and response.seconds == 0
        and 0 < response.nanoseconds <= 100_000_000
    )


@functools.lru_cache(maxsize=1)
def _reader_functions() -> tuple[Any, int] | None:
    """Return what changes a StatefulReader's times, and its table of virtual functions."""
    pointer = ctypes.c_void_p
    update_times = fast_dds_function(
        f"_ZN{RTPS}14StatefulReader11updateTimesERKNS1_11ReaderTimesE",
        *(ctypes.c_bool, pointer, pointer),
    )
    virtual = virtual_functions(f"_ZTVN{RTPS}14StatefulReaderE")
    return None if update_times is None or virtual is None else (update_times, virtual)


@functools.lru_cache(maxsize=1)
def _functions() -> tuple[Any, Any] | None:
    """Return what finds a writer by GUID and changes its times.

    None where the libraries are others.
    """
    pointer = ctypes.c_void_p
    found = (
        fast_dds_function(
            f"_ZN{RTPS}14RTPSDomainImpl17find_local_writerERKNS1_6GUID_tE", pointer, pointer
        ),
        fast_dds_function(
            f"_ZN{RTPS}14StatefulWriter11updateTimesERKNS1_11WriterTimesE", None, pointer, pointer
        ),
    )
    return None if None in found else found
