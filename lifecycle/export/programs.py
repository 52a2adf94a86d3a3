"""What a captured node runs: its process's command line, taken apart where it has ROS arguments.

Owns: `CapturedProgram`, which processes several nodes share, and how `--ros-args` (rcl/arguments.c)
become keys of a manifest where that means the same; where it does not, the command line stays as it
was and the manifest appends nothing to it. Pure but for looking whether parameter files are there.
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Collection, Mapping
from pathlib import Path

import msgspec
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind, RosArguments
from lifecycle.manifest.names import free_name, name_problem, node_name_problem, resolve

_OURS = "lifecycle.supervisor.processes.fork_server_main"
"""In the command line of processes that `lifecycle up` has forked."""

LOG_LEVELS = ("debug", "info", "warn", "error", "fatal")
_WORD = re.compile(r"[^A-Za-z0-9_]+")


class CapturedProgram(msgspec.Struct, frozen=True, kw_only=True):
    """How a process was started.

    Attributes:
        argv: its command line; the first word finds the program from where it was looked.
        working_directory: absolute.
        environment: (name, value) of what matters and is otherwise here; sorted.
        withheld: names of variables that matter, whose values are secret or too long.
        has_ended: it ended by itself while it was looked at.
    """

    process_id: int
    argv: tuple[str, ...]
    working_directory: str
    environment: tuple[tuple[str, str], ...] = ()
    withheld: tuple[str, ...] = ()
    has_ended: bool = False

    @property
    def is_of_a_supervisor(self) -> bool:
        """Whether `lifecycle up` runs it: its command line is the fork server's."""
        return _OURS in self.argv

    def names(self, node: str) -> bool:
        """Whether it made the name of a node up as it started: with its pid, or a long number."""
        numbers = re.findall(r"\d+", node)
        return any(each == str(self.process_id) or len(each) > 5 for each in numbers)


class CapturedRun(msgspec.Struct, frozen=True, kw_only=True):
    """The keys of a manifest that start a process again.

    Attributes:
        process: name of a process that several nodes share; empty for one of a single node.
        ros_args: AUTO where ROS arguments of the command line have become keys.
        names: the name of the node is one of them.
    """

    program: CapturedProgram
    command: tuple[str, ...]
    process: str = ""
    ros_args: RosArguments = RosArguments.NONE
    names: bool = False
    remap: tuple[tuple[str, str], ...] = ()
    parameter_files: tuple[str, ...] = ()
    log_level: str = ""
    gaps: tuple[str, ...] = ()


def run_of(
    program: CapturedProgram,
    node: str,
    *,
    process: str,
    renamed: bool,
    parameters: Collection[str],
    endpoints: Collection[tuple[EndpointKind, str]],
) -> CapturedRun:
    """Return how to start the process of a node again.

    Args:
        program: how it was started.
        node: full name of the node.
        process: name of the process, where several nodes share it.
        renamed: the manifest gives the node another name than it has.
        parameters: names of those whose values the manifest gives.
        endpoints: kind and full name of each endpoint that the manifest declares.
    """
    gaps: tuple[str, ...] = ()
    if program.withheld:
        names = ", ".join(program.withheld)
        gaps = (f"values of its environment left out, secret or too long: {names}",)
    run = CapturedRun(program=program, command=program.argv, process=process, gaps=gaps)
    if process:
        return run
    made_up = renamed or program.names(node.rpartition("/")[2])
    if "--ros-args" not in program.argv:
        return replace(run, ros_args=RosArguments.AUTO, names=True) if made_up else run
    taken = _taken_apart(run, node, parameters)
    # Every endpoint has to get its name of now when the manifest's remaps are applied.
    if taken is None or any(
        _resolve(taken, node, kind, declared_name(taken, node, kind, name)) != name
        for kind, name in endpoints
    ):
        return run
    return replace(taken, names=taken.names or made_up)


def _taken_apart(run: CapturedRun, node: str, parameters: Collection[str]) -> CapturedRun | None:
    """Make keys of ROS arguments; None where they do not mean what the keys would."""
    argv = run.program.argv
    start = argv.index("--ros-args")
    own, words = argv[:start], list(argv[start + 1 :])
    if "--" in words or "--ros-args" in words:
        return None
    rest: list[str] = []
    while words:
        option = words.pop(0)
        if option in ("-r", "--remap") and words:
            remapped = _remapped(run, node, words.pop(0))
            if remapped is None:
                return None
            run = remapped
        elif option in ("-p", "--param") and words:
            word = words.pop(0)
            rest += [] if word.partition(":=")[0] in parameters else [option, word]
        elif option == "--params-file" and words:
            run = _with_file(run, words.pop(0))
        elif option == "--log-level" and words and words[0].lower() in LOG_LEVELS:
            run = replace(run, log_level=words.pop(0).lower())
        else:
            rest.append(option)
    command = (*own, *(["--ros-args", *rest] if rest else []))
    return replace(run, command=command, ros_args=RosArguments.AUTO)


def _remapped(run: CapturedRun, node: str, rule: str) -> CapturedRun | None:
    """Return a run with one more remap rule; None where no key means the same."""
    namespace, _, name = node.rpartition("/")
    left, separator, right = rule.partition(":=")
    if left in ("__node", "__name") and right == name:
        return replace(run, names=True)
    if left == "__ns" and right.rstrip("/") == namespace:
        return run  # the manifest has the namespace of every node
    if not separator or left.startswith("__") or ":" in left or left in dict(run.remap):
        return None
    return replace(run, remap=(*run.remap, (left, right)))


def _with_file(run: CapturedRun, word: str) -> CapturedRun:
    file = os.path.normpath(Path(run.program.working_directory) / word)
    # launch makes such files, and removes them.
    is_temporary = file.startswith(f"{tempfile.gettempdir()}/")
    of_launch = is_temporary and Path(file).name.startswith("launch_params_")
    if os.path.isfile(file) and not of_launch:
        return replace(run, parameter_files=(*run.parameter_files, file))
    gap = f"it was given the parameter file {word}, which does not stay"
    return replace(run, gaps=(*run.gaps, gap))


def declared_name(run: CapturedRun, node: str, kind: EndpointKind, name: str) -> str:
    """Return the name that a node uses for an endpoint; the full one where that is not known."""
    for source, _ in run.remap:
        if not name_problem(source) and _resolve(run, node, kind, source) == name:
            return source
    return name


def _resolve(run: CapturedRun, node: str, kind: EndpointKind, name: str) -> str:
    namespace, _, base = node.rpartition("/")
    return resolve(name, node_name=base, namespace=namespace or "/", remap=run.remap, kind=kind)


def process_names(shared: Mapping[int, CapturedProgram], taken: Collection[str]) -> dict[int, str]:
    """Return a name for each process that several nodes share, by pid.

    Args:
        shared: those processes by pid.
        taken: keys of nodes, which no process may have.
    """
    names: dict[int, str] = {}
    for pid, program in shared.items():
        # What its command line runs: the script or module of Python's, its file.
        word, *others = program.argv
        if re.match(r"python[\d.]*$", Path(word).name):
            word = next((each for each in others if not each.startswith("-")), word)
        stem = _WORD.sub("_", Path(word).name.removesuffix(".py")).strip("_")
        stem = "process" if node_name_problem(stem) else stem
        names[pid] = free_name(stem, {*names.values(), *taken})
    return names
