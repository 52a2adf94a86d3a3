"""Operating system processes: which nodes share one, command lines, environment, secrets in it.

Whatever leaves the supervisor and the processes that it starts, on a terminal, on disk or on the
network, is redacted here. Starts nothing.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence

from msgspec.structs import replace

from lifecycle.manifest.diagnostics import Diagnostic, Position, error, note
from lifecycle.manifest.installed_types import search_prefixes
from lifecycle.manifest.model import (
    DiscoveryRange,
    Node,
    ParameterValue,
    RosArguments,
    Run,
    RunKind,
)
from lifecycle.network.medium import TRANSPORTS_VARIABLE
from lifecycle.network.ports import (
    LINUX,
    LOCALHOST_PARTICIPANTS,
    LOCALHOST_PEERS_RANGE,
    describe_domains,
    max_participants,
    safe_domains,
)
from lifecycle.plan.model import Plan, PlanError, PlannedNode, PlannedProcess


def variables_of(plan: Plan) -> tuple[tuple[str, str], ...]:
    """Return what connects a process whose participant is its own code's to the control plane.

    Only what Fast DDS 2.14 reads from the environment: transports and a discovery server. With
    FASTDDS_BUILTIN_TRANSPORTS other than NONE beside a server, every sample would arrive twice.
    """
    server = plan.server
    if server is not None:
        at = f"TCPv4:[{server.address}]" if server.tcp else server.address
        return (
            ("ROS_DISCOVERY_SERVER", f"{at}:{server.port}"),
            (TRANSPORTS_VARIABLE, "NONE" if server.tcp else "UDPv4"),
        )
    value = plan.discovery.transport.builtin
    return ((TRANSPORTS_VARIABLE, value),) if value else ()


def planned_processes(
    nodes: Sequence[Node], plan: Plan, environment: Mapping[str, str]
) -> tuple[PlannedProcess, ...]:
    """Group nodes by process, in the order in which the manifest first names each process.

    Commands that have shared memory alone are not given the range LOCALHOST: rmw_fastrtps_cpp 8.4
    would have them look for peers at 127.0.0.1 only, where no peer is, and shared memory stays on
    this host anyway.

    Raises:
        PlanError: an executable cannot be found in this environment.
    """
    groups: dict[str, list[Node]] = {}
    for node in nodes:
        groups.setdefault(node.process_name, []).append(node)

    def process(name: str, group: Sequence[Node]) -> PlannedProcess:
        run = group[0].run
        is_command = run.kind is RunKind.COMMAND
        reach = plan.discovery_range
        if is_command and reach is DiscoveryRange.LOCALHOST and plan.discovery.transport.in_memory:
            reach = DiscoveryRange.SYSTEM_DEFAULT
        return PlannedProcess(
            name=name,
            machine=group[0].machine,
            run=run,
            nodes=tuple(node.key for node in group),
            argv=(*run.prefix, *command_line(group, environment)) if is_command else (),
            environment=tuple(
                {
                    **(dict(variables_of(plan)) if is_command else {}),
                    "ROS_DOMAIN_ID": str(plan.domain_id),
                    "ROS_AUTOMATIC_DISCOVERY_RANGE": reach.name,
                    **dict(run.environment),
                }.items()
            ),
        )

    return tuple(process(name, group) for name, group in groups.items())


def command_line(nodes: Sequence[Node], environment: Mapping[str, str]) -> tuple[str, ...]:
    """Return the full argv of a COMMAND process, whose nodes share one `run:`.

    It is given ROS arguments only where a key of one of its nodes asks for them. Those of a process
    with several nodes are for the one node alone; who is to be renamed is known by its key.

    Raises:
        PlanError: the package or its executable cannot be found.
    """
    run = nodes[0].run
    argv = list(run.command) or [find_executable(run, environment, at=nodes[0].at)]
    given: list[str] = []
    if run.ros_args is not RosArguments.NONE:
        given = [word for node in nodes for word in _ros_arguments(node, alone=len(nodes) == 1)]
        levels = dict.fromkeys(node.log_level for node in nodes if node.log_level)
        given += [word for level in levels for word in ("--log-level", level)]
    return tuple(argv + ["--ros-args"] * bool(given) + given)


def _ros_arguments(node: Node, *, alone: bool) -> Iterator[str]:
    """Yield what one node asks for. Files precede values, because rcl lets the later one win.

    Name and namespace are given where the manifest writes them.
    """
    old = "" if alone else f"{node.key.rpartition('/')[2]}:"
    own = "" if alone else f"{node.name}:"
    if node.where("name") is not node.at:
        yield from ("-r", f"{old}__node:={node.name}")
    if node.namespace != "/" or node.where("namespace") is not node.at:
        yield from ("-r", f"{own}__ns:={node.namespace}")
    for source, target in node.remap:
        rule = source if _NODE_PREFIX.match(source) else f"{own}{source}"
        yield from ("-r", f"{rule}:={target}")
    for file in node.parameter_files:
        yield from ("--params-file", file)
    # rcl 9.2 knows a value for one node by the name alone, and so has none for a namespace; the
    # supervisor sets these.
    for name, value in node.parameters if alone or node.namespace == "/" else ():
        if value == ():
            continue  # rcl has no empty array: `[]` takes the node's default from it
        yield from ("-p", f"{own}{name}:={parameter_text(value)}")


_NODE_PREFIX = re.compile(r"\w+:(?!//)", re.ASCII)


def find_executable(run: Run, environment: Mapping[str, str], *, at: Position) -> str:
    """Find `lib/<package>/<executable>` under the first prefix that has it, where types are found.

    Raises:
        PlanError: no prefix holds the package or the executable.
    """
    prefixes = search_prefixes(environment)
    wanted = f"executable {run.executable!r} of package {run.package!r}"
    found: set[str] = set()
    for prefix in prefixes:
        folder = prefix / "lib" / run.package
        candidate = folder / run.executable
        if os.path.isfile(candidate) and os.access(candidate, os.X_OK):
            return str(candidate)
        if os.path.isdir(folder):
            found |= {each.name for each in folder.iterdir() if os.access(each, os.X_OK)}
    if found:
        raise PlanError(f"cannot find {wanted}: the package has {', '.join(sorted(found))}", at=at)
    raise PlanError(
        f"cannot find {wanted}: no lib/{run.package} with executables under "
        f"{', '.join(map(str, prefixes))}",
        hint="build and source its workspace, or correct the package name",
        at=at,
    )


def parameter_text(value: ParameterValue) -> str:
    """Write a parameter value as the YAML that rcl reads back as the same type.

    Strings are always quoted: bare `1`, `true` or `1.0` would change type.
    """
    if isinstance(value, tuple):
        return "[" + ", ".join(parameter_text(each) for each in value) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, float):
        if math.isnan(value):
            return ".nan"
        if math.isinf(value):
            return ".inf" if value > 0 else "-.inf"
    return repr(value)


REDACTED = "(redacted)"


_SECRET = re.compile(
    "TOKEN|SECRET|PASSW|PASSPHRASE|(^|_)PASS(_|$)|_PWD$|CREDENTIAL|PRIVATE|COOKIE"
    "|(API|ACCESS)_?KEY|(^|_)KEYS?$|AUTH(?!OR)",
    re.IGNORECASE,
)

_PASSWORD_IN_URL = re.compile(r"(?<=://)([^/?#@\s:]*):[^/@\s]+(?=@)")
"""RFC 3986 section 3.2.1, `user:password@`."""


def shown(variable: str, value: str) -> str:
    """Return the value of an environment variable as it may be shown."""
    if _SECRET.search(variable):
        return REDACTED
    return _PASSWORD_IN_URL.sub(rf"\1:{REDACTED}", value)


def without_secrets(plan: Plan) -> Plan:
    """Return `plan` without values of environment variables whose names say they are secret."""
    nodes = tuple(replace(each, run=_redacted(each.run)) for each in plan.nodes)
    processes = tuple(
        replace(
            each,
            run=_redacted(each.run),
            environment=tuple((name, shown(name, value)) for name, value in each.environment),
        )
        for each in plan.processes
    )
    return replace(plan, nodes=nodes, processes=processes)


def _redacted(run: Run) -> Run:
    return replace(
        run, environment={name: shown(name, value) for name, value in run.environment.items()}
    )


_OTHER_MEANS = (
    "FASTDDS_DEFAULT_PROFILES_FILE",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "ROS_DISCOVERY_SERVER",
)
"""Variables by which a process may find others in another way than by the range."""


def overcrowded(plan: Plan, environment: Mapping[str, str]) -> Iterator[Diagnostic]:
    """Yield findings about hosts with more participants than have ports, or find each other.

    Counted for `range: localhost` is what certainly looks for others in the way of rmw_fastrtps:
    the supervisor's participant, and those of processes that it starts.
    """
    is_local = (
        plan.discovery_range is DiscoveryRange.LOCALHOST
        and plan.discovery.transport.by_udp
        and plan.rmw.startswith("rmw_fastrtps")
        and not any(environment.get(name) for name in _OTHER_MEANS)
    )
    own = {"ROS_AUTOMATIC_DISCOVERY_RANGE", "RMW_IMPLEMENTATION", "ROS_DOMAIN_ID", *_OTHER_MEANS}
    by_host: dict[str, list[PlannedNode]] = {}
    for node in plan.nodes:
        by_host.setdefault(plan.address_of(node.machine), []).append(node)
    for nodes in by_host.values():
        at = plan.positions.get("discovery", nodes[0].at)
        where = f"on {' and '.join(dict.fromkeys(repr(node.machine) for node in nodes))}"
        participants = _participants(nodes)
        # What holds whatever an operating system does with its ports, then Linux's default.
        for make, ephemeral in ((error, range(0)), (note, LINUX)):
            room = max_participants(plan.domain_id, ephemeral)
            if participants > room.participants:
                message = (
                    f"cannot run {participants} participants in domain {plan.domain_id} {where}: "
                    f"{room.participants} fit before {room.limit}"
                )
                safe = describe_domains(safe_domains(LINUX))
                hint = f"use a domain of {safe}, fewer processes, or fewer unique publishers"
                yield make("check.ports", at, message, hint)
                break
        looking = _participants(
            node
            for node in nodes
            if node.run.kind is not RunKind.ATTACH and own.isdisjoint(dict(node.run.environment))
        )
        if is_local and looking > LOCALHOST_PARTICIPANTS:
            message = (
                f"cannot run {looking} participants with range localhost {where}: at most "
                f"{LOCALHOST_PARTICIPANTS} all find each other, because each looks for participants"
                f" 0 to {LOCALHOST_PEERS_RANGE - 1} of its host only"
            )
            hint = "use 'range: subnet', or give several nodes one 'process:'"
            yield error("check.localhost", at, message, hint)


def _participants(nodes: Iterable[PlannedNode]) -> int:
    """Count those that take ports of the domain: the supervisor's, the nodes' and extra ones."""
    shared, extra = set(), 0
    for node in nodes:
        shared.add((node.process, node.transports, node.connections))
        extra += sum(not each.connection for each in node.participants)
    return 1 + len(shared) + extra
