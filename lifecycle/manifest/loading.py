"""Load a manifest file: parse, substitute, validate, build, add includes, check. The entry point.

Owns: `load`: the run of source → arguments and schema → build for a manifest and everything it
includes, then of the checks; which files `include:` names. Documents and groups are walked from the
outside in; each node is built with what is around it (`Shared`). A phase that finds errors reports
all that it finds and is the last one.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType

import msgspec
from msgspec.structs import replace

from lifecycle.errors import did_you_mean
from lifecycle.manifest.building import (
    Shared,
    build_modes,
    build_node,
    positions_of,
    quantities,
    settle,
)
from lifecycle.manifest.checks import check
from lifecycle.manifest.diagnostics import (
    Diagnostic,
    Findings,
    ManifestError,
    Position,
    Severity,
    error,
    in_order,
    note,
)
from lifecycle.manifest.model import (
    THIS_HOST,
    DataLayer,
    Discovery,
    EndpointKind,
    Link,
    LinkKeys,
    Machine,
    Manifest,
    Network,
    Node,
    Policy,
)
from lifecycle.manifest.names import topic_of
from lifecycle.manifest.parameter_files import ParameterFiles
from lifecycle.manifest.schema import validate
from lifecycle.manifest.written import OnViolation, build, read_part
from lifecycle.manifest.yaml.arguments import substitute
from lifecycle.manifest.yaml.document import Document, Place, Value, quote
from lifecycle.manifest.yaml.source import read_document
from lifecycle.manifest.yaml.substitutions import Programs, Surroundings, folder_of
from lifecycle.network.nfe import canonical, parse_address

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
    loading = _Loading(variables, Programs(variables) if run_commands else None)
    loading.read(Path(path), arguments)
    manifest, found = loading.manifest(), loading.found
    if manifest is None or _has_errors(found):
        raise ManifestError(in_order(found, loading.files))
    files = ParameterFiles(manifest.path)
    manifest = settle(_without_left_out(manifest), files, found)
    if not manifest.nodes:
        at = Position(file=manifest.path, line=1, column=1)
        why = ": conditions leave out all of them" if manifest.left_out else ""
        hint = "lifecycle check --arguments lists what they follow" if why else ""
        message = f"cannot run a system without nodes{why}"
        found.append(error("manifest.condition", at, message, hint))
    if not _has_errors(found):
        found += check(manifest, environment=variables, files=files)
    warnings = in_order(found, loading.files)
    if _has_errors(found):
        raise ManifestError(warnings)
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
    """Return the arguments that one manifest declares, whatever else is in it.

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


def _other_kind(document: Document) -> tuple[str, str] | None:
    """Return which other document of ROS 2 this is, and what takes it; None for a manifest."""
    if "manifest_version" in document:
        return None
    if "launch" in document:
        return "a launch file", f"write a manifest from it: lifecycle import {document.file}"
    if "nodl_version" in document:
        return "a NoDL document", "a node names it: 'interface: local://PATH'"
    if any("ros__parameters" in each for _, each in document.entries()):
        return "a parameter file", "a node names it: 'parameter_files: [PATH]'"
    return None


def _without_left_out(manifest: Manifest) -> Manifest:
    """Return a manifest whose nodes wait for no node that is left out, and links have both ends."""
    if not manifest.left_out:
        return manifest
    there = {node.key for node in manifest.nodes}
    prefixes = tuple(key for key in manifest.left_out if key.endswith("/"))

    def stays(key: str) -> bool:
        return key in there or not (key in manifest.left_out or key.startswith(prefixes))

    nodes = (
        replace(node, after=tuple(each for each in node.after if stays(each.node)))
        for node in manifest.nodes
    )
    links = (link for link in manifest.links if stays(link.from_node) and stays(link.to_node))
    modes = (
        replace(
            mode,
            inactive=tuple(filter(stays, mode.inactive)),
            parameters=tuple(each for each in mode.parameters if stays(each.node)),
        )
        for mode in manifest.modes
    )
    return replace(manifest, nodes=tuple(nodes), links=tuple(links), modes=tuple(modes))


_SECTIONS = ("discovery", "network", "data_layer", "on_violation")
"""Sections of a document that findings may be about."""


NOTHING = Shared()


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
        self._nodes: dict[str, Node] = {}
        self._machines: dict[str, Machine] = {}
        self._links: list[Link] = []
        self._left_out: list[str] = []

    def manifest(self) -> Manifest | None:
        """Return what was read; None if the outermost document cannot be used."""
        return self._outermost and replace(
            self._outermost,
            machines=tuple(self._machines.values()),
            nodes=tuple(self._nodes.values()),
            links=tuple(self._links),
            left_out=tuple(self._left_out),
        )

    def read(
        self,
        path: Path,
        given: Mapping[str, str],
        *,
        chain: tuple[Path, ...] = (),
        entry: Document | None = None,
        around: Shared = NOTHING,
    ) -> None:
        """Read one manifest and what it includes.

        Args:
            path: the file.
            given: argument values.
            chain: the manifests that include it, outermost first.
            entry: the include that names it; None for the outermost.
            around: what the including manifests and groups give its nodes.
        """
        # Bytes that are no UTF-8 could be neither shown nor sent.
        self.files.append(os.fsencode(path).decode("utf-8", errors="replace"))
        try:
            document = read_document(path, shown=self.files[-1])
        except ManifestError as problem:
            self.found += problem.diagnostics
            return
        if kind := _other_kind(document):
            what, hint = kind
            message = f"cannot use {what} as a manifest"
            self.found.append(error("manifest.kind", document.at(), message, hint))
            return
        before = len(self.found)
        surroundings = Surroundings(
            environment=self._environment, folder=folder_of(path), programs=self._programs
        )
        substituted = substitute(document, given, surroundings, include=entry)
        self.found += substituted.found
        document = substituted.document
        ignore = [*substituted.broken, *substituted.left_out]
        self.found += validate(document, ignore=ignore)
        if _has_errors(self.found[before:]):
            return
        self._system(document, tuple(substituted.arguments.items()))
        for name, each in document.entries("machines"):
            self._machine(name, each)
        first_link = len(self._links)
        self._contents(document, around, entry, (*chain, path), substituted.left_out)
        links = [self._link(each, around) for each in document.items("links")]
        self._links[first_link:first_link] = links

    def _system(self, document: Document, arguments: tuple[tuple[str, str], ...]) -> None:
        """Build what is declared of the whole system: the outermost manifest's holds."""
        reactions = document.get("on_violation")
        declared = Manifest(
            path=document.file,
            arguments=arguments,
            system=document.text("system"),
            description=document.text("description"),
            discovery=read_part(document, Discovery, ("discovery",)),
            network=read_part(document, Network, ("network",)),
            data_layer=read_part(document, DataLayer, ("data_layer",)),
            policy=read_part(document, Policy, ("policy",)),
            on_violation=read_part(reactions, OnViolation).value if reactions else (),
            modes=build_modes(document, self.found),
            positions={
                **positions_of(document, _SECTIONS),
                **{key: document.key_at((key,)) for key in _SECTIONS if key in document},
            },
        )
        outer = self._outermost
        if outer is None:
            self._outermost = declared
            return
        for key in (*_SECTIONS, "policy", "modes"):
            if key in document and getattr(declared, key) != getattr(outer, key):
                message = f"cannot use the {key} of an included manifest; the including one's holds"
                at = document.key_at((key,))
                self.found.append(note("manifest.include-ignored", at, message))

    def _contents(
        self,
        root: Document,
        around: Shared,
        entry: Document | None,
        chain: tuple[Path, ...],
        without: Collection[Place],
    ) -> None:
        """Add what a document or group has; `entry` is the group or the include that it came by."""
        shared = around.inner(root, self.found)
        for key, part in root.entries("nodes"):
            node = build_node(
                key,
                part,
                base=chain[-1].parent,
                shared=shared,
                environment=self._environment,
                found=self.found,
            )
            first = self._nodes.setdefault(node.key, node)
            if first is not node and entry is not None:
                what = "include" if "manifest" in entry else "group"
                message = (
                    f"cannot include the node {quote(node.key)}: {first.at.spelled} declares it too"
                )
                hint = f"give the {what} a prefix"
                self.found.append(error("manifest.duplicate-node", entry.at(), message, hint))
            if node.machine == THIS_HOST:
                self._machines.setdefault(THIS_HOST, Machine(name=THIS_HOST, at=node.at))
        left_out = [str(place[-1]) for place in without if place[:-1] == (*root.place, "nodes")]
        for each in root.items("include"):
            if each.place not in without:
                path = _locate(each, chain, self.found)
                self._documents += path is not None
                if path is not None and self._documents <= MAX_MANIFESTS:
                    given = {name: one.root.text for name, one in each.entries("arguments")}
                    inner = shared.inner(each, self.found)
                    self.read(path, given, chain=chain, entry=each, around=inner)
                elif path is not None and self._documents == MAX_MANIFESTS + 1:
                    message = f"cannot include more than {MAX_MANIFESTS} manifests"
                    self.found.append(error("manifest.include", each.at(), message))
            elif (prefix := each.text("prefix")) and "$(" not in prefix:
                left_out.append(f"{prefix}/")
        for each in root.items("groups"):
            if each.place not in without:
                self._contents(each, shared, each, chain, without)
            else:
                left_out += _keys_of(each.root)
        self._left_out += map(shared.key, left_out)

    def _machine(self, name: str, part: Document) -> None:
        address = canonical(part.text("address"))
        if address and parse_address(address) is None:
            message = f"cannot use {quote(address)} as an address; it must be IPv4 or IPv6"
            hint = "" if address[-1].isdigit() else "look the name up: a plan asks no name server"
            self.found.append(error("manifest.address", part.at(("address",)), message, hint))
        machine = Machine(name=name, address=address, at=part.key_at())
        first = self._machines.setdefault(name, machine)
        if first.address != address:
            message = (
                f"cannot give machine {quote(name)} the address {quote(address)}: "
                f"it has {quote(first.address)} at {first.at.spelled}"
            )
            self.found.append(
                error("manifest.machine", machine.at, message, "rename one of the two")
            )

    def _link(self, part: Document, around: Shared) -> Link:
        """Build a link of a document; its topic moves with the document's namespace."""
        keys = read_part(part, LinkKeys)
        ends = (
            (around.key(keys.from_node), EndpointKind.PUBLISHER),
            (around.key(keys.to_node), EndpointKind.SUBSCRIPTION),
        )
        return build(
            Link,
            keys,
            topic=self._moved(keys.topic, ends, around.namespace),
            from_node=ends[0][0],
            to_node=ends[1][0],
            quantities=tuple(quantities(part, keys)),
            at=part.at(),
        )

    def _moved(self, topic: str, ends: Iterable[tuple[str, EndpointKind]], namespace: str) -> str:
        """Return what a topic is called in the system that its document is included in.

        It moves with its publisher; only names that are not absolute move with a namespace.
        """
        for key, kind in ends:
            node = self._nodes.get(key)
            if node is None or not namespace:
                continue
            alone = f"/{node.namespace.removeprefix(f'/{namespace}').lstrip('/')}"
            before = replace(node, namespace=alone)
            for each in node.interface.endpoints:
                if each.kind is kind and topic_of(before, each.name, kind) == topic:
                    return topic_of(node, each.name, kind) or topic
        return topic


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


MAX_INCLUDE_DEPTH = 16
"""Manifests that include each other in a row."""

MAX_MANIFESTS = 256
"""Manifests of one system; included twice counts twice."""


def _locate(entry: Document, chain: tuple[Path, ...], found: Findings) -> Path | None:
    """Return the file that an entry of `include:` names; None after reporting why there is none."""
    name = entry.text("manifest")
    path = Path(os.path.normpath(chain[-1].parent / name))
    why, hint = "", ""
    if path in map(Path, map(os.path.normpath, chain)):
        why = "it would include itself"
    elif len(chain) == MAX_INCLUDE_DEPTH:
        why = f"at most {MAX_INCLUDE_DEPTH} manifests in a row"
    elif not os.path.exists(path):
        why = f"there is no file {quote(str(path), limit=200)}"
        with contextlib.suppress(OSError, ValueError):  # no such folder, or not ours to read
            hint = did_you_mean(path.name, sorted(each.name for each in path.parent.iterdir()))
    elif path.is_dir():
        why = "it is a directory"
    if not why:
        return path
    message = f"cannot include {quote(name)}: {why}"
    found.append(error("manifest.include", entry.at(("manifest",)), message, hint))
    return None
