"""Which IP sockets a process has open, asked of the kernel.

Owns: reading /proc/PID/fd and /proc/PID/net/{udp,tcp,udp6,tcp6} (proc(5)), which show the network
that the process is in.
"""

from __future__ import annotations

import contextlib
import dataclasses
import ipaddress
import struct
from pathlib import Path

_TABLES = ("udp", "tcp", "udp6", "tcp6")
_TCP_LISTEN = 0x0A  # include/net/tcp_states.h


@dataclasses.dataclass(frozen=True, kw_only=True, order=True)
class Socket:
    """One IP socket.

    Attributes:
        protocol: "udp" or "tcp".
        address: own; `0.0.0.0` for any.
        peer: `address:port` that it is connected to; empty if to none.
        listening: TCP, waiting for connections.
    """

    protocol: str
    address: str
    port: int
    peer: str = ""
    listening: bool = False


def ip_sockets(pid: int) -> list[Socket]:
    """Return every UDP and TCP socket of a process, sorted."""
    inodes = _inodes(pid)
    return sorted(
        socket for table in _TABLES for inode, socket in _table(pid, table) if inode in inodes
    )


def _inodes(pid: int) -> set[str]:
    found = set()
    for entry in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(OSError):  # closed meanwhile
            target = str(entry.readlink())
            if target.startswith("socket:["):
                found.add(target[len("socket:[") : -1])
    return found


def _table(pid: int, table: str) -> list[tuple[str, Socket]]:
    try:
        lines = Path(f"/proc/{pid}/net/{table}").read_text(encoding="ascii").splitlines()[1:]
    except FileNotFoundError:  # a kernel without IPv6
        return []
    found = []
    for line in lines:
        words = line.split()
        address, port = _place(words[1])
        peer, peer_port = _place(words[2])
        listening = table.startswith("tcp") and int(words[3], 16) == _TCP_LISTEN
        socket = Socket(
            protocol=table[:3],
            address=address,
            port=port,
            peer=f"{peer}:{peer_port}" if peer_port else "",
            listening=listening,
        )
        found.append((words[9], socket))
    return found


def _place(text: str) -> tuple[str, int]:
    """Read `0100007F:1EDC`: 32-bit words in the byte order of the machine."""
    address, _, port = text.partition(":")
    words = [int(address[at : at + 8], 16) for at in range(0, len(address), 8)]
    octets = b"".join(struct.pack("=I", word) for word in words)
    return str(ipaddress.ip_address(octets)), int(port, 16)
