"""Find what nodes run without running it: executables, packages, Python classes, handlers.

It looks where `up` would: PATH of the node's environment, the working directory, AMENT_PREFIX_PATH,
the modules of this interpreter. What Python or exec(3) would refuse is an error; what only running
it, or another host, can show is named as unresolved.
"""

from __future__ import annotations

import ast
import difflib
import functools
import importlib.util
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import msgspec
from msgspec.structs import replace

from lifecycle.errors import LifecycleError, did_you_mean
from lifecycle.manifest.diagnostics import Diagnostic, Position, error, warning
from lifecycle.manifest.model import EndpointKind, Manifest, Node, Run, RunKind
from lifecycle.manifest.parameter_values import is_implicit
from lifecycle.plan.model import PlanError
from lifecycle.plan.processes import find_executable
from lifecycle.plan.python_source import (
    ACCESS,
    ClassKind,
    Handler,
    NodeClass,
    NoModuleError,
    NotThereError,
    Sources,
    UnknownError,
    binds,
)

RULE = "program.missing"
UNHANDLED = "program.handler"
UNDECLARED = "program.endpoint"
NO_HEALTH = "program.health"
IMPORT = "program.import"
UNCALLED = "program.callback"
PARAMETER = "program.parameter"

_WORDS = {
    EndpointKind.SUBSCRIPTION: ("subscription", "@on_message"),
    EndpointKind.SERVICE_SERVER: ("service server", "@on_service"),
    EndpointKind.ACTION_SERVER: ("action server", "@on_action"),
}
_DECLARES = {
    *("declare_publisher", "declare_subscription", "declare_service", "declare_client"),
    *("declare_action", "declare_action_client"),
}
_CALLBACKS = (
    *("on_configure", "on_connect", "on_activate", "on_deactivate"),
    *("on_disconnect", "on_cleanup", "on_shutdown", "on_error"),
)
_PYTHON = re.compile(r"python(3(\.\d+)?)?")


class UnresolvedProgram(msgspec.Struct, frozen=True, kw_only=True):
    """Something of a node that could not be looked for here.

    Attributes:
        at: where the manifest names it; `path` is its place there.
        subject: what it is, "class 'demo:Talker'".
        reason: why not, half a sentence.
    """

    at: Position
    subject: str
    reason: str

    def __str__(self) -> str:
        place = f"{self.at.spelled}: {self.at.path}: "
        return f"{place}could not resolve {self.subject}: {self.reason}"


class Resolution(msgspec.Struct, frozen=True, kw_only=True):
    """What of everything that a manifest runs would fail, and what could not be decided."""

    diagnostics: tuple[Diagnostic, ...] = ()
    unresolved: tuple[UnresolvedProgram, ...] = ()


def resolve_programs(
    manifest: Manifest,
    *,
    environment: Mapping[str, str],
    is_ours: Callable[[str], bool] = lambda _: True,
) -> Resolution:
    """Look for everything that the nodes of a manifest run.

    Args:
        manifest: valid.
        environment: as processes of `up` would inherit it.
        is_ours: whether a machine, by name, is this host; what is missing here of the others is
            unresolved. Code that is found here is judged for them, too.
    """
    sources = functools.cache(Sources)
    found: list[_Found] = []
    for node in manifest.nodes:
        ours = is_ours(node.machine)
        if node.run.kind is RunKind.PYTHON:
            found += _python(node, sources(_folders(node)), ours=ours)
        elif node.run.kind is RunKind.COMMAND:
            found += _command(node, environment, ours=ours)
    return Resolution(
        diagnostics=tuple(each for each in found if isinstance(each, Diagnostic)),
        unresolved=tuple(each for each in found if isinstance(each, UnresolvedProgram)),
    )


_Found = Diagnostic | UnresolvedProgram


def _command(node: Node, environment: Mapping[str, str], *, ours: bool) -> Iterator[_Found]:
    run = node.run
    try:
        if run.command:
            part, subject = "run.command", f"program {run.command[0]!r}"
            _find_command(run, environment)
        else:
            part = "run.executable"
            subject = f"executable {run.executable!r} of package {run.package!r}"
            find_executable(run, environment, at=node.at)
    except (NotThereError, PlanError) as problem:
        if run.command or environment.get("AMENT_PREFIX_PATH"):
            yield _missing(node, part, subject, problem, ours=ours)
        else:
            reason = "AMENT_PREFIX_PATH is empty; source the setup file of its workspace"
            at = _at(node, "run.package")
            yield UnresolvedProgram(at=at, subject=subject, reason=reason)


def _missing(node: Node, part: str, subject: str, problem: LifecycleError, *, ours: bool) -> _Found:
    at = _at(node, part)
    if ours:
        return error(RULE, at, problem.message, problem.hint)
    here = problem.message.replace("cannot find", "there is no", 1)
    reason = f"it is for machine {node.machine!r}; here, {here}"
    return UnresolvedProgram(at=at, subject=subject, reason=reason)


def _python(node: Node, sources: Sources, *, ours: bool) -> Iterator[_Found]:
    subject = f"class {node.run.python!r}"
    at = _at(node, "run.python")
    module, separator, name = node.run.python.partition(":")
    if not separator or not module or not name.isidentifier():
        yield error(RULE, at, f"cannot read {node.run.python!r}; write package.module:Class")
        return
    try:
        found = sources.read_class(module, name)
    except NotThereError as problem:
        # A module that is not here may be there; one that is here lacks the class there, too.
        here = ours or not isinstance(problem, NoModuleError)
        yield _missing(node, "run.python", subject, problem, ours=here)
        return
    except UnknownError as problem:
        yield UnresolvedProgram(at=at, subject=subject, reason=problem.message)
        return
    if found.kind is ClassKind.NO_NODE:
        yield error(
            RULE,
            at,
            f"cannot use {name!r} of {module} ({found.file}) as a node: it is no node class",
            "derive it from lifecycle.LifecycleNode, or from rclpy.node.Node",
        )
        return
    yield from _called(node, found, at)
    yield from _without_health(node, found)
    # What of a class is unknown may bring along what seems to be missing.
    if ours and not found.unknown and importlib.util.find_spec("rclpy"):
        for package, place in sources.missing(found):
            message = f"cannot import {package!r}, as {place} does: it is not installed here"
            yield warning(IMPORT, at, message, "install it where the node runs")
    yield from _uncalled(found, at)
    if not found.unknown and not node.parameter_files:
        yield from _parameters(node, found, at)
    yield from _interface(node, found, at, subject)


def _interface(node: Node, found: NodeClass, at: Position, subject: str) -> Iterator[_Found]:
    """Compare what a class handles and asks for with what the node declares."""
    ours = found.kind is ClassKind.OURS
    problems = [*_pairs(node, found, at)] if ours else []
    asks = [*_undeclared(node, found, at)] if ours else []
    if found.unknown:
        of = "handlers" if ours else "node class"
        yield UnresolvedProgram(at=at, subject=f"{of} of {subject}", reason=found.unknown)
        # What is there is there, whatever else may be.
        problems = [each for each in problems if each.message.startswith("cannot use")]
    declares = any(
        isinstance(each, ast.Attribute) and each.attr in _DECLARES
        for _, statement in found.body
        for each in ast.walk(statement)
    )
    if declares and (problems or asks):
        first = f"; {problems[0].message}" if problems else ""
        reason = f"its code declares endpoints itself{first}"
        yield UnresolvedProgram(at=at, subject=f"endpoints of {subject}", reason=reason)
        return
    yield from (*problems, *asks)


def _folders(node: Node) -> tuple[str, ...]:
    """Return where modules are looked for first, as a host does."""
    given = dict(node.run.environment).get("PYTHONPATH", "").split(os.pathsep)
    beside = [str(Path(node.at.file).absolute().parent)] if node.at.file else []
    first = node.run.working_directory or str(Path.cwd())
    return tuple(dict.fromkeys((first, *beside, *filter(None, given), str(Path.cwd()))))


def _called(node: Node, found: NodeClass, at: Position) -> Iterator[Diagnostic]:
    """Yield what keeps a class or function from being called and hosted as the manifest says."""
    if found.spins:
        yield error(
            RULE,
            at,
            f"cannot host the nodes of {found.name!r}: it calls {found.spins}, which their host "
            "does",
            "name the node's class, or a function that returns nodes without spinning them",
        )
    if node.managed and found.kind is ClassKind.PLAIN:
        yield error(
            RULE,
            at,
            f"cannot manage {node.key!r}: {found} is a plain node",
            "write 'managed: false'; it is held by its executor until the system is verified",
        )
    arguments = dict(node.run.arguments)
    where = _at(node, "run")
    if found.takes is not None:
        for name in arguments:
            if name not in found.takes:
                yield error(
                    RULE,
                    where,
                    f"cannot give {found} an argument {name!r}",
                    did_you_mean(name, found.takes)
                    or f"it takes {', '.join(found.takes) or 'none'}",
                )
    # rclpy's own name for what the manifest says anyway.
    missing = [each for each in found.needs if each not in (*arguments, "node_name")]
    if missing:
        yield error(
            RULE,
            where,
            f"cannot call {found} without {', '.join(missing)}",
            "give it under 'run: {arguments: …}'",
        )


def _without_health(node: Node, found: NodeClass) -> Iterator[Diagnostic]:
    """Yield that a node is to be asked for its health whose class has nothing to ask."""
    if node.health is None or not node.health.check or not node.managed:
        return
    why = ""
    if found.kind in (ClassKind.MANAGED, ClassKind.PLAIN):
        why, advice = "is not a lifecycle.LifecycleNode", "derive it from lifecycle.LifecycleNode"
    elif (
        found.kind is ClassKind.OURS
        and not found.unknown
        and not any("health" in binds(statement) for _, statement in found.body)
    ):
        why = "has no method 'health'"
        advice = (
            "give it 'def health(self)', which returns None if all is well and else what is wrong"
        )
    if why:
        yield error(
            NO_HEALTH,
            node.where("health"),
            f"cannot ask {node.key!r} whether it is healthy: {found} {why}",
            f"{advice}, or write 'health: {{diagnostics: NAME}}'",
        )


def _find_command(run: Run, environment: Mapping[str, str]) -> None:
    """Find a program, and the script of a Python one, as execvp(3) would in its folder.

    Raises:
        NotThereError: it is not there.
    """
    word, *arguments = run.command
    folder = Path(run.working_directory or Path.cwd())
    if not os.path.isdir(folder):
        raise NotThereError(f"cannot find the working directory {str(folder)!r}")
    if "/" in word:
        file = folder / word
        if not os.path.exists(file):
            near = did_you_mean(file.name, _names(file.parent))
            where = "" if Path(word).is_absolute() else f" in {str(folder)!r}"
            raise NotThereError(f"cannot find program {word!r}{where}", hint=near)
        if not os.path.isfile(file) or not os.access(file, os.X_OK):
            hint = f"chmod +x {word}" if os.path.isfile(file) else ""
            raise NotThereError(f"cannot run {word!r}: it is not executable", hint=hint)
    else:
        path = {**environment, **dict(run.environment)}.get("PATH", os.defpath)
        folders = os.pathsep.join(str(folder / each) for each in path.split(os.pathsep))
        if shutil.which(word, path=folders) is None:
            raise NotThereError(
                f"cannot find program {word!r} on PATH",
                hint="install it, name its path, or set PATH in run.environment",
            )
    script = next(iter(arguments), "-")
    if _PYTHON.fullmatch(Path(word).name) and not script.startswith("-"):
        file = folder / script
        if not os.path.exists(file):
            near = did_you_mean(file.name, _names(file.parent))
            raise NotThereError(f"cannot find script {script!r} in {str(folder)!r}", hint=near)


def _names(folder: Path) -> tuple[str, ...]:
    try:
        return tuple(sorted(each.name for each in folder.iterdir()))
    except OSError:
        return ()


def _pairs(node: Node, found: NodeClass, at: Position) -> Iterator[Diagnostic]:
    """Yield what `node.handlers.match` would refuse when the node is configured."""
    wanted = {(e.kind, e.name): e for e in node.interface.endpoints if e.kind in _WORDS}
    taken: dict[tuple[EndpointKind, str, bool], Handler] = {}
    for each in found.handlers:
        noun, decorator = _WORDS[each.kind]
        decorator = "@on_goal" if each.decides else decorator
        if (each.kind, each.name) not in wanted:
            declared = [name for kind, name in wanted if kind is each.kind]
            yield error(
                UNHANDLED,
                at,
                f"cannot use handler {each.text} ({each.place}): {decorator}({each.name!r}) "
                f"names no {noun} that {node.key!r} declares",
                _declared(each.name, declared),
            )
        elif first := taken.get((each.kind, each.name, each.decides)):
            yield error(
                UNHANDLED,
                at,
                f"cannot use two handlers of {noun} {each.name!r}: {first.text} ({first.place}) "
                f"and {each.text} ({each.place})",
            )
        taken.setdefault((each.kind, each.name, each.decides), each)
    for (kind, name), endpoint in wanted.items():
        if (kind, name, False) not in taken:
            noun, decorator = _WORDS[kind]
            yield error(
                UNHANDLED,
                endpoint.at,
                f"cannot serve {noun} {name!r}: no method of {found} is decorated with "
                f"{decorator}({name!r})",
            )


def _undeclared(node: Node, found: NodeClass, at: Position) -> Iterator[Diagnostic]:
    """Yield the endpoints that code asks for by a literal name, and that are not declared."""
    for of, method in found.methods:
        for call in ast.walk(method):
            match call:
                case ast.Call(
                    func=ast.Attribute(value=ast.Name(id="self"), attr=attr),
                    args=[ast.Constant(value=str(name))],
                ) if attr in ACCESS:
                    kind = ACCESS[attr]
                    declared = [e.name for e in node.interface.endpoints if e.kind is kind]
                    if name not in declared:
                        yield warning(
                            UNDECLARED,
                            at,
                            f"cannot tell what {ast.unparse(call)[:80]} ({of.place(call)}) is to "
                            f"get: {node.key!r} declares no {kind.noun} {name!r}",
                            _declared(name, declared),
                        )


def _uncalled(found: NodeClass, at: Position) -> Iterator[Diagnostic]:
    """Yield methods that are called almost as a transition callback is, and by nothing."""
    for of, method in found.methods if found.kind is not ClassKind.PLAIN else ():
        name = method.name
        if not name.startswith("on_") or name in _CALLBACKS or method.decorator_list:
            continue
        near = difflib.get_close_matches(name, _CALLBACKS, n=1, cutoff=0.85)
        if near and len(re.findall(rf"\b{name}\b", of.module.text)) == 1:
            what = f"{of.node.name}.{name} ({of.place(method)})"
            message = f"cannot tell what {what} is for: nothing calls it"
            yield warning(UNCALLED, at, message, f"did you mean {near[0]!r}?")


def _parameters(node: Node, found: NodeClass, at: Position) -> Iterator[Diagnostic]:
    """Yield the parameters that code gets by a literal name, and that nothing declares."""
    gets: list[tuple[str, str]] = []
    declared = [each.name for each in node.interface.parameters]
    known = {*declared, *(name for name, _ in node.parameters)}
    for of, statement in found.body:
        for part in ast.walk(statement):
            match part:
                case ast.Call(
                    func=ast.Attribute(attr="declare_parameter"), args=[ast.Constant(name), *_]
                ):
                    known.add(str(name))
                case ast.Call(func=ast.Attribute(attr="declare_parameter"), args=[_, *_]):
                    return  # under a name that only running it shows
                case ast.Attribute(attr="declare_parameters"):
                    return
                case ast.keyword(arg=str(word)) if "_parameters" in word:
                    return  # allow_undeclared_parameters and its like
                case ast.Call(
                    func=ast.Attribute(value=ast.Name(id="self"), attr="get_parameter"),
                    args=[ast.Constant(value=str(name))],
                ):
                    gets.append((name, of.place(part)))
    for name, place in gets:
        if name not in known and not is_implicit(name):
            message = (
                f"cannot get parameter {name!r} in {place}: {node.key!r} declares none of that name"
            )
            yield warning(PARAMETER, at, message, _declared(name, declared))


def _declared(name: str, declared: list[str]) -> str:
    listed = ", ".join(map(repr, declared)) or "none"
    near = did_you_mean(name, declared)
    return f"{near} declared: {listed}" if near else f"declared: {listed}"


def _at(node: Node, part: str) -> Position:
    at = node.where(part)
    at = node.where("run") if at == node.at else at
    known = at.path.endswith(part)
    return at if known else replace(at, path=f"nodes.{node.key}.{part}")
