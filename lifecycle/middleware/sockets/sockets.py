"""The sockets of this process that network flow endpoints stand for.

Owns: finding them by protocol, address and port among the process's descriptors (proc(5)), and what
they say of themselves. Fast DDS shows its sockets to nobody.
"""

from __future__ import annotations

import contextlib
import fcntl
import ipaddress
import os
import socket
from collections.abc import Iterator, Sequence
from pathlib import Path

from lifecycle.errors import MiddlewareError
from lifecycle.network.nfe import InternetProtocol, NetworkFlowEndpoint, TransportProtocol

_FAMILY = {InternetProtocol.IPV4: socket.AF_INET, InternetProtocol.IPV6: socket.AF_INET6}
_TYPE = {TransportProtocol.UDP: socket.SOCK_DGRAM, TransportProtocol.TCP: socket.SOCK_STREAM}


def never_wait(nfes: Sequence[NetworkFlowEndpoint]) -> bool:
    """Return whether every socket that `nfes` names is non-blocking (O_NONBLOCK, open(2)).

    Raises:
        MiddlewareError: no socket found.
    """
    with own_sockets(nfes) as sockets:
        flags = [fcntl.fcntl(each.fileno(), fcntl.F_GETFL) for each in sockets]
    return all(flag & os.O_NONBLOCK for flag in flags)


@contextlib.contextmanager
def own_sockets(nfes: Sequence[NetworkFlowEndpoint]) -> Iterator[list[socket.socket]]:
    """Yield duplicates of this process's sockets that `nfes` names; they are closed afterwards.

    Raises:
        MiddlewareError: there is none.
    """
    wanted = {
        (
            _FAMILY[nfe.internet_protocol],
            _TYPE[nfe.transport_protocol],
            _address(nfe.internet_address),
            nfe.transport_port,
        )
        for nfe in nfes
        if nfe.internet_protocol in _FAMILY and nfe.transport_protocol in _TYPE
    }
    with contextlib.ExitStack() as stack:
        found = []
        for number in socket_descriptors():
            try:
                duplicate = os.dup(number)
            except OSError:  # another thread has closed it since
                continue
            try:
                each = stack.enter_context(socket.socket(fileno=duplicate))
            except OSError:  # the number is no socket any more
                os.close(duplicate)
                continue
            if each.family in _FAMILY.values() and _key(each) in wanted:
                found.append(each)
        if not found:
            listed = ", ".join(f"{nfe.internet_address}:{nfe.transport_port}" for nfe in nfes)
            raise MiddlewareError(
                f"cannot find the sockets of this publisher among network flow endpoints "
                f"[{listed}]: it has no UDP or TCP socket in this process",
                hint="a publisher that only has shared memory cannot be marked",
            )
        yield found


def own_udp_socket(family: int, port: int) -> socket.socket | None:
    """Return a duplicate of a UDP socket of this process that has this port; None if none has.

    What is set on it is set on the original. Close it.
    """
    for number in socket_descriptors():
        with contextlib.suppress(OSError):  # closed since, or no socket any more
            duplicate = socket.socket(fileno=os.dup(number))
            same = (duplicate.family, duplicate.type) == (family, socket.SOCK_DGRAM)
            if same and duplicate.getsockname()[1] == port:
                return duplicate
            duplicate.close()
    return None


def socket_descriptors() -> list[int]:
    """Return the descriptors of this process that are sockets."""
    numbers = []
    for entry in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            if str(entry.readlink()).startswith("socket:"):
                numbers.append(int(entry.name))
    return numbers


def _key(each: socket.socket) -> tuple[int, int, str, int]:
    address = each.getsockname()
    return each.family, each.type, _address(address[0]), address[1]


def _address(text: str) -> str:
    try:
        # A scope (fe80::1%eth0) tells interfaces apart; rmw leaves it out.
        return str(ipaddress.ip_address(text.partition("%")[0]))
    except ValueError:
        return text


def where(each: socket.socket) -> str:
    """Return a socket's own address for messages, `0.0.0.0:7411`."""
    address = each.getsockname()
    return f"{address[0]}:{address[1]}"
