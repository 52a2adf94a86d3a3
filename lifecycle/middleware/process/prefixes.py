"""GUID prefixes of Fast DDS: of which process a participant is, and whether that is a host of ours.

Fast DDS writes its vendor, the host, the process and a number of its own into the first 16 hex
digits (GuidPrefix_t::create); all participants of a process share them. Must not import rclpy.

Anybody can serve `~/get_configuration`. So each process whose nodes report their configuration
holds an abstract Unix socket (unix(7)) that is named by these digits. It ends with the process, and
leaves no file. A program of this machine that sets out to pass for one of ours can bind such a
name, too; one on another machine, or in another network namespace, cannot.
"""

from __future__ import annotations

import contextlib
import socket

_HOST_DIGITS = slice(4, 8)
_PID_DIGITS = slice(8, 12)
PROCESS_DIGITS = 16


def is_of_process(prefix: str, pid: int, like: str) -> bool:
    """Return whether a participant may be one of a process of this host, by its GUID prefix.

    Fast DDS keeps the lower 16 bits of a pid: False is certain, True is not.

    Args:
        prefix: 24 hex digits.
        pid: of the process.
        like: the prefix of a participant on this host.
    """
    written = (pid & 0xFFFF).to_bytes(2, "little").hex()
    return is_of_host(prefix, like) and prefix[_PID_DIGITS] == written


def is_of_host(prefix: str, like: str) -> bool:
    """Return whether a participant is one of the host of another, by their GUID prefixes."""
    return prefix[: _HOST_DIGITS.stop] == like[: _HOST_DIGITS.stop]


_held: dict[str, socket.socket] = {}


def vouch_for(prefix: str) -> None:
    """Show that a participant of this process is of a node in our host, if its prefix is known."""
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
    """Return whether a process of this machine says so of a participant, by its GUID prefix."""
    with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)) as asking:
        return asking.connect_ex(_name(prefix)) == 0


def _name(prefix: str) -> str:
    return f"\0lifecycle-host-{prefix[:PROCESS_DIGITS]}"
