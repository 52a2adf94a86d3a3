"""The built-in readers of a participant of this process, by which Fast DDS discovers others.

Owns: a participant's GUID prefix, finding a reader by its entity id (DDSI-RTPS table 9.1), and
whether it is what it should be.
"""

from __future__ import annotations

import ctypes
import functools
from typing import Any

from rclpy.utilities import get_rmw_implementation_identifier

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.factory import RMW, fast_dds_function, shared_library
from lifecycle.middleware.rcl import abi

RTPS = "8eprosima8fastrtps4rtps"
POINTER_BYTES = ctypes.sizeof(ctypes.c_void_p)
PREFIX_BYTES = 12


class Endpoint(ctypes.Structure):
    """Endpoint.h: what each writer and reader begins with.

    Attributes:
        virtual: address of its table of virtual functions, see `virtual_functions`.
        participant: address of its RTPSParticipantImpl.
        guid: of its own.
    """

    _fields_ = (
        ("virtual", ctypes.c_void_p),
        ("participant", ctypes.c_void_p),
        ("guid", ctypes.c_uint8 * 16),
    )


def builtin_reader(rcl_node: int, entity: bytes) -> Endpoint | None:
    """Return a built-in reader of the participant of a node, in Fast DDS's own memory.

    Args:
        rcl_node: address of the rcl_node_t.
        entity: its EntityId.

    Returns:
        None with another RMW or another version, and where there is no such reader.
    """
    participant = participant_of(rcl_node)
    find_reader = _find_reader() if participant else None
    prefix = guid_prefix(participant) if participant else b""
    if find_reader is None or not prefix:
        return None
    guid = prefix + entity
    # std::shared_ptr<LocalReaderPointer>. It is not given back: 50 bytes, once in a process.
    found = (ctypes.c_void_p * 2)()
    find_reader(ctypes.byref(found), ctypes.create_string_buffer(guid, len(guid)))
    if not found[0]:
        return None
    address = pointer_at(found[0] + POINTER_BYTES)
    reader = Endpoint.from_address(address) if address else None
    return reader if reader is not None and bytes(reader.guid) == guid else None


def guid_prefix(participant: int) -> bytes:
    """Return the GUID prefix of a DomainParticipant by its address; empty with other libraries."""
    guid_of = _guid_of()
    return b"" if guid_of is None else ctypes.string_at(guid_of(participant), PREFIX_BYTES)


def pointer_at(address: int) -> int | None:
    """Return the pointer that is stored there."""
    value: int | None = ctypes.c_void_p.from_address(address).value
    return value


def virtual_functions(symbol: str) -> int | None:
    """Return what an object of a class points at, by its table's symbol; None if there is none.

    That lies behind two entries of the table, see the C++ ABI for Itanium.
    """
    table = fast_dds_address(symbol)
    return None if table is None else table + 2 * POINTER_BYTES


@functools.lru_cache(maxsize=1)
def _guid_of() -> Any:
    pointer = ctypes.c_void_p
    symbol = "_ZNK8eprosima7fastdds3dds17DomainParticipant4guidEv"
    return fast_dds_function(symbol, pointer, pointer)


@functools.lru_cache(maxsize=1)
def _find_reader() -> Any:
    pointer = ctypes.c_void_p
    return fast_dds_function(
        f"_ZN{RTPS}14RTPSDomainImpl17find_local_readerE"
        "RSt10shared_ptrINS1_18LocalReaderPointerEERKNS1_6GUID_tE",
        *(None, pointer, pointer),
    )


_PARTICIPANT_OF = "_ZN16rmw_fastrtps_cpp22get_domain_participantEP10rmw_node_s"


def participant_of(rcl_node: int) -> int | None:
    """Return the address of the DomainParticipant of a node; None where the libraries are others.

    Args:
        rcl_node: address of the rcl_node_t.
    """
    functions = _node_functions()
    if functions is None:
        return None
    rmw_handle, domain_participant = functions
    found: int | None = domain_participant(rmw_handle(rcl_node))
    return found


@functools.lru_cache(maxsize=1)
def _node_functions() -> tuple[Any, Any] | None:
    """Return rcl_node_get_rmw_handle and rmw_fastrtps_cpp's get_domain_participant, if they are."""
    if not abi.is_known() or get_rmw_implementation_identifier() != RMW:
        return None
    pointer = ctypes.c_void_p
    try:
        return (
            abi.bind("rcl", "rcl_node_get_rmw_handle", pointer, (pointer,)),
            abi.bind(RMW, _PARTICIPANT_OF, pointer, (pointer,)),
        )
    except MiddlewareError:
        return None


def fast_dds_address(symbol: str) -> int | None:
    """Return where a variable of libfastrtps 2.14 is, by its mangled name; None if there is none.

    As for `fast_dds_function`.
    """
    try:
        return ctypes.addressof(ctypes.c_char.in_dll(shared_library(), symbol))
    except (OSError, ValueError):
        return None
