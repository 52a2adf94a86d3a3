"""Leaving the graph as a whole before its parts are taken down.

Owns: `say_goodbye`, the same message that is sent in the place of a killed process, by a process
that is about to destroy its participants.

rmw_fastrtps takes a participant down endpoint by endpoint, and tells of each. In a peer, each
writer that goes so, just when its last message is answered, is an occasion for the deadlock of Fast
DDS 2.14 (its issue 6502, see docs/liveliness.md): it unmatches a writer with the lock of discovery
held, and not so a whole participant (PDP::removeWriterProxyData, PDP::remove_remote_participant).
"""

from __future__ import annotations

import os
from collections.abc import Iterable

from rclpy.node import Node

from lifecycle.middleware.discovery.dead_peers import remove_participants
from lifecycle.middleware.fastdds.settings import prefix_of


def say_goodbye(nodes: Iterable[Node]) -> None:
    """Have all others forget the participants of nodes that are about to be destroyed.

    By UDP, to whom the RMW's own discovery reaches; participants that settings of the user's or of
    a plan give other peers leave as they always do.
    """
    by_domain: dict[int, set[str]] = {}
    for node in nodes:
        if prefix := prefix_of(node):
            by_domain.setdefault(node.context.get_domain_id(), set()).add(prefix)
    for domain_id, prefixes in by_domain.items():
        remove_participants(prefixes, domain_id, (), os.environ)
