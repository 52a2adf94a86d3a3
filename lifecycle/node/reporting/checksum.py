"""The checksum of a node configuration, by which a reader knows that it must read it again.

Owns: what counts for it. Pure.
"""

from __future__ import annotations

import dataclasses
import hashlib

from lifecycle import codec
from lifecycle.verify.observation import NodeConfiguration

_DIGITS = 16


def checksum(configuration: NodeConfiguration) -> str:
    """Return 16 hex digits that change exactly when a reader must read the document again.

    State, matches and what follows from them (whether a connection is established) change
    all the time and are told by events, so they do not count.
    """
    stable = dataclasses.replace(
        configuration,
        state="",
        connected=False,
        checksum="",
        endpoints=tuple(
            dataclasses.replace(each, matched=None, peers=None, server_matched=None)
            for each in configuration.endpoints
        ),
        connections=tuple(
            dataclasses.replace(each, established=False) for each in configuration.connections
        ),
    )
    return hashlib.sha256(codec.to_json(stable)).hexdigest()[:_DIGITS]
