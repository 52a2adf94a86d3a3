"""Everything a manifest's parts say about each other: the checks that need the whole system.

Owns: `check`, which runs every topic's checks and collects what they find; one file per topic, each
a generator of diagnostics with rule ids `check.*`. Those that hold of a part are run by `partial`.
Needs no ROS: types come from the ament index.
"""

from __future__ import annotations

import os
from collections.abc import Mapping

from lifecycle.manifest.checks import matching, names, order, placement, remaps, types
from lifecycle.manifest.checks.connections import (
    connection_urls,
    connections,
    declared_connections,
    discovery,
)
from lifecycle.manifest.checks.flows import flow_transport, flows, identifiers, links, middleware
from lifecycle.manifest.checks.parameters import parameter_files, parameters
from lifecycle.manifest.checks.partial import Partial, check_sound
from lifecycle.manifest.checks.system import System
from lifecycle.manifest.diagnostics import Diagnostic
from lifecycle.manifest.flows.flow_needs import FlowNeeds
from lifecycle.manifest.model import Manifest
from lifecycle.manifest.types.ament_index import search_prefixes

__all__ = ["Partial", "check", "check_sound"]


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
    variables = os.environ if environment is None else environment
    system = System.of(manifest)
    prefixes = search_prefixes(variables)
    needs = FlowNeeds(manifest, prefixes)
    found = [
        *names.check(system),
        *remaps.check(system),
        *types.check(system, prefixes),
        *matching.check(system),
        *connections.check(system),
        *order.check(system),
        *parameters.check(system),
        *parameter_files.check(system),
        *placement.check(system, needs, variables),
        *discovery.check(system, variables),
        *declared_connections.endpoints(system),
        *declared_connections.check(system, needs),
        *connection_urls.check(system),
        *flows.endpoints(system),
        *flows.check(system, needs),
        *flow_transport.check(system, needs, variables),
        *identifiers.check(system, needs),
        *middleware.check(system, needs, variables),
        *links.check(system, needs),
    ]
    files = {each.at.file: None for each in found}
    rank = {file: index for index, file in enumerate((manifest.path, *files))}
    found.sort(key=lambda each: (rank[each.at.file], each.at.line, each.at.column))
    return tuple(dict.fromkeys(found))
