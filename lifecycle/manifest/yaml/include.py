"""`include:` of manifests: find included files, prefix and namespace them, join the results.

Owns: finding included files, refusing cycles, moving a manifest under a key prefix and a namespace,
and joining it with the one that includes it. `load` reads them. Looks at the file system for
existence only.
"""

from __future__ import annotations

import os
from pathlib import Path

import msgspec
from msgspec.structs import replace

from lifecycle.errors import did_you_mean
from lifecycle.manifest.diagnostics import Position
from lifecycle.manifest.interface import Findings
from lifecycle.manifest.model import EndpointKind, Link, Machine, Manifest, Node, Run
from lifecycle.manifest.names import topic_of
from lifecycle.manifest.yaml.document import Document, error
from lifecycle.manifest.yaml.yaml_parser import quote

MAX_DEPTH = 16
"""Manifests that include each other in a row."""

MAX_DOCUMENTS = 256
"""Manifests of one system; included twice counts twice."""


class Origin(msgspec.Struct, frozen=True, kw_only=True):
    """A manifest file in the chain of includes.

    Attributes:
        path: the file.
        identity: its path without links, to recognise it again.
    """

    path: Path
    identity: str

    @property
    def shown(self) -> str:
        """How messages name the file: bytes that are no UTF-8 could be neither shown nor sent."""
        return os.fsencode(self.path).decode("utf-8", errors="replace")

    @classmethod
    def of(cls, path: Path) -> Origin:
        """Return the origin of a path as the user wrote it."""
        try:
            identity = os.path.realpath(path)
        except (OSError, ValueError):  # a name that no file can have; opening it reports that
            identity = str(path)
        return cls(path=path, identity=identity)


def locate(entry: Document, chain: tuple[Origin, ...], found: Findings) -> Origin | None:
    """Return the file that an entry of `include:` names; None after reporting why there is none.

    Args:
        entry: the entry.
        chain: the including manifests, outermost first.
        found: findings are appended here.
    """
    name = entry.text("manifest")
    at = entry.at(("manifest",))
    path = Path(os.path.normpath(chain[-1].path.parent / name))
    origin = Origin.of(path)
    identities = [each.identity for each in chain]
    message, hint = "", ""
    if origin.identity in identities:
        round_trip = [*chain[identities.index(origin.identity) :], origin]
        names = " → ".join(each.path.name for each in round_trip)
        message = f"cannot include {quote(name)}: it would include itself, {names}"
    elif len(chain) == MAX_DEPTH:
        message = f"cannot include {quote(name)}: at most {MAX_DEPTH} manifests in a row"
    elif not os.path.exists(path):
        message = f"cannot include {quote(name)}: there is no file {quote(str(path), limit=200)}"
        hint = did_you_mean(path.name, _siblings(path))
    elif path.is_dir():
        message = f"cannot include {quote(name)}: it is a directory"
    if not message:
        return origin
    found.append(error("manifest.include", at, message, hint))
    return None


def _siblings(path: Path) -> list[str]:
    try:
        return sorted(os.listdir(path.parent))  # noqa: PTH208 - names, not paths
    except (OSError, ValueError):  # no such folder, or not ours to read: there is no suggestion
        return []


def move(manifest: Manifest, *, prefix: str, namespace: str) -> Manifest:
    """Put a manifest under a key prefix and a namespace.

    Names of nodes move with their namespace, and so do relative topic names; an absolute topic
    name stays where it is. A link's topic moves with its publisher.
    """
    old = {node.key: node for node in manifest.nodes}
    new = {node.key: _move_node(node, prefix, namespace) for node in manifest.nodes}
    links = tuple(
        replace(
            link,
            topic=_moved_topic(link, old, new),
            from_node=join_key(prefix, link.from_node),
            to_node=join_key(prefix, link.to_node),
        )
        for link in manifest.links
    )
    return replace(
        manifest,
        nodes=tuple(new.values()),
        links=links,
        left_out=tuple(join_key(prefix, each) for each in manifest.left_out),
    )


def _move_node(node: Node, prefix: str, namespace: str) -> Node:
    outer, inner = namespace.strip("/"), node.namespace.strip("/")
    return replace(
        node,
        key=join_key(prefix, node.key),
        namespace="/" + "/".join(part for part in (outer, inner) if part),
        process=join_key(prefix, node.process) if node.process else "",
        run=_moved_run(node.run, prefix),
        after=tuple(replace(each, node=join_key(prefix, each.node)) for each in node.after),
    )


def _moved_run(run: Run, prefix: str) -> Run:
    """Return how a node comes to run; a container that the manifest itself has moves with it."""
    if not run.container or run.container.startswith("/"):
        return run
    return replace(run, container=join_key(prefix, run.container))


def join_key(prefix: str, key: str) -> str:
    """Return what a key of an included manifest is called in the one that includes it."""
    return f"{prefix}/{key}" if prefix else key


def _moved_topic(link: Link, old: dict[str, Node], new: dict[str, Node]) -> str:
    """Return where the endpoint has gone that a link names; the topic as it is if there is none."""
    ends = ((link.from_node, EndpointKind.PUBLISHER), (link.to_node, EndpointKind.SUBSCRIPTION))
    for key, kind in ends:
        if key not in old:
            continue
        for endpoint in old[key].interface.endpoints:
            if endpoint.kind is kind and topic_of(old[key], endpoint.name, kind) == link.topic:
                return topic_of(new[key], endpoint.name, kind) or link.topic
    return link.topic


def join(outer: Manifest, inner: Manifest, at: Position, found: Findings, *, what: str) -> Manifest:
    """Add an included manifest to the one that includes it.

    The discovery, network, data layer and policy of the including one hold.

    Args:
        outer: the including manifest.
        inner: the included one, moved to its place.
        at: the include.
        found: findings are appended here.
        what: what it came by, an include or a group.
    """
    nodes = {node.key: node for node in outer.nodes}
    for node in inner.nodes:
        first = nodes.setdefault(node.key, node)
        if first is not node:
            message = (
                f"cannot include the node {quote(node.key)}: {first.at.spelled} declares it too"
            )
            hint = f"give the {what} a prefix"
            found.append(error("manifest.duplicate-node", at, message, hint))
    machines = {machine.name: machine for machine in outer.machines}
    for machine in inner.machines:
        _join_machine(machines.setdefault(machine.name, machine), machine, found)
    return replace(
        outer,
        nodes=tuple(nodes.values()),
        machines=tuple(machines.values()),
        links=(*outer.links, *inner.links),
        left_out=(*outer.left_out, *inner.left_out),
    )


def _join_machine(first: Machine, machine: Machine, found: Findings) -> None:
    if first.address != machine.address:
        message = (
            f"cannot give machine {quote(machine.name)} the address {quote(machine.address)}: "
            f"it has {quote(first.address)} at {first.at.spelled}"
        )
        found.append(error("manifest.machine", machine.at, message, "rename one of the two"))
