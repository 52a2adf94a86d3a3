"""The checks of a manifest in which something is wrong already.

Owns: which checks still hold of what is left, so that one run tells as much as it can. Only what
whatever is missing could not put right: two names that are one, two ends that do not fit, a node
that nobody declares. Needs no ROS.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Collection, Iterator, Mapping

from lifecycle.manifest.checks import matching, names, order, placement, remaps, types
from lifecycle.manifest.checks.connections import connection_urls, declared_connections, discovery
from lifecycle.manifest.checks.flows import flows, links, middleware
from lifecycle.manifest.checks.parameters import parameter_files, parameters
from lifecycle.manifest.checks.system import System
from lifecycle.manifest.diagnostics import Diagnostic
from lifecycle.manifest.flows.flow_needs import FlowNeeds
from lifecycle.manifest.model import Manifest
from lifecycle.manifest.types.ament_index import search_prefixes

SEPARABLE = frozenset(
    {
        "after",
        "connections",
        "flows",
        "log_level",
        "parameter_files",
        "parameters",
        "run",
        "timeouts",
    }
)
"""Keys of a node that can be wrong while its name and its endpoints are what they are."""


_UNIQUE = "check.link-not-unique"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Partial:
    """What is left of a manifest.

    Attributes:
        manifest: with the nodes whose name and endpoints are sound, and the links that are.
        flawed: by node key, which of its SEPARABLE parts are not sound; those may be left out.
        sections: sections of the document that are not sound as a whole.
        lost: as `System.lost`.
        machines: names of all that are declared; None if not all are known.
    """

    manifest: Manifest
    flawed: Mapping[str, frozenset[str]]
    sections: frozenset[str]
    lost: frozenset[str] | None
    machines: frozenset[str] | None

    def system(self, *needed: str) -> System:
        """Return the nodes of which the `needed` parts are sound."""
        nodes = self.manifest.nodes
        kept = tuple(each for each in nodes if not self.flawed.get(each.key, set()) & {*needed})
        lost = self.lost
        if lost is not None:
            lost |= {each.key for each in nodes} - {each.key for each in kept}
        return System.of(dataclasses.replace(self.manifest, nodes=kept), lost=lost)

    def sound(self, *sections: str) -> bool:
        """Whether nothing is wrong in these sections."""
        return not self.sections & {*sections}


def check_sound(
    part: Partial, *, environment: Mapping[str, str] | None = None
) -> tuple[Diagnostic, ...]:
    """Check what is left of a manifest without what is wrong already.

    Args:
        part: as `load` has built it.
        environment: as for `check`.
    """
    variables = os.environ if environment is None else environment
    named = part.system()
    prefixes = search_prefixes(variables)
    return (
        *names.check(named),
        *remaps.check(named),
        *types.check(named, prefixes),
        *matching.check(named),
        *order.check(part.system("after")),
        *parameters.check(part.system("run")),
        *_parameter_files(part),
        *_places(part),
        *declared_connections.endpoints(named),
        *flows.endpoints(named),
        *_links(part),
        *_of_sound_sections(part, variables),
    )


def _parameter_files(part: Partial) -> Iterator[Diagnostic]:
    found = parameter_files.check(part.system("parameters", "parameter_files", "run"))
    # Whom a file is for may be among what is left out.
    yield from _but(found, {"check.parameter-file-unmatched"})


def _places(part: Partial) -> Iterator[Diagnostic]:
    if part.machines is not None:
        yield from placement.machines(part.system(), sorted(part.machines))
    yield from placement.processes(part.system("run"))


def _links(part: Partial) -> Iterator[Diagnostic]:
    """Judge links; what they demand of flows depends on their ends' needs too."""
    system = part.system()
    yield from _but(links.check(system, FlowNeeds(system.manifest, ())), {_UNIQUE})
    if part.sound("network"):
        system = part.system("flows")
        found = links.check(system, FlowNeeds(system.manifest, ()))
        yield from (each for each in found if each.rule == _UNIQUE)


def _of_sound_sections(part: Partial, variables: Mapping[str, str]) -> Iterator[Diagnostic]:
    """Run the checks that read a node together with sections of the whole system."""
    wired = part.system("connections", "flows", "run")
    needs = FlowNeeds(wired.manifest, search_prefixes(variables))
    if part.sound("network", "links", "machines"):
        yield from flows.check(wired, needs)
        yield from middleware.check(wired, needs, variables)
    if not part.sound("discovery", "machines", "data_layer"):
        return
    yield from discovery.check(part.system("run"), variables)
    if part.sound("network", "links"):
        yield from declared_connections.check(wired, needs)
    # Whom a URL names may be among what is left out.
    yield from _but(connection_urls.check(part.system("connections")), {"check.connection-peer"})


def _but(found: Iterator[Diagnostic], rules: Collection[str]) -> Iterator[Diagnostic]:
    return (each for each in found if each.rule not in rules)
