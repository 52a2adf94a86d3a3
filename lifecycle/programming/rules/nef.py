"""Flow rules as bodies of 3GPP NEF AsSessionWithQoS subscriptions.

Owns: our own model of AsSessionWithQoSSubscription (3GPP TS 29.122 §5.14, release 17, API version
1.2.3; written from the specification's facts, not from its files) and how a flow becomes one. Pure.

One subscription per flow and device: a known open implementation passes on only the last of several
flows. The interface's schema does not look inside filter strings, so they are checked here.
"""

from __future__ import annotations

import enum
import re
from collections.abc import Iterable, Mapping

from lifecycle import dataclasses
from lifecycle.programming.rules.mobile import (
    DeviceEnd,
    Requests,
    class_name,
    document,
    parse_devices,
    requests_of,
)
from lifecycle.programming.rules.packet_filter import (
    Direction,
    PacketFilter,
    PortRange,
    check_address,
    parse_filter,
)
from lifecycle.programming.rules.rules import FlowRule, LeftOut

API_VERSION = "1.2.3"

_URL = re.compile(r"https?://[^\s/]+\S*")
_HEX = re.compile(r"[0-9A-Fa-f]+")


class UplinkFilter(enum.Enum):
    """How a server wants the filter of packets that a device sends."""

    IN = "in"  # `permit in 17 from DEVICE to SERVER`, as TS 29.214 §5.3.8 says
    OUT_REVERSED = "out_reversed"  # `permit out 17 from SERVER to DEVICE`, which it turns round


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Snssai:
    """A network slice (TS 29.571 §5.4.4.2).

    Attributes:
        sst: slice and service type, 0–255.
        sd: slice differentiator, six hexadecimal digits; empty if there is none.
    """

    sst: int
    sd: str = ""

    def __post_init__(self) -> None:
        if not 0 <= self.sst <= 255:
            raise ValueError(f"cannot use sst {self.sst}; use 0 to 255")
        if self.sd and not re.fullmatch(r"[0-9A-Fa-f]{6}", self.sd):
            raise ValueError(f"cannot use sd {self.sd!r}; use six hexadecimal digits")

    def body(self) -> dict[str, object]:
        """Return the JSON object."""
        return {"sst": self.sst, **({"sd": self.sd} if self.sd else {})}


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class FlowInfo:
    """FlowInfo of TS 29.122 §5.2.1.2.

    Attributes:
        flow_id: >= 0, unique in its subscription.
        flow_descriptions: one or two filters, as text: one per direction.
    """

    flow_id: int
    flow_descriptions: tuple[str, ...]

    def __post_init__(self) -> None:
        if self.flow_id < 0:
            raise ValueError(f"cannot use flowId {self.flow_id}; use 0 or more")
        if not 1 <= len(self.flow_descriptions) <= 2:
            raise ValueError(
                f"cannot use {len(self.flow_descriptions)} flowDescriptions; use one or two"
            )
        for text in self.flow_descriptions:
            parse_filter(text)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class QosSubscription:
    """AsSessionWithQoSSubscription, the part of it that we ask with.

    Attributes:
        notification_destination: URL that the network reports to; required by the interface.
        qos_reference: name of a class that the operator provides.
        flow_info: the flows; one here.
        ue_ipv4_addr: of the device; empty if it is the other family.
        ue_ipv6_addr: of the device; empty if it is the other family.
        supported_features: bits as hexadecimal text (TS 29.571 SupportedFeatures), "0" for none.
        dnn: data network name; empty to leave it to the network.
        snssai: network slice; None to leave it to the network.
    """

    notification_destination: str
    qos_reference: str
    flow_info: tuple[FlowInfo, ...]
    ue_ipv4_addr: str = ""
    ue_ipv6_addr: str = ""
    supported_features: str = "0"
    dnn: str = ""
    snssai: Snssai | None = None

    def __post_init__(self) -> None:
        _check_common(self.notification_destination, self.supported_features)
        if not self.qos_reference:
            raise ValueError("cannot use an empty qosReference; use a class of the operator's")
        if not self.flow_info:
            raise ValueError("cannot ask for no flow; use at least one flowInfo")
        if bool(self.ue_ipv4_addr) == bool(self.ue_ipv6_addr):
            raise ValueError(
                f"cannot use ueIpv4Addr {self.ue_ipv4_addr!r} with ueIpv6Addr "
                f"{self.ue_ipv6_addr!r}; use exactly one of them"
            )
        for text, version in ((self.ue_ipv4_addr, 4), (self.ue_ipv6_addr, 6)):
            if text and check_address(text).version != version:
                raise ValueError(f"cannot use {text} as ueIpv{version}Addr; use an IPv{version}")

    def body(self) -> dict[str, object]:
        """Return the JSON object for POST and PUT."""
        ipv4 = {"ueIpv4Addr": self.ue_ipv4_addr} if self.ue_ipv4_addr else {}
        ipv6 = {"ueIpv6Addr": self.ue_ipv6_addr} if self.ue_ipv6_addr else {}
        return {
            "supportedFeatures": self.supported_features,
            "notificationDestination": self.notification_destination,
            **ipv4,
            **ipv6,
            "flowInfo": [
                {"flowId": each.flow_id, "flowDescriptions": list(each.flow_descriptions)}
                for each in self.flow_info
            ],
            "qosReference": self.qos_reference,
            **({"dnn": self.dnn} if self.dnn else {}),
            **({"snssai": self.snssai.body()} if self.snssai else {}),
        }


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class NefSettings:
    """What the flows themselves do not say.

    Attributes:
        notification_destination: http or https URL that the network reports to.
        devices: addresses or networks of the network's devices, `10.45.0.0/16`, or `source` or
            `destination` for that end of every flow.
        device_address: of the one device as the mobile network knows it, where flows show another.
        qos_references: the operator's names of classes, by 5QI.
        default_qos_reference: for flows whose 5QI is not named; empty leaves them out.
        supported_features: hexadecimal text.
        protocol_by_name: write `udp` instead of `17`, as some servers want it.
        uplink: how the server wants filters of what devices send.
        dnn: data network name; empty to leave it to the network.
        snssai: network slice; None to leave it to the network.
    """

    notification_destination: str
    devices: tuple[str, ...]
    qos_references: Mapping[int, str] = dataclasses.field(default_factory=dict)
    default_qos_reference: str = ""
    supported_features: str = "0"
    protocol_by_name: bool = False
    uplink: UplinkFilter = UplinkFilter.IN
    device_address: str = ""
    dnn: str = ""
    snssai: Snssai | None = None

    def __post_init__(self) -> None:
        _check_common(self.notification_destination, self.supported_features)
        parse_devices(self.devices, address=self.device_address)


def nef_subscriptions(
    rules: Iterable[FlowRule], settings: NefSettings
) -> Requests[QosSubscription]:
    """Return one subscription per flow and device, and the flows that cannot be asked for."""
    return requests_of(
        rules,
        parse_devices(settings.devices, address=settings.device_address),
        lambda rule, end: _subscription(rule, end, settings),
    )


def render_nef(
    rules: Iterable[FlowRule], settings: NefSettings, *, left_out: Iterable[LeftOut] = ()
) -> str:
    """Return the subscriptions as JSON: `{"subscriptions": [{key, flow, asks, body}], …}`."""
    return document("subscriptions", nef_subscriptions(rules, settings), left_out)


def _subscription(rule: FlowRule, end: DeviceEnd, settings: NefSettings) -> QosSubscription:
    reference = class_name(
        rule,
        settings.qos_references,
        settings.default_qos_reference,
        setting="qos_references",
    )
    ipv6 = check_address(end.device).version == 6
    return QosSubscription(
        notification_destination=settings.notification_destination,
        qos_reference=reference,
        flow_info=(FlowInfo(flow_id=1, flow_descriptions=(_filter(rule, end, settings),)),),
        ue_ipv4_addr="" if ipv6 else end.device,
        ue_ipv6_addr=end.device if ipv6 else "",
        supported_features=settings.supported_features,
        dnn=settings.dnn,
        snssai=settings.snssai,
    )


def _filter(rule: FlowRule, end: DeviceEnd, settings: NefSettings) -> str:
    towards = end.direction is Direction.OUT or settings.uplink is UplinkFilter.OUT_REVERSED
    device = (end.device, PortRange(low=end.device_port, high=end.device_port))
    server = (end.server, PortRange(low=end.server_port, high=end.server_port))
    source, destination = (server, device) if towards else (device, server)
    return PacketFilter(
        direction=Direction.OUT if towards else Direction.IN,
        protocol=rule.protocol_number,
        source=source[0],
        source_ports=source[1],
        destination=destination[0],
        destination_ports=destination[1],
    ).text(protocol_by_name=settings.protocol_by_name)


def _check_common(notification_destination: str, supported_features: str) -> None:
    if not _URL.fullmatch(notification_destination):
        raise ValueError(
            f"cannot use notificationDestination {notification_destination!r}; "
            f"use an http or https URL that the network can reach"
        )
    if not _HEX.fullmatch(supported_features):
        raise ValueError(
            f"cannot use supportedFeatures {supported_features!r}; "
            f"use hexadecimal digits, 0 for none"
        )
