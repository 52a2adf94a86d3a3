"""The command line of a node that is an ordinary ROS executable.

Owns: argv of COMMAND processes: the executable found through AMENT_PREFIX_PATH, then node name,
namespace, remaps, parameters and log level after `--ros-args`, as rcl's argument parser reads them
(https://design.ros2.org/articles/ros_command_line_arguments.html). Pure but for looking at files.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path

from lifecycle.manifest.diagnostics import Position
from lifecycle.manifest.model import Node, ParameterValue, Run
from lifecycle.plan.model import PlanError


def command_line(node: Node, environment: Mapping[str, str]) -> tuple[str, ...]:
    """Return the full argv of a COMMAND node.

    Parameter files come before single parameters, because rcl lets the later one win.

    Raises:
        PlanError: the package or its executable cannot be found.
    """
    argv = list(node.run.command)
    if not argv:
        argv = [find_executable(node.run, environment, at=node.at)]
    argv += ["--ros-args", "-r", f"__node:={node.name}", "-r", f"__ns:={node.namespace}"]
    for source, target in node.remap:
        argv += ["-r", f"{source}:={target}"]
    for file in node.parameter_files:
        argv += ["--params-file", file]
    for name, value in node.parameters:
        argv += ["-p", f"{name}:={parameter_text(value)}"]
    if node.log_level:
        argv += ["--log-level", node.log_level]
    return tuple(argv)


def find_executable(run: Run, environment: Mapping[str, str], *, at: Position) -> str:
    """Find `lib/<package>/<executable>` under the first prefix of AMENT_PREFIX_PATH that has it.

    Raises:
        PlanError: AMENT_PREFIX_PATH is empty, or no prefix holds the package or the executable.
    """
    prefixes = [prefix for prefix in environment.get("AMENT_PREFIX_PATH", "").split(":") if prefix]
    wanted = f"executable {run.executable!r} of package {run.package!r}"
    if not prefixes:
        raise PlanError(
            f"cannot find {wanted}: AMENT_PREFIX_PATH is empty",
            hint="source the setup file of a workspace that holds the package",
            at=at,
        )
    found: list[str] = []
    for prefix in prefixes:
        folder = Path(prefix) / "lib" / run.package
        candidate = folder / run.executable
        if candidate.is_file() and os.access(candidate, os.X_OK):
            return str(candidate)
        if folder.is_dir():
            found += [each.name for each in folder.iterdir() if os.access(each, os.X_OK)]
    if found:
        raise PlanError(
            f"cannot find {wanted}: the package has {', '.join(sorted(set(found)))}", at=at
        )
    raise PlanError(
        f"cannot find {wanted}: no lib/{run.package} with executables under {', '.join(prefixes)}",
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
