"""TRANSPORT_PRIORITY → TOS byte as RTI Connext Micro computes it, for systems that number so.

Owns: the mapping of *Connext Micro, Transport Priority*, "Using transport priority with UDP", and
what it silently loses. Pure.
"""

from __future__ import annotations

import dataclasses

from lifecycle.network.dscp import ECN_MASK, describe, dscp_of_tos

_BITS_32 = 0xFFFFFFFF


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class TransportPriorityMapping:
    """UDPInterfaceFactoryProperty's three transport priority fields.

    Attributes:
        mask: 0–0xFFFFFFFF, the bits of the priority that take part; 0 leaves the TOS byte alone.
        low: 0–255, the TOS byte of the lowest priority.
        high: 0–255, that of the highest; not below `low`.
    """

    mask: int
    low: int = 0
    high: int = 0xFF

    def __post_init__(self) -> None:
        if not 0 <= self.mask <= _BITS_32:
            raise ValueError(f"cannot use mask {self.mask:#x}; use 0 to {_BITS_32:#x}")
        if not 0 <= self.low <= self.high <= 0xFF:
            raise ValueError(
                f"cannot map to {self.low:#x} … {self.high:#x}; use 0 to 0xff, low <= high"
            )


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class MappedPriority:
    """What becomes of one TRANSPORT_PRIORITY value.

    Attributes:
        tos: 0–255; None if the mask is 0 and the TOS byte is not set.
        ignored_bits: bits of the priority that made no difference: outside the mask or shifted out.
    """

    priority: int
    mapping: TransportPriorityMapping
    tos: int | None
    ignored_bits: int

    @property
    def sets_ecn(self) -> bool:
        """Whether the result would write the two ECN bits, which belong to the transport."""
        return self.tos is not None and bool(self.tos & ECN_MASK)

    def dscp(self) -> int | None:
        """Return the DSCP, 0–63; None if the TOS byte is not set.

        Raises:
            ValueError: the result sets ECN bits.
        """
        return None if self.tos is None else dscp_of_tos(self.tos)

    def notes(self) -> tuple[str, ...]:
        """Return what a user should know of this result, one sentence each; often nothing."""
        found: list[str] = []
        if self.tos is None:
            found.append(f"transport priority {self.priority:#x} has no effect: the mask is 0")
        elif self.ignored_bits:
            found.append(
                f"bits {self.ignored_bits:#x} of transport priority {self.priority:#x} vanish: "
                f"mask {self.mapping.mask:#x} leaves TOS {self.tos:#04x}"
            )
        if self.tos is not None and self.sets_ecn:
            clear = self.tos & ~ECN_MASK
            found.append(
                f"TOS {self.tos:#04x} sets ECN bits {self.tos & ECN_MASK:#04b}, which belong to "
                f"the transport; without them it is {describe(clear >> 2)}"
            )
        return tuple(found)


def map_priority(priority: int, mapping: TransportPriorityMapping) -> MappedPriority:
    """Return the TOS byte for a TRANSPORT_PRIORITY value, in integer arithmetic.

    Let n be the number of 4-bit right shifts until `mask & 0xffff0000` is 0. Then
    `TOS = ((priority & mask) >> 4n) * (high - low) / (mask >> 4n) + low`.

    Args:
        priority: the QoS value, a signed 32-bit `long` in DDS; its bits count.
        mapping: the transport's three fields.

    Raises:
        ValueError: the priority does not fit 32 bits.
    """
    if not -(2**31) <= priority <= _BITS_32:
        raise ValueError(f"cannot use transport priority {priority}; it does not fit 32 bits")
    bits = priority & _BITS_32
    if mapping.mask == 0:
        return MappedPriority(priority=priority, mapping=mapping, tos=None, ignored_bits=bits)
    shift = 0
    while (mapping.mask >> shift) & 0xFFFF0000:
        shift += 4
    masked, mask = (bits & mapping.mask) >> shift, mapping.mask >> shift
    return MappedPriority(
        priority=priority,
        mapping=mapping,
        tos=masked * (mapping.high - mapping.low) // mask + mapping.low,
        ignored_bits=bits & ~(masked << shift),
    )
