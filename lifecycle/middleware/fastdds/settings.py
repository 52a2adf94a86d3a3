"""Settings of a participant, applied to the one that a context is about to get.

Owns: bringing a ParticipantSettings into force at the only moment there is: while rmw_fastrtps
makes the participant, which is when the first node of a context is constructed.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Iterator

from rclpy.context import Context
from rclpy.utilities import get_rmw_implementation_identifier

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.discovery.discovery_range import system_default, without_localhost
from lifecycle.middleware.fastdds import default_qos
from lifecycle.middleware.fastdds.participant_profile import (
    ParticipantSettings,
    default_profile,
    profile,
)
from lifecycle.middleware.fastdds.static_discovery import endpoint_profiles
from lifecycle.middleware.sockets.url_check import (
    check_free,
    check_host,
    check_sockets,
    open_sockets,
)

_RMW = "rmw_fastrtps_cpp"
_SERVER_VARIABLE = "ROS_DISCOVERY_SERVER"


@contextlib.contextmanager
def participant_settings(context: Context, settings: ParticipantSettings) -> Iterator[None]:
    """Give the participant of `context` these settings: construct its first node in the block.

    Everything is as before after the block, and later participants get what they always got.
    Participants that other contexts get inside the block have the settings as well.

    Args:
        context: initialised, without a node yet; otherwise nothing comes of it.
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
        # Under the lock of the default profile: no participant of ours comes in between.
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
