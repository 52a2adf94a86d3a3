"""Read Python node classes from their source: bases, handlers, constructor; imports nothing.

`NotThereError` is what Python itself would refuse, `UnknownError` what only running the code can
show (star imports, names made by assignments or under conditions, classes that are decorated).
"""

from __future__ import annotations

import ast
import builtins
import enum
import importlib.machinery
import importlib.util
import itertools
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec

from lifecycle.errors import LifecycleError, did_you_mean
from lifecycle.manifest.model import EndpointKind

_MOST_BYTES = 4 * 2**20
_MOST_IMPORTS = 20
_DYNAMIC = re.compile(r"import \*|__getattr__|globals\(\)|vars\(\)|exec\(|sys\.modules")
"""What makes names of a module that its statements do not show."""

_HANDLERS = {
    "on_message": EndpointKind.SUBSCRIPTION,
    "on_service": EndpointKind.SERVICE_SERVER,
    "on_action": EndpointKind.ACTION_SERVER,
    "on_goal": EndpointKind.ACTION_SERVER,
}
_HARMLESS = {"override", "abstractmethod", "on_timer", "setter", "getter", "deleter"}
ACCESS = {
    "publisher": EndpointKind.PUBLISHER,
    "client": EndpointKind.SERVICE_CLIENT,
    "action_client": EndpointKind.ACTION_CLIENT,
}
"""Methods of a LifecycleNode by which its code asks for an endpoint, by name."""

_OF_HOST = {"rclpy.init", "rclpy.spin", "rclpy.shutdown", "init", "spin", "shutdown"}
"""What a script's `main` calls, and a host does itself."""


class NotThereError(LifecycleError):
    """Python would refuse it: no such module, no such class."""


class NoModuleError(NotThereError):
    """There is no such module here; elsewhere there may be one."""


class UnknownError(LifecycleError):
    """Only running it can show that; the message is the reason, half a sentence."""


class ClassKind(enum.Enum):
    """What kind of node a class is."""

    OURS = "lifecycle.LifecycleNode"
    MANAGED = "rclpy.lifecycle.Node"
    PLAIN = "rclpy.node.Node"
    FUNCTION = "function"  # which nodes it returns is known once it has
    NO_NODE = "no node"
    UNKNOWN = "unknown"  # one of its bases cannot be found


_NODES = (ClassKind.OURS, ClassKind.MANAGED, ClassKind.PLAIN)

Function = (ast.FunctionDef, ast.AsyncFunctionDef)
AnyFunction = ast.FunctionDef | ast.AsyncFunctionDef


class _Module(msgspec.Struct):
    """A module's source; `bound` holds the top statements that bind a name, anywhere inside."""

    name: str
    file: Path
    is_package: bool
    text: str
    bound: dict[str, list[ast.stmt]]

    def only(self, name: str) -> ast.stmt | None:
        """Return the one statement that binds a name; None if there is none, or several do."""
        bound = self.bound.get(name, [])
        return bound[0] if len(bound) == 1 else None


class Definition(msgspec.Struct, frozen=True):
    """A class or function, and the module that defines it."""

    module: _Module
    node: ast.ClassDef | AnyFunction

    def place(self, node: ast.stmt | ast.expr) -> str:
        """Return where a part of it is, `file:line`."""
        return f"{_shown(self.module.file)}:{node.lineno}"


class Handler(msgspec.Struct, frozen=True, kw_only=True):
    """A method that is decorated as the handler of an endpoint.

    Attributes:
        text: `Class.method`.
        place: `file:line`.
        decides: it decides on an action's goals, instead of executing them.
    """

    kind: EndpointKind
    name: str
    text: str
    place: str
    decides: bool


class NodeClass(msgspec.Struct, frozen=True, kw_only=True):
    """What the source of a class, or of a function that returns nodes, shows.

    Attributes:
        file: empty of a class of rclpy.
        takes: keyword arguments that it is called with; None where any is taken, or nothing is
            known.
        needs: those of them without a default.
        spins: where a function calls what its host has done or does, `rclpy.spin (nodes.py:7)`.
        bases: the class and its bases, as far as they were found; none of a function.
        unknown: why more may belong to it than is known; empty if nothing does.
    """

    name: str
    file: str
    kind: ClassKind
    takes: tuple[str, ...] | None = None
    needs: tuple[str, ...] = ()
    spins: str = ""
    bases: tuple[Definition, ...] = ()
    handlers: tuple[Handler, ...] = ()
    unknown: str = ""

    def __str__(self) -> str:
        return f"{self.name} ({self.file or 'rclpy'})"

    @property
    def body(self) -> list[tuple[Definition, ast.stmt]]:
        """The statements of the class and its bases."""
        return [(each, one) for each in self.bases for one in each.node.body]

    @property
    def methods(self) -> list[tuple[Definition, AnyFunction]]:
        """Their methods, those of the class first."""
        return [(each, method) for each, method in self.body if isinstance(method, Function)]


class Sources:
    """Modules as one process would find them, which looks first in some folders."""

    def __init__(self, folders: Sequence[str]) -> None:
        self._folders = tuple(folders)
        self._modules: dict[str, _Module] = {}
        importlib.invalidate_caches()

    def read_class(self, module: str, name: str) -> NodeClass:
        """Return what the class, or function, `module:name` is.

        Raises:
            NotThereError: there is no such module, or no such class in it.
            UnknownError: that cannot be decided.
        """
        found = self._named(f"{module}.{name}")
        if isinstance(found, str):
            kind = next((each for each in _NODES if each.value == found), ClassKind.UNKNOWN)
            return NodeClass(name=name, file="", kind=kind)
        if isinstance(found.node, ast.ClassDef):
            return self._described(found)
        takes, needs = _arguments(found.node.args)
        return NodeClass(
            name=name,
            file=_shown(found.module.file),
            kind=ClassKind.FUNCTION,
            takes=takes,
            needs=needs,
            spins=_spins(found),
        )

    def _described(self, value: Definition) -> NodeClass:
        bases, known, unknown = self._bases(value)
        kind = next((each for each in _NODES if each.value in known), ClassKind.NO_NODE)
        if unknown and kind in (ClassKind.PLAIN, ClassKind.NO_NODE):
            kind = ClassKind.UNKNOWN
        found = NodeClass(
            name=value.node.name,
            file=_shown(value.module.file),
            kind=kind,
            bases=bases,
            unknown=unknown,
        )
        takes: tuple[str, ...] | None = None
        needs: tuple[str, ...] = ()
        constructor = next((each for _, each in found.methods if each.name == "__init__"), None)
        if constructor and not unknown:
            takes, needs = _arguments(constructor.args, is_method=True)
        handlers: dict[str, list[Handler]] = {}  # a method hides those of its name in the bases
        for each, method in found.methods:
            marks, why = _marks(each, method)
            unknown = unknown or why
            if marks:
                handlers.setdefault(method.name, marks)
        for each, statement in found.body:
            if _makes_methods(statement):
                why = f"methods of {each.node.name} are made in line {statement.lineno}"
                unknown = unknown or why
        return msgspec.structs.replace(
            found,
            takes=takes,
            needs=needs,
            handlers=tuple(itertools.chain.from_iterable(handlers.values())),
            unknown=unknown,
        )

    def missing(self, found: NodeClass) -> Iterator[tuple[str, str]]:
        """Yield what the top of a class's module imports and is not there: package, `file:line`."""
        if not found.bases:
            return
        of = found.bases[0]
        for statement in dict.fromkeys(itertools.chain(*of.module.bound.values())):
            names: list[str] = []
            if isinstance(statement, ast.Import):
                names = [each.name for each in statement.names]
            elif isinstance(statement, ast.ImportFrom) and not statement.level:
                names = [str(statement.module)]
            for package in dict.fromkeys(each.partition(".")[0] for each in names):
                if not self._has(package):
                    yield package, of.place(statement)

    def _has(self, package: str) -> bool:
        try:
            self._locate(package)
        except (NotThereError, UnknownError) as problem:
            return not isinstance(problem, NoModuleError)
        return True

    def _bases(self, value: Definition) -> tuple[tuple[Definition, ...], set[str], str]:
        """Return a class and its bases, the known ones by name, and what is open."""
        found: list[Definition] = []
        known: set[str] = set()
        unknown = ""
        left = [value]
        while left:
            each = left.pop(0)
            if each in found or not isinstance(each.node, ast.ClassDef):
                continue
            found.append(each)
            if each.node.decorator_list or each.node.keywords:
                unknown = unknown or f"class {each.node.name} has a decorator or a metaclass"
            above: list[Definition] = []
            for base in each.node.bases:
                try:
                    named = self._named(_dotted(each.module, base))
                except (NotThereError, UnknownError) as problem:
                    unknown = unknown or f"its base {ast.unparse(base)} is not known: {problem}"
                    continue
                if isinstance(named, str):
                    known.add(named)
                else:
                    above.append(named)
            left = above + left
        return tuple(found), known, unknown

    def _named(self, dotted: str, depth: int = 0) -> Definition | str:
        """Return what a full name stands for, through imports; text for what need not be read.

        Raises:
            NotThereError: nothing in its module is called so.
            UnknownError: that cannot be decided.
        """
        if known := _known(dotted):
            return known
        place, _, name = dotted.rpartition(".")
        if not place or depth > _MOST_IMPORTS:
            raise UnknownError("it has to be evaluated")
        module = self._module(place)
        only = module.only(name)
        if isinstance(only, ast.ImportFrom):
            return self._named(_dotted(module, ast.Name(name)), depth + 1)
        if isinstance(only, ast.ClassDef) or (
            isinstance(only, Function) and not only.decorator_list
        ):
            return Definition(module, only)
        file = _shown(module.file)
        if re.search(rf"\b{re.escape(name)}\b", module.text):
            raise UnknownError(f"{name} is made by running {file}")
        if dynamic := _DYNAMIC.search(module.text):
            raise UnknownError(f"{module.name} uses {dynamic.group()} ({file})")
        classes = [
            each
            for each, (first, *_) in module.bound.items()
            if isinstance(first, ast.ClassDef) and not each.startswith("_")
        ]
        has = f"; it has {', '.join(classes)}" if classes else "; it has no classes"
        raise NotThereError(
            f"cannot find class {name!r} in {module.name} ({file}){has}",
            hint=did_you_mean(name, classes),
        )

    def _module(self, name: str) -> _Module:
        if name not in self._modules:
            self._modules[name] = _read(name, *self._locate(name))
        return self._modules[name]

    def _locate(self, name: str) -> tuple[Path, bool]:
        """Return the source file of a module, and whether it is a package."""
        paths: Sequence[str] | None = (*self._folders, *filter(None, sys.path))
        origin: str | None = None
        inside = ""
        for part in name.split("."):
            file = _shown(Path(origin or ""))
            if paths is None:
                raise NotThereError(f"cannot import {name!r}: {inside!r} is no package ({file})")
            so_far = f"{inside}.{part}".lstrip(".")
            # By its last name: of nested namespace packages it would ask for the imported parent.
            spec = importlib.machinery.PathFinder.find_spec(part, paths)
            if spec is None and not inside:
                spec = _found_otherwise(so_far)
            if spec is None and origin and "__path__" in self._module(inside).text:
                raise UnknownError(f"{inside} changes how its modules are found ({file})")
            if spec is None:
                hint = f"it is looked for in {', '.join(self._folders)} and in what is installed"
                if inside:
                    hint = f"looked in {', '.join(_shown(Path(each)) for each in paths)}"
                raise NoModuleError(f"cannot find module {so_far!r}", hint=hint)
            found = spec.submodule_search_locations
            origin, paths, inside = spec.origin, found and list(found), so_far
        if origin is None:
            raise NotThereError(f"cannot find anything in {name!r}: it has no __init__.py")
        if not origin.endswith(".py"):
            raise UnknownError(f"{name} is compiled")
        return Path(origin), paths is not None


def _found_otherwise(name: str) -> importlib.machinery.ModuleSpec | None:
    """Ask what else finds modules at the top: built in, frozen, editable installations."""
    try:
        return importlib.util.find_spec(name)
    except (ImportError, AttributeError, ValueError) as problem:
        raise UnknownError(f"{name} cannot be looked for: {problem}") from problem


def _read(name: str, file: Path, is_package: bool) -> _Module:
    try:
        data = file.read_bytes()
        if len(data) > _MOST_BYTES:
            raise UnknownError(f"{_shown(file)} is too large to be read")
        tree = ast.parse(data)
    except SyntaxError as problem:
        raise NotThereError(
            f"cannot import {name!r}: {_shown(file)}:{problem.lineno}: {problem.msg}"
        ) from problem
    except (OSError, ValueError, RecursionError, MemoryError) as problem:
        raise UnknownError(f"{_shown(file)} cannot be read: {problem}") from problem
    module = _Module(name, file, is_package, data.decode("utf-8", "replace"), {})
    for statement in tree.body:
        for each in binds(statement):
            module.bound.setdefault(each, []).append(statement)
    return module


def binds(statement: ast.stmt) -> set[str]:
    """Return the names that a statement binds, also under conditions inside it."""
    if isinstance(statement, (ast.ClassDef, *Function)):
        return {statement.name}
    names = set()
    for each in ast.walk(statement):
        if isinstance(each, (ast.ClassDef, *Function)):
            names.add(each.name)
        elif isinstance(each, ast.Name) and isinstance(each.ctx, ast.Store):
            names.add(each.id)
        elif isinstance(each, ast.alias):
            names.add(_bound_by(each))
    return names


def _bound_by(alias: ast.alias) -> str:
    return alias.asname or alias.name.partition(".")[0]


def _dotted(module: _Module, expression: ast.expr) -> str:
    """Return the full name of what an expression names; empty if it is not a plain name."""
    if isinstance(expression, ast.Subscript):
        return _dotted(module, expression.value)
    if isinstance(expression, ast.Attribute):
        outer = _dotted(module, expression.value)
        return outer and f"{outer}.{expression.attr}"
    name = expression.id if isinstance(expression, ast.Name) else ""
    bound = module.bound.get(name, [])
    if not bound and hasattr(builtins, name):
        return f"builtins.{name}"
    found = {_imported(module, each, name) or f"{module.name}.{name}" for each in bound}
    return found.pop() if len(found) == 1 else ""


def _imported(module: _Module, statement: ast.stmt, name: str) -> str:
    """Return the full name of what an import binds to a name; empty if it is no import of it."""
    if not isinstance(statement, (ast.Import, ast.ImportFrom)):
        return ""
    alias = next(each for each in statement.names if _bound_by(each) == name)
    if isinstance(statement, ast.Import):
        return alias.name if alias.asname else name  # `import a.b` binds `a`
    parts = module.name.split(".") if statement.level else []
    parts = parts[: len(parts) - statement.level + int(module.is_package)]
    return ".".join([*parts, *filter(None, [statement.module]), alias.name])


def _known(dotted: str) -> str:
    """Return the public name of what need not be read; empty of everything else."""
    module, _, name = dotted.rpartition(".")
    room = module.partition(".")[0]
    if room == "lifecycle" and name in {"LifecycleNode", "on_timer", *_HANDLERS}:
        return f"lifecycle.{name}"
    if room == "rclpy" and (
        name in {"LifecycleNode", "LifecycleNodeMixin"} or "lifecycle" in module
    ):
        return ClassKind.MANAGED.value
    if room == "rclpy" and name == "Node":
        return ClassKind.PLAIN.value
    return dotted if module in {"builtins", "typing", "abc", "enum", "typing_extensions"} else ""


def _arguments(
    given: ast.arguments, *, is_method: bool = False
) -> tuple[tuple[str, ...] | None, tuple[str, ...]]:
    """Return the keywords that a function takes, None for any, and those that it needs."""
    positional = [each.arg for each in (*given.posonlyargs, *given.args)]
    keywords = zip(given.kwonlyargs, given.kw_defaults, strict=True)
    needs = positional[: len(positional) - len(given.defaults)]
    needs += [each.arg for each, default in keywords if default is None]
    own = positional[:1] if is_method else []
    takes = tuple(each.arg for each in (*given.args, *given.kwonlyargs) if each.arg not in own)
    return None if given.kwarg else takes, tuple(each for each in needs if each not in own)


def _spins(function: Definition) -> str:
    for node in ast.walk(function.node):
        if isinstance(node, ast.Call) and ast.unparse(node.func) in _OF_HOST:
            return f"{ast.unparse(node.func)} ({function.place(node)})"
    return ""


def _makes_methods(statement: ast.stmt) -> bool:
    """Whether a statement of a class body makes methods otherwise than by `def`."""
    return not isinstance(statement, (*Function, ast.ClassDef)) and any(
        isinstance(node, (*Function, ast.Lambda))
        or (isinstance(node, ast.Name) and node.id in _HANDLERS)
        for node in ast.walk(statement)
    )


def _marks(of: Definition, function: AnyFunction) -> tuple[list[Handler], str]:
    """Return the handlers that a method is, and why there may be more."""
    marks: list[Handler] = []
    text = f"{of.node.name}.{function.name}"
    unknown = f"{text} replaces that of LifecycleNode" if function.name in ACCESS else ""
    for decorator in function.decorator_list:
        called = decorator.func if isinstance(decorator, ast.Call) else decorator
        shown = ast.unparse(called)
        dotted = _dotted(of.module, called)
        if shown.rpartition(".")[2] in _HARMLESS or dotted.startswith("builtins."):
            continue
        word = _known(dotted).removeprefix("lifecycle.")
        name = _literal(of.module, decorator) if word in _HANDLERS else None
        if name is None:
            unknown = unknown or f"{text} is decorated with @{shown}"
            continue
        handler = Handler(
            kind=_HANDLERS[word],
            name=name,
            text=text,
            place=of.place(function),
            decides=word == "on_goal",
        )
        marks.insert(0, handler)  # the decorator next to the function marks it first
    return marks, unknown


def _literal(module: _Module, decorator: ast.expr) -> str | None:
    """Return the name that a decorator is given: a string, or a constant of the module."""
    match decorator:
        case (
            ast.Call(args=[value], keywords=[])
            | ast.Call(args=[], keywords=[ast.keyword(value=value)])
        ):
            if isinstance(value, ast.Name) and isinstance(of := module.only(value.id), ast.Assign):
                value = of.value
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                return value.value
    return None


def _shown(file: Path) -> str:
    """Return a path as short as it can be written from here."""
    try:
        return str(file.relative_to(Path.cwd()))
    except ValueError:
        return str(file)
