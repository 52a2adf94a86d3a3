"""Node classes whose process says when it asks for sender sockets.

It also says when it makes a subscription to learn whether it has shared memory.
"""

from __future__ import annotations

import functools
import sys
from typing import Any

from hosted import Good, Plain, Theirs

from lifecycle.middleware.fastdds import nfe

__all__ = ["Good", "Plain", "Theirs"]


def _saying(what: str, function: Any) -> Any:
    @functools.wraps(function)
    def call(*arguments: Any) -> Any:
        if what != "asked" or "publisher" in arguments:
            print(what, file=sys.stderr, flush=True)
        return function(*arguments)

    return call


nfe._listens_on_shared_memory = _saying("probed", nfe._listens_on_shared_memory)
nfe.read_handle = _saying("asked", nfe.read_handle)
