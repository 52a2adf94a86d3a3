"""Who has which endpoint: an index by node and by topic, and what a new configuration changes.

Owns: the endpoints of all nodes of one graph. A change costs work in proportion to its node's
endpoints, a query in proportion to its answer, neither to the system. Pure; not thread-safe.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

from lifecycle.manifest.model import EndpointKind
from lifecycle.verify.observation import EndpointReport


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class EndpointChange:
    """What is different about one node's endpoints; the new report for those that changed."""

    added: tuple[EndpointReport, ...] = ()
    removed: tuple[EndpointReport, ...] = ()
    changed: tuple[EndpointReport, ...] = ()

    def __bool__(self) -> bool:
        """Whether anything is different."""
        return bool(self.added or self.removed or self.changed)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Owned:
    """An endpoint and the node (fully qualified) that has it."""

    node: str
    endpoint: EndpointReport


_Key = tuple[EndpointKind, str, str, str, int]
"""Kind, resolved name, type, declared name; a number tells equal ones of one node apart."""


class EndpointIndex:
    """The endpoints of all nodes."""

    def __init__(self) -> None:
        self._by_node: dict[str, dict[_Key, EndpointReport]] = {}
        self._by_name: dict[tuple[EndpointKind, str], dict[tuple[str, _Key], Owned]] = {}

    def update(self, node: str, endpoints: Iterable[EndpointReport]) -> EndpointChange:
        """Set the endpoints of `node` and return what is different from before."""
        new: dict[_Key, EndpointReport] = {}
        for endpoint in endpoints:
            key = (endpoint.kind, endpoint.resolved, endpoint.type, endpoint.name, 0)
            while key in new:
                key = (*key[:4], key[4] + 1)
            new[key] = endpoint
        old = self._by_node.get(node, {})
        removed = {key: each for key, each in old.items() if key not in new}
        added = {key: each for key, each in new.items() if key not in old}
        changed = {key: each for key, each in new.items() if key in old and old[key] != each}
        for key in (*removed, *changed):
            self._drop(node, key, old[key])
        for key, endpoint in (*added.items(), *changed.items()):
            self._put(node, key, endpoint)
        if new:
            self._by_node[node] = new
        else:
            self._by_node.pop(node, None)
        return EndpointChange(
            added=tuple(added.values()),
            removed=tuple(removed.values()),
            changed=tuple(changed.values()),
        )

    def named(self, kind: EndpointKind, name: str) -> tuple[Owned, ...]:
        """Return the endpoints of a kind that have this resolved name, or have it as an alias."""
        return tuple(self._by_name.get((kind, name), {}).values())

    def names(self, kind: EndpointKind) -> tuple[str, ...]:
        """Return every name that an endpoint of this kind has."""
        return tuple(name for each, name in self._by_name if each is kind)

    def _put(self, node: str, key: _Key, endpoint: EndpointReport) -> None:
        owned = Owned(node=node, endpoint=endpoint)
        for name in names_of(endpoint):
            self._by_name.setdefault((endpoint.kind, name), {})[node, key] = owned

    def _drop(self, node: str, key: _Key, endpoint: EndpointReport) -> None:
        for name in names_of(endpoint):
            place = (endpoint.kind, name)
            self._by_name[place].pop((node, key), None)
            if not self._by_name[place]:
                del self._by_name[place]


def names_of(endpoint: EndpointReport) -> tuple[str, ...]:
    """Return the fully qualified names by which an endpoint can be reached, without doubles."""
    return tuple(dict.fromkeys((endpoint.resolved, *endpoint.aliases)))
