"""Checks of where, in which order and after whom nodes start, and what becomes of them. Pure."""

from __future__ import annotations

import shlex
from collections.abc import Iterator

from lifecycle.errors import did_you_mean
from lifecycle.manifest.checks.system import DeclaredSystem
from lifecycle.manifest.diagnostics import Diagnostic, Position, error, note, warning
from lifecycle.manifest.model import (
    PROCESS_KEYS,
    SUPERVISION_KEYS,
    After,
    Condition,
    Consequence,
    EndpointPolicy,
    Node,
    Readiness,
    ReadyBy,
    Restart,
    RosArguments,
    Run,
    RunKind,
    TargetState,
)
from lifecycle.manifest.names import (
    full_name_problem,
    name_problem,
    topic_of,
)
from lifecycle.manifest.parameter_values import is_implicit


def check_machine(system: DeclaredSystem, node: Node) -> Iterator[Diagnostic]:
    """Yield a finding about a node on a machine that is not declared."""
    declared = [each.name for each in system.manifest.machines]
    if node.machine not in declared:
        message = f"cannot run {node.key!r} on machine {node.machine!r}: there is no such machine"
        hint = did_you_mean(node.machine, declared) or "declare it under 'machines:'"
        yield error("check.unknown-machine", node.where("machine"), message, hint)


def check_processes(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about processes that nodes share."""
    first: dict[str, Node] = {}
    for node in system.manifest.nodes:
        if not node.process:
            continue
        at = node.where("process")
        if node.run.kind is RunKind.ATTACH:
            what = "its container's process has it" if node.run.component else "others start it"
            message = f"cannot run {node.key!r} in process {node.process!r}: {what}"
            yield error("check.process-run", at, message, "remove 'process:'")
            continue
        namesake = system.nodes.get(node.process)
        if namesake is not None and namesake.process != node.process:
            message = (
                f"cannot name a process {node.process!r}: node {namesake.key!r} runs in a process "
                f"of that name ({namesake.at.spelled})"
            )
            yield error("check.process-name", at, message, "choose another name")
        other = first.setdefault(node.process, node)
        if other is not node:
            yield from _apart(node, other, at)


def _apart(node: Node, other: Node, at: Position) -> Iterator[Diagnostic]:
    """Judge two nodes that share a process."""
    together = f"cannot share process {node.process!r} with {other.key!r} ({other.at.spelled})"
    if node.machine != other.machine:
        message = (
            f"{together}: it runs on machine {other.machine!r}, {node.key!r} on {node.machine!r}"
        )
        yield error("check.process-machine", at, message, "put both on one machine")
    one, two = node.run, other.run
    if one.kind is not two.kind or _program(one) != _program(two):
        message = f"{together}: it runs {_program(two)}, {node.key!r} runs {_program(one)}"
        hint = "a process that is one command has it at each of its nodes"
        yield error("check.process-run", at, message, hint)
        return
    asked = {name: (getattr(one, name), getattr(two, name)) for name in PROCESS_KEYS}
    asked["environment"] = (dict(one.environment), dict(two.environment))
    asked["executor"] = ((one.executor, one.threads), (two.executor, two.threads))
    for name, (here, there) in asked.items():
        if here != there:
            message = f"{together}: a process has one {name}, these nodes ask for two"
            hint = f"give both the same 'run.{name}'"
            yield error("check.process-environment", at, message, hint)
    for key in SUPERVISION_KEYS:
        if getattr(node.supervision, key) != getattr(other.supervision, key):
            message = f"{together}: a process has one {key}, these nodes ask for two"
            yield error("check.restart", node.where(key), message, f"write '{key}' at one of them")


def check_supervision(_system: DeclaredSystem, node: Node) -> Iterator[Diagnostic]:
    """Yield findings about what is to be done when the process of a node fails."""
    own = [key for key in SUPERVISION_KEYS if key in node.positions and key not in node.shared]
    how, hint = node.supervision, "write 'restart: on-failure', or remove it"
    if node.run.kind is RunKind.ATTACH:
        what = "it has its container's process" if node.run.component else "others start it"
        for key in own:
            message = f"cannot set {key} of {node.key!r}: {what}"
            hint = "set it at the container" if node.run.component else "remove it"
            yield error("check.restart", node.where(key), message, hint)
    elif how.restart is Restart.NO:
        for key in own:
            if key != "restart":
                message = f"cannot use {key} of {node.key!r}: it is not started again"
                yield error("check.restart", node.where(key), message, hint)
    else:
        if node.may_end and "restart" in own and how.restart is Restart.ALWAYS:
            message = f"cannot start {node.key!r} again whenever it ends: it may end by itself"
            hint = "write 'restart: on-failure', or remove 'may_end'"
            yield error("check.restart", node.where("restart"), message, hint)
        yield from _delays(node)


def check_health(_system: DeclaredSystem, node: Node) -> Iterator[Diagnostic]:
    """Yield findings about health that nothing can report."""
    if node.health is None:
        return
    at = node.where("health")
    if not node.health.check and not node.health.diagnostics:
        message = f"cannot require that {node.key!r} is healthy: nothing says how that is known"
        yield error("check.health", at, message, "write 'check: true', or remove 'health'")
    elif node.health.check and not node.managed:
        message = f"cannot ask {node.key!r} whether it is healthy: it is not managed"
        hint = "its class must be a lifecycle.LifecycleNode; or name its 'diagnostics'"
        yield error("check.health", at, message, hint)


def check_on_violation(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about what is done on a violation that cannot be done."""
    rule, manifest = "check.on-violation", system.manifest
    modes = [each.name for each in manifest.modes]
    several = len({node.machine for node in manifest.nodes}) > 1
    reactions = [
        (each, manifest.where(f"on_violation.{each.rule}")) for each in manifest.on_violation
    ]
    for node in manifest.nodes:
        for each in node.on_violation:
            at = node.where(f"on_violation.{each.rule}")
            reactions.append((each, at))
            if each.what is Consequence.DEACTIVATE and (why := _never_deactivated(node)):
                message = f"cannot deactivate {node.key!r} when it violates: {why}"
                hint = "write 'pause' or 'stop', which are for the whole system"
                yield error(rule, at, message, hint)
    for each, at in reactions:
        what = f"cannot enter mode {each.mode!r} on a violation"
        if each.what is Consequence.MODE and each.mode not in modes:
            hint = did_you_mean(each.mode, modes) or "declare it under 'modes:'"
            yield error(rule, at, f"{what}: there is no such mode", hint)
        elif each.what is Consequence.MODE and several:
            hint = "write 'deactivate', 'pause' or 'stop'; a mode is switched by one supervisor"
            yield error(rule, at, f"{what}: several machines run in it", hint)


def check_modes(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about modes that cannot be entered, or in which nodes wait for ever."""
    for mode in system.manifest.modes:
        for key in mode.inactive:
            node = system.nodes.get(key)
            if node is None:
                message = f"cannot keep {key!r} inactive in mode {mode.name!r}: no such node"
                yield error("check.mode", mode.at, message, did_you_mean(key, system.nodes))
            elif why := _never_deactivated(node):
                message = f"cannot keep {key!r} inactive in mode {mode.name!r}: {why}"
                yield error("check.mode", mode.at, message, "remove it from the mode")
        for node in system.manifest.nodes:
            for after in node.after:
                beyond = after.condition in (Condition.ACTIVE, Condition.HEALTHY)
                if beyond and after.node in mode.inactive:
                    message = (
                        f"cannot wait until {after.node!r} is {after.condition}: mode "
                        f"{mode.name!r} ({mode.at.spelled}) keeps it inactive"
                    )
                    hint = f"write '{after.node}: connected', or remove it from the mode"
                    yield error("check.mode", after.at, message, hint)


def _never_deactivated(node: Node) -> str:
    """Say why a node is never active, or stays so; empty if it may be deactivated."""
    if not node.holds:
        return "no gate holds it"
    kept = node.state is not TargetState.ACTIVE
    return f"it is kept {node.state.value}" if kept else ""


def _delays(node: Node) -> Iterator[Diagnostic]:
    """Judge the delays of a process that is started again."""
    how = node.supervision
    longest, grows = how.restart_max_delay_sec, how.restart_steps > 0
    if grows is (longest is None) or (longest is not None and not 0 < how.restart_sec <= longest):
        message = (
            "cannot let the delay grow: it does from restart_sec, which is not 0, in restart_steps "
            "to restart_max_delay_sec"
        )
        at = node.positions.get("restart_max_delay_sec", node.where("restart_steps"))
        hint = "write 'restart_sec: 0.1', 'restart_steps: 5' and 'restart_max_delay_sec: 30'"
        yield error("check.restart", at, message, hint)
    least_s = how.restart_sec * how.start_limit_burst
    interval_s = how.start_limit_interval_sec
    if interval_s and least_s > interval_s:
        message = (
            f"cannot reach the limit of {how.start_limit_burst} starts in {interval_s:g} s: with "
            f"restart_sec {how.restart_sec:g} they take {least_s:g} s, so it is never given up"
        )
        at = node.positions.get("start_limit_interval_sec", node.where("restart_sec"))
        hint = f"set start_limit_interval_sec > {least_s:g}, or to 0 if that is meant"
        yield note("check.start-limit", at, message, hint)


def _program(run: Run) -> str:
    """Return what a process runs, as messages show it; classes of one process may differ."""
    if run.kind is RunKind.PYTHON:
        return "Python classes"
    return shlex.join(run.command) if run.command else f"{run.executable} of {run.package}"


def check_program(_system: DeclaredSystem, node: Node) -> Iterator[Diagnostic]:
    """Yield findings about what is asked of a node's program that cannot be had."""
    if node.run.ros_args is RosArguments.NONE:
        asked = ["remap"] if node.remap else []
        for key in [*asked, "log_level"] if node.log_level else asked:
            at = node.where(f"remap.{node.remap[0][0]}" if key == "remap" else key)
            message = f"cannot give {key} to {node.key!r}: it has 'ros_args: none'"
            hint = "write it into its command line, or 'ros_args: auto'"
            yield warning("check.ros-args", at, message, hint)
    if node.may_end and node.managed:
        message = f"cannot let {node.key!r} end by itself: a managed node is ended by its gate"
        yield error("check.may-end", node.where("may_end"), message, "write 'managed: false'")
    elif node.may_end and node.run.kind is not RunKind.COMMAND:
        message = f"cannot see how {node.key!r} ends: it is not a command that we start"
        yield error("check.may-end", node.where("may_end"), message, "remove it")
    if node.state is not TargetState.ACTIVE and not node.managed:
        message = f"cannot keep {node.key!r} {node.state.value}: it is not managed"
        yield error("check.state", node.where("state"), message, "remove 'state:'")
    is_python = node.run.kind is RunKind.PYTHON
    if is_python and node.state is TargetState.UNCONFIGURED and node.interface.endpoints:
        message = (
            f"cannot keep {node.key!r} unconfigured with an interface: a Python node makes its "
            "endpoints when it connects"
        )
        hint = "write 'state: inactive', or 'endpoints: open' and no interface"
        yield error("check.state", node.where("state"), message, hint)


def check_container(system: DeclaredSystem, node: Node) -> Iterator[Diagnostic]:
    """Yield a finding about a component whose container cannot load it."""
    name, other = node.run.container, system.nodes.get(node.run.container)
    problem, hint = "", ""
    if not name:
        return
    if name.startswith("/"):
        problem = full_name_problem(name)
    elif other is None:
        problem = "there is no such node"
        hint = did_you_mean(name, system.nodes) or "others' containers have a full name, '/NAME'"
    elif other.machine != node.machine:
        problem = f"it is for machine {node.machine!r}, {name!r} runs on {other.machine!r}"
        hint = "put both on one machine"
    if problem:
        message = f"cannot load {node.key!r} into {name!r}: {problem}"
        yield error("check.container", node.where("run.container"), message, hint)


def check_order(system: DeclaredSystem, node: Node) -> Iterator[Diagnostic]:
    """Yield findings about what a node waits for."""
    for after in {each.node: each for each in reversed(node.after)}.values():
        other = system.nodes.get(after.node)
        if other is None:
            message = f"cannot wait for node {after.node!r}: there is no such node"
            hint = did_you_mean(after.node, system.nodes)
            yield error("check.after-unknown", after.at, message, hint)
        elif other is node:
            message = f"cannot make {node.key!r} wait for itself"
            yield error("check.after-self", after.at, message, "remove it")
        elif isinstance(after.condition, Condition):
            yield from _never_holds(node, other, after.condition, after.at)


def _never_holds(
    node: Node, other: Node, condition: Condition, at: Position
) -> Iterator[Diagnostic]:
    """Judge conditions of nodes that have nothing but a start, or are kept in a lower state."""
    key, beyond = other.key, condition in (Condition.ACTIVE, Condition.HEALTHY)
    if condition is Condition.HEALTHY and other.health is None:
        message = f"cannot wait until {key!r} is healthy: nothing says how that is known"
        yield error("check.health", at, message, f"write 'health: {{check: true}}' at {key!r}")
    elif not node.managed and beyond:
        message = (
            f"cannot hold the start of {node.key!r} until {key!r} is {condition}: {node.key!r} is "
            "not managed, and nothing is activated before every node runs"
        )
        yield error("check.after-unmanaged", at, message, f"write '{key}: connected'")
    elif not other.managed and condition not in (Condition.STARTED, Condition.HEALTHY):
        message = f"cannot wait until {key!r} is {condition}: it is not managed and only starts"
        yield warning("check.after-unmanaged", at, message, f"write '{key}: started'")
    order, furthest = list(Condition), _FURTHEST[other.state]
    if other.managed and order.index(condition) > order.index(furthest):
        kept = other.state.value
        message = f"cannot wait until {key!r} is {condition}: it is kept {kept}"
        hint = f"write '{key}: {furthest}', or remove its 'state: {kept}'"
        yield error("check.after-state", at, message, hint)


_FURTHEST = {
    TargetState.UNCONFIGURED: Condition.STARTED,
    TargetState.INACTIVE: Condition.CONNECTED,
    TargetState.ACTIVE: Condition.HEALTHY,
}
"""How far the supervisor brings a node that is kept in a state."""


def check_readiness(system: DeclaredSystem, node: Node) -> Iterator[Diagnostic]:
    """Yield findings about topics, services and parameters that a node waits for others to have."""
    for after in node.after:
        other, wanted = system.nodes.get(after.node), after.condition
        if other in (None, node) or not isinstance(wanted, Readiness):
            continue
        if wanted.by is ReadyBy.PARAMETER:
            yield from _ready_parameter(after, wanted, other)
        elif problem := name_problem(wanted.name):
            message = f"cannot wait until {after.node!r} {wanted}: {problem}"
            yield error("check.name", after.at, message)
        else:
            yield from _ready_endpoint(after, wanted, other, system)


def _ready_endpoint(
    after: After, wanted: Readiness, other: Node, system: DeclaredSystem
) -> Iterator[Diagnostic]:
    noun, message = wanted.by.kinds[0].noun, f"cannot wait until {after.node!r} {wanted}"
    names = [(kind, topic_of(other, wanted.name, kind)) for kind in wanted.by.kinds]
    if any(each.node.key == other.key for one in names for each in system.named(*one)):
        return
    declared = [each.name for each in other.interface.endpoints if each.kind in wanted.by.kinds]
    why = f"{message}: its interface declares no such {noun}"
    hint = did_you_mean(wanted.name, declared)
    if other.endpoints is EndpointPolicy.DECLARED:
        hint = hint or f"declare it in the interface of {after.node!r}, or write 'endpoints: open'"
        yield error("check.after-undeclared", after.at, why, hint)
    elif declared:
        yield note("check.after-undeclared", after.at, f"{why}, and may have others", hint)


def _ready_parameter(after: After, wanted: Readiness, other: Node) -> Iterator[Diagnostic]:
    declared = {each.name: each.type for each in other.interface.parameters}
    type_, why, hint = declared.get(wanted.name, ""), "", ""
    if type_ and type_ != "bool":
        why = f"it is declared as {type_}"
    elif not type_ and other.interface.has_all_parameters and not is_implicit(wanted.name):
        why = "its interface declares no such parameter"
        hint = did_you_mean(wanted.name, declared) or "declare it under 'interface.parameters'"
    if why:
        message = f"cannot wait until {after.node!r} {wanted}: {why}"
        yield error("check.after-undeclared", after.at, message, hint)


CHECKS = (check_processes, check_on_violation, check_modes)
OF_A_NODE = (
    check_order,
    check_machine,
    check_program,
    check_container,
    check_supervision,
    check_health,
    check_readiness,
)
