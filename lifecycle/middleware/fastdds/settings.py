"""Participant settings and discovery range of an rclpy context, applied while rmw makes it.

Owns: applying a ParticipantSettings at the only moment there is: while rmw_fastrtps makes the
participant, which is when the first node of a context is constructed; and reading how far that
participant looks for others (the discovery range that rmw gets), and taking it away from
rmw_fastrtps.

For LOCALHOST it adds a shared memory and a UDP transport to whatever a profile says
(create_participant of rmw_fastrtps_shared_cpp), so a participant without shared memory has to bring
the same discovery in its own profile; for SUBNET it adds a multicast group as soon as there is a
static peer. Layouts are those of rmw 7: rmw/{init,init_options,discovery_options}.h.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
from collections.abc import Iterator
from typing import Any

from rclpy.context import Context
from rclpy.utilities import get_rmw_implementation_identifier

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds import default_qos
from lifecycle.middleware.fastdds.participant_profile import (
    ParticipantSettings,
    default_profile,
    endpoint_profiles,
    profile,
)
from lifecycle.middleware.rcl import abi
from lifecycle.middleware.sockets.url_check import (
    check_free,
    check_host,
    check_sockets,
    open_sockets,
)

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


_RMW = "rmw_fastrtps_cpp"
_SERVER_VARIABLE = "ROS_DISCOVERY_SERVER"


@contextlib.contextmanager
def participant_settings(context: Context, settings: ParticipantSettings) -> Iterator[None]:
    """Give the participant of `context` these settings: construct its first node in the block.

    Everything is as before after the block, and later participants get what they always got.
    Participants that other contexts get inside the block have the settings as well.

    Args:
        context: initialised, without a node yet; otherwise it has no effect.
        settings: empty ones change nothing, and need no Fast DDS.

    Raises:
        MiddlewareError: another RMW than rmw_fastrtps_cpp, an unknown version of it, a default
            profile that already chooses transports, or URLs with an address that this host has
            not; nothing was changed. At the end of the block: the participant has not got the
            ports of its URLs; its node is the caller's to destroy.
    """
    if not settings:
        yield
        return
    rmw = get_rmw_implementation_identifier()
    if rmw != _RMW:
        raise MiddlewareError(
            f"cannot choose the transports of a participant with RMW {rmw!r}",
            hint=f"set RMW_IMPLEMENTATION={_RMW}",
        )
    if settings.urls:
        _check_environment(settings)
        check_host(settings.urls)
    domain_id = context.get_domain_id()
    with contextlib.ExitStack() as stack:
        peers = None
        if settings.governs_discovery:
            stack.enter_context(system_default(context))
        elif settings.chooses_transports:
            peers = stack.enter_context(without_localhost(context))
        if settings.static_participants:
            # The participant's own endpoints, of the graph topic, are made with it.
            own = endpoint_profiles(settings.static_endpoints)
            stack.enter_context(default_qos.endpoint_profiles(own))
        base = default_profile()
        # The name says what is in it: equal profiles are loaded once.
        draft = profile("draft", settings, base=base, localhost_peers=peers, domain_id=domain_id)
        name = f"lifecycle_{hashlib.sha256(draft.encode()).hexdigest()[:16]}"
        xml = profile(name, settings, base=base, localhost_peers=peers, domain_id=domain_id)
        default_qos.load_profile(name, xml)
        stack.enter_context(default_qos.default_participant(name))
        if not settings.urls:
            yield
            return
        # Under the lock of the default profile: no participant of ours is made in between.
        check_free(settings.urls)
        before = {each.inode for each in open_sockets()}
        yield
        check_sockets(settings.urls, [s for s in open_sockets() if s.inode not in before])


def _check_environment(settings: ParticipantSettings) -> None:
    server = os.environ.get(_SERVER_VARIABLE, "")
    if server and not any(url.server for url in settings.urls):
        raise MiddlewareError(
            f"cannot connect by {str(settings.urls[0])!r}: {_SERVER_VARIABLE}={server!r} makes "
            "every participant a client of that server",
            hint=f"unset {_SERVER_VARIABLE}, or name the server in the URL, server=ADDRESS:PORT",
        )
