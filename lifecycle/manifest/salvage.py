"""What of a document, and of a manifest, is left without what is wrong in it.

Owns: how much of a manifest a finding takes with it. A part that something is wrong in is left out,
and the rest is checked in the same run. Pure.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Mapping, Sequence

from lifecycle.manifest.checks import Partial
from lifecycle.manifest.checks.partial import SEPARABLE
from lifecycle.manifest.diagnostics import Diagnostic
from lifecycle.manifest.model import Manifest, Node
from lifecycle.manifest.schema.message_text import nearest
from lifecycle.manifest.schema.validation import MANIFEST, read_schema
from lifecycle.manifest.yaml.document import Document, Place, Value

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
