"""A manifest file → a checked system.

Owns: the run of source → arguments → schema → build for a manifest and everything it includes,
then of the semantic checks, with every finding gathered on the way. Touches the file system; needs
no ROS.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from lifecycle.manifest import salvage
from lifecycle.manifest.builders.cursor import Cursor
from lifecycle.manifest.builders.system import Fragment, build_fragment
from lifecycle.manifest.checks import check, check_sound
from lifecycle.manifest.diagnostics import Diagnostic, ManifestError, Position, Severity
from lifecycle.manifest.model import Manifest
from lifecycle.manifest.schema.validation import validate
from lifecycle.manifest.yaml import include
from lifecycle.manifest.yaml.arguments import substitute
from lifecycle.manifest.yaml.document import Document, error, warning
from lifecycle.manifest.yaml.source import is_outside, read_document

SUFFIX = ".lifecycle.yaml"
"""What a manifest's name ends in; plain `.yaml` belongs to ROS launch files."""


def load_manifest(
    path: Path, arguments: Mapping[str, str], environment: Mapping[str, str]
) -> tuple[Manifest, tuple[Diagnostic, ...]]:
    """Read and check a manifest, with everything it includes.

    Args:
        path: the file.
        arguments: values by argument name.
        environment: what `$(env NAME)` sees.

    Returns:
        The manifest and its warnings.

    Raises:
        ManifestError: with every error and warning, sorted by position.
    """
    loading = _Loading(environment)
    origin = include.Origin.of(path)
    result = loading.read(origin, arguments, ())
    found = loading.found

    def every() -> tuple[Diagnostic, ...]:
        quoted = _without_outside_text(found, str(path), environment)
        return _sorted(quoted, loading.files)

    if result is None:
        raise ManifestError(every())
    fragment, values = result
    manifest = Manifest(
        path=origin.shown,
        system=fragment.system,
        description=fragment.description,
        arguments=values,
        machines=fragment.machines,
        discovery=fragment.discovery,
        network=fragment.network,
        data_layer=fragment.data_layer,
        policy=fragment.policy,
        nodes=fragment.nodes,
        links=fragment.links,
        positions=fragment.positions,
    )
    if wrong := [each for each in found if each.severity is Severity.ERROR]:
        part = salvage.partial(manifest, wrong, lost=fragment.lost, machines=loading.machines)
        found += check_sound(part, environment=environment)
        raise ManifestError(every())
    found += check(manifest, environment=environment)
    if any(each.severity is Severity.ERROR for each in found):
        raise ManifestError(every())
    return manifest, every()


class _Loading:
    """One run over a manifest and its includes."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        self.found: list[Diagnostic] = []
        self.files: list[str] = []
        self.machines: frozenset[str] | None = frozenset()
        self._environment = environment
        self._documents = 0
        self._outermost: Fragment | None = None

    def read(
        self,
        origin: include.Origin,
        given: Mapping[str, str],
        chain: tuple[include.Origin, ...],
        entry: Cursor | None = None,
    ) -> tuple[Fragment, tuple[tuple[str, str], ...]] | None:
        """Read one manifest and what it includes.

        Args:
            origin: the file.
            given: argument values.
            chain: the manifests that include it, outermost first.
            entry: the include that names it.

        Returns:
            What is declared, as far as it is sound, and argument values; None if the file cannot be
            read at all.
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
        root = Cursor.root(salvage.sound(document, unsound))
        fragment = dataclasses.replace(
            build_fragment(
                root,
                base=origin.path.parent,
                environment=self._environment,
                unsound=salvage.links(unsound),
            ),
            lost=salvage.lost(document, root.document),
        )
        names = salvage.entries(document, "machines")
        self.machines = None if names is None or self.machines is None else self.machines | names
        self.found += fragment.diagnostics
        self._check_outermost(root, fragment)
        for each in Cursor.root(document).items("include") if _is_list(document) else ():
            if not any(place[: len(each.place)] == each.place for place in unsound):
                fragment = self._include(fragment, each, (*chain, origin))
            else:
                fragment = self._unread(fragment)
        return fragment, substituted.arguments

    def _include(
        self, outer: Fragment, entry: Cursor, chain: tuple[include.Origin, ...]
    ) -> Fragment:
        origin = include.locate(entry, chain, self.found)
        if origin is None:
            return self._unread(outer)
        self._documents += 1
        if self._documents > include.MAX_DOCUMENTS:
            if self._documents == include.MAX_DOCUMENTS + 1:
                message = f"cannot include more than {include.MAX_DOCUMENTS} manifests"
                self.found.append(error("manifest.include", entry.at, message))
            return self._unread(outer)
        given = {name: each.value.text for name, each in entry.entries("arguments")}
        result = self.read(origin, given, chain, entry)
        if result is None:
            return self._unread(outer)
        inner = include.move(
            result[0], prefix=entry.text("prefix"), namespace=entry.text("namespace")
        )
        return include.join(outer, inner, entry.at, self.found)

    def _unread(self, outer: Fragment) -> Fragment:
        """Note that a manifest is missing which may declare whatever is looked for."""
        self.machines = None
        return dataclasses.replace(outer, lost=None)

    def _check_suffix(self, document: Document) -> None:
        if not document.file.endswith(SUFFIX):
            at = Position(file=document.file, line=1, column=1)
            name = Path(document.file).name
            message = f"cannot tell by its name {name!r} that this is a manifest"
            stem = name.removesuffix(".yaml").removesuffix(".yml")
            hint = f"rename it to {stem}{SUFFIX}"
            self.found.append(warning("manifest.suffix", at, message, hint))

    def _check_outermost(self, root: Cursor, fragment: Fragment) -> None:
        """Say so where a system-wide section of an included manifest does not come to hold."""
        if self._outermost is None:
            self._outermost = fragment
            return
        outer = self._outermost
        same = {
            "discovery": dataclasses.replace(fragment.discovery, at=None)
            == dataclasses.replace(outer.discovery, at=None),
            "network": dataclasses.replace(fragment.network, at=None)
            == dataclasses.replace(outer.network, at=None),
            "data_layer": dataclasses.replace(fragment.data_layer, at=None)
            == dataclasses.replace(outer.data_layer, at=None),
            "policy": fragment.policy == outer.policy,
        }
        for key, equal in same.items():
            if key in root and not equal:
                message = f"cannot use the {key} of an included manifest; the including one's holds"
                at = root.document.key_at((key,))
                self.found.append(warning("manifest.include-ignored", at, message))


def _is_list(document: Document) -> bool:
    section = document.find(("include",))
    return section is not None and isinstance(section.data, tuple)


def _mark(each: Diagnostic) -> tuple[str, int, int]:
    return each.at.file, each.at.line, each.at.column


_READING = ("yaml.", "manifest.", "nodl.", "check.parameter")
"""Rules whose messages quote what a file holds before anything says that it is one of ours."""


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

    Of a value that is refused as YAML nothing else is said: `.nan` is no number, that is all.
    """
    refused = {_mark(each) for each in found if each.rule.startswith("yaml.")}
    unique = [
        each
        for each in dict.fromkeys(found)
        # What is said of a whole document stands where its first key does.
        if each.rule.startswith("yaml.") or not each.at.path or _mark(each) not in refused
    ]
    files = list(dict.fromkeys([*read, *(each.at.file for each in unique)]))
    return tuple(
        sorted(unique, key=lambda each: (files.index(each.at.file), each.at.line, each.at.column))
    )
