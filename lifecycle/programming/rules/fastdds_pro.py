"""Flow rules as Fast DDS Pro priority mappings, an XML profile of its transports.

Owns: the `<udp_priority_mappings>` of one profile file. Pure.

Fast DDS Pro maps a DataWriter's TRANSPORT_PRIORITY to a source port and a DSCP, so that writers of
one participant differ: what the open edition needs a participant of its own for. The mapping's key
is the priority; here its lowest byte is the TOS byte, as Connext takes it, and the rest counts.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from xml.sax.saxutils import quoteattr

from lifecycle import dataclasses
from lifecycle.network import InternetProtocol, TransportProtocol, describe, tos
from lifecycle.programming.rules.rules import FlowRule, LeftOut, named

_KINDS = {InternetProtocol.IPV4: "UDPv4", InternetProtocol.IPV6: "UDPv6"}


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PriorityMapping:
    """One `<priority>`.

    Attributes:
        value: the TRANSPORT_PRIORITY that selects it, an int32, unique in a transport.
        dscp: 0–63.
        source_port: 1–65535.
        interface: name or address that it sends from; empty for any.
    """

    value: int
    dscp: int
    source_port: int
    interface: str
    flows: tuple[str, ...]

    def xml(self) -> str:
        """Return the element."""
        interface = f" interface={quoteattr(self.interface)}" if self.interface else ""
        return (
            f'<priority value="{self.value}" dscp="{self.dscp}" '
            f'source_port="{self.source_port}"{interface}/>'
        )


def render_fastdds_pro(
    rules: Iterable[FlowRule], *, system: str, left_out: Sequence[LeftOut] = ()
) -> str:
    """Return an XML profile with the priority mappings of every UDP flow that has a DSCP.

    Args:
        rules: of verified flows.
        system: names the transports.
        left_out: flows without a rule, named in comments.
    """
    every = tuple(rules)
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        *(_comment(each) for each in _heads(every, left_out)),
        '<dds xmlns="http://www.eprosima.com">',
        "  <profiles>",
        "    <transport_descriptors>",
    ]
    for family, kind in _KINDS.items():
        mappings = tuple(_mappings(each for each in every if each.internet_protocol is family))
        if not mappings:
            continue
        lines += [
            "      <transport_descriptor>",
            f"        <transport_id>{system}_{kind.lower()}</transport_id>",
            f"        <type>{kind}</type>",
            "        <udp_priority_mappings>",
        ]
        for each in mappings:
            lines += [
                f"          {_comment(f'{flow}: {describe(each.dscp)}')}" for flow in each.flows
            ]
            lines.append(f"          {each.xml()}")
        lines += ["        </udp_priority_mappings>", "      </transport_descriptor>"]
    lines += ["    </transport_descriptors>", "  </profiles>", "</dds>"]
    return "\n".join(lines) + "\n"


def _heads(rules: Sequence[FlowRule], left_out: Sequence[LeftOut]) -> Iterator[str]:
    yield (
        "for Fast DDS Pro only; give each DataWriter the transport_priority of its mapping's value"
    )
    for each in left_out:
        yield f"left out: {each}"
    for rule in rules:
        if rule.transport_protocol is not TransportProtocol.UDP:
            yield f"left out: {named(rule)}: it is {rule.transport_protocol.value}, not udp"
        elif rule.dscp is None:
            yield f"left out: {named(rule)}: it has no DSCP"


def _mappings(rules: Iterable[FlowRule]) -> Iterator[PriorityMapping]:
    """One mapping per DSCP, port and interface, each with a priority of its own."""
    flows: dict[tuple[int, int, str], list[str]] = {}
    for rule in rules:
        if rule.transport_protocol is TransportProtocol.UDP and rule.dscp is not None:
            key = (rule.dscp, rule.source_port, rule.source_address)
            flows.setdefault(key, []).append(named(rule))
    taken: set[int] = set()
    for (dscp, port, address), names in flows.items():
        # The lowest byte stays the TOS byte, however often a DSCP occurs.
        # 0 is the priority of everything that asks for none, so nothing is mapped to it.
        value = tos(dscp) or 0x100
        while value in taken:
            value += 0x100
        taken.add(value)
        yield PriorityMapping(
            value=value,
            dscp=dscp,
            source_port=port,
            interface=address,
            flows=tuple(dict.fromkeys(names)),
        )


def _comment(text: str) -> str:
    """An XML comment; two hyphens would end it early."""
    return f"<!-- {text.replace('--', '- -')} -->"
