"""Participant discovery (PDP) of Fast DDS: a participant that is not met before it has endpoints.

Owns: `Unannounced`, and whether the installed Fast DDS is laid out so that it can be used.

Participants that know each other send each endpoint that is made to each other one, and the names
of a node again with each: some 20 datagrams and 16 messages from each node to each. Those that meet
when they have their endpoints send all of them in two datagrams, and the names once.

A participant is made by a profile that has it ignore all others (`ignoreParticipantFlags`, see
`ParticipantSettings.unannounced`). It announces itself once while it is made, which no setting
changes, and is disposed of here: participants that discovered it remove it, and answer when it is
announced again. Then what it ignores is set back, which Fast DDS 2.14 has no function for: it is
one number in PDP::m_discovery. So this is done only where all that lies around it is as in 2.14.5,
which is checked before, in a participant of the process that starts the others.
"""

from __future__ import annotations

import ctypes
import functools
from typing import Any

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.factory import fast_dds_function
from lifecycle.middleware.fastdds.local_readers import (
    POINTER_BYTES,
    RTPS,
    builtin_reader,
    pointer_at,
    virtual_functions,
)
from lifecycle.middleware.versions import INSTALL

_IGNORE_NONE_FLAGS, _IGNORE_ALL_FLAGS = 0, 7
_SIMPLE = 1
_READER = b"\x00\x01\x00\xc7"
"""EntityId of the built-in reader of participants, DDSI-RTPS table 9.1."""

_IMPL = f"_ZN{RTPS}19RTPSParticipantImpl"


class Duration(ctypes.Structure):
    """Duration_t of DDSI-RTPS as Fast DDS has it in memory."""

    _fields_ = (("seconds", ctypes.c_int32), ("nanoseconds", ctypes.c_uint32))


class _Pdp(ctypes.Structure):
    # PDP.h, and DiscoverySettings of RTPSParticipantAttributes.h, which m_discovery begins with.
    _fields_ = (
        ("virtual", ctypes.c_void_p),
        ("builtin", ctypes.c_void_p),
        ("participant", ctypes.c_void_p),
        ("between", ctypes.c_void_p),
        ("protocol", ctypes.c_uint32),
        ("simple_edp", ctypes.c_uint8),
        ("static_edp", ctypes.c_uint8),
        ("lease", Duration),
        ("announcement_period", Duration),
        ("announcements", ctypes.c_uint32),
        ("initial_period", Duration),
        ("simple_edp_settings", ctypes.c_uint8 * 4),
        ("factory", ctypes.c_void_p * 2),
        ("sync_period", Duration),
        ("servers", ctypes.c_void_p * 3),
        ("ignored", ctypes.c_uint32),
    )


class Unannounced:
    """A participant that is not discovered, and discovers none, until it is announced; see `of`."""

    def __init__(self, pdp: _Pdp) -> None:
        self._pdp = pdp
        _announcing("31stopRTPSParticipantAnnouncementEv")(pdp.participant)
        _announce()(ctypes.addressof(pdp), True, True)

    @classmethod
    def of(cls, rcl_node: int) -> Unannounced | None:
        """Dispose of a participant in the graph that was announced when it was made.

        Args:
            rcl_node: address of the rcl_node_t of its first node that was made by a profile for
                `unannounced`.

        Returns:
            None if it discovers others: a node of a user's module had it made before, perhaps.

        Raises:
            MiddlewareError: Fast DDS is not laid out as known; the participant stays alone.
        """
        pdp = _pdp_of(rcl_node)
        if pdp is None:
            raise MiddlewareError(
                "cannot have a participant discover others: the loaded Fast DDS is not laid out as "
                "2.14.5, though that of the process that started this one is",
                hint=f"start both in one environment; {INSTALL}",
            )
        return cls(pdp) if pdp.ignored == _IGNORE_ALL_FLAGS else None

    def announce(self) -> None:
        """Have it discover others, and be discovered."""
        self._pdp.ignored = _IGNORE_NONE_FLAGS
        _announce()(ctypes.addressof(self._pdp), True, False)
        _announcing("32resetRTPSParticipantAnnouncementEv")(self._pdp.participant)


def can_be_unannounced(rcl_node: int) -> bool:
    """Return whether participants of processes like this one can be made unannounced.

    Args:
        rcl_node: address of the rcl_node_t of any node of this process.

    Returns:
        False with another RMW, another version of Fast DDS, a discovery server, static endpoint
        discovery, and where a profile has participants ignored.
    """
    pdp = _pdp_of(rcl_node)
    return pdp is not None and pdp.ignored == _IGNORE_NONE_FLAGS


def _pdp_of(rcl_node: int) -> _Pdp | None:
    """Return the PDP of the participant of a node; None where anything is not as known."""
    functions = _functions()
    reader = builtin_reader(rcl_node, _READER) if functions else None
    if functions is None or reader is None:
        return None
    listener_of, virtual = functions
    listener = listener_of(ctypes.addressof(reader))
    pdp_address = pointer_at(listener + POINTER_BYTES) if listener else None
    if not pdp_address or pointer_at(pdp_address) != virtual:
        return None
    pdp = _Pdp.from_address(pdp_address)
    is_known = (
        pdp.participant == reader.participant
        and pdp.protocol == _SIMPLE
        and (pdp.simple_edp, pdp.static_edp) == (1, 0)
        and 0 < pdp.announcement_period.seconds <= pdp.lease.seconds
        and all(each.nanoseconds < 10**9 for each in (pdp.announcement_period, pdp.initial_period))
        and pdp.simple_edp_settings[0] == pdp.simple_edp_settings[1] == 1
        and not any(pdp.factory)
        and (pdp.sync_period.seconds, pdp.sync_period.nanoseconds) == (0, 450_000_000)
    )
    return pdp if is_known else None


@functools.lru_cache(maxsize=1)
def _functions() -> tuple[Any, int] | None:
    """Return what tells a reader's listener, and PDPSimple's table of virtual functions.

    None where the libraries are others.
    """
    pointer = ctypes.c_void_p
    found = fast_dds_function(f"_ZNK{RTPS}10RTPSReader11getListenerEv", pointer, pointer)
    virtual = virtual_functions(f"_ZTVN{RTPS}9PDPSimpleE")
    others = (
        _announce(),
        _announcing("31stopRTPSParticipantAnnouncementEv"),
        _announcing("32resetRTPSParticipantAnnouncementEv"),
    )
    if virtual is None or None in (found, *others):
        return None
    return found, virtual


def _announce() -> Any:
    """Return PDPSimple::announceParticipantState(new_change, dispose)."""
    symbol = f"_ZN{RTPS}9PDPSimple24announceParticipantStateEbb"
    return fast_dds_function(symbol, None, ctypes.c_void_p, ctypes.c_bool, ctypes.c_bool)


def _announcing(name: str) -> Any:
    """Return a function of RTPSParticipantImpl without arguments."""
    return fast_dds_function(_IMPL + name, None, ctypes.c_void_p)
