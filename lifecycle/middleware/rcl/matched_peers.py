"""Which remote endpoints a publisher or subscription is matched with, by GUID (Fast DDS 2.14).

Owns: the question that rmw has no function for: `rmw_*_count_matched_*` gives a number, and the
matched event the number's changes. Fast DDS itself answers it for one peer at a time
(RTPSWriter::matched_reader_is_matched, RTPSReader::matched_writer_is_matched), so it is queried for
every endpoint of the other side that the participant has discovered. Both are called by mangled
name through ctypes, on objects that are found by GUID and recognised by GUID and vtable before.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Iterable
from typing import Any

from rclpy.publisher import Publisher
from rclpy.subscription import Subscription

from lifecycle.middleware.rcl import abi

_FASTDDS = "libfastrtps.so.2.14"
_RTPS = "8eprosima8fastrtps4rtps"
_GUID = "6GUID_tE"
_GUID_BYTES = 16
_GUID_AT = 16
"""Endpoint: a vtable, the participant, then m_guid."""

_READER_AT = (8, 16)
"""LocalReaderPointer: a vtable, then the reader and a counter; which is first is looked at."""

_LEAST_ADDRESS = 1 << 16
_VTABLE_HEADER_BYTES = 16
"""Offset to top and type information come before what objects point at (Itanium C++ ABI §2.5.2)."""

_MATCHES = (
    ("14StatefulWriter", "14StatefulWriter25matched_reader_is_matched"),
    ("24StatefulPersistentWriter", "14StatefulWriter25matched_reader_is_matched"),
    ("15StatelessWriter", "15StatelessWriter25matched_reader_is_matched"),
    ("25StatelessPersistentWriter", "15StatelessWriter25matched_reader_is_matched"),
    ("14StatefulReader", "14StatefulReader25matched_writer_is_matched"),
    ("24StatefulPersistentReader", "14StatefulReader25matched_writer_is_matched"),
    ("15StatelessReader", "15StatelessReader25matched_writer_is_matched"),
    ("25StatelessPersistentReader", "15StatelessReader25matched_writer_is_matched"),
)
"""Classes of Fast DDS and the method that answers for each."""


def guid_of(entity: Publisher | Subscription) -> str:
    """Return the GUID of a publisher or subscription in hex; empty where it is unknown.

    Raises:
        rclpy.exceptions.InvalidHandle: the entity was destroyed.
    """
    library = _library()
    if library is None:
        return ""
    with entity.handle:
        return library.guid(entity).hex()


def matched_with(
    entity: Publisher | Subscription, candidates: Iterable[str]
) -> tuple[str, ...] | None:
    """Return those of `candidates` that `entity` is matched with, sorted.

    Args:
        entity: of this process; it must not be destroyed meanwhile in another thread.
        candidates: GUIDs in hex, 32 digits, of endpoints of the other side of its topic.

    Returns:
        None where this is unknown: another RMW, another Fast DDS.

    Raises:
        rclpy.exceptions.InvalidHandle: the entity was destroyed.
    """
    library = _library()
    if library is None:
        return None
    with entity.handle:
        return library.matched(entity, candidates)


class _MatchLibrary:
    """The functions, bound; get it from `_library`."""

    def __init__(self) -> None:
        pointer = ctypes.c_void_p
        fastdds, rmw = ctypes.CDLL(_FASTDDS), ctypes.CDLL("librmw_fastrtps_cpp.so")
        rcl = ctypes.CDLL("librcl.so")

        def bind(library: ctypes.CDLL, symbol: str, result: Any, *arguments: Any) -> Any:
            function = getattr(library, symbol)
            function.restype, function.argtypes = result, arguments
            return function

        dds = "8eprosima7fastdds3dds"
        self._endpoints = {
            Publisher: (
                bind(rcl, "rcl_publisher_get_rmw_handle", pointer, pointer),
                bind(
                    rmw, "_ZN16rmw_fastrtps_cpp14get_datawriterEP15rmw_publisher_s", *(pointer,) * 2
                ),
                bind(fastdds, f"_ZNK{dds}10DataWriter4guidEv", pointer, pointer),
            ),
            Subscription: (
                bind(rcl, "rcl_subscription_get_rmw_handle", pointer, pointer),
                bind(
                    rmw,
                    "_ZN16rmw_fastrtps_cpp14get_datareaderEP18rmw_subscription_s",
                    *(pointer,) * 2,
                ),
                bind(fastdds, f"_ZNK{dds}10DataReader4guidEv", pointer, pointer),
            ),
        }
        domain = f"_ZN{_RTPS}14RTPSDomainImpl17find_local_"
        self._find_writer = bind(fastdds, f"{domain}writerERKNS1_{_GUID}", pointer, pointer)
        self._find_reader = bind(
            fastdds,
            f"{domain}readerERSt10shared_ptrINS1_18LocalReaderPointerEERKNS1_{_GUID}",
            *(None, pointer, pointer),
        )
        self._methods = {
            _address(fastdds, f"_ZTVN{_RTPS}{class_}E") + _VTABLE_HEADER_BYTES: bind(
                fastdds, f"_ZN{_RTPS}{method}ERKNS1_{_GUID}", *(ctypes.c_bool, pointer, pointer)
            )
            for class_, method in _MATCHES
        }
        # std::shared_ptr counts by it; it is the one such function that libstdc++ exports.
        self._add = bind(
            ctypes.CDLL("libstdc++.so.6"),
            "_ZN9__gnu_cxx18__exchange_and_addEPVii",
            *(ctypes.c_int, pointer, ctypes.c_int),
        )

    def guid(self, entity: Publisher | Subscription) -> bytes:
        """Return the GUID, empty if the RMW is another; the caller holds the handle."""
        kind = Publisher if isinstance(entity, Publisher) else Subscription
        rmw_handle, get_endpoint, get_guid = self._endpoints[kind]
        handle = rmw_handle(entity.handle.pointer)
        endpoint = get_endpoint(handle) if handle else None
        return ctypes.string_at(get_guid(endpoint), _GUID_BYTES) if endpoint else b""

    def matched(
        self, entity: Publisher | Subscription, candidates: Iterable[str]
    ) -> tuple[str, ...] | None:
        guid = self.guid(entity)
        if not guid:
            return None
        if isinstance(entity, Publisher):
            return self._ask(self._find_writer(guid), guid, candidates)
        shared = (ctypes.c_void_p * 2)()
        self._find_reader(ctypes.byref(shared), guid)
        if not shared[0] or not shared[1]:
            return None
        try:
            for offset in _READER_AT:
                reader = ctypes.c_void_p.from_address(shared[0] + offset).value or 0
                if reader >= _LEAST_ADDRESS:
                    return self._ask(reader, guid, candidates)
            return None
        finally:
            # The reader, which the caller's handle keeps, has the other reference.
            self._add(shared[1] + ctypes.sizeof(ctypes.c_void_p), -1)

    def _ask(
        self, endpoint: int | None, guid: bytes, candidates: Iterable[str]
    ) -> tuple[str, ...] | None:
        if not endpoint or ctypes.string_at(endpoint + _GUID_AT, _GUID_BYTES) != guid:
            return None
        method = self._methods.get(ctypes.c_void_p.from_address(endpoint).value or 0)
        if method is None:
            return None
        return tuple(sorted(each for each in candidates if method(endpoint, bytes.fromhex(each))))


def load_library() -> None:
    """Load what is asked through, for a process that forks others."""
    _library()


@functools.lru_cache(maxsize=1)
def _library() -> _MatchLibrary | None:
    """Return the functions; None where the libraries are others."""
    if not abi.is_known():
        return None
    try:
        return _MatchLibrary()
    except (OSError, AttributeError, ValueError):
        return None


def _address(library: ctypes.CDLL, symbol: str) -> int:
    return ctypes.addressof(ctypes.c_char.in_dll(library, symbol))
