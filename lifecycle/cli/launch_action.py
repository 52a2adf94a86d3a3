"""`lifecycle_manifest`, an action of ROS 2 launch files: a manifest as one process of a launch.

Found by its entry point where `launch` is installed. In Python, `LifecycleManifest(manifest=…,
arguments={…})`; in XML and YAML, `lifecycle_manifest` with `manifest` and `arg` of name and value.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any, List  # noqa: UP035 - launch looks for this spelling

from launch.actions import ExecuteProcess
from launch.frontend import Entity, Parser, expose_action

SHUTDOWN_S = 30
"""Seconds that an orderly end may take before launch goes on to SIGTERM: nodes end in order."""


@expose_action("lifecycle_manifest")
class LifecycleManifest(ExecuteProcess):  # type: ignore[misc]
    """Bring a manifest up in a process of its own, as `lifecycle up` does.

    Args:
        manifest: its path; text or substitutions.
        arguments: values of its arguments, likewise.
        options: further words for `lifecycle up`.
        process: further arguments of ExecuteProcess.
    """

    def __init__(
        self,
        *,
        manifest: Any,
        arguments: Mapping[str, Any] | None = None,
        options: list[Any] | None = None,
        **process: Any,
    ) -> None:
        words: list[Any] = [sys.executable, "-m", "lifecycle", "up", manifest]
        for name, value in (arguments or {}).items():
            parts = value if isinstance(value, (list, tuple)) else [value]
            words.append([f"{name}:=", *parts])
        process.setdefault("output", "screen")
        process.setdefault("sigterm_timeout", str(SHUTDOWN_S))
        super().__init__(cmd=[*words, *(options or ())], **process)

    @classmethod
    def parse(
        cls, entity: Entity, parser: Parser
    ) -> tuple[type[LifecycleManifest], dict[str, Any]]:
        """Read it in a launch file in XML or YAML."""
        _, kwargs = super().parse(entity, parser, ignore=["cmd"])
        kwargs["manifest"] = parser.parse_substitution(entity.get_attr("manifest"))
        arguments = entity.get_attr("arg", data_type=List[Entity], optional=True) or []  # noqa: UP006
        kwargs["arguments"] = {
            each.get_attr("name"): parser.parse_substitution(each.get_attr("value"))
            for each in arguments
        }
        for each in arguments:
            each.assert_entity_completely_parsed()
        return cls, kwargs
