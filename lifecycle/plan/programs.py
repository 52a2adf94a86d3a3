"""Find what nodes run without running it: executables, packages, Python classes, handlers.

It looks where `up` would: PATH of the node's environment, the working directory, AMENT_PREFIX_PATH,
the modules of this interpreter. What Python or exec(3) would refuse is an error; what only running
it, or another host, can show is named as unresolved.
"""

from __future__ import annotations

import ast
import builtins
import contextlib
import difflib
import enum
import functools
import importlib.machinery
import importlib.util
import os
import re
import shutil
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path

import msgspec

from lifecycle.errors import LifecycleError, did_you_mean
from lifecycle.manifest.diagnostics import Diagnostic, Position, error, warning
from lifecycle.manifest.model import EndpointKind, Manifest, Node, Run, RunKind
from lifecycle.manifest.parameter_values import is_implicit
from lifecycle.plan.model import PlanError
from lifecycle.plan.processes import find_executable

RULE = "program.missing"
UNHANDLED = "program.handler"
IMPORT = "program.import"
UNCALLED = "program.callback"
PARAMETER = "program.parameter"

_HANDLERS = {
    "on_message": EndpointKind.SUBSCRIPTION,
    "on_service": EndpointKind.SERVICE_SERVER,
    "on_action": EndpointKind.ACTION_SERVER,
    "on_goal": EndpointKind.ACTION_SERVER,
}
_HARMLESS = {
    *("override", "abstractmethod", "on_timer", "setter", "getter", "deleter"),
    *("property", "staticmethod", "classmethod"),
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
_MOST_IMPORTS = 20
_DYNAMIC = r"import \*|__getattr__|globals\(\)|vars\(\)|exec\(|sys\.modules"
"""What makes names of a module that its statements do not show."""


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


class _NotThereError(LifecycleError):
    """Python, or exec(3), would refuse it."""


class _NoModuleError(_NotThereError):
    """There is no such module here; elsewhere there may be one."""


class _UnknownError(LifecycleError):
    """Only running it can show that; the message is the reason, half a sentence."""


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
    sources = functools.cache(_Sources)
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
    except (_NotThereError, PlanError) as problem:
        if run.command or environment.get("AMENT_PREFIX_PATH"):
            yield _missing(node, part, subject, problem, ours=ours)
        else:
            reason = "AMENT_PREFIX_PATH is empty; source the setup file of its workspace"
            at = node.where("run.package")
            yield UnresolvedProgram(at=at, subject=subject, reason=reason)


def _missing(node: Node, part: str, subject: str, problem: LifecycleError, *, ours: bool) -> _Found:
    at = node.where(part)
    if ours:
        return error(RULE, at, problem.message, problem.hint)
    here = problem.message.replace("cannot find", "there is no", 1)
    reason = f"it is for machine {node.machine!r}; here, {here}"
    return UnresolvedProgram(at=at, subject=subject, reason=reason)


def _find_command(run: Run, environment: Mapping[str, str]) -> None:
    """Find a program, and the script of a Python one, as execvp(3) would in its folder.

    Raises:
        _NotThereError: it is not there.
    """
    word, *arguments = run.command
    folder = Path(run.working_directory or Path.cwd())
    if not os.path.isdir(folder):
        raise _NotThereError(f"cannot find the working directory {str(folder)!r}")
    if "/" in word:
        _find_file("program", folder / word)
        if shutil.which(folder / word) is None:
            raise _NotThereError(f"cannot run {word!r}: it is not executable")
    else:
        path = {**environment, **dict(run.environment)}.get("PATH", os.defpath)
        folders = os.pathsep.join(str(folder / each) for each in path.split(os.pathsep))
        if shutil.which(word, path=folders) is None:
            hint = "install it, name its path, or set PATH in run.environment"
            raise _NotThereError(f"cannot find program {word!r} on PATH", hint=hint)
    script = next(iter(arguments), "-")
    if _PYTHON.fullmatch(Path(word).name) and not script.startswith("-"):
        _find_file("script", folder / script)


def _find_file(what: str, file: Path) -> None:
    if not os.path.exists(file):
        names: list[str] = []
        with contextlib.suppress(OSError, ValueError):
            names = sorted(each.name for each in file.parent.iterdir())
        hint = did_you_mean(file.name, names)
        raise _NotThereError(f"cannot find {what} {file.name!r} in {str(file.parent)!r}", hint=hint)


def _python(node: Node, sources: _Sources, *, ours: bool) -> Iterator[_Found]:
    subject = f"class {node.run.python!r}"
    at = node.where("run.python")
    module, _, name = node.run.python.partition(":")
    try:
        found = sources.read_class(module, name)
    except _NotThereError as problem:
        # A module that is not here may be there; one that is here lacks the class there, too.
        here = ours or not isinstance(problem, _NoModuleError)
        yield _missing(node, "run.python", subject, problem, ours=here)
        return
    except _UnknownError as problem:
        yield UnresolvedProgram(at=at, subject=subject, reason=problem.message)
        return
    if found.kind is _Kind.NO_NODE:
        yield error(
            RULE,
            at,
            f"cannot use {name!r} of {module} ({found.file}) as a node: it is no node class",
            "derive it from lifecycle.LifecycleNode, or from rclpy.node.Node",
        )
        return
    if node.managed and found.kind is _Kind.PLAIN:
        message = f"cannot manage {node.key!r}: {name} ({found.file}) is a plain node"
        hint = "write 'managed: false'; it is held by its executor until the system is verified"
        yield error(RULE, at, message, hint)
    # What of a class is unknown may bring along what seems to be missing.
    if found.unknown:
        of = "handlers" if found.kind is _Kind.OURS else "node class"
        yield UnresolvedProgram(at=at, subject=f"{of} of {subject}", reason=found.unknown)
    elif ours and importlib.util.find_spec("rclpy"):
        for package, place in sources.missing(found):
            message = f"cannot import {package!r}, as {place} does: it is not installed here"
            yield warning(IMPORT, at, message, "install it where the node runs")
    yield from _uncalled(found, at)
    if not found.unknown and not node.parameter_files:
        yield from _parameters(node, found, at)
    problems = [*_endpoints(node, found, at)] if found.kind is _Kind.OURS else []
    if problems and any(call.rpartition(".")[2] in _DECLARES for call, _, _ in found.calls):
        reason = f"its code declares endpoints itself; {problems[0].message}"
        yield UnresolvedProgram(at=at, subject=f"endpoints of {subject}", reason=reason)
    else:
        yield from problems


def _folders(node: Node) -> tuple[str, ...]:
    """Return where modules are looked for first, as a host does."""
    given = dict(node.run.environment).get("PYTHONPATH", "").split(os.pathsep)
    beside = [str(Path(node.at.file).absolute().parent)] if node.at.file else []
    first = node.run.working_directory or str(Path.cwd())
    return tuple(dict.fromkeys((first, *beside, *filter(None, given), str(Path.cwd()))))


def _endpoints(node: Node, found: _Class, at: Position) -> Iterator[Diagnostic]:
    """Yield handlers without endpoint, and endpoints without handler."""
    declared: dict[EndpointKind, dict[str, Position]] = {}
    for each in node.interface.endpoints:
        declared.setdefault(each.kind, {})[each.name] = each.at
    served = {(call.removeprefix("lifecycle."), name) for call, name, _ in found.calls}
    for call, name, place in found.calls:
        kind = _HANDLERS.get(call.removeprefix("lifecycle."))
        if kind and name and name not in (known := declared.get(kind, {})):
            message = f"cannot use handler @{call}({name!r}) ({place}): {node.key!r} declares no"
            yield error(UNHANDLED, at, f"{message} {kind.noun} {name!r}", _declared(name, known))
    for word, kind in _HANDLERS.items() if not found.unknown else ():
        for name, where in declared.get(kind, {}).items():
            if word != "on_goal" and served.isdisjoint({(word, name), (word, None)}):
                message = (
                    f"cannot serve {kind.noun} {name!r}: no method of {found.name} ({found.file}) "
                    f"is decorated with @{word}({name!r})"
                )
                yield error(UNHANDLED, where, message)


def _uncalled(found: _Class, at: Position) -> Iterator[Diagnostic]:
    """Yield methods that are called almost as a transition callback is, and by nothing."""
    for module, class_ in found.bases if found.kind is not _Kind.PLAIN else ():
        for method in class_.body:
            if not isinstance(method, _Function) or method.decorator_list:
                continue
            name = method.name
            near = difflib.get_close_matches(name, _CALLBACKS, n=1, cutoff=0.85)
            is_slip = name.startswith("on_") and name not in _CALLBACKS and near
            if is_slip and len(re.findall(rf"\b{name}\b", module.text)) == 1:
                what = f"{class_.name}.{name} ({module.place(method)})"
                message = f"cannot tell what {what} is for: nothing calls it"
                yield warning(UNCALLED, at, message, f"did you mean {near[0]!r}?")


def _parameters(node: Node, found: _Class, at: Position) -> Iterator[Diagnostic]:
    """Yield the parameters that code gets by a literal name, and that nothing declares."""
    declared = [each.name for each in node.interface.parameters]
    known = {*declared, *(name for name, _ in node.parameters)}
    declares = {name for call, name, _ in found.calls if call.endswith(".declare_parameter")}
    # A name that is computed may be any, and `allow_undeclared_parameters` and its like allow all.
    many = any(re.search("declared?_parameters", module.text) for module, _ in found.bases)
    for call, name, place in () if many or None in declares else found.calls:
        if call != "self.get_parameter" or name is None:
            continue
        if name not in known | declares and not is_implicit(name):
            message = (
                f"cannot get parameter {name!r} in {place}: {node.key!r} declares none of that name"
            )
            yield warning(PARAMETER, at, message, _declared(name, declared))


def _declared(name: str, declared: Collection[str]) -> str:
    listed = ", ".join(map(repr, declared)) or "none"
    return f"{did_you_mean(name, declared)} declared: {listed}".lstrip()


class _Kind(enum.Enum):
    """What kind of node a class is; the names of what need not be read to know that."""

    OURS = r"lifecycle\.(\w+\.)*LifecycleNode"
    MANAGED = r"rclpy\.((\w+\.)*LifecycleNode(Mixin)?|lifecycle\..*)"
    PLAIN = r"rclpy\.(\w+\.)*Node"
    NO_NODE = r"(builtins|typing|abc|enum|typing_extensions)\.\w+"
    UNKNOWN = r"\Z."  # a base cannot be found, or it is a function that returns nodes


_Function = (ast.FunctionDef, ast.AsyncFunctionDef)


class _Module(msgspec.Struct):
    """A module's source.

    Attributes:
        names: what its top imports and defines, by full name.
        definitions: its classes, and functions without decorators.
    """

    name: str
    file: str
    text: str
    body: list[ast.stmt]
    names: dict[str, str]
    definitions: dict[str, ast.ClassDef | ast.FunctionDef]

    def place(self, node: ast.stmt | ast.expr) -> str:
        """Return where a part of it is, `file:line`."""
        return f"{self.file}:{node.lineno}"

    def full_name(self, expression: ast.expr) -> str:
        """Return the full name of what an expression names; empty if it is not a plain name."""
        head, _, rest = ast.unparse(expression).partition("[")[0].partition(".")
        full = self.names.get(head, f"builtins.{head}" if hasattr(builtins, head) else "")
        return f"{full}.{rest}".rstrip(".") if full else ""


class _Class(msgspec.Struct, kw_only=True):
    """What the source of a class, or of a function that returns nodes, shows.

    Attributes:
        bases: the class and its bases, as far as they were found; none of a function.
        calls: what its code calls, the first argument if that is a text, and `file:line`.
        unknown: why more may belong to it than is known; empty if nothing does.
    """

    name: str
    file: str = "rclpy"
    kind: _Kind = _Kind.UNKNOWN
    bases: list[tuple[_Module, ast.ClassDef]] = []
    calls: list[tuple[str, str | None, str]] = []
    unknown: str = ""


class _Sources:
    """Modules as one process would find them, which looks first in some folders."""

    def __init__(self, folders: Sequence[str]) -> None:
        self._folders = tuple(folders)
        self._modules: dict[str, _Module] = {}
        importlib.invalidate_caches()

    def read_class(self, module: str, name: str) -> _Class:
        """Return what the class, or function, `module:name` is.

        Raises:
            _NotThereError: there is no such module, or no such class in it.
            _UnknownError: that cannot be decided.
        """
        found = self._named(f"{module}.{name}")
        if isinstance(found, _Kind):
            return _Class(name=name, kind=found)
        class_ = _Class(name=name, file=found[0].file)
        if isinstance(found[1], ast.ClassDef):
            class_.kind = self._collect(found[0], found[1], class_)
            if class_.unknown and class_.kind in (_Kind.PLAIN, _Kind.NO_NODE):
                class_.kind = _Kind.UNKNOWN
            _read_methods(class_)
        return class_

    def _collect(self, module: _Module, node: ast.ClassDef, into: _Class) -> _Kind:
        """Add a class and its bases to what is known; return what kind it is."""
        kinds = {_Kind.NO_NODE}
        into.bases.append((module, node))
        if node.decorator_list or node.keywords:
            into.unknown = into.unknown or f"class {node.name} has a decorator or a metaclass"
        for base in node.bases:
            try:
                found = self._named(module.full_name(base))
            except (_NotThereError, _UnknownError) as problem:
                why = f"its base {ast.unparse(base)} is not known: {problem}"
                into.unknown = into.unknown or why
                continue
            if isinstance(found, _Kind):
                kinds.add(found)
            elif isinstance(found[1], ast.ClassDef) and found not in into.bases:
                kinds.add(self._collect(found[0], found[1], into))
        return next(each for each in _Kind if each in kinds)

    def missing(self, found: _Class) -> Iterator[tuple[str, str]]:
        """Yield what the top of a class's module imports and is not there: package, `file:line`."""
        for module, _ in found.bases[:1]:
            for statement in module.body:
                names: list[str] = []
                if isinstance(statement, ast.Import):
                    names = [each.name for each in statement.names]
                elif isinstance(statement, ast.ImportFrom) and not statement.level:
                    names = [str(statement.module)]
                for package in dict.fromkeys(each.partition(".")[0] for each in names):
                    if self._spec(package) is None:
                        yield package, module.place(statement)

    def _named(
        self, dotted: str, depth: int = 0
    ) -> tuple[_Module, ast.ClassDef | ast.FunctionDef] | _Kind:
        """Return what a full name refers to, through imports; its kind where that is known.

        Raises:
            _NotThereError: nothing in its module is called so.
            _UnknownError: that cannot be decided.
        """
        for kind in _Kind:
            if re.fullmatch(kind.value, dotted):
                return kind
        place, _, name = dotted.rpartition(".")
        if not place or depth > _MOST_IMPORTS:
            raise _UnknownError("it has to be evaluated")
        module = self._modules.get(place) or self._modules.setdefault(place, self._read(place))
        if name in module.definitions:
            return module, module.definitions[name]
        full = module.names.get(name, "")
        if full.rpartition(".")[0] and full != dotted:
            return self._named(full, depth + 1)
        if re.search(rf"\b{re.escape(name)}\b|{_DYNAMIC}", module.text):
            raise _UnknownError(f"{name} is made by running {module.file}")
        classes = [each for each in module.definitions if not each.startswith("_")]
        raise _NotThereError(
            f"cannot find class {name!r} in {module.name} ({module.file}); it has "
            f"{', '.join(classes) or 'none'}",
            hint=did_you_mean(name, classes),
        )

    def _spec(self, package: str) -> importlib.machinery.ModuleSpec | None:
        """Return where a package is, at the top: also built in, or an editable installation."""
        folders = (*self._folders, *filter(None, sys.path))
        with contextlib.suppress(ImportError, AttributeError, ValueError):
            return importlib.machinery.PathFinder.find_spec(
                package, folders
            ) or importlib.util.find_spec(package)
        return None

    def _locate(self, name: str) -> str:
        """Return the source file of a module."""
        first, *parts = name.split(".")
        spec = self._spec(first)
        for part in parts if spec else ():
            inside = spec.submodule_search_locations if spec else None
            spec = importlib.machinery.PathFinder.find_spec(part, inside or ())
        if spec is None:
            where = f"it is looked for in {', '.join(self._folders)} and in what is installed"
            raise _NoModuleError(f"cannot find module {name!r}", hint=where)
        if not spec.origin or not spec.origin.endswith(".py"):
            raise _UnknownError(f"{name} is not written in Python")
        return spec.origin

    def _read(self, name: str) -> _Module:
        file = Path(self._locate(name))
        short = str(file.relative_to(Path.cwd()) if file.is_relative_to(Path.cwd()) else file)
        try:
            text = file.read_text("utf-8-sig", "replace")
            body = ast.parse(text).body
        except SyntaxError as problem:
            where = f"{short}:{problem.lineno}: {problem.msg}"
            raise _NotThereError(f"cannot import {name!r}: {where}") from problem
        except (OSError, ValueError, RecursionError, MemoryError) as problem:
            raise _UnknownError(f"{short} cannot be read: {problem}") from problem
        module = _Module(name, short, text, body, {}, {})
        package = name if file.name == "__init__.py" else name.rpartition(".")[0]
        for statement in body:
            match statement:
                case ast.Import():
                    for alias in statement.names:
                        first = alias.name.partition(".")[0]  # `import a.b` binds `a`
                        module.names[alias.asname or first] = alias.name if alias.asname else first
                case ast.ImportFrom():
                    parts = package.split(".")
                    parts = parts[: len(parts) - statement.level + 1] if statement.level else []
                    start = ".".join([*parts, *filter(None, [statement.module])])
                    for alias in statement.names:
                        module.names[alias.asname or alias.name] = f"{start}.{alias.name}"
                case ast.ClassDef() | ast.FunctionDef(decorator_list=[]):
                    module.names[statement.name] = f"{name}.{statement.name}"
                    module.definitions[statement.name] = statement
        return module


def _read_methods(class_: _Class) -> None:
    """Read what the methods of a class and its bases call, decorators included."""
    hidden: set[str] = set()  # a handler hides that of its name in the bases
    for module, node in class_.bases:
        for statement in node.body:
            name = getattr(statement, "name", "")
            decorators = getattr(statement, "decorator_list", [])
            if name in hidden:
                continue
            hidden.update([name] if decorators else [])
            for each in map(ast.unparse, decorators):
                shown = each.partition("(")[0]
                if shown.rpartition(".")[2] not in {*_HANDLERS, *_HARMLESS}:
                    why = f"{node.name}.{name} is decorated with @{shown}"
                    class_.unknown = class_.unknown or why
            for part in ast.walk(statement):
                match part:
                    case ast.Call(args=[ast.Constant(value=str(text)), *_]):
                        class_.calls.append((ast.unparse(part.func), text, module.place(part)))
                    case ast.Call():
                        class_.calls.append((ast.unparse(part.func), None, module.place(part)))
