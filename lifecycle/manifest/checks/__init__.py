"""Static checks of a whole manifest: the registry of `check.*` rules.

Owns: `CHECKS`, the one registry. Each check is a generator of diagnostics with rule ids `check.*`
and reads a manifest that was read and built without an error. Needs no ROS: types are read from
the ament index.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import msgspec

from lifecycle.manifest.checks.connection_urls import check_urls
from lifecycle.manifest.checks.connections import (
    check_connections,
    check_counterparts,
    check_qos,
    check_types,
)
from lifecycle.manifest.checks.flows import (
    check_flows,
    check_identifiers,
    check_links,
)
from lifecycle.manifest.checks.names import check_names, check_remaps
from lifecycle.manifest.checks.nodes import (
    check_health,
    check_machines,
    check_modes,
    check_on_violation,
    check_order,
    check_ports,
    check_processes,
    check_programs,
    check_supervision,
)
from lifecycle.manifest.checks.parameters import (
    check_mode_parameters,
    check_parameter_files,
    check_parameters,
)
from lifecycle.manifest.checks.system import DeclaredSystem
from lifecycle.manifest.checks.transport import check_discovery, check_middleware, check_transport
from lifecycle.manifest.diagnostics import Diagnostic
from lifecycle.manifest.flows import FlowNeeds
from lifecycle.manifest.installed_types import search_prefixes
from lifecycle.manifest.model import Manifest
from lifecycle.manifest.parameter_files import ParameterFiles


class Scope(msgspec.Struct, frozen=True, kw_only=True, dict=True):
    """What a check may read.

    Attributes:
        system: the manifest, with the names of its endpoints resolved.
        environment: of the process that will run the system.
    """

    system: DeclaredSystem
    environment: Mapping[str, str]

    @functools.cached_property
    def prefixes(self) -> tuple[Path, ...]:
        """Where packages are installed, in the order in which they are searched."""
        return search_prefixes(self.environment)

    @functools.cached_property
    def files(self) -> ParameterFiles:
        """The parameter files that nodes name."""
        return ParameterFiles(self.system.manifest.path)

    @functools.cached_property
    def needs(self) -> FlowNeeds:
        """What the endpoints of the system ask of their flows."""
        return FlowNeeds(self.system.manifest, self.prefixes)


CHECKS: tuple[Callable[[Scope], Iterator[Diagnostic]], ...] = (
    lambda scope: check_names(scope.system),
    lambda scope: check_remaps(scope.system),
    lambda scope: check_types(scope.system, scope.prefixes),
    lambda scope: check_qos(scope.system),
    lambda scope: check_counterparts(scope.system),
    lambda scope: check_order(scope.system),
    lambda scope: check_parameters(scope.system, scope.files),
    lambda scope: check_parameter_files(scope.system, scope.files),
    lambda scope: check_machines(scope.system),
    lambda scope: check_processes(scope.system),
    lambda scope: check_programs(scope.system),
    lambda scope: check_supervision(scope.system),
    lambda scope: check_health(scope.system),
    lambda scope: check_on_violation(scope.system),
    lambda scope: check_modes(scope.system),
    lambda scope: check_mode_parameters(scope.system, scope.files),
    lambda scope: check_ports(scope.system, scope.needs, scope.environment),
    lambda scope: check_discovery(scope.system, scope.environment),
    lambda scope: check_connections(scope.system, scope.needs),
    lambda scope: check_urls(scope.system),
    lambda scope: check_flows(scope.system, scope.needs),
    lambda scope: check_transport(scope.system, scope.needs, scope.environment),
    lambda scope: check_identifiers(scope.system, scope.needs),
    lambda scope: check_middleware(scope.system, scope.needs, scope.environment),
    lambda scope: check_links(scope.system, scope.needs),
)


def check(
    manifest: Manifest, *, environment: Mapping[str, str] | None = None
) -> tuple[Diagnostic, ...]:
    """Check a manifest that has been built; nothing stops at the first finding.

    Args:
        manifest: what `load` or a test has built.
        environment: for AMENT_PREFIX_PATH, ROS_DOMAIN_ID, RMW_IMPLEMENTATION and
            FASTDDS_BUILTIN_TRANSPORTS; this process's if None.

    Returns:
        Every error and warning, in the order of their places in each document.
    """
    scope = Scope(
        system=DeclaredSystem.of(manifest),
        environment=os.environ if environment is None else environment,
    )
    found = [finding for each in CHECKS for finding in each(scope)]
    files = {each.at.file: None for each in found}
    rank = {file: index for index, file in enumerate((manifest.path, *files))}
    found.sort(key=lambda each: (rank[each.at.file], each.at.line, each.at.column))
    return tuple(dict.fromkeys(found))
