"""Options of `lifecycle up`, and the result of a run.

Owns: `Until`, `UpOptions`, `UpResult`, and which processes belong to this machine. Must not import
rclpy.
"""

from __future__ import annotations

import enum
import ipaddress
from collections.abc import Iterable
from typing import TYPE_CHECKING

import msgspec
from msgspec.structs import replace

from lifecycle.errors import ExitCode, UsageError
from lifecycle.manifest.model import Machine, Manifest
from lifecycle.network.connection_url import Peer, parse
from lifecycle.plan.media import urls_of
from lifecycle.plan.model import ParticipantConnections, Plan, PlannedProcess
from lifecycle.verify.observation import NodeConfiguration
from lifecycle.verify.verdict import Verdict
from lifecycle.verify.view import only_shared_memory

if TYPE_CHECKING:
    from lifecycle.programming.target import Program


TIMEOUT_S = 30.0
"""For a bring-up, where no other is asked for; as long again at most for what is in the way at
the gate."""

STARTING_S = 1.0
"""More for each process to start: a node costs half a second of a processor, and two starting at
once cost more than one after the other."""


class Until(enum.Enum):
    """How far to bring a system up."""

    CONNECTED = "connected"
    VERIFIED = "verified"
    ACTIVE = "active"


class UpOptions(msgspec.Struct, frozen=True, kw_only=True):
    """How to bring a system up.

    Attributes:
        stop_after_s: hold it so long, ≥ 0; None holds an active system until it is asked to end.
        timeout_s: for everything from the first start to the system being active, > 0; None for
            one that follows the number of processes, see `bring_up_s` and `gate_s`.
        strict: what cannot be verified keeps the gate closed.
        machine: run only this machine's nodes; empty runs all whose address is local.
        keep_going: report a dead process, but do not take the others down.
        program: networks to program with the verified flows for as long as the system is active.
        adopt: take nodes that run already as they are found, and start only the others.
    """

    until: Until = Until.ACTIVE
    stop_after_s: float | None = None
    timeout_s: float | None = None
    strict: bool = False
    machine: str = ""
    keep_going: bool = False
    program: Program | None = None
    adopt: bool = False

    @property
    def hold_s(self) -> float | None:
        """Seconds for which it is held once it is up; None until it is asked to end."""
        stays = self.stop_after_s is not None or self.until is Until.ACTIVE
        return self.stop_after_s if stays else 0.0

    def bring_up_s(self, processes: int) -> float:
        """Return the seconds for all of a bring-up that starts so many processes."""
        return TIMEOUT_S + processes * STARTING_S if self.timeout_s is None else self.timeout_s

    def gate_s(self, left_s: float) -> float:
        """Return the seconds that a connected system has until it is active, of those left.

        Only with a timeout that was asked for may they all be used: what contradicts a large system
        is not to be waited for longer than in a small one.
        """
        return min(left_s, TIMEOUT_S) if self.timeout_s is None else left_s


class UpResult(msgspec.Struct, frozen=True, kw_only=True):
    """How a run ended.

    Attributes:
        plan: what the verdict is of; None for the plan that the run began with.
    """

    exit_code: ExitCode
    verdict: Verdict
    plan: Plan | None = None


def own_machines(plan: Plan | Manifest, machine: str) -> frozenset[str]:
    """Return the names of the machines whose supervisor this is; empty for nodes that name none.

    Without `machine` these are all whose address is this host's.

    Raises:
        UsageError: the plan has no such machine.
    """
    known = {each.name: each for each in plan.machines}
    if machine:
        if machine not in known:
            allowed = ", ".join(sorted(known)) or "none"
            raise UsageError(
                f"cannot run machine {machine!r}: the manifest declares no such machine; "
                f"declared: {allowed}"
            )
        return frozenset({machine})
    own: set[str] = set()
    if any(each.address for each in plan.machines):
        import psutil  # which has them where a manifest is only checked, on other platforms, too

        interfaces = psutil.net_if_addrs().values()
        own |= {each.address.partition("%")[0] for addresses in interfaces for each in addresses}

    def is_local(machine: Machine) -> bool:
        if not machine.address:
            return True
        address = ipaddress.ip_address(machine.address)
        return address.is_loopback or str(address) in own

    return frozenset({"", *(each.name for each in filter(is_local, plan.machines))})


def local_processes(plan: Plan, machine: str) -> tuple[PlannedProcess, ...]:
    """Return the processes that this supervisor starts or attaches to.

    Raises:
        UsageError: the plan has no such machine, or nothing of it is for this host.
    """
    wanted = own_machines(plan, machine)
    chosen = tuple(each for each in plan.processes if each.machine in wanted)
    if plan.processes and not chosen:
        raise UsageError(
            f"cannot find a node of {plan.system!r} that runs on this host",
            hint="name its machine: lifecycle up MANIFEST --machine NAME",
        )
    return chosen


def observer_connections(plan: Plan, machine: str = "") -> ParticipantConnections:
    """Return how the participant of a supervisor, or of an outside observer, is connected here.

    Fast DDS discovers none by shared memory once a participant has another transport too
    (NetworkFactory::getDefaultMetatrafficMulticastLocators). Where nodes have nothing else, neither
    has the observer: it sees them, and their reports prove what is on their connections.

    Raises:
        UsageError: the plan has no such machine.
    """
    own = own_machines(plan, machine)
    found = next((each for name, each in plan.observers if name in own), ParticipantConnections())
    nodes = [each.connections for each in plan.nodes if each.machine in own]
    if not any(only_shared_memory(each) for each in nodes):
        return found
    shared = tuple(
        url for url in found.urls if only_shared_memory(ParticipantConnections(urls=(url,)))
    )
    return replace(found, urls=shared or found.urls)


def onlooker_connections(
    plan: Plan, reported: Iterable[NodeConfiguration] = ()
) -> ParticipantConnections:
    """Return how an observer beside the supervisor of this host is connected.

    As that one is, but on ports that are free: replies go to wherever it asks from. By TCP nodes
    dial the supervisor, and none dials an observer beside it: it dials all that listen, also by
    what nodes reported: one that was restarted listens elsewhere than planned.
    """
    connections = observer_connections(plan)
    planned = [url for node in plan.nodes for url in urls_of(node)]
    said = [url for each in reported for report in each.connections for url in report.urls]
    listening = {
        Peer(address=url.address, port=url.port)
        for url in map(parse, [*planned, *said])
        if url.transport.is_tcp and url.port and url.address
    }
    urls = []
    for text in connections.urls:
        url = parse(text)
        if not url.transport.is_group:
            url = replace(url, port=None, metatraffic_port=None, output_port=None)
        if url.transport.is_tcp and not url.server:
            url = replace(url, peers=tuple(sorted({*url.peers, *listening})))
        urls.append(str(url))
    return replace(connections, urls=tuple(urls))
