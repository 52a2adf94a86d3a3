"""The right to send one node its activate request, asked for where the bytes leave."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from lifecycle.graph.loop import set_within
from lifecycle.supervisor.nodes.driver import ChangedError

if TYPE_CHECKING:
    from lifecycle.supervisor.shell.supervisor import Supervisor

_REOPENS_S = 1.0
"""What changes as others are activated is judged within milliseconds, on a loaded machine later."""


class Permit:
    """Lets one request leave while the gate is open on a verdict of this very moment.

    Args:
        shell: whose gate it is.
        key: of the node.
    """

    def __init__(self, shell: Supervisor, key: str) -> None:
        self._shell = shell
        self._key = key

    async def use(self) -> None:
        """Return once the request may leave now; nothing may be awaited after it.

        Raises:
            ChangedError: what changed keeps the gate closed; the node is to be asked again later.
        """
        loop = asyncio.get_running_loop()
        until_s = loop.time() + _REOPENS_S
        while not self._shell.may_activate(self._key):
            left_s = until_s - loop.time()
            if left_s <= 0 or not await set_within(self._shell.moved, left_s):
                raise ChangedError(f"cannot activate {self._key!r}: the gate closed again")
