"""The three outcomes, and a node's connections: the words of a status.

Apart from verdicts and observations because `lifecycle status` shows them, which loads no plan, no
manifest and no rule. Pure.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable
from typing import Annotated

import msgspec


class Outcome(enum.Enum):
    """The three outcomes; nothing unknown is silently OK."""

    OK = "ok"
    VIOLATED = "violated"
    UNVERIFIABLE = "unverifiable"

    @classmethod
    def worst(cls, found: Iterable[Outcome]) -> Outcome:
        """Return VIOLATED if any is; else UNVERIFIABLE if any is; else OK."""
        outcomes = set(found)
        return next((each for each in (cls.VIOLATED, cls.UNVERIFIABLE) if each in outcomes), cls.OK)


class ConnectionReport(msgspec.Struct, frozen=True, kw_only=True):
    """What a node reports of one of its connections.

    Attributes:
        name: as `connect_to` named it; empty for the node's own participant.
        urls: what it was given, as text; empty if the RMW chose.
        node_name: base name of the hidden node that carries it; empty for the node's own.
        prefix: GUID prefix of that node's participant, 24 hex digits; empty where it is not known.
        established: it exists and, where it has mappings, all of them have a matched peer.
        mappings: declared names of what is mapped onto it, `publishers/video`.
        error: why it could not be made; empty if it was.
    """

    name: str
    urls: tuple[str, ...] = ()
    node_name: str = ""
    prefix: Annotated[str, msgspec.Meta(pattern="^([0-9a-f]{24})?$")] = ""
    established: bool = False
    mappings: tuple[str, ...] = ()
    error: str = ""
