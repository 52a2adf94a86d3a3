"""What a plan asks of its machines: participants and the UDP ports they will ask for.

Owns: counting the participants of each machine. Pure. The ports are those of the formula; a busy
one is replaced when it is taken, so the real ones are read from the running system.
"""

from __future__ import annotations

import dataclasses

from lifecycle.manifest.model import EndpointKind, RunKind
from lifecycle.network.connection_url import ConnectionTransport, parse
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.network.ports import participant_ports
from lifecycle.plan.model import Plan, PlannedNode, PlannedProcess

SUPERVISOR = "supervisor"
"""Owner of a machine's first participant: the observer that exists before any process starts."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ParticipantDemand:
    """One participant that a machine must hold.

    Attributes:
        owner: the process it belongs to, with the transports where these are prescribed, or the
            full name of its hidden node.
        index: participant id if participants start in plan order on an otherwise empty machine.
        discovery_port: metatraffic unicast port, as planned, else by the formula; 0 when that has
            none left, and where shared memory alone needs none.
        user_port: user unicast port; 0 likewise. TCP has one port for both.
        shared_memory: it has nothing else.
    """

    owner: str
    index: int
    discovery_port: int
    user_port: int
    shared_memory: bool = False


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class MachineDemand:
    """What one machine must hold.

    Attributes:
        machine: its name; several, joined by commas, when they have one address and so are one.
        unique_subscriptions: subscriptions that ask for a UDP port of their own.
    """

    machine: str
    participants: tuple[ParticipantDemand, ...]
    unique_subscriptions: int


def demand(plan: Plan) -> tuple[MachineDemand, ...]:
    """Count participants machine by machine, in the order in which processes name them.

    A process in our host has one participant for all its nodes whose transports are the same, and
    one for each planned extra; a process that others start is counted with one, the least it can
    have.
    """
    addresses = {each.name: each.address for each in plan.machines}
    names: dict[str, dict[str, None]] = {}
    hosts: dict[str, list[tuple[str, tuple[str, ...]]]] = {}
    unique: dict[str, int] = {}
    for process in plan.processes:
        host = addresses.get(process.machine, "")
        names.setdefault(host, {})[process.machine] = None
        if host not in hosts:
            known = {addresses.get(machine, ""): each for machine, each in plan.observers}
            observer = known.get(host)
            hosts[host] = [(SUPERVISOR, observer.urls if observer else ())]
        owners = hosts[host]
        nodes = [plan.node(key) for key in process.nodes]
        owners += dict.fromkeys((_owner(process, node), node.connections.urls) for node in nodes)
        for node in nodes:
            owners += [
                (f"{node.namespace.rstrip('/')}/{each.name}", each.connections.urls)
                for each in node.participants
            ]
            unique[host] = unique.get(host, 0) + sum(
                process.run.kind is RunKind.PYTHON
                and each.kind is EndpointKind.SUBSCRIPTION
                and each.unique
                in (UniqueRequirement.STRICTLY_REQUIRED, UniqueRequirement.OPTIONALLY_REQUIRED)
                for each in node.endpoints
            )
    return tuple(
        MachineDemand(
            machine=", ".join(filter(None, names[host])),
            participants=tuple(
                _participant(plan.domain_id, index, owner, urls)
                for index, (owner, urls) in enumerate(owners)
            ),
            unique_subscriptions=unique.get(host, 0),
        )
        for host, owners in hosts.items()
    )


def _owner(process: PlannedProcess, node: PlannedNode) -> str:
    """Name the participant that a node shares with those of its process that are like it."""
    facts = [*node.transports]
    if node.max_datagram_bytes is not None:
        facts.append(f"{node.max_datagram_bytes} bytes")
    return f"{process.name} ({', '.join(facts)})" if facts else process.name


def _participant(
    domain_id: int, index: int, owner: str, urls: tuple[str, ...]
) -> ParticipantDemand:
    parsed = [parse(text) for text in urls]
    # A group's port is the group's, not the participant's.
    fixed = [each for each in parsed if each.transport is not ConnectionTransport.UDPM]
    if parsed and all(each.transport is ConnectionTransport.SHM for each in parsed):
        return ParticipantDemand(
            owner=owner, index=index, discovery_port=0, user_port=0, shared_memory=True
        )
    told = next((each for each in fixed if each.metatraffic_port or each.port), None)
    if told is not None:
        port = told.port or 0
        discovery = told.metatraffic_port or port
        return ParticipantDemand(
            owner=owner, index=index, discovery_port=discovery, user_port=port or discovery
        )
    try:
        ports = participant_ports(domain_id, index)
    except ValueError:  # beyond 65535; `lifecycle check` explains, here the gap is shown
        return ParticipantDemand(owner=owner, index=index, discovery_port=0, user_port=0)
    return ParticipantDemand(
        owner=owner,
        index=index,
        discovery_port=ports.discovery_unicast,
        user_port=ports.user_unicast,
    )
