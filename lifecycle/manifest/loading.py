"""Load a manifest file: parse, substitute, validate, build, join includes, check. The entry point.

Owns: `load`: the run of source → arguments and schema → build for a manifest and everything it
includes, then of the checks; what one document declares, before it is joined with others by
`include`. A phase that finds errors reports all that it finds and is the last one. It is imported
when `load` is asked for: a process that hosts a node needs a manifest's types, but never YAML nor
JSON Schema, and those are half of what it would import.
Touches the file system; needs no ROS.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType

import msgspec
from msgspec.structs import replace

from lifecycle.manifest.building import (
    build_data_layer,
    build_modes,
    build_node,
    build_on_violation,
    positions_of,
    quantities,
)
from lifecycle.manifest.checks import check
from lifecycle.manifest.diagnostics import (
    Diagnostic,
    ManifestError,
    Position,
    Severity,
    in_order,
)
from lifecycle.manifest.interface import Findings
from lifecycle.manifest.model import (
    Discovery,
    Link,
    LinkKeys,
    Machine,
    Manifest,
    Network,
    NetworkKeys,
    Node,
    Policy,
)
from lifecycle.manifest.parameter_files import ParameterFiles
from lifecycle.manifest.schema import validate
from lifecycle.manifest.shared import Shared, settle
from lifecycle.manifest.written import build, read, read_part
from lifecycle.manifest.yaml import include
from lifecycle.manifest.yaml.arguments import Substituted, substitute
from lifecycle.manifest.yaml.document import Document, Place, Value, error, note
from lifecycle.manifest.yaml.source import read_document
from lifecycle.manifest.yaml.substitutions import Programs, Surroundings, folder_of
from lifecycle.manifest.yaml.yaml_parser import quote
from lifecycle.network.dscp import TransportPriorityMapping
from lifecycle.network.five_qi import DscpMapping, dscp_mappings, parse_mapping
from lifecycle.network.nfe import canonical, parse_address

_MAX_MAPPING_BYTES = 1_000_000


def build_network(root: Document, *, base: Path, found: list[Diagnostic]) -> Network:
    """Build the network of a document; the defaults where it declares nothing.

    Args:
        root: the document.
        base: folder that the path of a mapping starts from.
        found: findings are appended here.
    """
    network = root.get("network")
    if network is None:
        return Network()
    keys = network.plain()
    mapping = keys.pop("transport_priority_mapping", None)
    return build(
        Network,
        read(keys, NetworkKeys, strict=False),
        transport_priority_mapping=None if mapping is None else _priority_mapping(network, found),
        five_qi_dscp=_dscp_mapping(network, base, found) if "five_qi_dscp" in network else None,
    )


def _priority_mapping(
    network: Document, found: list[Diagnostic]
) -> TransportPriorityMapping | None:
    place = ("transport_priority_mapping",)
    try:
        return read_part(network, TransportPriorityMapping, place)
    except msgspec.ValidationError as problem:
        message, _, hint = str(problem.__cause__).partition("; ")
        found.append(error("manifest.transport-priority", network.at(place), message, hint))
        return None


def _dscp_mapping(network: Document, base: Path, found: list[Diagnostic]) -> DscpMapping | None:
    """Read a mapping: a published one by its name, else a file."""
    name = network.text("five_qi_dscp")
    shipped = {each.name: each for each in dscp_mappings()}
    if name in shipped:
        return shipped[name]
    try:
        with (base / name).open("rb") as file:
            text = file.read(_MAX_MAPPING_BYTES)
        return parse_mapping(text)
    except OSError as problem:
        message = f"cannot read the 5QI to DSCP mapping {quote(name)}: {problem.strerror}"
        hint = f"name a file, or a published mapping: {', '.join(shipped)}"
    except ValueError as problem:
        why = problem.__cause__ or problem
        message = f"cannot use {quote(name)} as a 5QI to DSCP mapping: {why}"
        hint = 'write {"name": …, "source": …, "values": {"85": "EF"}}'
    found.append(error("manifest.five-qi-dscp", network.at(("five_qi_dscp",)), message, hint))
    return None


THIS_HOST = "local"
"""Name of the machine of nodes that name none; declared implicitly, without address."""


_SECTIONS = ("discovery", "network", "data_layer", "on_violation")
"""Sections of a document that findings may be about."""


def build_manifest(
    root: Document,
    *,
    path: str,
    arguments: tuple[tuple[str, str], ...],
    base: Path,
    environment: Mapping[str, str],
    found: Findings,
    machine: str = THIS_HOST,
) -> Manifest:
    """Build what one document or group declares, its includes and groups not yet joined.

    Args:
        root: a document that fits the schema, or a group of one.
        path: as the user wrote it.
        arguments: resolved values by name.
        base: folder that its relative paths start from.
        environment: for AMENT_PREFIX_PATH, where interfaces by reference are searched.
        found: findings are appended here.
        machine: of nodes that name none, where the group names none either.
    """
    machine = root.text("machine", machine)
    nodes = tuple(
        build_node(key, each, base=base, machine=machine, environment=environment, found=found)
        for key, each in root.entries("nodes")
    )
    return Manifest(
        path=path,
        arguments=arguments,
        system=root.text("system"),
        description=root.text("description"),
        machines=_machines(root, nodes, found),
        discovery=read_part(root, Discovery, ("discovery",)),
        network=build_network(root, base=base, found=found),
        data_layer=build_data_layer(root, found),
        policy=read_part(root, Policy, ("policy",)),
        on_violation=build_on_violation(root),
        modes=build_modes(root, found),
        nodes=nodes,
        links=tuple(_link(each) for each in root.items("links")),
        positions={
            **positions_of(root, _SECTIONS),
            **{key: root.key_at((key,)) for key in _SECTIONS if key in root},
        },
    )


def _machines(root: Document, nodes: tuple[Node, ...], found: Findings) -> tuple[Machine, ...]:
    machines = []
    for name, each in root.entries("machines"):
        address = canonical(each.text("address"))
        if address and parse_address(address) is None:
            message = f"cannot use {quote(address)} as an address; it must be IPv4 or IPv6"
            hint = "look the name up: a plan must not depend on a name server"
            found.append(error("manifest.address", each.at(("address",)), message, hint))
        machines.append(Machine(name=name, address=address, at=each.key_at()))
    if THIS_HOST not in {each.name for each in machines}:
        here = next((node for node in nodes if node.machine == THIS_HOST), None)
        if here is not None:
            machines.append(Machine(name=THIS_HOST, at=here.at))
    return tuple(machines)


def _link(part: Document) -> Link:
    keys = read_part(part, LinkKeys)
    return build(Link, keys, quantities=tuple(quantities(part, keys)), at=part.at())


_NONE: Mapping[str, str] = MappingProxyType({})


class Loaded(msgspec.Struct, frozen=True, kw_only=True):
    """A manifest without errors.

    Attributes:
        warnings: what may be wrong with it, and notes, by position.
        files: the parameter files that its nodes name, as they were read.
    """

    manifest: Manifest
    warnings: tuple[Diagnostic, ...]
    files: ParameterFiles


def load(
    path: str | os.PathLike[str],
    arguments: Mapping[str, str] = _NONE,
    *,
    environment: Mapping[str, str] | None = None,
    run_commands: bool = True,
) -> Loaded:
    """Read and check a manifest, with everything it includes.

    Args:
        path: the file.
        arguments: values by argument name.
        environment: what `$(env NAME)` and the search for packages see; this process's environment
            if None.
        run_commands: run the programs of `$(command …)`; else what they would write is left out
            with a warning, and all else is judged.

    Raises:
        ManifestError: with every error and warning, sorted by position.
    """
    variables = os.environ if environment is None else environment
    origin = include.Origin.of(Path(path))
    loading = _Loading(variables, Programs(variables) if run_commands else None)
    manifest = loading.read(origin, arguments, ())
    found = loading.found

    def every() -> tuple[Diagnostic, ...]:
        return in_order(found, loading.files)

    if manifest is None or _has_errors(found):
        raise ManifestError(every())
    files = ParameterFiles(manifest.path)
    manifest = settle(_without_left_out(manifest), files, found)
    if not manifest.nodes and manifest.left_out:
        at = Position(file=manifest.path, line=1, column=1)
        message = "cannot run a system without nodes: conditions leave out all of them"
        found.append(
            error(
                "manifest.condition",
                at,
                message,
                "lifecycle check --arguments lists what they follow",
            )
        )
    if not _has_errors(found):
        found += check(manifest, environment=variables, files=files)
    if _has_errors(found):
        raise ManifestError(every())
    warnings = every()
    unproven = tuple(each for each in warnings if each.is_unproven)
    manifest = replace(manifest, unproven=unproven)
    return Loaded(manifest=manifest, warnings=warnings, files=files)


class ArgumentDeclaration(msgspec.Struct, frozen=True, kw_only=True):
    """An argument that a manifest takes: `rate:=5.0` on the command line.

    Attributes:
        default: as it is written, substitutions unresolved; None for one that is required.
        choices: the only values allowed; empty if any is.
    """

    name: str
    default: str | None
    choices: tuple[str, ...]
    description: str
    at: Position


def declared_arguments(path: str | Path) -> tuple[ArgumentDeclaration, ...]:
    """Return the arguments that one manifest declares, in their order, whatever else is in it.

    Raises:
        ManifestError: it cannot be read, or its `arguments:` are none.
    """
    document = read_document(path, shown=os.fspath(path))
    wrong = [each for each in validate(document) if each.at.path.startswith("arguments")]
    if wrong:
        raise ManifestError(in_order(wrong, [document.file]))
    return tuple(
        ArgumentDeclaration(
            name=name,
            default=each.text("default") if "default" in each else None,
            choices=tuple(choice.root.text for choice in each.items("choices")),
            description=each.text("description"),
            at=each.key_at(),
        )
        for name, each in document.entries("arguments")
    )


def _without_left_out(manifest: Manifest) -> Manifest:
    """Return a manifest whose nodes wait for no node that is left out, and links have both ends."""
    there = {node.key for node in manifest.nodes}
    exact = {key for key in manifest.left_out if not key.endswith("/")} - there
    prefixes = tuple(key for key in manifest.left_out if key.endswith("/"))

    def is_left_out(key: str) -> bool:
        return key not in there and (key in exact or key.startswith(prefixes))

    if not manifest.left_out:
        return manifest
    nodes = tuple(
        replace(node, after=tuple(each for each in node.after if not is_left_out(each.node)))
        for node in manifest.nodes
    )
    links = tuple(
        link
        for link in manifest.links
        if not is_left_out(link.from_node) and not is_left_out(link.to_node)
    )
    modes = tuple(
        replace(
            mode,
            inactive=tuple(key for key in mode.inactive if not is_left_out(key)),
            parameters=tuple(each for each in mode.parameters if not is_left_out(each.node)),
        )
        for mode in manifest.modes
    )
    return replace(manifest, nodes=nodes, links=links, modes=modes)


SUFFIX = ".lifecycle.yaml"
"""What a manifest's name ends in; plain `.yaml` belongs to ROS launch files."""


class _Reading(msgspec.Struct, frozen=True, kw_only=True):
    """One file while it is read: places in it are counted from its root.

    Attributes:
        chain: the manifests that include it, and itself.
        left_out: places that conditions leave out.
    """

    origin: include.Origin
    chain: tuple[include.Origin, ...]
    left_out: tuple[Place, ...]

    def leaves_out(self, each: Document) -> bool:
        """Whether an entry of `include` or `groups` is left out."""
        return each.place in self.left_out


NOTHING = Shared(machine=THIS_HOST)


class _Loading:
    """One run over a manifest and its includes.

    Attributes:
        found: errors and warnings so far.
        files: as they were read.
    """

    def __init__(self, environment: Mapping[str, str], programs: Programs | None) -> None:
        self.found: list[Diagnostic] = []
        self.files: list[str] = []
        self._environment = environment
        self._programs = programs
        self._documents = 0
        self._outermost: Manifest | None = None

    def read(
        self,
        origin: include.Origin,
        given: Mapping[str, str],
        chain: tuple[include.Origin, ...],
        *,
        entry: Document | None = None,
        shared: Shared = NOTHING,
    ) -> Manifest | None:
        """Read one manifest and what it includes.

        Args:
            origin: the file.
            given: argument values.
            chain: the manifests that include it, outermost first.
            entry: the include that names it.
            shared: what the including manifests and groups share.

        Returns:
            What is declared; None if the file cannot be read or does not fit the schema.
        """
        self.files.append(origin.shown)
        try:
            document = read_document(origin.path, shown=origin.shown)
        except ManifestError as problem:
            self.found += problem.diagnostics
            return None
        self._check_suffix(document)
        before = len(self.found)
        substituted = self._substituted(document, origin, given, entry)
        document = substituted.document
        emptied = [
            place[:-1]
            for place in substituted.left_out
            if (around := document.find(place[:-1])) is not None and not around.data
        ]
        ignore = [*substituted.broken, *substituted.left_out, *emptied]
        self.found += validate(document, ignore=ignore)
        if _has_errors(self.found[before:]):
            return None
        manifest = build_manifest(
            document,
            path=origin.shown,
            arguments=substituted.arguments,
            base=origin.path.parent,
            environment=self._environment,
            found=self.found,
            machine=shared.machine,
        )
        self._check_outermost(document, manifest)
        reading = _Reading(
            origin=origin,
            chain=(*chain, origin),
            left_out=substituted.left_out,
        )
        return self._contents(reading, document, manifest, shared=shared)

    def _substituted(
        self,
        document: Document,
        origin: include.Origin,
        given: Mapping[str, str],
        entry: Document | None,
    ) -> Substituted:
        surroundings = Surroundings(
            environment=self._environment,
            folder=folder_of(origin.path),
            programs=self._programs,
        )
        found = substitute(document, given, surroundings, include=entry)
        self.found += found.diagnostics
        for place in found.left_out:
            self.found += _misspelt(document, place)
        return found

    def _contents(
        self,
        reading: _Reading,
        root: Document,
        manifest: Manifest,
        *,
        shared: Shared,
    ) -> Manifest:
        """Give the nodes of a document or group what they share, and add groups and includes."""
        shared = shared.inner(root, self.found)
        manifest = replace(
            manifest,
            nodes=tuple(shared.given_to(node) for node in manifest.nodes),
            left_out=tuple(
                str(place[-1]) for place in reading.left_out if place[:-1] == (*root.place, "nodes")
            ),
        )
        for each in root.items("include"):
            if reading.leaves_out(each):
                key = each.text("prefix")
                here = (f"{key}/",) if key and "$(" not in key else ()
                manifest = replace(manifest, left_out=(*manifest.left_out, *here))
            else:
                manifest = self._include(manifest, each, reading.chain, shared)
        for each in root.items("groups"):
            if reading.leaves_out(each):
                keys = tuple(_keys_of(each.root))
                manifest = replace(manifest, left_out=(*manifest.left_out, *keys))
            else:
                manifest = self._group(reading, manifest, each, shared)
        return manifest

    def _group(
        self, reading: _Reading, outer: Manifest, entry: Document, shared: Shared
    ) -> Manifest:
        inner = build_manifest(
            entry,
            path=outer.path,
            arguments=(),
            base=reading.origin.path.parent,
            environment=self._environment,
            found=self.found,
            machine=shared.machine,
        )
        inner = self._contents(reading, entry, inner, shared=shared)
        return self._joined(outer, inner, entry, "group")

    def _joined(self, outer: Manifest, inner: Manifest, entry: Document, what: str) -> Manifest:
        prefix, namespace = entry.text("prefix"), entry.text("namespace")
        inner = include.move(inner, prefix=prefix, namespace=namespace)
        return include.join(outer, inner, entry.at(), self.found, what=what)

    def _include(
        self,
        outer: Manifest,
        entry: Document,
        chain: tuple[include.Origin, ...],
        shared: Shared,
    ) -> Manifest:
        origin = include.locate(entry, chain, self.found)
        if origin is None:
            return outer
        self._documents += 1
        if self._documents > include.MAX_DOCUMENTS:
            if self._documents == include.MAX_DOCUMENTS + 1:
                message = f"cannot include more than {include.MAX_DOCUMENTS} manifests"
                self.found.append(error("manifest.include", entry.at(), message))
            return outer
        given = {name: each.root.text for name, each in entry.entries("arguments")}
        inner = self.read(origin, given, chain, entry=entry, shared=shared)
        return outer if inner is None else self._joined(outer, inner, entry, "include")

    def _check_suffix(self, document: Document) -> None:
        if not document.file.endswith(SUFFIX):
            at = Position(file=document.file, line=1, column=1)
            name = Path(document.file).name
            message = f"cannot tell by its name {name!r} that this is a manifest"
            stem = name.removesuffix(".yaml").removesuffix(".yml")
            hint = f"rename it to {stem}{SUFFIX}"
            self.found.append(note("manifest.suffix", at, message, hint))

    def _check_outermost(self, root: Document, manifest: Manifest) -> None:
        """Warn where a system-wide section of an included manifest has no effect."""
        if self._outermost is None:
            self._outermost = manifest
            return
        outer = self._outermost
        for key in (*_SECTIONS, "policy", "modes"):
            if key in root and getattr(manifest, key) != getattr(outer, key):
                message = f"cannot use the {key} of an included manifest; the including one's holds"
                at = root.key_at((key,))
                self.found.append(note("manifest.include-ignored", at, message))


def _misspelt(document: Document, place: Place) -> tuple[Diagnostic, ...]:
    """Return what is wrong with something that is left out, whatever its substitutions become."""
    part = document.get(*place)
    if part is None:
        return ()
    kind = str(place[-2]).removesuffix("s").capitalize()
    return validate(part, definition=kind, is_resolved=False)


def _keys_of(group: Value) -> Iterator[str]:
    """Yield the keys of nodes in a group that is left out; with "/" at the end, a prefix."""
    data = group.data if isinstance(group.data, Mapping) else {}
    prefix = data["prefix"].text if "prefix" in data else ""
    if prefix:
        yield f"{prefix}/"
        return
    nodes = data["nodes"].data if "nodes" in data else {}
    yield from nodes if isinstance(nodes, Mapping) else ()
    for key in ("include", "groups"):
        items = data[key].data if key in data else ()
        for each in items if isinstance(items, tuple) else ():
            yield from _keys_of(each)


def _has_errors(found: Iterable[Diagnostic]) -> bool:
    return any(each.severity is Severity.ERROR for each in found)
