"""Captures a running ROS graph as data for a manifest: nodes, endpoints, parameters, gaps.

Owns: `CapturedSystem` and how an observation becomes one: tools left out, hidden participants
assigned to their nodes, everything that the graph does not show named as a gap. Pure.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping

import msgspec
from msgspec.structs import replace

from lifecycle.export.programs import (
    CapturedProgram,
    CapturedRun,
    declared_name,
    process_names,
    run_of,
)
from lifecycle.manifest.model import DiscoveryRange, EndpointKind, ParameterValue, TargetState
from lifecycle.manifest.names import (
    free_name,
    full_name_problem,
    name_problem,
    namespace_problem,
    node_name_problem,
)
from lifecycle.manifest.parameter_values import is_implicit
from lifecycle.manifest.qos import History, QosProfile
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.verify.observation import (
    EndpointReport,
    NodeConfiguration,
    Observation,
    ObservedEndpoint,
    ObservedNode,
)
from lifecycle.verify.tool_filter import is_noise_endpoint, known_node, tolerating_pattern

_TYPE = re.compile(r"[a-zA-Z][a-zA-Z0-9_]*/(msg|srv|action)/[a-zA-Z][a-zA-Z0-9_]*")


class CapturedParameter(msgspec.Struct, frozen=True, kw_only=True):
    """A parameter as its node describes it.

    Attributes:
        type: type name of rcl_interfaces, see ParameterDeclaration; empty if it is not set.
        value: at this moment; None where it is not set or cannot be written.
    """

    name: str
    type: str
    value: ParameterValue | None
    description: str = ""
    read_only: bool = False


class CapturedEndpoint(msgspec.Struct, frozen=True, kw_only=True):
    """An endpoint as the graph and its node report it.

    Attributes:
        name: fully qualified.
        declared: as a node of ours spells it in its code; the full name where that is not known.
        qos: None for services and actions.
        unique: as a node of ours reports; else NOT_REQUIRED.
        dscp: likewise; None if it is not marked.
    """

    kind: EndpointKind
    name: str
    declared: str
    type: str
    qos: QosProfile | None = None
    unique: UniqueRequirement = UniqueRequirement.NOT_REQUIRED
    dscp: int | None = None


class CapturedNode(msgspec.Struct, frozen=True, kw_only=True):
    """One node.

    Attributes:
        key: for a manifest, unique in the system.
        managed: it offers the lifecycle services.
        state: lifecycle_msgs/State label; empty if not known.
        parameters: None where it did not answer.
        run: how its process was started; None where others are to start it.
        may_end: its process may end by itself: it did so, or the node only asks others.
        has_configuration: its own configuration has more than discovery does.
        gaps: what is not known of it, one phrase each.
    """

    key: str
    name: str
    namespace: str
    managed: bool
    state: str
    endpoints: tuple[CapturedEndpoint, ...]
    repeated: tuple[CapturedEndpoint, ...]
    parameters: tuple[CapturedParameter, ...] | None
    has_configuration: bool
    process_id: int | None
    gaps: tuple[str, ...]
    run: CapturedRun | None = None
    may_end: bool = False

    @property
    def full_name(self) -> str:
        """Fully qualified node name."""
        return f"{self.namespace.rstrip('/')}/{self.name}"


class CapturedSystem(msgspec.Struct, frozen=True, kw_only=True):
    """A whole running system.

    Attributes:
        system: name that the manifest gives it.
        partial: nodes were left out.
        gaps: what is not known of the whole, one sentence each.
    """

    system: str
    domain_id: int
    discovery_range: DiscoveryRange
    nodes: tuple[CapturedNode, ...]
    partial: bool
    gaps: tuple[str, ...]


def capture(
    observation: Observation,
    parameters: Mapping[str, tuple[CapturedParameter, ...] | None],
    *,
    system: str,
    domain_id: int,
    discovery_range: DiscoveryRange,
    unsettled: str = "",
    programs: Programs | None = None,
) -> CapturedSystem:
    """Return what `observation` shows; the same for the same content in any order.

    Args:
        observation: of every node in the graph, configurations of ours included.
        parameters: by full node name; None where a node did not answer, and no entry where it has
            no parameter services: what its configuration reports of them counts then.
        system: name to give it.
        domain_id: where it was looked.
        discovery_range: likewise.
        unsettled: what discovery still waited for; empty if it had settled.
        programs: how the processes of nodes were started; nodes without are attached to.
    """
    configurations = {each.name: each for each in observation.configurations}
    owners = _owners(configurations)
    nodes = _counted(observation.nodes, owners)
    illegal = {name: _node_problem(name) for name in nodes}
    chosen = {name: node for name, node in nodes.items() if not illegal[name]}
    endpoints: dict[str, list[ObservedEndpoint]] = {name: [] for name in chosen}
    unknown: list[ObservedEndpoint] = []
    for endpoint in observation.endpoints:
        name = known_node(owners.get(endpoint.node, endpoint.node))
        if tolerating_pattern(name) or is_noise_endpoint(
            endpoint.kind, name, endpoint.name, endpoint.type, ours=name in configurations
        ):
            continue
        if name in endpoints:
            endpoints[name].append(endpoint)
        elif not name or name not in nodes:
            unknown.append(endpoint)
    instances = _instances(chosen, programs or {})
    keys = _keys(each.name for each in instances)
    apart = {each.node.full_name for each in instances if each.prefixes}
    shared = _shared(instances, keys)
    gaps = [unsettled] if unsettled else []
    ours = [configurations[name] for name in chosen if name in configurations]
    if len({each.identity.machine_id for each in ours}) > 1:
        gaps.append("nodes are on several machines: declare these, and the `machine` of each node")
    gaps += [f"node {name} is left out: {why}" for name, why in illegal.items() if why]
    gaps += [
        f"{node.count} nodes are named {name}; "
        + ("lifecycle up gives each a name of its own" if name in apart else _ALIKE)
        for name, node in chosen.items()
        if node.count > 1
    ]
    gaps += [
        f"nobody tells whose {each.kind.value.removesuffix('s').replace('_', ' ')} of {each.name} "
        f"({each.type}) this is"
        for each in sorted(set(unknown), key=_order)
    ]
    return CapturedSystem(
        system=system,
        domain_id=domain_id,
        discovery_range=discovery_range,
        nodes=tuple(
            _node(
                each,
                key=keys[each.name],
                endpoints=[one for one in endpoints[each.node.full_name] if each.has(one)],
                configuration=(own := configurations.get(each.node.full_name)),
                parameters=_parameters(parameters.get(each.node.full_name), own),
                serves=each.node.full_name in parameters,
                process=shared.get(each.program.process_id, "") if each.program else "",
            )
            for each in instances
        ),
        partial=len(chosen) < len(nodes),
        gaps=tuple(gaps),
    )


Programs = Mapping[str, Mapping[str, CapturedProgram]]
"""By full node name, how the processes of its participants were started, by GUID prefix."""

_ALIKE = "they cannot be told apart"
_PREFIX_DIGITS = 24


class _Instance(msgspec.Struct, frozen=True, kw_only=True):
    """A node of the graph, or one of several of a name.

    Attributes:
        node: as the graph shows it.
        name: full name that the manifest gives it.
        program: None where it is not known, or is not to be started again.
        prefixes: of its participants, where they tell it from others of its name.
        gap: why there is no program.
    """

    node: ObservedNode
    name: str
    program: CapturedProgram | None = None
    prefixes: frozenset[str] = frozenset()
    gap: str = ""

    def has(self, endpoint: ObservedEndpoint) -> bool:
        """Whether an endpoint of a node of this name may be its own."""
        prefix = endpoint.gid[:_PREFIX_DIGITS]
        return not self.prefixes or not prefix or prefix in self.prefixes


def _instances(nodes: Mapping[str, ObservedNode], programs: Programs) -> tuple[_Instance, ...]:
    """Return every node, several of one name apart where they are in processes of their own."""
    found = []
    for name, node in nodes.items():
        by_pid: dict[int, CapturedProgram] = {}
        prefixes: dict[int, set[str]] = {}
        for prefix, program in programs.get(name, {}).items():
            by_pid[program.process_id] = program
            prefixes.setdefault(program.process_id, set()).add(prefix)
        if not 1 <= len(by_pid) <= node.count:
            found.append(_Instance(node=node, name=name))
            continue
        if len(by_pid) < node.count:
            gap = "others of its name are not known by their processes" * (len(by_pid) > 1)
            by_pid = dict(sorted(by_pid.items())[:1])
            program = next(iter(by_pid.values()))
            found.append(_Instance(node=node, name=name, program=program, gap=gap))
            continue
        free = name
        for pid, program in sorted(by_pid.items()):
            apart = frozenset(prefixes[pid]) if len(by_pid) > 1 else frozenset()
            found.append(_Instance(node=node, name=free, program=program, prefixes=apart))
            free = free_name(name, {*nodes, *(each.name for each in found)})
    return tuple(map(_restartable, found))


def _restartable(instance: _Instance) -> _Instance:
    if instance.program is None or not instance.program.is_of_a_supervisor:
        return instance
    gap = "lifecycle up runs it: its own manifest says how it is started"
    return replace(instance, program=None, gap=gap)


def _shared(instances: Iterable[_Instance], keys: Mapping[str, str]) -> dict[int, str]:
    """Return names of the processes that several nodes share, by pid."""
    programs: dict[int, list[CapturedProgram]] = {}
    for each in instances:
        if each.program is not None:
            programs.setdefault(each.program.process_id, []).append(each.program)
    several = {pid: found[0] for pid, found in programs.items() if len(found) > 1}
    return process_names(several, set(keys.values()))


def _owners(configurations: Mapping[str, NodeConfiguration]) -> dict[str, str]:
    """Return the node that owns each hidden participant, as the nodes themselves report."""
    owners = {}
    for name, configuration in configurations.items():
        namespace = name.rpartition("/")[0]
        hidden = [each.participant for each in configuration.endpoints]
        hidden += [each.node_name for each in configuration.connections]
        owners.update({f"{namespace}/{each}": name for each in hidden if each})
    return owners


def _counted(nodes: Iterable[ObservedNode], owners: Mapping[str, str]) -> dict[str, ObservedNode]:
    found: dict[str, ObservedNode] = {}
    for node in sorted(nodes, key=lambda each: each.full_name):
        name = node.full_name
        if not known_node(name) or tolerating_pattern(name) or name in owners:
            continue
        other = found.get(name)
        count = node.count + (other.count if other else 0)
        found[name] = replace(node, count=count)
    return found


def _node_problem(name: str) -> str:
    """Return why no manifest can declare a node of this name; empty if one can."""
    namespace, _, base = name.rpartition("/")
    return node_name_problem(base) or namespace_problem(namespace or "/" * name.startswith("/"))


def _keys(nodes: Iterable[str]) -> dict[str, str]:
    """Return a key for each node: its base name, where several share one with their namespace."""
    names = list(nodes)
    bases = [name.rpartition("/")[2] for name in names]
    keys: dict[str, str] = {}
    for name, base in zip(names, bases, strict=True):
        key = base if bases.count(base) == 1 else name.strip("/").replace("/", "_")
        keys[name] = free_name(key, keys.values())
    return keys


def _parameters(
    answered: tuple[CapturedParameter, ...] | None, configuration: NodeConfiguration | None
) -> tuple[CapturedParameter, ...] | None:
    # A node under `lifecycle up` that declares none serves none until a client asks, and reports
    # those that rclpy declares for each.
    reported = configuration.parameters if configuration else None
    if answered is not None or reported is None:
        return answered
    each_has = tuple(
        CapturedParameter(name=one.name, type=one.type, value=one.value) for one in reported
    )
    if all(is_implicit(one.name) for one in each_has):
        return each_has
    return None


def _node(
    instance: _Instance,
    *,
    key: str,
    endpoints: Iterable[ObservedEndpoint],
    configuration: NodeConfiguration | None,
    parameters: tuple[CapturedParameter, ...] | None,
    serves: bool,
    process: str,
) -> CapturedNode:
    node = instance.node
    namespace, _, name = instance.name.rpartition("/")
    reports = configuration.endpoints if configuration else ()
    gaps = []
    taken: dict[tuple[EndpointKind, str], CapturedEndpoint] = {}
    repeated = []
    for endpoint in sorted(endpoints, key=_order):
        if not _TYPE.fullmatch(endpoint.type):
            gaps.append(f"{endpoint.kind.value}: {endpoint.name} has no ROS type: {endpoint.type}")
            continue
        if problem := full_name_problem(endpoint.name):
            gaps.append(f"{endpoint.kind.value}: {endpoint.name} is left out: {problem}")
            continue
        captured = _endpoint(endpoint, reports)
        if (captured.kind, captured.name) in taken:
            repeated.append(captured)
        taken.setdefault((captured.kind, captured.name), captured)
    state = node.state or (configuration.state if configuration else "")
    if node.managed and state not in TARGETS:
        gaps.append(f"it is {state or 'in an unknown state'}; it is judged as an active node")
    if node.managed is None:
        gaps.append("nobody tells whether it is managed")
    if parameters is None:
        why = "it did not answer" if serves else "it serves none"
        gaps.append(f"its parameters are not known: {why}")
    own = tuple(each for each in parameters or () if _is_own(each))
    run = None
    if instance.program is not None:
        run = run_of(
            instance.program,
            node.full_name,
            process=process,
            renamed=instance.name != node.full_name,
            parameters=[each.name for each in own if can_be_given(each)],
            endpoints=list(taken),
        )
        gaps += run.gaps
        taken = {
            key: replace(each, declared=declared_name(run, node.full_name, *key))
            if each.declared == each.name
            else each
            for key, each in taken.items()
        }
    gaps += [instance.gap] if instance.gap else []
    if unset := [each.name for each in parameters or () if not each.type]:
        gaps.append(f"parameters that are declared and not set: {', '.join(sorted(unset))}")
    return CapturedNode(
        key=key,
        name=name,
        namespace=namespace or "/",
        managed=bool(node.managed),
        state=state,
        endpoints=tuple(taken.values()),
        repeated=tuple(repeated),
        parameters=None if parameters is None else tuple(sorted(own, key=lambda each: each.name)),
        has_configuration=configuration is not None,
        process_id=configuration.identity.process_id if configuration else None,
        gaps=tuple(gaps),
        run=run,
        may_end=run is not None
        and not node.managed
        and (run.program.has_ended or all(kind in _ASKING for kind, _ in taken)),
    )


TARGETS = tuple(each.value for each in TargetState)
"""States that a manifest can ask for."""

_ASKING = (EndpointKind.SERVICE_CLIENT, EndpointKind.ACTION_CLIENT)


def can_be_given(parameter: CapturedParameter) -> bool:
    """Whether a manifest can give a parameter the value that it has now."""
    value = parameter.value
    if value is None or value == () or parameter.type == "byte_array":
        return False
    return is_finite(value)


def is_finite(value: ParameterValue) -> bool:
    """Whether a manifest can hold a value: it has no infinite number in it, and no NaN."""
    values = value if isinstance(value, tuple) else (value,)
    return all(not isinstance(each, float) or math.isfinite(each) for each in values)


def _is_own(parameter: CapturedParameter) -> bool:
    if parameter.name == "use_sim_time":
        return parameter.value is True
    return not is_implicit(parameter.name)


def _endpoint(endpoint: ObservedEndpoint, reports: Iterable[EndpointReport]) -> CapturedEndpoint:
    same = [
        each for each in reports if each.kind is endpoint.kind and endpoint.name == each.resolved
    ]
    exact = [each for each in same if each.gid and each.gid == endpoint.gid]
    report = next(iter([*exact, *same]), None)
    qos = endpoint.qos
    reported = report.qos if report else None
    if qos is not None and reported is not None and qos.history is History.UNKNOWN:
        qos = replace(qos, history=reported.history, depth=reported.depth)
    return CapturedEndpoint(
        kind=endpoint.kind,
        name=endpoint.name,
        # A node may report what it likes; a manifest is of what can be declared.
        declared=endpoint.name if report is None or name_problem(report.name) else report.name,
        type=endpoint.type,
        qos=qos,
        unique=report.unique if report else UniqueRequirement.NOT_REQUIRED,
        # 0 is unmarked.
        dscp=(report.dscp or None) if report else None,
    )


_KINDS = list(EndpointKind)


def _order(endpoint: ObservedEndpoint) -> tuple[object, ...]:
    return (_KINDS.index(endpoint.kind), endpoint.name, endpoint.type, endpoint.gid)
