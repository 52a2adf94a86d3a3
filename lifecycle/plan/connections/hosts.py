"""Which machines are one host, where it is reached, and which of its ports are given out.

Owns: `Hosts` and `PortPool`. Machines of one address are one host, and so are those of none, which
stand for this host. Ports are given out in a fixed order, so that equal plans have equal ports.
Pure.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence

from lifecycle.manifest.model import Machine
from lifecycle.network.ports import MAX_PORT
from lifecycle.plan.errors import PlanError

LOOPBACK = "127.0.0.1"
LOOPBACK6 = "::1"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Hosts:
    """The hosts of a system. A host is known by its address; this host's is empty if not declared.

    Attributes:
        machines: all that are declared.
        used: hosts that run something, in the order in which nodes name them.
    """

    machines: tuple[Machine, ...]
    used: tuple[str, ...]

    @classmethod
    def of(cls, machines: Sequence[Machine], names: Iterable[str]) -> Hosts:
        """Return the hosts of a system.

        Args:
            machines: as declared.
            names: machines that something runs on.
        """
        addresses = {each.name: each.address for each in machines}
        return cls(
            machines=tuple(machines),
            used=tuple(dict.fromkeys(addresses.get(name, "") for name in names)),
        )

    def host(self, machine: str) -> str:
        """Return the host of a machine; this host for one that is not declared."""
        return next((each.address for each in self.machines if each.name == machine), "")

    def names(self, host: str) -> tuple[str, ...]:
        """Return the machines that are this host."""
        return tuple(each.name for each in self.machines if each.address == host)

    @property
    def several(self) -> bool:
        """Whether the system runs on more than one host."""
        return len(self.used) > 1

    def address(self, host: str, *, ipv6: bool = False) -> str:
        """Return what others reach a host by; loopback where nobody else is.

        Args:
            host: one of `used`.
            ipv6: which loopback it is.

        Raises:
            PlanError: the host has no address, and others are to reach it.
        """
        if host or not self.several:
            return host or (LOOPBACK6 if ipv6 else LOOPBACK)
        names = ", ".join(map(repr, self.names(""))) or "this host"
        raise PlanError(
            f"cannot give fixed ports to machine {names}: it has no address, and others must reach "
            "it",
            hint="add 'address:' to it under 'machines:'",
            at=next((each.at for each in self.machines if not each.address), None),
        )


class PortPool:
    """Ports that are still free on each host, UDP and TCP alike.

    Args:
        first: the lowest that is given out, 1–65535.
        taken: by host, what is not given out.
    """

    def __init__(self, first: int, taken: Mapping[str, Iterable[int]] | None = None) -> None:
        self._first = first
        self._taken = {host: set(ports) for host, ports in (taken or {}).items()}

    def take(self, host: str, count: int = 1) -> tuple[int, ...]:
        """Give out the lowest free ports of a host.

        Raises:
            PlanError: there are none left.
        """
        taken = self._taken.setdefault(host, set())
        found: list[int] = []
        for port in range(self._first, MAX_PORT + 1):
            if len(found) == count:
                break
            if port not in taken:
                found.append(port)
        if len(found) < count:
            raise PlanError(
                f"cannot give out {count} more ports{f' on {host}' if host else ''}: from "
                f"{self._first} to {MAX_PORT} all are taken",
                hint="lower 'discovery.first_port'",
            )
        taken.update(found)
        return tuple(found)

    def take_everywhere(self, hosts: Sequence[str], first: int) -> int:
        """Give out the lowest port from `first` on that is free on all of these hosts.

        Raises:
            PlanError: there is none left.
        """
        for port in range(first, MAX_PORT + 1):
            if not any(port in self._taken.get(host, ()) for host in hosts):
                self.reserve(hosts, port)
                return port
        raise PlanError(
            f"cannot give out one more port: from {first} to {MAX_PORT} all are taken",
            hint="lower 'discovery.first_port'",
        )

    def reserve(self, hosts: Iterable[str], port: int) -> None:
        """Give a port to somebody who has chosen it."""
        for host in hosts:
            self._taken.setdefault(host, set()).add(port)
