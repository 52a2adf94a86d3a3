"""Find and read Python node classes without importing them: module, bases, methods, endpoints.

Owns: `Sources`, which follows `module:Class` through source files as `node.author.spec` would
through imports, `NodeClass`, what a class declares of endpoints, and the two ways in which that
ends: `NotThereError`, what Python itself would refuse, and `UnknownError`, what only running it can
show. Reads files; runs nothing.
"""

from __future__ import annotations

import ast
import builtins
import importlib.machinery
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from lifecycle import dataclasses
from lifecycle.errors import LifecycleError
from lifecycle.manifest import EndpointKind, did_you_mean

_MOST_BYTES = 4 * 2**20
_DEEPEST = 40
_COMPILED = (*importlib.machinery.EXTENSION_SUFFIXES, *importlib.machinery.BYTECODE_SUFFIXES)
_DYNAMIC = ("globals()", "exec(", "vars()", "sys.modules[", "setattr(sys.modules")
_MOVING = ("__path__", "sys.modules", "sys.meta_path")

_HANDLERS = {
    "on_message": EndpointKind.SUBSCRIPTION,
    "on_service": EndpointKind.SERVICE_SERVER,
    "on_action": EndpointKind.ACTION_SERVER,
    "on_goal": EndpointKind.ACTION_SERVER,
}
_HARMLESS = {"property", "staticmethod", "classmethod", "override", "abstractmethod", "on_timer"}
_ACCESS = {
    "publisher": EndpointKind.PUBLISHER,
    "client": EndpointKind.SERVICE_CLIENT,
    "action_client": EndpointKind.ACTION_CLIENT,
}
_DECLARES = {
    *("declare_publisher", "declare_subscription", "declare_service", "declare_client"),
    *("declare_action", "declare_action_client"),
}

_Function = (ast.FunctionDef, ast.AsyncFunctionDef)
_MANAGED = {
    "lifecycle.LifecycleNode",
    "rclpy.lifecycle.LifecycleNode",
    "rclpy.lifecycle.LifecycleNodeMixin",
    "rclpy.lifecycle.Node",
}
_OF_HOST = {"rclpy.init", "rclpy.spin", "rclpy.shutdown", "init", "spin", "shutdown"}
"""What a script's `main` calls, and a host does itself."""


class NotThereError(LifecycleError):
    """Python would refuse it: no such module, no such class, not a class."""


class UnknownError(LifecycleError):
    """Only running it can show that; the message is the reason, half a sentence."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Handler:
    """A decorated method.

    Attributes:
        method: `Class.method`.
        decorator: `@on_message`.
        decides: on an action's goals, instead of executing them.
        place: `file:line`.
    """

    kind: EndpointKind
    name: str
    method: str
    decorator: str
    decides: bool
    place: str


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Access:
    """An endpoint that code asks for by a literal name: `self.publisher("chatter")`."""

    kind: EndpointKind
    name: str
    text: str
    place: str


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class NodeClass:
    """What the source of a class shows.

    Attributes:
        is_node: it is a node class, or a function; None if one of its bases cannot be found.
        is_ours: it is a LifecycleNode of this package.
        is_managed: it is that or one of rclpy.lifecycle; None of a function, whose nodes are known
            once it has returned.
        takes: keyword arguments of its constructor, or of the function; None where any is taken,
            or nothing is known.
        needs: those of them without a default.
        spins: where a function calls what its host has done or does, `rclpy.spin (nodes.py:7)`.
        unknown: why more may belong to it than is known; empty if nothing does.
        declares: its code declares endpoints itself.
        has_health: it, or a base of it, has a `health` method of its own.
    """

    name: str
    file: str
    is_node: bool | None
    is_ours: bool
    is_managed: bool | None = None
    takes: tuple[str, ...] | None = None
    needs: tuple[str, ...] = ()
    spins: str = ""
    handlers: tuple[Handler, ...] = ()
    accesses: tuple[Access, ...] = ()
    unknown: str = ""
    declares: bool = False
    has_health: bool = False


@dataclasses.dataclass(slots=True)
class _Module:
    name: str
    file: Path
    is_package: bool
    text: str
    bound: dict[str, list[ast.AST]]
    stars: list[tuple[str, int]]


@dataclasses.dataclass(frozen=True, slots=True)
class _Class:
    module: _Module
    node: ast.ClassDef


@dataclasses.dataclass(frozen=True, slots=True)
class _Makes:
    """A function."""

    module: _Module
    node: ast.FunctionDef | ast.AsyncFunctionDef


@dataclasses.dataclass(frozen=True, slots=True)
class _Known:
    """A class, function or module that is known by its name alone."""

    name: str


@dataclasses.dataclass(frozen=True, slots=True)
class _Imported:
    name: str


_Value = _Class | _Makes | _Known | _Imported


class Sources:
    """Modules as one process would find them.

    Args:
        folders: looked in first, as `python -m` looks in its working directory.
    """

    def __init__(self, folders: Sequence[str]) -> None:
        self._folders = tuple(folders)
        self._paths = [*folders, *(each for each in sys.path if each)]
        self._modules: dict[str, _Module] = {}

    def read_class(self, module: str, name: str) -> NodeClass:
        """Return what the class, or function, `module:name` is.

        Raises:
            NotThereError: there is no such module, or no such class in it.
            UnknownError: that cannot be decided.
        """
        source = self._module(module)
        value = self._named(source, name, 0)
        if value is None:
            classes = [
                each
                for each, nodes in source.bound.items()
                if isinstance(nodes[-1], ast.ClassDef) and not each.startswith("_")
            ]
            has = f"; it has {', '.join(classes)}" if classes else "; it has no classes"
            raise NotThereError(
                f"cannot find class {name!r} in {module} ({_shown(source.file)}){has}",
                hint=did_you_mean(name, classes),
            )
        if isinstance(value, _Imported):
            raise NotThereError(f"cannot use {name!r} of {module} as a class: it is a module")
        if isinstance(value, _Known):
            node = value.name.rpartition(".")[2] in {"LifecycleNode", "Node"}
            return NodeClass(
                name=name,
                file="",
                is_node=node or None,
                is_ours=value.name == "lifecycle.LifecycleNode",
                is_managed=value.name in _MANAGED if node else None,
            )
        if isinstance(value, _Makes):
            takes, needs = _arguments(value.node, of_method=False)
            return NodeClass(
                name=name,
                file=_shown(value.module.file),
                is_node=True,
                is_ours=False,
                takes=takes,
                needs=needs,
                spins=_spins(value),
            )
        return self._described(value)

    def _described(self, value: _Class) -> NodeClass:
        line, known, unknown = self._line([value], 0)
        is_ours = "lifecycle.LifecycleNode" in known
        is_node = is_ours or any(each.startswith("rclpy.") for each in known)
        takes: tuple[str, ...] | None = None
        needs: tuple[str, ...] = ()
        constructors = [
            function
            for each in line
            for name, function in _methods(each.node)
            if name == "__init__" and isinstance(function, _Function)
        ]
        if constructors and not unknown:
            takes, needs = _arguments(constructors[0], of_method=True)
        found: dict[str, list[Handler]] = {}
        accesses: list[Access] = []
        declares = has_health = False
        for each in line:
            has_health = has_health or _binds_in_body(each.node, "health")
            for name, function in _methods(each.node):
                marks, why = self._marks(each, function)
                unknown = unknown or why
                if marks and name not in found:
                    found[name] = marks
                if name in _ACCESS:
                    unknown = unknown or f"{each.node.name}.{name} replaces that of LifecycleNode"
                accesses += _accesses(each, function)
            unknown = unknown or _made_in_body(each)
            declares = declares or any(
                isinstance(node, ast.Attribute) and node.attr in _DECLARES
                for node in ast.walk(each.node)
            )
        return NodeClass(
            name=value.node.name,
            file=_shown(value.module.file),
            is_node=True if is_node else None if unknown else False,
            is_ours=is_ours,
            is_managed=True if known & _MANAGED else None if unknown else False,
            takes=takes,
            needs=needs,
            handlers=tuple(each for marks in found.values() for each in marks),
            accesses=tuple(accesses),
            unknown=unknown,
            declares=declares,
            has_health=has_health,
        )

    def _line(self, classes: list[_Class], depth: int) -> tuple[list[_Class], set[str], str]:
        """Return the classes of a line of inheritance, the known ones by name, and what is open."""
        line: list[_Class] = []
        known: set[str] = set()
        unknown = ""
        for each in classes:
            line.append(each)
            if each.node.decorator_list:
                unknown = unknown or f"class {each.node.name} is decorated"
            if any(word.arg == "metaclass" for word in each.node.keywords):
                unknown = unknown or f"class {each.node.name} has a metaclass"
            for base in each.node.bases:
                shown = ast.unparse(base)
                try:
                    found = self._value(each.module, base, depth + 1)
                except (NotThereError, UnknownError) as problem:
                    unknown = unknown or f"its base {shown} is not known: {problem}"
                    continue
                if isinstance(found, _Known):
                    known.add(found.name)
                elif isinstance(found, _Class):
                    above, named, why = self._line([found], depth + 1)
                    line += [one for one in above if one not in line]
                    known |= named
                    unknown = unknown or why
                else:
                    unknown = unknown or f"its base {shown} is not known"
        return line, known, unknown

    def _value(self, module: _Module, expression: ast.expr, depth: int) -> _Value:
        """Return the value of an expression.

        Raises:
            NotThereError: it has none.
            UnknownError: that cannot be decided.
        """
        if isinstance(expression, ast.Subscript):
            return self._value(module, expression.value, depth)
        if isinstance(expression, ast.Name):
            found = self._named(module, expression.id, depth)
            if found is not None:
                return found
            if hasattr(builtins, expression.id):
                return _Known(f"builtins.{expression.id}")
            raise UnknownError(f"{expression.id} is not defined in {module.name}")
        if isinstance(expression, ast.Attribute):
            outer = self._value(module, expression.value, depth)
            if isinstance(outer, _Imported):
                return self._imported(outer.name, expression.attr, depth)
        raise UnknownError(f"{ast.unparse(expression)[:60]} has to be evaluated")

    def _imported(self, module: str, name: str, depth: int) -> _Value:
        """Return what `from module import name` gives."""
        known = _known(module, name)
        if known is not None:
            return known
        source = self._module(module)
        found = self._named(source, name, depth + 1)
        if found is not None:
            return found
        if source.is_package:
            self._locate(f"{module}.{name}")
            return _Imported(f"{module}.{name}")
        raise NotThereError(f"cannot import {name!r} from {module} ({_shown(source.file)})")

    def _named(self, module: _Module, name: str, depth: int) -> _Value | None:
        """Return the value of a name at the top of a module; None without one."""
        if depth > _DEEPEST:
            raise UnknownError(f"{name} goes through more than {_DEEPEST} modules")
        nodes = module.bound.get(name, [])
        if len(nodes) > 1:
            raise UnknownError(f"{name} is defined in several places of {_shown(module.file)}")
        if nodes:
            return self._bound(module, name, nodes[0], depth)
        for star, level in module.stars:
            source = self._module(_absolute(module, star, level))
            if not name.startswith("_"):
                found = self._named(source, name, depth + 1)
                if found is not None:
                    return found
        if "__getattr__" in module.bound:
            raise UnknownError(f"{module.name} has a __getattr__ ({_shown(module.file)})")
        for word in _DYNAMIC:
            if word in module.text:
                raise UnknownError(f"{module.name} uses {word} ({_shown(module.file)})")
        return None

    def _bound(self, module: _Module, name: str, node: ast.AST, depth: int) -> _Value:
        if isinstance(node, ast.ClassDef):
            return _Class(module, node)
        if isinstance(node, ast.ImportFrom):
            source = _absolute(module, node.module or "", node.level)
            original = next(each.name for each in node.names if (each.asname or each.name) == name)
            if source == module.name:  # `from . import part`: nothing but the module of that name
                self._locate(f"{source}.{original}")
                return _Imported(f"{source}.{original}")
            return self._imported(source, original, depth)
        if isinstance(node, ast.Import):
            each = next(one for one in node.names if _binds(one) == name)
            return _Imported(each.name if each.asname else each.name.partition(".")[0])
        if isinstance(node, (ast.Name, ast.Attribute)):
            return self._value(module, node, depth + 1)
        if isinstance(node, _Function) and not node.decorator_list:
            return _Makes(module, node)
        if isinstance(node, (ast.Constant, ast.List, ast.Dict, ast.Tuple, ast.Set)):
            raise NotThereError(
                f"cannot use {name!r} of {module.name} ({_shown(module.file)}:{node.lineno}) as a "
                f"class: it is {ast.unparse(node)[:60]}"
            )
        raise UnknownError(f"{name} is made by running {_shown(module.file)}")

    def _marks(self, of: _Class, function: ast.AST) -> tuple[list[Handler], str]:
        """Return the handlers that a method is, and why there may be more."""
        assert isinstance(function, _Function)
        marks, unknown = [], ""
        for decorator in function.decorator_list:
            called = decorator.func if isinstance(decorator, ast.Call) else decorator
            shown = ast.unparse(called)
            last = shown.rpartition(".")[2]
            if last in _HARMLESS or last in {"setter", "getter", "deleter"}:
                continue
            try:
                value = self._value(of.module, called, 0)
            except (NotThereError, UnknownError):
                value = None
            known = value.name if isinstance(value, _Known) else ""
            word = known.removeprefix("lifecycle.")
            if known.startswith("builtins.") or word == "on_timer":
                continue
            name = _literal(of.module, decorator) if word in _HANDLERS else None
            if name is None:
                unknown = unknown or f"{of.node.name}.{function.name} is decorated with @{shown}"
                continue
            marks.append(
                Handler(
                    kind=_HANDLERS[word],
                    name=name,
                    method=f"{of.node.name}.{function.name}",
                    decorator=f"@{word}",
                    decides=word == "on_goal",
                    place=f"{_shown(of.module.file)}:{function.lineno}",
                )
            )
        # The decorator next to the function marks it first.
        return marks[::-1], unknown

    def _module(self, name: str) -> _Module:
        if name not in self._modules:
            self._modules[name] = _read(name, *self._locate(name))
        return self._modules[name]

    def _locate(self, name: str) -> tuple[Path, bool]:
        """Return the source file of a module, and whether it is a package."""
        paths: Sequence[str] = self._paths
        parts = name.split(".")
        file: Path | None = None
        for index in range(len(parts)):
            so_far = ".".join(parts[: index + 1])
            first = self._folders if index == 0 else ()
            file, inside = _find(so_far, parts[index], paths, first=first)
            if inside is None and index + 1 < len(parts):
                raise NotThereError(
                    f"cannot import {name!r}: {so_far!r} is no package ({_shown(file)})"
                )
            paths = inside or ()
        if file is None:
            raise NotThereError(f"cannot find anything in {name!r}: it has no __init__.py")
        return file, bool(paths)


def _find(
    name: str, part: str, paths: Sequence[str], *, first: Sequence[str]
) -> tuple[Path | None, Sequence[str] | None]:
    """Return a module's file and, of a package, where its modules are.

    Args:
        name: of the module, in full.
        part: its last part.
        paths: where it is looked for.
        first: those of them that are no installation, for a module of the top; empty for others.
    """
    spaces = []
    for path in paths:
        base = Path(path) / part
        if (base / "__init__.py").is_file():
            _still(base / "__init__.py", name)
            return base / "__init__.py", (str(base),)
        for suffix in _COMPILED:
            compiled = (base / f"__init__{suffix}", Path(f"{base}{suffix}"))
            if any(each.is_file() for each in compiled):
                raise UnknownError(f"{name} is compiled")
        if (source := Path(f"{base}.py")).is_file():
            return source, None
        if base.is_dir():
            spaces.append(str(base))
    if spaces:
        return None, spaces
    if first:
        return _by_finders(name, first)
    raise NotThereError(f"cannot find module {name!r}", hint=_looked_in(paths))


def _still(init: Path, name: str) -> None:
    """Make sure that a package does not change where its modules are found."""
    text = init.read_bytes() if init.stat().st_size < _MOST_BYTES else b""
    for word in _MOVING:
        if word.encode() in text:
            raise UnknownError(f"{name} changes how its modules are found ({word})")


def _by_finders(name: str, first: Sequence[str]) -> tuple[Path | None, Sequence[str] | None]:
    """Ask what else finds modules here: built in, frozen, editable installations."""
    for finder in sys.meta_path:
        if finder is importlib.machinery.PathFinder:
            continue
        find = getattr(finder, "find_spec", None)
        try:
            spec = None if find is None else find(name, None)
        except Exception as problem:
            raise UnknownError(f"{name} is looked for by {finder!r}: {problem}") from problem
        if spec is None:
            continue
        if not spec.origin or not spec.origin.endswith(".py"):
            raise UnknownError(f"{name} is {spec.origin or 'found in no file'}")
        inside = spec.submodule_search_locations
        return Path(spec.origin), None if inside is None else list(inside)
    archives = [each for each in sys.path if Path(each).is_file()]
    if archives:
        raise UnknownError(f"{name} may be in {archives[0]}")
    raise NotThereError(
        f"cannot find module {name!r}",
        hint=f"it is looked for in {', '.join(first)} and in what is installed",
    )


def _looked_in(paths: Sequence[str]) -> str:
    folders = list(dict.fromkeys(_shown(Path(each)) for each in paths))
    return f"looked in {', '.join(folders[:3])}" if folders else ""


def _read(name: str, file: Path, is_package: bool) -> _Module:
    try:
        data = file.read_bytes()
        if len(data) > _MOST_BYTES:
            raise UnknownError(f"{_shown(file)} is too large to be read")
        tree = ast.parse(data)
        text = data.decode("utf-8", "replace")
    except SyntaxError as problem:
        raise NotThereError(
            f"cannot import {name!r}: {_shown(file)}:{problem.lineno}: {problem.msg}"
        ) from problem
    except (OSError, ValueError, RecursionError, MemoryError) as problem:
        raise UnknownError(f"{_shown(file)} cannot be read: {problem}") from problem
    module = _Module(name, file, is_package, text, {}, [])
    _collect(tree.body, module)
    return module


def _collect(body: Sequence[ast.stmt], module: _Module) -> None:
    """Note what statements bind at the top of a module."""
    for each in body:
        if isinstance(each, (ast.ImportFrom, ast.Import)):
            _collect_import(each, module)
        elif isinstance(each, ast.If) and "TYPE_CHECKING" in ast.unparse(each.test):
            _collect(each.orelse, module)
        elif bound := dict(_bindings(each)):
            for name, node in bound.items():
                module.bound.setdefault(name, []).append(node)
        else:
            for inner in ("body", "orelse", "finalbody"):
                _collect(getattr(each, inner, ()), module)
            for handler in getattr(each, "handlers", ()):
                _collect(handler.body, module)


def _bindings(each: ast.stmt) -> Iterator[tuple[str, ast.AST]]:
    if isinstance(each, (ast.ClassDef, *_Function)):
        yield each.name, each
    elif isinstance(each, ast.Assign):
        for target in each.targets:
            for name in ast.walk(target):
                if isinstance(name, ast.Name):
                    yield name.id, each.value if target is name else each
    elif isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name) and each.value:
        yield each.target.id, each.value


def _collect_import(each: ast.Import | ast.ImportFrom, module: _Module) -> None:
    for alias in each.names:
        if isinstance(each, ast.Import):
            # `import a.b` and `import a.c` both bind the one package `a`.
            if alias.asname or _binds(alias) not in module.bound:
                module.bound.setdefault(_binds(alias), []).append(each)
        elif alias.name == "*":
            module.stars.append((each.module or "", each.level))
        else:
            module.bound.setdefault(alias.asname or alias.name, []).append(each)


def _binds(alias: ast.alias) -> str:
    return alias.asname or alias.name.partition(".")[0]


def _absolute(module: _Module, name: str, level: int) -> str:
    """Return the absolute name of what a module imports."""
    if not level:
        return name
    parts = module.name.split(".")
    parts = parts[: len(parts) - level + (1 if module.is_package else 0)]
    return ".".join([*parts, *([name] if name else [])])


def _known(module: str, name: str) -> _Known | None:
    """Return what need not be read: what node authors import from lifecycle and from rclpy."""
    if module == "lifecycle" or module.startswith("lifecycle.node"):
        if name == "LifecycleNode" or name in _HANDLERS or name == "on_timer":
            return _Known(f"lifecycle.{name}")
        return None
    if module.partition(".")[0] == "rclpy":
        if name in {"LifecycleNode", "LifecycleNodeMixin"} or "lifecycle" in module:
            return _Known(f"rclpy.lifecycle.{name}")
        if name == "Node":
            return _Known("rclpy.node.Node")
    if module in {"typing", "abc", "enum", "typing_extensions"}:
        return _Known(f"{module}.{name}")
    return None


def _methods(node: ast.ClassDef) -> Iterator[tuple[str, ast.AST]]:
    for each in node.body:
        if isinstance(each, _Function):
            yield each.name, each


def _binds_in_body(node: ast.ClassDef, name: str) -> bool:
    """Return whether anything in a class body gives a name, also under a condition."""
    return any(
        (isinstance(each, (*_Function, ast.ClassDef)) and each.name == name)
        or (isinstance(each, ast.Name) and each.id == name and isinstance(each.ctx, ast.Store))
        or (isinstance(each, ast.alias) and (each.asname or each.name) == name)
        for each in _of_scope(node)
    )


def _of_scope(node: ast.ClassDef) -> Iterator[ast.AST]:
    """Yield what belongs to a class body, and not to the functions and classes in it."""
    left: list[ast.AST] = list(node.body)
    while left:
        each = left.pop()
        yield each
        if not isinstance(each, (*_Function, ast.ClassDef, ast.Lambda)):
            left += ast.iter_child_nodes(each)


def _arguments(
    function: ast.FunctionDef | ast.AsyncFunctionDef, *, of_method: bool
) -> tuple[tuple[str, ...] | None, tuple[str, ...]]:
    """Return the keywords that a function takes, None for any, and those that it needs."""
    given = function.args
    positional = given.posonlyargs + given.args
    defaults = len(given.defaults)
    required = positional[: len(positional) - defaults] if defaults else positional
    takes = [each.arg for each in (*given.args, *given.kwonlyargs)]
    needs = [each.arg for each in required]
    needs += [
        each.arg
        for each, default in zip(given.kwonlyargs, given.kw_defaults, strict=True)
        if default is None
    ]
    if of_method and positional:
        own = positional[0].arg
        takes = [each for each in takes if each != own]
        needs = needs[1:] if needs[:1] == [own] else needs
    return None if given.kwarg else tuple(takes), tuple(needs)


def _spins(function: _Makes) -> str:
    for node in ast.walk(function.node):
        if isinstance(node, ast.Call) and ast.unparse(node.func) in _OF_HOST:
            return f"{ast.unparse(node.func)} ({_shown(function.module.file)}:{node.lineno})"
    return ""


def _made_in_body(of: _Class) -> str:
    """Return what of a class body makes methods otherwise than by `def`; empty if nothing does."""
    for each in of.node.body:
        if isinstance(each, (*_Function, ast.Pass, ast.AnnAssign, ast.ClassDef)):
            continue
        for node in ast.walk(each):
            if isinstance(node, (*_Function, ast.Lambda)) or (
                isinstance(node, ast.Name) and node.id in _HANDLERS
            ):
                return f"methods of {of.node.name} are made in line {each.lineno}"
    return ""


def _literal(module: _Module, decorator: ast.expr) -> str | None:
    """Return the name that a decorator is given, where it can be read."""
    if not isinstance(decorator, ast.Call):
        return None
    given = [*decorator.args, *(each.value for each in decorator.keywords)]
    if len(given) != 1:
        return None
    value: ast.AST = given[0]
    if isinstance(value, ast.Name):
        bound = module.bound.get(value.id, [])
        value = bound[0] if len(bound) == 1 else value
    if isinstance(value, ast.Constant) and isinstance(value.value, str):
        return value.value
    return None


def _accesses(of: _Class, function: ast.AST) -> Iterator[Access]:
    assert isinstance(function, _Function)
    arguments = function.args.posonlyargs + function.args.args
    own = arguments[0].arg if arguments else ""
    for node in ast.walk(function):
        if (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Attribute)
            and node.func.attr in _ACCESS
            and isinstance(node.func.value, ast.Name)
            and node.func.value.id == own == "self"
            and len(node.args) == 1
            and isinstance(node.args[0], ast.Constant)
            and isinstance(node.args[0].value, str)
        ):
            yield Access(
                kind=_ACCESS[node.func.attr],
                name=node.args[0].value,
                text=ast.unparse(node)[:80],
                place=f"{_shown(of.module.file)}:{node.lineno}",
            )


def _shown(file: Path | None) -> str:
    """Return a path as short as it can be written from here."""
    if file is None:
        return "a folder without __init__.py"
    try:
        return str(file.relative_to(Path.cwd()))
    except ValueError:
        return str(file)
