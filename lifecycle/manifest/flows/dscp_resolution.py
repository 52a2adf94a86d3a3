"""Which DSCP an endpoint's need comes to, and why.

Owns: the ways to a DSCP besides writing it: a TRANSPORT_PRIORITY through its mapping, a 5QI through
a mapping, and a value of one's own where the DSCP is the identifier. Pure.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

from lifecycle.manifest.model import EndpointKind, FlowNeed, Network
from lifecycle.network.dscp import ECN_MASK, MAX_DSCP, code_points, describe
from lifecycle.network.transport_priority import (
    MappedPriority,
    TransportPriorityMapping,
    map_priority,
)

DIRECT = TransportPriorityMapping(mask=0xFF)
"""Takes the priority as the TOS byte: Connext Micro's mapping "as-is"."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Marking:
    """A DSCP and where it comes from.

    Attributes:
        dscp: 0–63; None if nothing is marked.
        reason: one phrase for people; empty where the DSCP is written as such.
        problem: message and hint of why the need cannot be met; two empty texts if it can.
        notes: what a user should know, one sentence each, each starting with "cannot".
    """

    dscp: int | None = None
    reason: str = ""
    problem: tuple[str, str] = ("", "")
    notes: tuple[str, ...] = ()


def marking_of(need: FlowNeed, network: Network, five_qi: int | None) -> Marking:
    """Return the marking of one endpoint.

    The priority of a publisher is of its data, that of a subscription of its acknowledgements, and
    neither follows from the other (*RTI Connext Micro, Transport Priority*, "Configuring transport
    priority"). A 5QI is of data and marks publishers only.

    Args:
        need: what it asks for.
        network: the system's mappings.
        five_qi: its 5QI, `auto` resolved.
    """
    if need.transport_priority is not None and need.dscp is None:
        mapping = network.transport_priority_mapping or DIRECT
        return _mapped(map_priority(need.transport_priority, mapping))
    publishes = need.kind is EndpointKind.PUBLISHER
    if need.dscp is not None or not publishes or network.five_qi_dscp is None or five_qi is None:
        return Marking(dscp=need.dscp)
    name, dscp = network.five_qi_dscp.name, network.five_qi_dscp.dscp_for(five_qi)
    if dscp is None:
        return Marking(notes=(f"cannot mark 5QI {five_qi} with a DSCP: mapping {name!r} has none",))
    return Marking(dscp=dscp, reason=f"for 5QI {five_qi} by mapping {name!r}")


def _mapped(result: MappedPriority) -> Marking:
    mapping, number = result.mapping, result.priority
    priority = f"transport_priority {number} ({number:#x})"
    through = f"mask {mapping.mask:#x}, low {mapping.low:#x}, high {mapping.high:#x}"
    if result.tos is None:
        return Marking(notes=(f"cannot mark anything with {priority}: the mask is 0",))
    if result.sets_ecn:
        clear = result.tos & ~ECN_MASK
        message = (
            f"cannot use {priority}: with {through} it is TOS {result.tos} ({result.tos:#04x}), "
            f"whose two lowest bits are ECN and belong to the transport (RFC 3168)"
        )
        return Marking(problem=(message, f"without them it is {describe(clear >> 2)}"))
    note = (
        f"cannot map bits {result.ignored_bits:#x} of {priority}: they are outside mask "
        f"{mapping.mask:#x}; what is left is {describe(result.tos >> 2)}"
    )
    return Marking(
        dscp=result.tos >> 2,
        reason=f"{priority} with {through}",
        notes=(note,) if result.ignored_bits else (),
    )


def identifiers(taken: Iterable[int]) -> tuple[int, ...]:
    """Return the DSCP values that may become identifiers, those that mislead least first.

    First pool 2, `xxxx11`, which RFC 2474 leaves to experimental and local use, then values without
    a name, then named classes, and 0, which every unmarked packet carries, last.

    Args:
        taken: values that publishers have already.
    """
    named = {each.dscp for each in code_points()}
    used = set(taken)
    return tuple(
        sorted(
            (each for each in range(MAX_DSCP + 1) if each not in used),
            key=lambda each: (each == 0, each in named, each & 0b11 != 0b11, each),
        )
    )
