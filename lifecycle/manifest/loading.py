"""Load a manifest file: parse, substitute, validate, build, join includes, check. The entry point.

Owns: `load`: the run of source → arguments → schema → build for a manifest and everything it
includes, then of the checks, with every finding gathered on the way. A part with an error is left
out, and the rest is checked in the same run. It is imported when `load` is asked for: a process
that hosts a node needs a manifest's types, but never YAML nor JSON Schema, and those are half of
what it would import. Touches the file system; needs no ROS.
"""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from lifecycle.manifest.builders.cursor import Cursor
from lifecycle.manifest.builders.system import build_manifest
from lifecycle.manifest.checks import check, check_sound
from lifecycle.manifest.checks.system import SEPARABLE, Partial
from lifecycle.manifest.diagnostics import Diagnostic, ManifestError, Position, Severity
from lifecycle.manifest.model import Manifest, Node
from lifecycle.manifest.schema import MANIFEST, nearest, read_schema, validate
from lifecycle.manifest.yaml import include
from lifecycle.manifest.yaml.arguments import substitute
from lifecycle.manifest.yaml.document import Document, Place, Value, error, warning
from lifecycle.manifest.yaml.source import is_outside, read_document

_NONE: Mapping[str, str] = MappingProxyType({})


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Loaded:
    """A manifest without errors.

    Attributes:
        warnings: what may be wrong with it, by position.
    """

    manifest: Manifest
    warnings: tuple[Diagnostic, ...]


def load(
    path: str | os.PathLike[str],
    arguments: Mapping[str, str] = _NONE,
    *,
    environment: Mapping[str, str] | None = None,
) -> Loaded:
    """Read and check a manifest, with everything it includes.

    Args:
        path: the file.
        arguments: values by argument name.
        environment: what `$(env NAME)` and the search for packages see; this process's environment
            if None.

    Raises:
        ManifestError: with every error and warning, sorted by position.
    """
    variables = os.environ if environment is None else environment
    loading = _Loading(variables)
    origin = include.Origin.of(Path(path))
    manifest = loading.read(origin, arguments, ())
    found = loading.found

    def every() -> tuple[Diagnostic, ...]:
        quoted = _without_outside_text(found, os.fspath(path), variables)
        return _sorted(quoted, loading.files)

    if manifest is None:
        raise ManifestError(every())
    if wrong := [each for each in found if each.severity is Severity.ERROR]:
        part = partial(manifest, wrong, lost=loading.lost, machines=loading.machines)
        found += check_sound(part, environment=variables)
        raise ManifestError(every())
    found += check(manifest, environment=variables)
    if any(each.severity is Severity.ERROR for each in found):
        raise ManifestError(every())
    return Loaded(manifest=manifest, warnings=every())


_SEGMENTS = re.compile(r"[^.\[]+")
"""Finds `nodes`, `camera`, `interface` in `nodes.camera.interface[0]`."""


def sound(document: Document, unsound: Sequence[Place]) -> Document:
    """Return a document without the parts, nodes, machines and sections that hold unsound values.

    Links stay in their list, so that the others keep their numbers; see `links`.
    """
    broken = links(unsound)
    cut = {_cut(place) for place in unsound if place and place[:2] not in broken}
    return dataclasses.replace(document, root=_without(document.root, cut))


def links(unsound: Iterable[Place]) -> frozenset[Place]:
    """Return the places of the links that hold unsound values."""
    return frozenset(place[:2] for place in unsound if place[:1] == ("links",) and len(place) > 1)


def lost(document: Document, rest: Document) -> frozenset[str] | None:
    """Return the keys of nodes that are left out of `rest`; None if they are not known."""
    every, kept = entries(document, "nodes"), entries(rest, "nodes")
    if every is None or kept is None:
        return every
    return every - kept


def entries(document: Document, section: str) -> frozenset[str] | None:
    """Return the keys in a section, none where it is missing; None if it is no mapping."""
    value = document.find((section,))
    if value is None:
        return frozenset()
    return frozenset(value.data) if isinstance(value.data, Mapping) else None


def partial(
    manifest: Manifest,
    wrong: Iterable[Diagnostic],
    *,
    lost: frozenset[str] | None,
    machines: frozenset[str] | None,
) -> Partial:
    """Return what is left of a manifest without the nodes whose name or endpoints are not sound.

    Args:
        manifest: what could be built.
        wrong: every error so far.
        lost: keys of nodes that could not be built; None if there may be any.
        machines: names of all that are declared; None if not all are known.
    """
    flaws: dict[tuple[str, str], set[str]] = {}
    sections: set[str] = set()
    for each in wrong:
        section, *inside = _SEGMENTS.findall(each.at.path)[:3] or [""]
        if section == "nodes" and inside:
            flaws.setdefault((each.at.file, inside[0]), set()).add(_part(inside[1:]))
        else:
            sections.add(section)
    flawed = {node.key: frozenset(flaws.get(_place(node), ())) for node in manifest.nodes}
    nodes = tuple(each for each in manifest.nodes if "" not in flawed[each.key])
    if lost is not None:
        lost |= {each.key for each in manifest.nodes} - {each.key for each in nodes}
    if machines is not None:
        machines |= {each.name for each in manifest.machines}
    return Partial(
        manifest=dataclasses.replace(manifest, nodes=nodes),
        flawed=flawed,
        sections=frozenset(sections),
        lost=lost,
        machines=machines,
    )


def _place(node: Node) -> tuple[str, str]:
    """The file and the key by which findings name a node; an include may have given it a prefix."""
    return node.at.file, _SEGMENTS.findall(node.at.path)[1]


def _part(inside: Iterable[str | int]) -> str:
    """Return the separable part of a node that a place in it belongs to; empty for the whole node.

    A key that is none is the one that it was most probably meant to be.
    """
    key = str(next(iter(inside), ""))
    keys = read_schema(MANIFEST)["$defs"]["node"]["properties"]
    meant = key if key in keys else nearest(key, keys)
    return meant if meant in SEPARABLE else ""


def _cut(place: Place) -> Place:
    """Return the place of what is left out with an unsound value."""
    if place[0] == "nodes" and len(place) > 1:
        part = _part(place[2:])
        return (*place[:2], part) if part else place[:2]
    return place[: 2 if place[0] == "machines" else 1]


def _without(value: Value, cut: Iterable[Place]) -> Value:
    if not isinstance(value.data, Mapping):
        return value
    below: dict[str | int, list[Place]] = {}
    for first, *rest in cut:
        below.setdefault(first, []).append(tuple(rest))
    kept = {
        key: _without(each, below.get(key, ()))
        for key, each in value.data.items()
        if () not in below.get(key, ())
    }
    return dataclasses.replace(value, data=kept)


SUFFIX = ".lifecycle.yaml"
"""What a manifest's name ends in; plain `.yaml` belongs to ROS launch files."""


class _Loading:
    """One run over a manifest and its includes.

    Attributes:
        found: errors and warnings so far.
        files: as they were read.
        machines: names of all that are declared; None if not all are known.
        lost: keys of nodes that are declared and could not be built; None if there may be any.
    """

    def __init__(self, environment: Mapping[str, str]) -> None:
        self.found: list[Diagnostic] = []
        self.files: list[str] = []
        self.machines: frozenset[str] | None = frozenset()
        self.lost: frozenset[str] | None = frozenset()
        self._environment = environment
        self._documents = 0
        self._outermost: Manifest | None = None

    def read(
        self,
        origin: include.Origin,
        given: Mapping[str, str],
        chain: tuple[include.Origin, ...],
        entry: Cursor | None = None,
        prefix: str = "",
    ) -> Manifest | None:
        """Read one manifest and what it includes.

        Args:
            origin: the file.
            given: argument values.
            chain: the manifests that include it, outermost first.
            entry: the include that names it.
            prefix: what all its includes put before its keys.

        Returns:
            What is declared, as far as it is sound; None if the file cannot be read at all.
        """
        flaws: list[Diagnostic] = []
        self.files.append(origin.shown)
        try:
            document = read_document(origin.path, shown=origin.shown, found=flaws)
        except ManifestError as problem:
            self.found += problem.diagnostics
            return None
        self.found += flaws
        self._check_suffix(document)
        substituted = substitute(document, given, self._environment, include=entry)
        document = substituted.document
        self.found += substituted.diagnostics
        violations = validate(document, ignore=substituted.broken)
        self.found += [each for _, each in violations]
        unsound = [*substituted.broken, *(place for place, _ in violations)]
        root = Cursor.root(sound(document, unsound))
        manifest = build_manifest(
            root,
            path=origin.shown,
            arguments=substituted.arguments,
            base=origin.path.parent,
            environment=self._environment,
            unsound=links(unsound),
            found=self.found,
        )
        self.machines = _union(self.machines, entries(document, "machines"))
        self.lost = _union(self.lost, lost(document, root.document), prefix)
        self._check_outermost(root, manifest)
        for each in Cursor.root(document).items("include") if _is_list(document) else ():
            if not any(place[: len(each.place)] == each.place for place in unsound):
                manifest = self._include(manifest, each, (*chain, origin), prefix)
            else:
                self._unread()
        return manifest

    def _include(
        self, outer: Manifest, entry: Cursor, chain: tuple[include.Origin, ...], prefix: str
    ) -> Manifest:
        origin = include.locate(entry, chain, self.found)
        if origin is None:
            self._unread()
            return outer
        self._documents += 1
        if self._documents > include.MAX_DOCUMENTS:
            if self._documents == include.MAX_DOCUMENTS + 1:
                message = f"cannot include more than {include.MAX_DOCUMENTS} manifests"
                self.found.append(error("manifest.include", entry.at, message))
            self._unread()
            return outer
        given = {name: each.value.text for name, each in entry.entries("arguments")}
        own = entry.text("prefix")
        inner = self.read(origin, given, chain, entry, include.join_key(prefix, own))
        if inner is None:
            self._unread()
            return outer
        inner = include.move(inner, prefix=own, namespace=entry.text("namespace"))
        return include.join(outer, inner, entry.at, self.found)

    def _unread(self) -> None:
        """Note that a manifest is missing which may declare whatever is looked for."""
        self.machines = self.lost = None

    def _check_suffix(self, document: Document) -> None:
        if not document.file.endswith(SUFFIX):
            at = Position(file=document.file, line=1, column=1)
            name = Path(document.file).name
            message = f"cannot tell by its name {name!r} that this is a manifest"
            stem = name.removesuffix(".yaml").removesuffix(".yml")
            hint = f"rename it to {stem}{SUFFIX}"
            self.found.append(warning("manifest.suffix", at, message, hint))

    def _check_outermost(self, root: Cursor, manifest: Manifest) -> None:
        """Warn where a system-wide section of an included manifest has no effect."""
        if self._outermost is None:
            self._outermost = manifest
            return
        outer = self._outermost
        for key in ("discovery", "network", "data_layer", "policy"):
            mine, holds = getattr(manifest, key), getattr(outer, key)
            if key != "policy":
                mine = dataclasses.replace(mine, at=holds.at)
            if key in root and mine != holds:
                message = f"cannot use the {key} of an included manifest; the including one's holds"
                at = root.document.key_at((key,))
                self.found.append(warning("manifest.include-ignored", at, message))


def _union(
    known: frozenset[str] | None, keys: frozenset[str] | None, prefix: str = ""
) -> frozenset[str] | None:
    """Add keys, under a prefix, to those that are known; None if either are not all known."""
    if known is None or keys is None:
        return None
    return known | {include.join_key(prefix, key) for key in keys}


def _is_list(document: Document) -> bool:
    section = document.find(("include",))
    return section is not None and isinstance(section.data, tuple)


def _mark(each: Diagnostic) -> tuple[str, int, int]:
    return each.at.file, each.at.line, each.at.column


_READING = ("yaml.", "manifest.", "nodl.", "check.parameter")
"""Rules whose messages quote what a file holds before it is known to be one of ours."""


def _without_outside_text(
    found: Sequence[Diagnostic], manifest: str, environment: Mapping[str, str]
) -> list[Diagnostic]:
    """Return findings that quote nothing of files outside the manifest's tree."""
    outside: dict[str, bool] = {}
    kept = []
    for each in found:
        file = each.at.file
        if file not in outside:
            outside[file] = is_outside(file, manifest, environment)
        if outside[file] and each.rule.startswith(_READING) and each.rule not in _QUOTES_NOTHING:
            each = dataclasses.replace(  # noqa: PLW2901 - the same finding, without the text
                each,
                at=dataclasses.replace(each.at, path=""),
                message=f"cannot use what is written here ({each.rule})",
                hint=f"not quoted, as the file is outside the folder of {manifest}; open it there, "
                "or move it",
            )
        kept.append(each)
    return kept


_QUOTES_NOTHING = frozenset({"yaml.file", "yaml.empty", "manifest.suffix"})


def _sorted(found: Sequence[Diagnostic], read: Iterable[str]) -> tuple[Diagnostic, ...]:
    """Return findings without repetitions, by file in the order of reading, then by position.

    Of a value that is refused as YAML nothing else is reported: `.nan` is no number, that is all.
    """
    refused = {_mark(each) for each in found if each.rule.startswith("yaml.")}
    unique = [
        each
        for each in dict.fromkeys(found)
        # A finding about a whole document has the position of its first key.
        if each.rule.startswith("yaml.") or not each.at.path or _mark(each) not in refused
    ]
    files = list(dict.fromkeys([*read, *(each.at.file for each in unique)]))
    return tuple(
        sorted(unique, key=lambda each: (files.index(each.at.file), each.at.line, each.at.column))
    )
