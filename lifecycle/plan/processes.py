"""Operating system processes: which nodes share one, and what each is started with.

Owns: grouping nodes into processes, their argv and environment. Pure but for finding executables.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from lifecycle.manifest.model import DiscoveryRange, Node, RunKind
from lifecycle.plan.command import command_line
from lifecycle.plan.errors import PlanError
from lifecycle.plan.model import PlannedProcess


def process_name(node: Node) -> str:
    """Return the name of the node's process: as declared, else the node's key."""
    return node.process or node.key


def planned_processes(
    nodes: Sequence[Node],
    *,
    domain_id: int,
    discovery_range: DiscoveryRange,
    environment: Mapping[str, str],
    shared_memory: bool = False,
) -> tuple[PlannedProcess, ...]:
    """Group nodes by process, in the order in which the manifest first names each process.

    Args:
        nodes: in manifest order.
        domain_id: 0–232.
        discovery_range: given to every process in ROS_AUTOMATIC_DISCOVERY_RANGE, but to commands
            that have shared memory alone: rmw_fastrtps_cpp 8.4 would have them look for peers at
            127.0.0.1 only, where nobody is, and shared memory stays on this host anyway.
        shared_memory: own participants have nothing else.
        environment: where AMENT_PREFIX_PATH is looked up.

    Raises:
        PlanError: nodes of one process disagree about machine, kind, folder or a variable; two
            executables want one process; an executable cannot be found.
    """
    groups: dict[str, list[Node]] = {}
    for node in nodes:
        groups.setdefault(process_name(node), []).append(node)

    def graph_variables(kind: RunKind) -> tuple[tuple[str, str], ...]:
        near = discovery_range is DiscoveryRange.LOCALHOST and shared_memory
        reach = (
            DiscoveryRange.SYSTEM_DEFAULT if near and kind is RunKind.COMMAND else discovery_range
        )
        return (("ROS_DOMAIN_ID", str(domain_id)), ("ROS_AUTOMATIC_DISCOVERY_RANGE", reach.name))

    return tuple(
        _process(name, group, graph_variables(group[0].run.kind), environment)
        for name, group in groups.items()
    )


def _process(
    name: str,
    nodes: Sequence[Node],
    graph_variables: tuple[tuple[str, str], ...],
    environment: Mapping[str, str],
) -> PlannedProcess:
    first = nodes[0]
    for node in nodes[1:]:
        _must_agree(name, first, node)
    is_command = first.run.kind is RunKind.COMMAND
    return PlannedProcess(
        name=name,
        machine=first.machine,
        run=first.run,
        nodes=tuple(node.key for node in nodes),
        argv=command_line(first, environment) if is_command else (),
        environment=_variables(name, nodes, graph_variables),
    )


def _must_agree(process: str, first: Node, node: Node) -> None:
    """Raise PlanError unless `node` can live in the process of `first`."""
    where = f"cannot put nodes {first.key!r} and {node.key!r} into one process {process!r}"
    if node.machine != first.machine:
        raise PlanError(
            f"{where}: they stand on machines {first.machine!r} and {node.machine!r}", at=node.at
        )
    if node.run.kind is not first.run.kind:
        raise PlanError(
            f"{where}: one is run by {first.run.kind.value}, the other by {node.run.kind.value}",
            at=node.at,
        )
    if node.run.kind is RunKind.COMMAND:
        raise PlanError(
            f"{where}: a command is a process of its own; only python nodes share one", at=node.at
        )
    if node.run.working_directory != first.run.working_directory:
        raise PlanError(
            f"{where}: they want working directories {first.run.working_directory!r}"
            f" and {node.run.working_directory!r}",
            at=node.at,
        )


def _variables(
    process: str, nodes: Sequence[Node], graph_variables: tuple[tuple[str, str], ...]
) -> tuple[tuple[str, str], ...]:
    """Merge the nodes' variables over those that place the process in the graph."""
    merged: dict[str, tuple[str, str]] = {}
    for node in nodes:
        for name, value in node.run.environment:
            known, owner = merged.setdefault(name, (value, node.key))
            if known != value:
                raise PlanError(
                    f"cannot set {name} of process {process!r} to {value!r} for node {node.key!r}:"
                    f" node {owner!r} sets it to {known!r}",
                    at=node.at,
                )
    own = {name: value for name, (value, _) in merged.items()}
    return tuple({**dict(graph_variables), **own}.items())
