"""A participant that makes publishers, publishes names anew and counts publishers, as it is told.

Run with the domain and the connection URLs, as `tests.net.test_discovery_server` does. A line of
standard input is an order, and a line of standard output its answer: `make TOPIC`, `names`, and
`count TOPIC`.
"""

from __future__ import annotations

import sys

from std_msgs.msg import String

from lifecycle.manifest.model import EndpointKind
from lifecycle.middleware.fastdds.participant import republish_names
from lifecycle.middleware.rcl.graph import GraphObserver
from lifecycle.middleware.rcl.graph_queries import endpoints_of
from lifecycle.plan.model import ParticipantConnections


def main() -> None:
    domain_id, *urls = sys.argv[1:]
    with GraphObserver(int(domain_id), ParticipantConnections(urls=tuple(urls))) as observer:
        node = observer.node
        print(flush=True)  # it is made
        for line in sys.stdin:
            order, _, topic = line.strip().partition(" ")
            if order == "make":
                node.create_publisher(String, topic, 1)
            elif order == "names":
                republish_names([node])
            print(
                len(endpoints_of(node, EndpointKind.PUBLISHER, topic)) if topic else 0, flush=True
            )


if __name__ == "__main__":
    main()
