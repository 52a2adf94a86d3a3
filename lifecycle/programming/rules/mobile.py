"""Flows as a mobile network sees them: which end is a device, and what class is asked for it.

Owns: what NEF and CAMARA have in common. A mobile network treats the packets to and from its
devices, so a flow between two devices is asked for twice, once for each. Pure.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import msgspec

from lifecycle.codec import to_json
from lifecycle.programming.rules.rules import FlowRule, LeftOut, asks

_ENDS = ("source", "destination")

IpNetwork = ipaddress.IPv4Network | ipaddress.IPv6Network

Body = dict[str, Any]
"""Of a request, JSON-able."""


class DeviceEnd(msgspec.Struct, frozen=True, kw_only=True):
    """One end of a flow that is a device of the mobile network, and the other end.

    Attributes:
        sends: the device is the sender.
        device: address of the device.
        device_port: 1–65535.
        server: address of the other end, a device or not.
        server_port: 1–65535.
    """

    sends: bool
    device: str
    device_port: int
    server: str
    server_port: int

    @property
    def is_ipv6(self) -> bool:
        """Whether its addresses are of IPv6."""
        return ":" in self.device


class NetworkRequest(msgspec.Struct, frozen=True, kw_only=True):
    """What to ask the network for one flow and one of its ends.

    Attributes:
        key: of the FlowRule, with the direction behind it: unique.
        rule: that it is made from.
    """

    key: str
    rule: FlowRule
    body: Body


class Requests(msgspec.Struct, frozen=True, kw_only=True):
    """Everything to ask the network for, and what cannot be asked."""

    requests: tuple[NetworkRequest, ...]
    left_out: tuple[LeftOut, ...]


def device_networks(devices: Iterable[str]) -> tuple[IpNetwork, ...]:
    """Return the networks among what says which ends of flows are devices.

    Args:
        devices: `10.45.0.0/16`, `2001:db8:45::/48`, single addresses, or `source` and
            `destination` for that end of every flow.

    Raises:
        ValueError: not a network, or none at all: without it no end is known to be a device.
    """
    every = tuple(devices)
    if not every:
        raise ValueError(
            "cannot tell which ends of flows are devices: devices is empty; name the addresses or "
            "networks of the devices, such as 10.45.0.0/16, or 'source' or 'destination'"
        )
    return tuple(_network(each) for each in every if each not in _ENDS)


def _network(text: str) -> IpNetwork:
    try:
        return ipaddress.ip_network(text, strict=False)
    except ValueError:
        raise ValueError(
            f"cannot use {text!r} as a network of devices; "
            f"use an address or a network, such as 10.45.0.0/16"
        ) from None


def requests_of(
    rules: Iterable[FlowRule], devices: Sequence[str], make: Callable[[FlowRule, DeviceEnd], Body]
) -> Requests:
    """Return one request per flow and device, and the flows that none can be made for.

    Args:
        rules: of verified flows.
        devices: see `device_networks`.
        make: the body for one flow and one of its ends; a ValueError leaves the flow out.
    """
    requests: list[NetworkRequest] = []
    left: list[LeftOut] = []
    for rule in rules:
        try:
            requests += [
                NetworkRequest(
                    # As stable as the rule's own key: a manifest keeps it whatever the ports are.
                    key=f"{rule.key} {'from' if end.sends else 'to'} device",
                    rule=rule,
                    body=make(rule, end),
                )
                for end in device_ends(rule, devices)
            ]
        except ValueError as error:  # noqa: PERF203 - the other flows are asked for
            left += [
                LeftOut(
                    topic=topic, publisher=publisher, subscription=subscription, reason=str(error)
                )
                for topic, publisher, subscription in rule.names
            ]
    return Requests(requests=tuple(requests), left_out=tuple(left))


def device_ends(rule: FlowRule, devices: Sequence[str]) -> tuple[DeviceEnd, ...]:
    """Return the ends of a flow that are devices: one or both.

    Raises:
        ValueError: none is, or an end that has to be known is not.
    """
    source = (rule.source_address, rule.source_port)
    destination = (rule.destination_address, rule.destination_port)
    if ipaddress.ip_address(rule.destination_address).is_loopback:
        raise ValueError("it never leaves its machine")
    if not rule.source_address:
        raise ValueError(
            "the address it is sent from is not known; give its machine an address in the manifest"
        )
    networks = device_networks(devices)
    found: list[DeviceEnd] = []
    for end, sends, device, server in (
        ("destination", False, destination, source),
        ("source", True, source, destination),
    ):
        if end in devices or any(ipaddress.ip_address(device[0]) in each for each in networks):
            found.append(
                DeviceEnd(
                    sends=sends,
                    device=device[0],
                    device_port=device[1],
                    server=server[0],
                    server_port=server[1],
                )
            )
    if not found:
        text = ", ".join(map(str, networks))
        raise ValueError(f"neither end is a device of the mobile network ({text})")
    return tuple(found)


def class_name(rule: FlowRule, names: Mapping[int, str], default: str, *, setting: str) -> str:
    """Return what the operator calls the class that a flow asks for.

    Args:
        rule: of the flow.
        names: by 5QI.
        default: for flows whose 5QI has no name or that ask for none; empty leaves them out.
        setting: name of `names` in the settings, for the message.

    Raises:
        ValueError: there is no name.
    """
    if rule.five_qi is not None and rule.five_qi in names:
        return names[rule.five_qi]
    if default:
        return default
    if rule.five_qi is None:
        raise ValueError(f"it asks for no 5QI ({asks(rule)}), and there is no default class")
    raise ValueError(
        f"the operator's name for 5QI {rule.five_qi} is not known; add it to {setting}"
    )


def document(name: str, found: Requests, left_out: Iterable[LeftOut]) -> str:
    """Return requests as JSON for people and scripts: each body beside what it is for.

    Args:
        name: of the list of requests.
        found: the requests, and what they leave out.
        left_out: what was left out before.
    """
    return to_json(
        {
            name: [
                {
                    "key": request.key,
                    "flow": request.rule.describe(),
                    "asks": asks(request.rule),
                    "body": request.body,
                }
                for request in found.requests
            ],
            "left_out": [str(each) for each in (*left_out, *found.left_out)],
        }
    ).decode()
