"""Messages between a supervisor and its fork server.

Owns: the messages, each one datagram of JSON on an AF_UNIX SOCK_SEQPACKET pair, with descriptors
beside it (SCM_RIGHTS, unix(7)). Imports nothing of this room: the fork server must start fast.
"""

from __future__ import annotations

import dataclasses

LARGEST_MESSAGE = 1 << 18
"""Bytes; a request is one datagram, its argv and variables must fit."""

MSG_CMSG_CLOEXEC = 0x40000000
"""recvmsg(2): descriptors arrive close-on-exec; the socket module does not name it."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ForkRequest:
    """Supervisor → fork server, with descriptors stdout, stderr and, if `control`, the channel.

    Attributes:
        id: ≥ 1; 0 only asks whether the fork server serves, which answers with the same id.
    """

    id: int
    argv: tuple[str, ...]
    environment: tuple[tuple[str, str], ...]
    working_directory: str
    control: bool


SERVES = ForkRequest(id=0, argv=(), environment=(), working_directory="", control=False)
"""Forks nothing, see ForkRequest.id."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ChildReport:
    """Fork server → supervisor: a child was forked (with its pidfd), stopped, continued or ended.

    Attributes:
        id: of the ForkRequest.
        pid: of the child; 0 if it could not be forked.
        status: waitpid(2) status; None while it runs.
        error: why it could not be forked.
        stopped: a signal stopped it (True) or made it continue (False); None reports neither.
    """

    id: int
    pid: int = 0
    status: int | None = None
    error: str = ""
    stopped: bool | None = None
