"""Settings of the participant of an rclpy context, applied while rmw makes it.

Owns: applying a ParticipantSettings at the only moment there is, which is when the first node of a
context is constructed; keeping rmw_fastrtps from adding discovery of its own; and whether a
participant has shared memory.

For LOCALHOST rmw_fastrtps adds a shared memory and a UDP transport to whatever a profile says
(create_participant of rmw_fastrtps_shared_cpp), so a participant without shared memory has to bring
the same discovery in its own profile; for SUBNET it adds a multicast group as soon as there is a
static peer.
"""

from __future__ import annotations

import contextlib
import os
import weakref
from collections.abc import Iterator

from msgspec.structs import replace
from rclpy.context import Context
from rclpy.node import Node
from rclpy.utilities import get_default_context, get_rmw_implementation_identifier

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.factory import (
    DRAFT,
    RMW,
    default_participant,
    fast_dds_refusal,
    load_endpoint_profiles,
)
from lifecycle.middleware.fastdds.participant_profile import ParticipantSettings, profile
from lifecycle.middleware.fastdds.profiles import (
    DISCOVERY_SERVER_VARIABLE,
    PEERS_VARIABLE,
    RANGE_VARIABLE,
    default_profile,
)
from lifecycle.middleware.fastdds.sockets import check_free, check_host
from lifecycle.middleware.process.shared_memory import own_segments
from lifecycle.network.medium import RMW_DISCOVERY, TRANSPORTS_VARIABLE

_LOCALHOST_ONLY = "ROS_LOCALHOST_ONLY"
"""ROS 2 of before Jazzy has that for a range of LOCALHOST, and it counts first."""


def observer_settings(settings: ParticipantSettings, *, super_client: bool) -> ParticipantSettings:
    """Return the settings of an observer's participant: no shared memory, unless it is chosen.

    An observer needs none, and a process that is killed while it holds the mutex of a port there
    blocks each process that sends to it for 10 s at a time. It is chosen where these settings, a
    profile or the environment say what transports there are, and by another RMW.
    """
    if get_rmw_implementation_identifier() != RMW or fast_dds_refusal():
        return settings
    if settings or super_client:
        connections = replace(settings.connections, super_client=super_client)
        return replace(settings, connections=connections)
    with contextlib.suppress(MiddlewareError):  # Fast DDS ignores such a profile
        base = default_profile()
        if not (os.environ.get(TRANSPORTS_VARIABLE) or (base and base.chosen_transports)):
            return replace(settings, transports=(RMW_DISCOVERY,), announces_often=True)
    return settings


def _localhost_peers() -> tuple[str, ...] | None:
    """Return the static peers where the environment asks for LOCALHOST; None if it does not."""
    if os.environ.get(_LOCALHOST_ONLY) == "1":
        return ()
    if os.environ.get(RANGE_VARIABLE) != "LOCALHOST":
        return None
    return tuple(filter(None, os.environ.get(PEERS_VARIABLE, "").split(";")))


@contextlib.contextmanager
def discovery_by_profile(settings: ParticipantSettings) -> Iterator[None]:
    """Have rmw leave discovery to the profile of a context that is initialised in the block.

    rcl reads the range from the environment then (rcl/discovery_options.h).

    Args:
        settings: that the context's participant gets; what they leave open stays as it is.
    """
    is_left = settings.chooses_transports and _localhost_peers() is not None
    if not (settings.governs_discovery or is_left):
        yield
        return
    before = {each: os.environ.pop(each, None) for each in (RANGE_VARIABLE, _LOCALHOST_ONLY)}
    os.environ[RANGE_VARIABLE] = "SYSTEM_DEFAULT"
    try:
        yield
    finally:
        del os.environ[RANGE_VARIABLE]
        os.environ.update({name: value for name, value in before.items() if value is not None})


_SHARED_MEMORY_OF: weakref.WeakKeyDictionary[Context, bool] = weakref.WeakKeyDictionary()


def has_shared_memory(node: Node) -> bool:
    """Return whether the participant of `node` has a shared memory transport.

    Of one that was made otherwise than by this package it is what the process has: segments of Fast
    DDS in /dev/shm.
    """
    noted = _SHARED_MEMORY_OF.get(node.context)
    return bool(own_segments()) if noted is None else noted


@contextlib.contextmanager
def participant_settings(context: Context, settings: ParticipantSettings) -> Iterator[None]:
    """Give the participant of `context` these settings: construct its first node in the block.

    Participants that other contexts get inside the block have the settings as well.

    Args:
        context: initialised in `discovery_by_profile`, without a node yet; otherwise it has no
            effect.
        settings: empty ones change nothing, and need no Fast DDS.

    Raises:
        MiddlewareError: another RMW than rmw_fastrtps_cpp, an unknown version of it, a default
            profile that already chooses transports, or URLs with an address that this host has
            not, or a port that is taken; nothing was changed.
    """
    before = own_segments()
    with _applied(context, settings) if settings else contextlib.nullcontext():
        yield
    # Not by a subscription, whose list has it: one that is announced and taken back while others
    # discover the participant may cost another participant of the process its subscriptions.
    opened = not own_segments() <= before
    # Of the default context others may have made the participant, with what was there before.
    is_ours = context is not get_default_context() or not before
    if get_rmw_implementation_identifier() == RMW and (opened or is_ours):
        _SHARED_MEMORY_OF.setdefault(context, opened)


@contextlib.contextmanager
def _applied(context: Context, settings: ParticipantSettings) -> Iterator[None]:
    rmw = get_rmw_implementation_identifier()
    if rmw != RMW:
        raise MiddlewareError(
            f"cannot choose the transports of a participant with RMW {rmw!r}",
            hint=f"set RMW_IMPLEMENTATION={RMW}",
        )
    if settings.urls:
        server = os.environ.get(DISCOVERY_SERVER_VARIABLE, "")
        if server and not any(url.server for url in settings.urls):
            raise MiddlewareError(
                f"cannot connect by {str(settings.urls[0])!r}: {DISCOVERY_SERVER_VARIABLE}="
                f"{server!r} makes every participant a client of that server",
                hint=f"unset {DISCOVERY_SERVER_VARIABLE}, or name the server in the URL, "
                "server=ADDRESS:PORT",
            )
        check_host(settings.urls)
    load_endpoint_profiles(settings.static_endpoints)
    is_open = settings.chooses_transports and not settings.governs_discovery
    xml = profile(
        DRAFT,
        settings,
        base=default_profile(),
        localhost_peers=_localhost_peers() if is_open else None,
        domain_id=context.get_domain_id(),
    )
    with default_participant(xml):
        # Under its lock: no other participant of ours is made in between.
        check_free(settings.urls)
        yield
