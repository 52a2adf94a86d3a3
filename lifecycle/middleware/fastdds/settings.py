"""Participant settings and discovery range of an rclpy context, applied while rmw makes it.

Owns: applying a ParticipantSettings at the only moment there is: while rmw_fastrtps makes the
participant, which is when the first node of a context is constructed; and keeping rmw_fastrtps from
adding discovery of its own to it.

For LOCALHOST rmw_fastrtps adds a shared memory and a UDP transport to whatever a profile says
(create_participant of rmw_fastrtps_shared_cpp), so a participant without shared memory has to bring
the same discovery in its own profile; for SUBNET it adds a multicast group as soon as there is a
static peer.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import weakref
from collections.abc import Iterator

from rclpy.context import Context
from rclpy.utilities import get_rmw_implementation_identifier

from lifecycle import dataclasses
from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.factory import (
    RMW,
    default_participant,
    fast_dds_refusal,
    load_endpoint_profiles,
    load_profile,
)
from lifecycle.middleware.fastdds.participant_profile import (
    DISCOVERY_SERVER_VARIABLE,
    ParticipantSettings,
    default_profile,
    profile,
    without_shared_memory,
)
from lifecycle.middleware.fastdds.sockets import (
    check_free,
    check_host,
    check_sockets,
    open_sockets,
)
from lifecycle.middleware.process.shared_memory import own_segments
from lifecycle.middleware.rcl import abi


def unknown_versions() -> str:
    """Return which of the libraries here are not known, and what that costs; empty if all are.

    It needs rclpy, and loads nothing that rclpy has not loaded.
    """
    unknown = []
    if refusal := abi.refusal():
        unknown.append(
            f"{refusal}: nodes, endpoints and states are "
            "verified; network flow endpoints cannot be read or made unique, so that what requires "
            "them is unverifiable or refused"
        )
    if refusal := fast_dds_refusal():
        unknown.append(
            f"{refusal}: participants get no connections, transports or DSCP of their own"
        )
    return "; ".join(unknown)


def observer_settings(settings: ParticipantSettings, *, super_client: bool) -> ParticipantSettings:
    """Return the settings of an observer's participant: no shared memory, unless it is chosen.

    Args:
        settings: what it needs otherwise.
        super_client: it is to be, see ParticipantSettings.

    Returns:
        `settings`, where they, a profile or the environment say what transports it has, and with
        another RMW or an unknown version of Fast DDS.
    """
    if get_rmw_implementation_identifier() != RMW or fast_dds_refusal():
        return settings
    try:
        if settings or super_client:
            return dataclasses.replace(settings, super_client=super_client)
        transports = without_shared_memory(os.environ)
        return dataclasses.replace(
            settings, transports=transports, announces_often=bool(transports)
        )
    except MiddlewareError:
        # An error of a profile is reported where the profile is needed; Fast DDS ignores it.
        return settings


_RANGE, _PEERS = "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS"
_LOCALHOST_ONLY = "ROS_LOCALHOST_ONLY"
"""ROS 2 of before Jazzy has that for a range of LOCALHOST, and it counts first."""


def _localhost_peers() -> tuple[str, ...] | None:
    """Return the static peers where the environment asks for LOCALHOST; None if it does not."""
    if os.environ.get(_LOCALHOST_ONLY) == "1":
        return ()
    if os.environ.get(_RANGE) != "LOCALHOST":
        return None
    return tuple(filter(None, os.environ.get(_PEERS, "").split(";")))


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
    before = {each: os.environ.pop(each, None) for each in (_RANGE, _LOCALHOST_ONLY)}
    os.environ[_RANGE] = "SYSTEM_DEFAULT"
    try:
        yield
    finally:
        del os.environ[_RANGE]
        os.environ.update({name: value for name, value in before.items() if value is not None})


_SHARED_MEMORY_OF: weakref.WeakKeyDictionary[Context, bool] = weakref.WeakKeyDictionary()


def noted_shared_memory(context: Context) -> bool | None:
    """Return whether the participant of a context has it, where that was seen when it was made."""
    return _SHARED_MEMORY_OF.get(context)


@contextlib.contextmanager
def noting_shared_memory(context: Context, *, is_new: bool) -> Iterator[None]:
    """Note whether the participant of a context has it, which is made in the block and no other.

    Where that cannot be seen nothing is noted: nothing was opened, and the participant may have
    been there, beside others.

    Args:
        context: of the next node.
        is_new: it has no participant yet.

    To ask for it costs a subscription, which is announced and taken back while others discover the
    participant; then another one in the same process may lack all its subscriptions for good.
    """
    before = own_segments()
    yield
    if get_rmw_implementation_identifier() == RMW:
        opened = not own_segments() <= before
        if opened or is_new or not before:
            _SHARED_MEMORY_OF[context] = opened


_DRAFT = "lifecycle_draft_of_a_profile"


@contextlib.contextmanager
def participant_settings(context: Context, settings: ParticipantSettings) -> Iterator[None]:
    """Give the participant of `context` these settings: construct its first node in the block.

    Everything is as before after the block, and later participants get what they always got.
    Participants that other contexts get inside the block have the settings as well.

    Args:
        context: initialised in `discovery_by_profile`, without a node yet; otherwise it has no
            effect.
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
    if rmw != RMW:
        raise MiddlewareError(
            f"cannot choose the transports of a participant with RMW {rmw!r}",
            hint=f"set RMW_IMPLEMENTATION={RMW}",
        )
    if settings.urls:
        _check_environment(settings)
        check_host(settings.urls)
    domain_id = context.get_domain_id()
    with contextlib.ExitStack() as stack:
        is_open = settings.chooses_transports and not settings.governs_discovery
        peers = _localhost_peers() if is_open else None
        if settings.static_participants:
            load_endpoint_profiles(settings.static_endpoints)
        base = default_profile()
        # The name says what is in it: equal profiles are loaded once.
        draft = profile(_DRAFT, settings, base=base, localhost_peers=peers, domain_id=domain_id)
        name = f"lifecycle_{hashlib.sha256(draft.encode()).hexdigest()[:16]}"
        load_profile(name, draft.replace(_DRAFT, name))
        stack.enter_context(default_participant(name))
        if not settings.urls:
            yield
            return
        # Under the lock of the default profile: no participant of ours is made in between.
        check_free(settings.urls)
        before = {each.inode for each in open_sockets()}
        yield
        opened = [each for each in open_sockets() if each.inode not in before]
        check_sockets(settings.urls, opened)


def _check_environment(settings: ParticipantSettings) -> None:
    server = os.environ.get(DISCOVERY_SERVER_VARIABLE, "")
    if server and not any(url.server for url in settings.urls):
        raise MiddlewareError(
            f"cannot connect by {str(settings.urls[0])!r}: {DISCOVERY_SERVER_VARIABLE}={server!r} "
            "makes every participant a client of that server",
            hint=f"unset {DISCOVERY_SERVER_VARIABLE}, or name the server in the URL, "
            "server=ADDRESS:PORT",
        )
