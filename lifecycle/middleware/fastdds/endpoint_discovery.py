"""Endpoint discovery (EDP) of Fast DDS: how soon a participant sends its endpoints again.

Owns: the nack response delay of a participant's two built-in EDP writers (DDSI-RTPS §8.5.4). A
participant that is discovered after its endpoints were made is asked for them, and Fast DDS 2.14
waits 100 ms before it answers (`edp_nack_response_delay`, EDPSimple.cpp); no profile and no
variable changes that. Here StatefulWriter::updateTimes does, with all other times as they are.
"""

from __future__ import annotations

import ctypes
import functools
from typing import Any

from lifecycle.middleware.fastdds.factory import fast_dds_function
from lifecycle.middleware.fastdds.local_readers import RTPS, guid_prefix, participant_of

_WRITERS = (b"\x00\x00\x03\xc2", b"\x00\x00\x04\xc2")
"""EntityIds of the built-in writers of publications and subscriptions, DDSI-RTPS table 9.1."""


class _WriterTimes(ctypes.Structure):
    """WriterTimes of WriterAttributes.h: four times Duration_t behind a pointer that is not read.

    Initial heartbeat delay, heartbeat period, nack response delay and nack suppression duration.
    """

    _fields_ = (("virtual", ctypes.c_void_p), ("times", ctypes.c_uint32 * 8))


SOON_S = 0.005
"""Fast DDS's own delay of writers of topics."""

_SHARE_S = 0.005
_LEAST_S = 0.02
_MOST_S = 0.1
"""Fast DDS's own delay of built-in writers."""


def together_s(participants: int) -> float:
    """Return how late one of so many that meet all at once answers who asks for its endpoints.

    Requests that come meanwhile are answered together: of twenty processes on two processors each
    spent 20 ms of CPU on answering one by one, and 5 ms so.
    """
    return min(max(_LEAST_S, participants * _SHARE_S), _MOST_S)


def resend_endpoints_soon(rcl_node: int, delay_s: float = SOON_S) -> bool:
    """Have the participant of a node answer soon who asks for its endpoints.

    Args:
        rcl_node: address of the rcl_node_t.
        delay_s: seconds, 0.001–0.1.

    Returns:
        Whether it will; False with another RMW, another version, or static endpoint discovery.
    """
    participant = participant_of(rcl_node)
    functions = _functions() if participant else None
    if participant is None or functions is None:
        return False
    find_writer, update_times = functions
    prefix = guid_prefix(participant)
    writers = [find_writer(prefix + entity) for entity in _WRITERS]
    if not all(writers):
        return False
    # All others are those of the built-in writers.
    times = (0, 12_000_000, 1, 0, 0, round(delay_s * 1e9), 0, 10_000_000)
    for writer in writers:
        update_times(writer, ctypes.byref(_WriterTimes(None, times)))
    return True


@functools.lru_cache(maxsize=1)
def _functions() -> tuple[Any, Any] | None:
    """Return what finds a writer by GUID and changes its times; None where they are others."""
    pointer = ctypes.c_void_p
    found = (
        fast_dds_function(
            f"_ZN{RTPS}14RTPSDomainImpl17find_local_writerERKNS1_6GUID_tE",
            *(pointer, ctypes.c_char_p),
        ),
        fast_dds_function(
            f"_ZN{RTPS}14StatefulWriter11updateTimesERKNS1_11WriterTimesE", None, pointer, pointer
        ),
    )
    return None if None in found else found
