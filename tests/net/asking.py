"""Asks one thing of a running system from outside, as a process on one of its hosts.

`python -m tests.net.asking DOMAIN URL WORDS…`: URL says how it takes part itself, `shm://`; the
words are `disconnect NODE CONNECTION`, over the remote node interface, or `publishers TOPIC`, which
prints one node a line.
"""

from __future__ import annotations

import asyncio
import sys

from lifecycle.graph.loop import set_within
from lifecycle.middleware.rcl.graph import GraphObserver
from lifecycle.middleware.services.clients import NodeClients
from lifecycle.plan.model import ParticipantConnections

_LIMIT_S = 15.0


async def _settled(observer: GraphObserver) -> None:
    """Wait until everybody who was there before us is seen."""
    changed = asyncio.Event()
    loop = asyncio.get_running_loop()
    remove = observer.on_change(lambda: loop.call_soon_threadsafe(changed.set))
    try:
        while True:
            changed.clear()
            observer.snapshot()
            left_s = observer.settling.left_s()
            if left_s <= 0:
                return
            await set_within(changed, left_s)
    finally:
        remove()


async def _main(domain: int, url: str, verb: str, *words: str) -> None:
    observer = GraphObserver(domain, ParticipantConnections(urls=(url,)))
    clients = NodeClients(observer)
    try:
        await _settled(observer)
        if verb == "disconnect":
            await clients.wire(words[0], "disconnect", *words[1:], timeout_s=_LIMIT_S)
        elif verb == "publishers":
            for each in observer.node.get_publishers_info_by_topic(*words):
                print(f"{each.node_namespace.rstrip('/')}/{each.node_name}")
        else:
            sys.exit(f"cannot {verb!r}")
    finally:
        clients.destroy()
        observer.destroy()


if __name__ == "__main__":
    asyncio.run(_main(int(sys.argv[1]), *sys.argv[2:]))
