"""Static checks of a whole manifest.

Each check is a generator of diagnostics with rule ids `check.*` and reads a system that was read
and built without an error. Needs no ROS: types are read from the ament index.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator, Mapping

from lifecycle.manifest.checks import connections, discovery, flows, nodes, parameters, system
from lifecycle.manifest.checks.system import DeclaredSystem
from lifecycle.manifest.diagnostics import Diagnostic, in_order
from lifecycle.manifest.model import Manifest, Node
from lifecycle.manifest.parameter_files import ParameterFiles

CHECKS: tuple[Callable[[DeclaredSystem], Iterator[Diagnostic]], ...] = (
    *system.CHECKS,
    *connections.CHECKS,
    *nodes.CHECKS,
    *parameters.CHECKS,
    *flows.CHECKS,
    *discovery.CHECKS,
)
OF_A_NODE: tuple[Callable[[DeclaredSystem, Node], Iterator[Diagnostic]], ...] = (
    *system.OF_A_NODE,
    *connections.OF_A_NODE,
    *nodes.OF_A_NODE,
    *parameters.OF_A_NODE,
    *flows.OF_A_NODE,
    *discovery.OF_A_NODE,
)
"""Those that look at one node after the other."""


def check(
    manifest: Manifest,
    *,
    environment: Mapping[str, str] | None = None,
    files: ParameterFiles | None = None,
) -> tuple[Diagnostic, ...]:
    """Check a manifest that has been built; nothing stops at the first finding.

    Args:
        manifest: what `load` or a test has built.
        environment: for AMENT_PREFIX_PATH, ROS_DOMAIN_ID, RMW_IMPLEMENTATION and
            FASTDDS_BUILTIN_TRANSPORTS; this process's if None.
        files: parameter files of its nodes that were read already.
    """
    declared = DeclaredSystem(
        manifest,
        environment=os.environ if environment is None else environment,
        files=files or ParameterFiles(manifest.path),
    )
    found = [*itertools.chain(*(each(declared) for each in CHECKS))]
    for node in manifest.nodes:
        found += itertools.chain(*(each(declared, node) for each in OF_A_NODE))
    return in_order(found, [manifest.path])
