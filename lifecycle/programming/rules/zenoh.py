"""Flow rules as Zenoh endpoint settings, which mark the packets of one link.

Owns: the `#dscp=` of endpoints (Zenoh 1.4 and later) in a JSON5 configuration. Pure.

What Zenoh calls dscp is the raw TOS byte: EF is 0xb8 there, and 0x2e would be DSCP 11 with ECN
bits. So each line says both.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from lifecycle.codec import to_json
from lifecycle.network import InternetProtocol, describe, tos
from lifecycle.programming.rules.rules import FlowRule, LeftOut, named


def zenoh_endpoint(rule: FlowRule) -> str:
    """Return the endpoint to connect to, `udp/10.77.0.2:17910#dscp=0xb8`.

    Raises:
        ValueError: the rule has no DSCP.
    """
    if rule.dscp is None:
        raise ValueError(f"cannot make a Zenoh endpoint for {named(rule)}: it has no DSCP")
    ipv6 = rule.internet_protocol is InternetProtocol.IPV6
    address = f"[{rule.destination_address}]" if ipv6 else rule.destination_address
    where = f"{rule.transport_protocol.value}/{address}:{rule.destination_port}"
    return f"{where}#dscp={tos(rule.dscp):#04x}"


def render_zenoh(rules: Iterable[FlowRule], *, left_out: Sequence[LeftOut] = ()) -> str:
    """Return a JSON5 configuration whose endpoints mark what is sent to each destination.

    One link carries all topics to its destination, so one address and port has one DSCP: where
    rules disagree, the endpoints are side by side and the comments say so.
    """
    every = tuple(rules)
    marked: dict[str, list[FlowRule]] = {}
    for rule in every:
        if rule.dscp is not None:
            marked.setdefault(zenoh_endpoint(rule), []).append(rule)
    places = [endpoint.partition("#")[0] for endpoint in marked]
    lines = [
        "// Zenoh 1.4 or later; its dscp is the whole TOS byte.",
        "// Addresses and ports are those of the verified flows: put a router's in their place.",
        *(f"// left out: {each}" for each in left_out),
        *(f"// left out: {named(each)}: it has no DSCP" for each in every if each.dscp is None),
        "{",
        "  connect: {",
        "    endpoints: [",
    ]
    for endpoint, flows in marked.items():
        dscp = flows[0].dscp
        assert dscp is not None
        lines += [f"      // {named(each)}: {describe(dscp)}" for each in flows]
        if places.count(endpoint.partition("#")[0]) > 1:
            lines.append("      // choose one: other flows to this address and port differ in DSCP")
        lines.append(f"      {to_json(endpoint).decode()},")
    lines += ["    ],", "  },", "}"]
    return "\n".join(lines) + "\n"
