"""Makes this process announce another definition of an interface than the one installed.

Owns: `redefine`, which changes the type hash (REP-2016) that the type support returns, in memory:
what a process built from another version of the package announces. Only the hash differs, so the
endpoints match on DDS by the name of the type, exactly as two real versions do.
"""

from __future__ import annotations

import ctypes
import mmap
from typing import Any

_HASH_BYTES = 32


class _TypeHash(ctypes.Structure):
    """rosidl_type_hash_t."""

    _fields_ = (("version", ctypes.c_uint8), ("value", ctypes.c_uint8 * _HASH_BYTES))


class _MessageTypeSupport(ctypes.Structure):
    """rosidl_message_type_support_t, as far as the hash."""

    _fields_ = (
        ("typesupport_identifier", ctypes.c_char_p),
        ("data", ctypes.c_void_p),
        ("func", ctypes.c_void_p),
        (
            "get_type_hash",
            ctypes.CFUNCTYPE(ctypes.POINTER(_TypeHash), ctypes.c_void_p),
        ),
    )


class _ServiceTypeSupport(ctypes.Structure):
    """rosidl_service_type_support_t, as far as the request's type support."""

    _fields_ = (
        ("typesupport_identifier", ctypes.c_char_p),
        ("data", ctypes.c_void_p),
        ("func", ctypes.c_void_p),
        ("request", ctypes.POINTER(_MessageTypeSupport)),
    )


def redefine(interface: type[Any]) -> None:
    """Change the hash of a message, of a service's request or of an action's goal, for good."""
    if hasattr(interface, "Impl"):
        interface = interface.Impl.SendGoalService
    interface.__class__.__import_type_support__()  # type: ignore[attr-defined]
    address = ctypes.pythonapi.PyCapsule_GetPointer
    address.restype, address.argtypes = ctypes.c_void_p, (ctypes.py_object, ctypes.c_char_p)
    handle = address(interface._TYPE_SUPPORT, None)
    if hasattr(interface, "Request"):
        support = _ServiceTypeSupport.from_address(handle).request.contents
    else:
        support = _MessageTypeSupport.from_address(handle)
    value = support.get_type_hash(ctypes.addressof(support)).contents
    _make_writable(ctypes.addressof(value), ctypes.sizeof(value))
    value.value[0] ^= 0xFF


def _make_writable(address: int, size: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    start = address - address % mmap.PAGESIZE
    length = address + size - start
    allowed = mmap.PROT_READ | mmap.PROT_WRITE
    if libc.mprotect(ctypes.c_void_p(start), ctypes.c_size_t(length), allowed):
        raise OSError(ctypes.get_errno(), "cannot change the type hash")
