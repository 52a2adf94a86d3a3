"""Shows other processes of this machine which participants are those of nodes in our hosts.

Owns: one abstract Unix socket (unix(7)) for each process whose nodes report their configuration,
named by what the GUIDs of its participants begin with. Anybody can serve `~/get_configuration`;
only the process that bears this prefix holds its socket. It ends with the process, and leaves no
file. A program of this machine that sets out to pass for one of ours can bind such a name, too; one
on another machine, or in another network namespace, cannot.
"""

from __future__ import annotations

import contextlib
import socket

from lifecycle.middleware.discovery.prefixes import PROCESS_DIGITS

_held: dict[str, socket.socket] = {}


def vouch_for(prefix: str) -> None:
    """Show that a participant of this process is that of a node in our host; again is harmless.

    Args:
        prefix: of its GUID, 24 hex digits; nothing is done without one.
    """
    name = _name(prefix)
    if not prefix or name in _held:
        return
    held = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        held.bind(name)
    except OSError:  # no Unix sockets here, or the name is taken: then nothing is shown
        held.close()
    else:
        _held[name] = held


def is_vouched_for(prefix: str) -> bool:
    """Return whether a process of this machine says so of a participant.

    Args:
        prefix: of its GUID, 24 hex digits.
    """
    with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)) as asking:
        return asking.connect_ex(_name(prefix)) == 0


def _name(prefix: str) -> str:
    return f"\0lifecycle-host-{prefix[:PROCESS_DIGITS]}"
