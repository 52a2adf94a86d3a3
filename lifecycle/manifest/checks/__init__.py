"""Static checks of a whole manifest: the registry of `check.*` rules and which of them can run.

Owns: `CHECKS`, the one registry. Each check is a generator of diagnostics with rule ids `check.*`
and declares what it needs: in a manifest that already has errors, a check runs on the nodes that
are sound for it, if mending those errors cannot remove its findings. Needs no ROS: types are read
from the ament index.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from lifecycle import dataclasses
from lifecycle.manifest.checks.connection_urls import check_urls
from lifecycle.manifest.checks.connections import (
    check_connections,
    check_counterparts,
    check_mapped_endpoints,
    check_qos,
    check_types,
)
from lifecycle.manifest.checks.flows import (
    check_flow_endpoints,
    check_flows,
    check_identifiers,
    check_link_uniqueness,
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
from lifecycle.manifest.checks.system import DeclaredSystem, Partial
from lifecycle.manifest.checks.transport import check_discovery, check_middleware, check_transport
from lifecycle.manifest.diagnostics import Diagnostic
from lifecycle.manifest.flows import FlowNeeds
from lifecycle.manifest.installed_types import search_prefixes
from lifecycle.manifest.model import Manifest

__all__ = ["CHECKS", "Check", "Scope", "check", "check_sound"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scope:
    """What a check may read.

    Attributes:
        system: the manifest, or the part of it that is sound for the check.
        machines: names of all machines that are declared.
        environment: of the process that will run the system.
    """

    system: DeclaredSystem
    machines: tuple[str, ...]
    environment: Mapping[str, str]

    @functools.cached_property
    def prefixes(self) -> tuple[Path, ...]:
        """Where packages are installed, in the order in which they are searched."""
        return search_prefixes(self.environment)

    @functools.cached_property
    def needs(self) -> FlowNeeds:
        """What the endpoints of the system ask of their flows."""
        return FlowNeeds(self.system.manifest, self.prefixes)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """One check, and what must be sound so that its findings hold.

    Attributes:
        run: yields what it finds.
        parts: keys of a node without which the node is left out (see `SEPARABLE`).
        sections: sections of the document that must be sound.
        machines: the names of all declared machines must be known.
        whole: it holds only of a manifest in which nothing is wrong.
        whole_rules: these of its rules do: what they are about may be among what is left out.
    """

    run: Callable[[Scope], Iterator[Diagnostic]]
    parts: tuple[str, ...] = ()
    sections: frozenset[str] = frozenset()
    machines: bool = False
    whole: bool = False
    whole_rules: frozenset[str] = frozenset()

    def holds_of(self, part: Partial) -> bool:
        """Whether what it needs of a document is sound in this part of it."""
        known = part.machines is not None or not self.machines
        return not self.whole and known and part.sound(*self.sections)


_REACH = frozenset({"discovery", "machines", "data_layer"})
_FLOWS = frozenset({"network", "links", "machines"})
_WIRED = ("connections", "flows", "run")

CHECKS = (
    Check(run=lambda scope: check_names(scope.system)),
    Check(run=lambda scope: check_remaps(scope.system)),
    Check(run=lambda scope: check_types(scope.system, scope.prefixes)),
    Check(run=lambda scope: check_qos(scope.system)),
    Check(run=lambda scope: check_counterparts(scope.system), whole=True),
    Check(run=lambda scope: check_order(scope.system), parts=("after",)),
    Check(run=lambda scope: check_parameters(scope.system), parts=("run",)),
    Check(
        run=lambda scope: check_parameter_files(scope.system),
        parts=("parameters", "parameter_files", "run"),
        whole_rules=frozenset({"check.parameter-file-unmatched"}),
    ),
    Check(run=lambda scope: check_machines(scope.system, scope.machines), machines=True),
    Check(run=lambda scope: check_processes(scope.system), parts=("run",)),
    Check(run=lambda scope: check_programs(scope.system), parts=("run",)),
    Check(run=lambda scope: check_supervision(scope.system), parts=("run",)),
    Check(run=lambda scope: check_health(scope.system)),
    Check(
        run=lambda scope: check_on_violation(scope.system),
        parts=("run",),
        sections=frozenset({"modes"}),
    ),
    Check(run=lambda scope: check_modes(scope.system), parts=("run", "after")),
    Check(
        run=lambda scope: check_mode_parameters(scope.system),
        parts=("run", "interface", "parameters", "parameter_files"),
    ),
    Check(
        run=lambda scope: check_ports(scope.system, scope.needs, scope.environment),
        whole=True,
    ),
    Check(
        run=lambda scope: check_discovery(scope.system, scope.environment),
        parts=("run",),
        sections=_REACH,
    ),
    Check(run=lambda scope: check_mapped_endpoints(scope.system)),
    Check(
        run=lambda scope: check_connections(scope.system, scope.needs),
        parts=_WIRED,
        sections=_REACH | _FLOWS,
    ),
    Check(
        run=lambda scope: check_urls(scope.system),
        parts=("connections",),
        sections=_REACH,
        whole_rules=frozenset({"check.connection-peer"}),
    ),
    Check(run=lambda scope: check_flow_endpoints(scope.system)),
    Check(run=lambda scope: check_flows(scope.system, scope.needs), parts=_WIRED, sections=_FLOWS),
    Check(
        run=lambda scope: check_transport(scope.system, scope.needs, scope.environment),
        whole=True,
    ),
    Check(run=lambda scope: check_identifiers(scope.system, scope.needs), whole=True),
    Check(
        run=lambda scope: check_middleware(scope.system, scope.needs, scope.environment),
        parts=_WIRED,
        sections=_FLOWS,
    ),
    Check(run=lambda scope: check_links(scope.system)),
    Check(
        run=lambda scope: check_link_uniqueness(scope.system, scope.needs),
        parts=("flows",),
        sections=frozenset({"network"}),
    ),
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
        machines=tuple(each.name for each in manifest.machines),
        environment=os.environ if environment is None else environment,
    )
    found = [finding for each in CHECKS for finding in each.run(scope)]
    files = {each.at.file: None for each in found}
    rank = {file: index for index, file in enumerate((manifest.path, *files))}
    found.sort(key=lambda each: (rank[each.at.file], each.at.line, each.at.column))
    return tuple(dict.fromkeys(found))


def check_sound(
    part: Partial, *, environment: Mapping[str, str] | None = None
) -> tuple[Diagnostic, ...]:
    """Check what is left of a manifest without what is wrong already.

    Args:
        part: as `load` has built it.
        environment: as for `check`.
    """
    variables = os.environ if environment is None else environment
    scopes: dict[tuple[str, ...], Scope] = {}

    def scope(parts: tuple[str, ...]) -> Scope:
        if parts not in scopes:
            scopes[parts] = Scope(
                system=part.system(*parts),
                machines=tuple(sorted(part.machines or ())),
                environment=variables,
            )
        return scopes[parts]

    return tuple(
        finding
        for each in CHECKS
        if each.holds_of(part)
        for finding in each.run(scope(each.parts))
        if finding.rule not in each.whole_rules
    )
