"""How far a context's participant looks for others, as rmw will be told when it makes it.

Owns: reading that, and taking it out of rmw_fastrtps's hands. For LOCALHOST it adds a shared memory
and a UDP transport to whatever a profile says (create_participant of rmw_fastrtps_shared_cpp), so a
participant without shared memory has to bring the same discovery in its own profile; for SUBNET it
adds a multicast group as soon as there is a static peer. Layouts are those of rmw 7:
rmw/{init,init_options,discovery_options}.h.
"""

from __future__ import annotations

import contextlib
import ctypes
from collections.abc import Iterator
from typing import Any

from rclpy.context import Context

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.rcl import abi

_LOCALHOST = 2
_SYSTEM_DEFAULT = 4
_PEER_BYTES = 256


class _Security(ctypes.Structure):
    _fields_ = (("enforce", ctypes.c_int), ("root_path", ctypes.c_void_p))


class _Peer(ctypes.Structure):
    _fields_ = (("address", ctypes.c_char * _PEER_BYTES),)


class _Discovery(ctypes.Structure):
    # rmw_discovery_options_t
    _fields_ = (
        ("range", ctypes.c_int),
        ("peers", ctypes.POINTER(_Peer)),
        ("peers_count", ctypes.c_size_t),
        ("allocator", abi.Allocator),
    )


class _InitOptions(ctypes.Structure):
    # rmw_init_options_t
    _fields_ = (
        ("instance_id", ctypes.c_uint64),
        ("identifier", ctypes.c_void_p),
        ("domain_id", ctypes.c_size_t),
        ("security", _Security),
        ("localhost_only", ctypes.c_int),
        ("discovery", _Discovery),
        ("enclave", ctypes.c_char_p),
        ("allocator", abi.Allocator),
        ("impl", ctypes.c_void_p),
    )


class _RmwContext(ctypes.Structure):
    # rmw_context_t
    _fields_ = (
        ("instance_id", ctypes.c_uint64),
        ("identifier", ctypes.c_void_p),
        ("options", _InitOptions),
        ("domain_id", ctypes.c_size_t),
        ("impl", ctypes.c_void_p),
    )


@contextlib.contextmanager
def without_localhost(context: Context) -> Iterator[tuple[str, ...] | None]:
    """Have rmw leave discovery alone, inside the block, if it were to look on this host only.

    Args:
        context: initialised; without a node yet, or its participant exists already.

    Yields:
        The context's static peers, if it was LOCALHOST; None if nothing was changed.

    Raises:
        MiddlewareError: the installed rmw is laid out otherwise.
    """
    with context.handle:
        discovery = _discovery(context)
        if discovery.range != _LOCALHOST:
            yield None
            return
        peers = tuple(
            discovery.peers[index].address.decode() for index in range(discovery.peers_count)
        )
        with _set(discovery, _SYSTEM_DEFAULT):
            yield peers


@contextlib.contextmanager
def system_default(context: Context) -> Iterator[None]:
    """Have rmw leave discovery alone inside the block, whatever the environment asked for.

    Args:
        context: initialised; without a node yet, or its participant exists already.

    Raises:
        MiddlewareError: the installed rmw is laid out otherwise.
    """
    with context.handle, _set(_discovery(context), _SYSTEM_DEFAULT):
        yield


@contextlib.contextmanager
def _set(discovery: Any, range_: int) -> Iterator[None]:
    before = discovery.range
    discovery.range = range_
    try:
        yield
    finally:
        discovery.range = before


def _discovery(context: Context) -> Any:
    address = abi.load().rmw_context(context.handle.pointer)
    found = _RmwContext.from_address(address)
    domain_id = context.get_domain_id()
    options = found.options
    laid_out_as_known = (
        found.identifier == options.identifier
        and (found.domain_id, options.domain_id) == (domain_id, domain_id)
        and found.instance_id == options.instance_id
        and 0 < options.discovery.range <= _SYSTEM_DEFAULT
        and bytes(options.allocator) == bytes(abi.load().default_allocator)
    )
    if not laid_out_as_known:
        raise MiddlewareError(
            f"cannot use the installed rcl {abi.rcl_version() or '(version unknown)'}: its "
            f"rmw_context_t is not laid out as rcl {abi.SUPPORTED_RCL_MAJOR}'s",
            hint="install ros-jazzy-rclpy[fastrtps]",
        )
    return options.discovery
