"""Evaluates a launch description without starting anything, and writes its nodes as a manifest.

Actions that only set something for what follows are carried out; processes, nodes, timers and event
handlers are read instead of run. A launch file in Python is a program, which evaluating it runs,
and so does a `Command` substitution.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import re
import shlex
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from lifecycle.errors import UsageError
from lifecycle.export.manifest_yaml import Noted, Tree, comment, kept, literal, to_yaml
from lifecycle.manifest.names import free_name


class LaunchedNode(msgspec.Struct, kw_only=True):
    """What a launch file says of one node.

    Attributes:
        name: empty where the node's code chooses it.
        keys: of the manifest.
        container: full name of the component container that loads it; empty for a process.
        gaps: what a manifest cannot say of it, or launch does not say.
    """

    name: str
    namespace: str
    keys: dict[str, Tree]
    container: str = ""
    gaps: list[str] = msgspec.field(default_factory=list)

    @property
    def full_name(self) -> str:
        """`/namespace/name`; without the name where that is not known."""
        return f"{self.namespace.rstrip('/')}/{self.name}"


class Launched(msgspec.Struct, kw_only=True):
    """What evaluating a launch file has shown.

    Attributes:
        arguments: name and value of each that the file and what it includes declare.
        gaps: what concerns no single node.
    """

    nodes: list[LaunchedNode] = msgspec.field(default_factory=list)
    arguments: dict[str, str] = msgspec.field(default_factory=dict)
    gaps: list[str] = msgspec.field(default_factory=list)


def evaluate(path: Path, arguments: Mapping[str, str], *, folder: Path) -> Launched:
    """Evaluate a launch file, in Python, XML or YAML, without starting what it describes.

    Args:
        path: of the launch file.
        arguments: of it.
        folder: of the manifest, from which its paths start.

    Raises:
        UsageError: `launch` is not installed, there is no such file, or it cannot be evaluated.
    """
    try:
        launch = importlib.import_module("launch")
    except ModuleNotFoundError as problem:
        if problem.name != "launch":
            raise
        raise UsageError(
            "cannot import a launch file: the Python package 'launch' is not installed here",
            hint="install the ros-DISTRO-launch package of your ROS distribution and source its "
            "setup file; PyPI has none",
        ) from problem
    if not os.path.isfile(path):
        raise UsageError(f"cannot import {str(path)!r}: there is no such file")
    before = dict(os.environ)
    # launch_ros looks nowhere without it; wheels of ROS packages are below sys.prefix.
    os.environ.setdefault("AMENT_PREFIX_PATH", sys.prefix)
    argv = [f"{name}:={value}" for name, value in arguments.items()]
    walk = _Walk(launch.LaunchContext(argv=argv), folder)
    try:
        walk.begin(path, arguments)
    except Exception as problem:
        # Anything: a launch file is a program, and launch raises what its parsers raise.
        said = [each.strip(" -:") for each in str(problem).splitlines()]
        why = "; ".join(filter(None, said))[:600] or type(problem).__name__
        raise UsageError(
            f"cannot evaluate the launch file {str(path)!r}: {why}",
            hint="ros2 launch --show-args FILE lists what it takes; give NAME:=VALUE here",
        ) from problem
    finally:
        os.environ.clear()
        os.environ.update(before)
    return walk.found


_READ = ("ExecuteLocal", "RegisterEventHandler", "TimerAction", "LoadComposableNodes")
"""Actions, by a class they inherit, that start something or wait: they are read, never executed."""

_NEVER = (
    "EmitEvent",
    "Shutdown",
    "ShutdownAction",
    "LifecycleTransition",
    "UnregisterEventHandler",
)
"""Actions that act on what runs: nothing runs."""


class _Walk:
    """One walk over a launch description, depth first, in the order in which launch acts."""

    def __init__(self, context: Any, folder: Path) -> None:
        self.found = Launched()
        self._context = context
        self._folder = folder
        self._environment = dict(os.environ)

    def begin(self, path: Path, arguments: Mapping[str, str]) -> None:
        """Evaluate a launch file, whatever its language."""
        sources = importlib.import_module("launch.launch_description_sources")
        place = {
            "current_launch_file_path": str(path.resolve()),
            "current_launch_file_directory": str(path.resolve().parent),
        }
        self._context.extend_locals(place)
        self._context.extend_globals(place)
        self._context.launch_configurations.update(arguments)
        self.visit(sources.get_launch_description_from_any_launch_file(str(path.absolute())))

    def visit(self, entity: Any, notes: tuple[str, ...] = ()) -> None:
        """Carry out what sets something, read what would start something."""
        kinds = [each.__name__ for each in type(entity).__mro__]
        if "Action" in kinds and not self._holds(entity.condition):
            return
        if any(each in kinds for each in _READ):
            self._read(entity, kinds, notes)
        elif any(each in kinds for each in _NEVER):
            self._gap(
                f"{kinds[0]}: it acts on what runs; `after:` of a node says what it waits for"
            )
        elif "DeclareLaunchArgument" in kinds:
            entity.execute(self._context)
            value = self._context.launch_configurations.get(entity.name, "")
            self.found.arguments[entity.name] = value
        else:
            for each in entity.visit(self._context) or ():
                self.visit(each, notes)

    def _holds(self, condition: Any) -> bool:
        return condition is None or bool(condition.evaluate(self._context))

    def _read(self, entity: Any, kinds: Sequence[str], notes: tuple[str, ...]) -> None:
        if "TimerAction" in kinds:
            period = entity.period
            period = f"{period:g}" if isinstance(period, (int, float)) else self._text(period)
            note = f"launch starts it {period} s later; `after:` says what it waits for"
            for each in entity.actions:
                self.visit(each, (*notes, note))
        elif "RegisterEventHandler" in kinds:
            self._handler(entity.event_handler, notes)
        elif "LoadComposableNodes" in kinds:
            container = _private(entity, "target_container")
            if _is_a(container, "Node"):
                namespace = self._namespace(_private(container, "node_namespace"))
                name = f"{namespace.rstrip('/')}/{self._text(_private(container, 'node_name'))}"
            else:
                name = f"/{self._text(container).removeprefix('/')}"
            for each in _private(entity, "composable_node_descriptions") or ():
                self._component(each, name, notes)
        elif "Node" in kinds:
            self._node(entity, kinds, notes)
        else:
            words = [kinds[0]]
            with contextlib.suppress(Exception):  # a word of it may depend on what runs
                words = [self._text(each) for each in entity.cmd]
            self._gap(f"the process {shlex.join(words)!r} is no node: a manifest starts nodes only")

    def _handler(self, handler: Any, notes: tuple[str, ...]) -> None:
        kind = type(handler).__name__
        entities = _private(handler, "actions_on_event", "entities") or ()
        inside = list(entities) if isinstance(entities, Iterable) else [entities]
        starts = [each for each in inside if _is_a(each, *_READ)]
        if not starts:
            self._gap(f"{kind}: what it does on an event is not in the manifest")
        note = f"launch starts it on an event, {kind}; `after:` says what it waits for"
        for each in starts:
            self.visit(each, (*notes, note))

    def _gap(self, text: str) -> None:
        if text not in self.found.gaps:
            self.found.gaps.append(text)

    def _node(self, action: Any, kinds: Sequence[str], notes: tuple[str, ...]) -> None:
        gaps = [*notes]
        keys = self._settings(_private(action, "parameters"), _private(action, "remappings"), gaps)
        if self._is_true(_private(action, "respawn")):
            keys["restart"] = "always"
            delay_s = _private(action, "respawn_delay")
            if isinstance(delay_s, (int, float)):
                keys["restart_sec"] = delay_s
        if "LifecycleNode" not in kinds:
            keys["managed"] = _MANAGED
        if words := [self._text(each) for each in _private(action, "ros_arguments") or ()]:
            gaps.append(f"ROS arguments {shlex.join(words)}: see remap, parameters and log_level")
        description = getattr(action, "process_description", None)
        said = {
            "respawn_max_retries": (_private(action, "respawn_max_retries") or -1) >= 0,
            "shell": self._is_true(_private(action, "shell") or getattr(action, "shell", None)),
            "env, which are its only variables there": getattr(description, "env", None),
            "on_exit": _private(action, "on_exit"),
        }
        gaps += [f"{name}: a manifest has nothing like it" for name, is_so in said.items() if is_so]
        node = self._add(action, "node_name", "node_namespace", {"run": self._run(action), **keys})
        node.gaps += gaps
        for each in _private(action, "composable_node_descriptions") or ():
            self._component(each, node.full_name, notes)

    def _add(
        self, described: Any, name: str, namespace: str, keys: dict[str, Tree]
    ) -> LaunchedNode:
        written = _private(described, name), _private(described, namespace)
        node = LaunchedNode(
            name=self._text(written[0]), namespace=self._namespace(written[1]), keys=keys
        )
        self.found.nodes.append(node)
        return node

    def _is_true(self, value: Any) -> bool:
        return value is not None and self._text(value).lower() in ("true", "1")

    def _run(self, action: Any) -> dict[str, Tree]:
        package, executable = (
            self._text(_private(action, name)) for name in ("package", "node_executable")
        )
        arguments = [self._text(each) for each in _private(action, "arguments") or ()]
        # Words of one argument stand for several where they were parsed from XML.
        run: dict[str, Tree]
        if package and not arguments:
            run = {"package": package, "executable": executable}
        elif package:
            path = f"$(find-pkg-share {package})/../../lib/{package}/{executable}"
            run = {"command": [path, *map(literal, arguments)]}
        else:
            run = {"command": [literal(each) for each in (executable, *arguments)]}
        description = getattr(action, "process_description", None)
        prefix = self._text(_private(description, "prefix"))
        if prefix:
            run["prefix"] = [literal(each) for each in shlex.split(prefix)]
        output = _private(action, "output")
        output = "" if isinstance(output, dict) else self._text(output)
        if output in ("screen", "both"):  # launch's default is log
            run["output"] = output
        # What SetEnvironmentVariable has set by now.
        environment = {
            name: value
            for name, value in self._context.environment.items()
            if self._environment.get(name) != value
        }
        given = [*(_private(description, "env") or ())]
        for name, value in (*given, *(_private(description, "additional_env") or ())):
            environment[self._text(name)] = self._text(value)
        if environment:
            run["environment"] = {name: literal(each) for name, each in environment.items()}
        folder = self._text(_private(description, "cwd"))
        if folder:
            run["working_directory"] = literal(folder)
        return run

    def _namespace(self, written: Any) -> str:
        names = importlib.import_module("launch_ros.utilities")
        own = None if written is None else self._text(written)
        base = self._context.launch_configurations.get("ros_namespace")
        return str(names.make_namespace_absolute(names.prefix_namespace(base, own)) or "/")

    def _settings(self, parameters: Any, remappings: Any, gaps: list[str]) -> dict[str, Tree]:
        """Return parameter files, parameters and remaps, also those that launch gives to all."""
        values: dict[str, Tree] = {}
        files: list[Tree] = []
        given = [*(self._context.launch_configurations.get("global_params") or ())]
        for each in given + (self._evaluated(parameters) if parameters else []):
            if isinstance(each, (str, os.PathLike)):
                name = Path(each).name
                if Path(each).parent == Path(tempfile.gettempdir()):
                    # launch writes a parameter file with substitutions to a temporary one.
                    gaps.append(f"{each}: a parameter file with substitutions; write it out")
                if values:
                    gaps.append(f"launch lets {name} win over parameters before it; here they win")
                files.append(literal(os.path.relpath(each, self._folder)))
            else:
                one = each if isinstance(each, (tuple, Mapping)) else each.evaluate(self._context)
                for name, value in one.items() if isinstance(one, Mapping) else [one]:
                    is_list = isinstance(value, (list, tuple))
                    values[name] = list(map(literal, value)) if is_list else literal(value)
        remap: dict[str, Tree] = {}
        rules = [*(self._context.launch_configurations.get("ros_remaps") or ())]
        for source, target in (*rules, *(remappings or ())):
            # rcl takes the first that matches.
            remap.setdefault(self._text(source), literal(self._text(target)))
        return {"parameter_files": files, "parameters": values, "remap": remap}

    def _evaluated(self, parameters: Any) -> list[Any]:
        utilities = importlib.import_module("launch_ros.utilities")
        return list(utilities.evaluate_parameters(self._context, parameters))

    def _component(self, described: Any, container: str, notes: tuple[str, ...]) -> None:
        if not self._holds(described.condition()):
            return
        gaps = [*notes]
        run: dict[str, Tree] = {
            "component": f"{self._text(described.package)}/{self._text(described.node_plugin)}"
        }
        extra: dict[str, Tree] = {}
        for each in self._evaluated(described.extra_arguments or ()):
            if isinstance(each, Mapping):
                extra.update(each)
            else:
                gaps.append("extra_arguments: those of a file are missing")
        keys = self._settings(described.parameters, described.remappings, gaps)
        keys |= {"run": kept({**run, "extra_arguments": extra}), "managed": _MANAGED}
        node = self._add(described, "node_name", "node_namespace", keys)
        node.container = container
        node.gaps += gaps

    # -- values

    def _text(self, value: Any) -> str:
        """Return text of what may be text, a substitution, or a list of these."""
        if value is None:
            return ""
        if isinstance(value, (str, bool, int, float, os.PathLike)):
            return str(value)
        if isinstance(value, Iterable):
            return "".join(self._text(each) for each in value)
        return str(value.perform(self._context))


def _is_a(value: Any, *names: str) -> bool:
    return bool({each.__name__ for each in type(value).__mro__} & {*names})


def _private(value: Any, *names: str) -> Any:
    """Return an attribute that launch keeps for itself, of whichever class has it.

    launch offers no way to read what an action was made with: `_Node__parameters` and its like
    are the same in Humble, Jazzy and later.
    """
    for name in names:
        for each in type(value).__mro__:
            found = getattr(value, f"_{each.__name__.lstrip('_')}__{name}", None)
            if found is not None:
                return found
    return None


def to_launched_manifest(
    found: Launched,
    *,
    source: str,
    system: str,
    schema: str = "manifest.v1.schema.json",
) -> str:
    """Return what a launch file describes as a manifest, gaps marked.

    Args:
        found: what it says.
        source: how the launch file is named in the first lines.
        system: name to give the system.
        schema: where editors find the manifest's schema, a path or URL.
    """
    keys = _keys(found.nodes)
    by_name = {node.full_name: key for node, key in zip(found.nodes, keys, strict=True)}
    nodes = {key: _tree(node, by_name) for node, key in zip(found.nodes, keys, strict=True)}
    head = [
        f"# yaml-language-server: $schema={schema}",
        comment(f"Imported from {source}: evaluated, and never run. `gap:` marks what is missing."),
    ]
    head += [comment(f"{name}:={value}") for name, value in found.arguments.items()]
    head += [comment(f"gap: {each}") for each in found.gaps]
    tree: dict[str, Tree] = {
        "manifest_version": 1,
        "system": system,
        "policy": Noted(
            value={"unpublished": "ignore", "unheard": "ignore"},
            note="as long as interfaces are missing",
        ),
        "nodes": nodes,
    }
    return "\n".join(head) + "\n" + to_yaml(tree)


def _keys(nodes: Iterable[LaunchedNode]) -> list[str]:
    keys: list[str] = []
    for node in nodes:
        run: Any = node.keys["run"]
        program = run.get("executable") or run.get("component") or run["command"][0]
        base = node.name or Path(program).name.rpartition("::")[2] or "node"
        base = re.sub(r"\W", "_", base, flags=re.ASCII)
        base = base if base[0].isalpha() or base[0] == "_" else f"_{base}"
        in_namespace = "_".join(filter(None, (*node.namespace.strip("/").split("/"), base)))
        keys.append(base if base not in keys else free_name(in_namespace, keys))
    return keys


_MANAGED = Noted(
    value=False,
    note="gap: launch does not say whether it has a lifecycle; remove this line if it has",
)
_OPEN = Noted(
    value="open",
    note="gap: a launch file says nothing of its interface: lifecycle capture shows it once it "
    "runs",
)


def _tree(node: LaunchedNode, by_name: Mapping[str, str]) -> Tree:
    run: Any = node.keys["run"]
    if node.container:
        run = {**run, "container": by_name.get(node.container, node.container)}
    # The name is written even if it is the key: only then a command is given it.
    namespace = "" if node.namespace == "/" else node.namespace
    named = {"run": run, "name": node.name, "namespace": namespace}
    tree = kept({**named, **node.keys, "run": run, "endpoints": _OPEN})
    gaps = [*node.gaps]
    if not node.name:
        gaps.insert(0, "launch leaves its name to its code; the key must be that name")
    return Noted(value=tree, note="; ".join(f"gap: {each}" for each in gaps)) if gaps else tree


def gaps_of(found: Launched) -> Iterator[str]:
    """Yield each gap, with the node that it is about."""
    yield from found.gaps
    for node in found.nodes:
        for each in node.gaps:
            yield f"{node.full_name}: {each}"
