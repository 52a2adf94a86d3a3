"""Node names in the ROS graph without the stale ones that rmw_dds_common keeps.

Owns: `StaleNodeFilter`. rmw_dds_common learns node names from one topic and which participants left
from discovery, in two threads: the last message of a leaving participant may be read after it was
removed, and then its names stay for good. A gate would take a restarted node for two.
"""

from __future__ import annotations

import typing
from collections import Counter
from collections.abc import Iterable, Mapping

from rclpy.node import Node

from lifecycle.manifest.model import EndpointKind
from lifecycle.middleware.discovery.prefixes import PROCESS_DIGITS
from lifecycle.middleware.rcl.graph_queries import endpoints_of, endpoints_of_node, node_names

_NODES_TOPIC = "ros_discovery_info"
"""Every participant of rmw_fastrtps writes it, and no other; a plain DDS name."""

_EACH_NODE_TOPIC = "/parameter_events"
"""rclcpp and rclpy give every node one publisher of it."""

_PREFIX_DIGITS = 24

Homes = Mapping[str, Counter[str]]
"""By full name of a node: the prefixes of the participants it is on, and how often it is there."""


@typing.final
class StaleNodeFilter:
    """Counts the nodes that `node` sees; remembers where they were, so keep it.

    From any thread, one call at a time.

    Attributes:
        ghosts: full names that stale nodes had, too, when they were last counted: what rcl says of
            such a name may be of a stale one.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._homes: dict[str, frozenset[str]] = {}
        self._dead: frozenset[str] = frozenset()
        self.ghosts: frozenset[str] = frozenset()

    def ignore(self, process: str) -> None:
        """Count no participants of a process that has ended, for as long as discovery shows them.

        Args:
            process: the first 16 hex digits of their GUIDs; Fast DDS never gives them again.
        """
        self._dead |= {process}

    def was_on(self, names: Iterable[str], prefixes: frozenset[str]) -> None:
        """Take note of the participants that nodes were on, which may have been seen too briefly.

        Args:
            names: fully qualified.
            prefixes: of GUIDs, 24 hex digits each.
        """
        for name in names:
            self._homes[name] = self._homes.get(name, frozenset()) | prefixes

    def ignores(self, gid: str) -> bool:
        """Whether an endpoint or participant is one of a dead process.

        Args:
            gid: in hex, or its first 24 digits.
        """
        return gid[:PROCESS_DIGITS] in self._dead

    def count(self) -> Counter[str]:
        """Return by full name how many nodes there are; a name that is not known yet included."""
        every = shown = Counter(node_names(self._node))
        homes = self.homes()
        if dead := self.shown() - self.participants() if self._dead else frozenset():
            shown = without_dead(shown, homes, self._homes, dead)
        if any(
            count > homes.get(name, Counter()).total() and self._homes.get(name)
            for name, count in shown.items()
        ):
            known = self._known(shown, homes)
            shown = without_ghosts(shown, homes, self._homes, self.participants(), known)
        for name, where in homes.items():
            self._homes[name] = self._homes.get(name, frozenset()) | where.keys()
        self.ghosts = frozenset(name for name, count in shown.items() if count < every[name])
        return shown

    def homes(self) -> dict[str, Counter[str]]:
        """Return by full name the prefixes of the participants that nodes are on now."""
        homes: dict[str, Counter[str]] = {}
        for each in endpoints_of(self._node, EndpointKind.PUBLISHER, _EACH_NODE_TOPIC):
            if not self.ignores(each.gid):
                homes.setdefault(each.node, Counter())[each.gid[:_PREFIX_DIGITS]] += 1
        return homes

    def _known(self, shown: Iterable[str], homes: Homes) -> frozenset[str]:
        """Return the prefixes of the participants of which some node is known.

        The participants of a node's connections have a node without parameters, which is known by
        any other of its endpoints.
        """
        known = {prefix for where in homes.values() for prefix in where}
        for name in shown:
            if name in homes:
                continue
            for kind in (EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION):
                for topic in {
                    topic for topic, _ in endpoints_of_node(self._node, kind, name) or ()
                }:
                    known |= {
                        each.gid[:_PREFIX_DIGITS]
                        for each in endpoints_of(self._node, kind, topic)
                        if each.node == name
                    }
        return frozenset(known)

    def participants(self) -> frozenset[str]:
        """Return the prefixes of every participant of rmw_fastrtps that is not ignored."""
        return frozenset(each for each in self.shown() if not self.ignores(each))

    def shown(self) -> frozenset[str]:
        """Return the prefixes of every participant of rmw_fastrtps that discovery has."""
        return frozenset(
            each.gid[:_PREFIX_DIGITS]
            for each in endpoints_of(
                self._node, EndpointKind.PUBLISHER, _NODES_TOPIC, no_mangle=True
            )
        )


def without_dead(
    shown: Mapping[str, int],
    homes: Homes,
    before: Mapping[str, frozenset[str]],
    dead: frozenset[str],
) -> Counter[str]:
    """Return `shown` without the nodes of participants whose process is dead.

    Args:
        shown: how many nodes of each name rmw_dds_common has.
        homes: where the living ones are now, as far as that can be seen.
        before: the prefixes of every participant that a node of this name was ever seen on.
        dead: the prefixes of the participants of dead processes that discovery still has.
    """
    return +Counter(
        {
            name: max(
                homes.get(name, Counter()).total(),
                count - len(before.get(name, frozenset()) & dead),
            )
            for name, count in shown.items()
        }
    )


def without_ghosts(
    shown: Mapping[str, int],
    homes: Homes,
    before: Mapping[str, frozenset[str]],
    alive: frozenset[str],
    known: frozenset[str],
) -> Counter[str]:
    """Return `shown` without the nodes of participants that have left.

    Args:
        shown: how many nodes of each name rmw_dds_common has.
        homes: where they are now, as far as that can be seen.
        before: the prefixes of every participant that a node of this name was ever seen on.
        alive: the prefixes of every participant that discovery has.
        known: the prefixes of those of which some node is known. While one that is alive is not
            among them it may be the home of each, and nothing is taken for a ghost.
    """
    if not alive <= known:
        return Counter(shown)
    counts: Counter[str] = Counter()
    for name, count in shown.items():
        gone = before.get(name, frozenset()) - alive
        counts[name] = min(count, max(homes.get(name, Counter()).total(), count - len(gone)))
    return +counts
