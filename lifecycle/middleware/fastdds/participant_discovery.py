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
from lifecycle.middleware.fastdds.endpoint_discovery import Duration
from lifecycle.middleware.fastdds.settings import (
    fast_dds_address,
    fast_dds_function,
    participant_of,
)
from lifecycle.middleware.rcl import abi

_IGNORE_NONE_FLAGS, _IGNORE_ALL_FLAGS = 0, 7
_SIMPLE = 1
_READER = b"\x00\x01\x00\xc7"
"""EntityId of the built-in reader of participants, DDSI-RTPS table 9.1."""

_RTPS = "8eprosima8fastrtps4rtps"
_IMPL = f"_ZN{_RTPS}19RTPSParticipantImpl"
_PREFIX_BYTES = 12
_POINTER_BYTES = ctypes.sizeof(ctypes.c_void_p)


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


class _Endpoint(ctypes.Structure):
    # Endpoint.h: what each writer and reader begins with.
    _fields_ = (
        ("virtual", ctypes.c_void_p),
        ("participant", ctypes.c_void_p),
        ("guid", ctypes.c_uint8 * 16),
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
                hint=f"start both in one environment; {abi.INSTALL}",
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
    participant = participant_of(rcl_node)
    functions = _functions() if participant else None
    if functions is None:
        return None
    guid_of, find_reader, listener_of, virtual = functions
    guid = ctypes.string_at(guid_of(participant), _PREFIX_BYTES) + _READER
    # std::shared_ptr<LocalReaderPointer>. It is not given back: 50 bytes, once in a process.
    found = (ctypes.c_void_p * 2)()
    find_reader(ctypes.byref(found), ctypes.create_string_buffer(guid, len(guid)))
    if not found[0]:
        return None
    address = _pointer_at(found[0] + _POINTER_BYTES)
    reader = _Endpoint.from_address(address) if address else None
    if reader is None or bytes(reader.guid) != guid:
        return None
    listener = listener_of(address)
    pdp_address = _pointer_at(listener + _POINTER_BYTES) if listener else None
    if not pdp_address or _pointer_at(pdp_address) != virtual:
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


def _pointer_at(address: int) -> int | None:
    value: int | None = ctypes.c_void_p.from_address(address).value
    return value


@functools.lru_cache(maxsize=1)
def _functions() -> tuple[Any, Any, Any, int] | None:
    """Return what tells GUID, reader and listener, and PDPSimple's table of virtual functions.

    None where the libraries are others.
    """
    pointer = ctypes.c_void_p
    found = (
        fast_dds_function("_ZNK8eprosima7fastdds3dds17DomainParticipant4guidEv", pointer, pointer),
        fast_dds_function(
            f"_ZN{_RTPS}14RTPSDomainImpl17find_local_readerE"
            "RSt10shared_ptrINS1_18LocalReaderPointerEERKNS1_6GUID_tE",
            *(None, pointer, pointer),
        ),
        fast_dds_function(f"_ZNK{_RTPS}10RTPSReader11getListenerEv", pointer, pointer),
    )
    table = fast_dds_address(f"_ZTVN{_RTPS}9PDPSimpleE")
    others = (
        _announce(),
        _announcing("31stopRTPSParticipantAnnouncementEv"),
        _announcing("32resetRTPSParticipantAnnouncementEv"),
    )
    if table is None or None in (*found, *others):
        return None
    # What an object points at lies behind two entries of the table, see the C++ ABI for Itanium.
    return (*found, table + 2 * _POINTER_BYTES)


def _announce() -> Any:
    """Return PDPSimple::announceParticipantState(new_change, dispose)."""
    symbol = f"_ZN{_RTPS}9PDPSimple24announceParticipantStateEbb"
    return fast_dds_function(symbol, None, ctypes.c_void_p, ctypes.c_bool, ctypes.c_bool)


def _announcing(name: str) -> Any:
    """Return a function of RTPSParticipantImpl without arguments."""
    return fast_dds_function(_IMPL + name, None, ctypes.c_void_p)
