"""The heartbeat periods that the EDP writers of a participant have."""

from __future__ import annotations

import ctypes

from lifecycle.middleware.fastdds import endpoint_discovery


def heartbeat_periods_s(rcl_node: int) -> list[float]:
    """What Fast DDS has, read where its own function has put it."""
    functions = endpoint_discovery._functions()
    assert functions is not None
    find_writer, _ = functions
    prefix = endpoint_discovery.guid_prefix(endpoint_discovery.participant_of(rcl_node))
    found = []
    for entity in endpoint_discovery._WRITERS:
        writer = find_writer(ctypes.create_string_buffer(prefix + entity, 16))
        times = endpoint_discovery._WriterTimes.from_address(writer + endpoint_discovery._TIMES_AT)
        period = times.heartbeat_period
        found.append(period.seconds + period.nanoseconds / 1e9)
    return found
