"""Validated `discovery:`, `data_layer:` and `connections:` sections → frozen types.

Owns: reading connection URLs out of a document, and the findings about them that a schema cannot
detect. Pure.
"""

from __future__ import annotations

import ipaddress

from lifecycle.manifest.builders.cursor import Cursor
from lifecycle.manifest.diagnostics import Diagnostic, Position
from lifecycle.manifest.model import (
    ConnectionDeclaration,
    DataLayer,
    Discovery,
    EndpointKind,
    Interface,
)
from lifecycle.manifest.yaml.document import error
from lifecycle.manifest.yaml.yaml_parser import quote
from lifecycle.network import ConnectionUrl, ConnectionUrlError, parse

_KINDS = {kind.value: kind for kind in EndpointKind}


def build_discovery(root: Cursor) -> Discovery:
    """Build the discovery of a document; the defaults where it declares nothing."""
    cursor = root.get("discovery")
    return Discovery() if cursor is None else cursor.build(Discovery, at=cursor.key_at)


def build_data_layer(root: Cursor, found: list[Diagnostic]) -> DataLayer:
    """Build the data layer of a document; the defaults where it declares nothing."""
    cursor = root.get("data_layer")
    if cursor is None:
        return DataLayer()
    default = DataLayer()
    group = cursor.text("multicast_group", default.multicast_group)
    if not _is_ipv4_group(group):
        at = root.document.at((*cursor.place, "multicast_group"))
        message = f"cannot use {quote(group)} as a multicast group; it must be IPv4"
        hint = "239.255.0.0 to 239.255.255.255 stay within an organisation (RFC 2365)"
        found.append(error("manifest.multicast-group", at, message, hint))
        group = default.multicast_group
    return cursor.build(DataLayer, multicast_group=group, at=cursor.key_at)


def section_positions(root: Cursor) -> tuple[tuple[str, Position], ...]:
    """Return positions of values of `discovery:` and `data_layer:`, by path, `discovery.mode`."""
    return tuple(
        (f"{section}.{key}", value.at)
        for section in ("discovery", "data_layer")
        for key, value in root.entries(section)
    )


def _is_ipv4_group(text: str) -> bool:
    try:
        return ipaddress.IPv4Address(text).is_multicast
    except ValueError:
        return False


def build_connections(
    node: Cursor, interface: Interface, found: list[Diagnostic]
) -> tuple[ConnectionDeclaration, ...]:
    """Build the connections that a node's section spells out.

    Args:
        node: the node.
        interface: of that node; what `map: all` expands to.
        found: findings are appended here.
    """
    return tuple(
        ConnectionDeclaration(
            name=name,
            urls=_urls(cursor, found),
            map=_map(cursor, interface),
            at=cursor.key_at,
        )
        for name, cursor in node.entries("connections")
    )


def _urls(connection: Cursor, found: list[Diagnostic]) -> tuple[ConnectionUrl, ...]:
    urls = []
    for cursor in connection.items("urls"):
        url = _url(cursor, found)
        if url is not None:
            urls.append(url)
    return tuple(urls)


def _url(cursor: Cursor, found: list[Diagnostic]) -> ConnectionUrl | None:
    try:
        return parse(cursor.value.text)
    except ConnectionUrlError as problem:
        found.append(error("manifest.connection-url", cursor.at, problem.message, problem.hint))
        return None


def _map(connection: Cursor, interface: Interface) -> tuple[tuple[EndpointKind, str], ...]:
    if connection.text("map") == "all":
        return tuple((each.kind, each.name) for each in interface.endpoints)
    return tuple(
        (_KINDS[kind], each.value.text)
        for kind, names in connection.entries("map")
        for each in names.items()
    )


def connection_positions(node: Cursor) -> list[tuple[str, Position]]:
    """Return where the parts of a node's connections are, by path below the node.

    `connections.net`, `connections.net.urls.0`, `connections.net.map.publishers.0`, and
    `connections.net.map` where it is a single string.
    """
    positions = []
    for name, connection in node.entries("connections"):
        place = f"connections.{name}"
        positions.append((place, connection.key_at))
        for index, url in enumerate(connection.items("urls")):
            positions.append((f"{place}.urls.{index}", url.at))
        mapped = connection.get("map")
        if mapped is None:
            continue
        if connection.text("map") == "all":
            positions.append((f"{place}.map", mapped.at))
            continue
        for kind, names in mapped.entries():
            for index, each in enumerate(names.items()):
                positions.append((f"{place}.map.{kind}.{index}", each.at))
    return positions
