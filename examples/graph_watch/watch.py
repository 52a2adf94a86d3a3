"""Say who publishes a topic, as soon as somebody does.

    python -m examples.graph_watch.watch /chatter

It has no node of its own and sleeps in between: the graph calls back. Ctrl-C ends it.
"""

from __future__ import annotations

import signal
import sys

from lifecycle.graph.graph import Graph
from lifecycle.graph.state import GraphEvent


def appeared(event: GraphEvent) -> None:
    """Greet a new publisher."""
    assert event.endpoint is not None
    print(f"{event.node} publishes {event.endpoint.resolved} ({event.endpoint.type})", flush=True)


def vanished(event: GraphEvent) -> None:
    """Note that a publisher is gone."""
    assert event.endpoint is not None
    print(f"{event.node} no longer publishes {event.endpoint.resolved}", flush=True)


def main() -> int:
    """Watch until SIGINT or SIGTERM."""
    topic = sys.argv[1] if len(sys.argv) > 1 else "/chatter"
    stop = {signal.SIGINT, signal.SIGTERM}
    signal.pthread_sigmask(signal.SIG_BLOCK, stop)  # before any thread is made, which inherits it
    with Graph.open() as graph:
        graph.events.on_publisher(topic, appeared, vanished)
        print(f"watching {topic}", flush=True)
        signal.sigwait(stop)
    return 0


if __name__ == "__main__":
    sys.exit(main())
