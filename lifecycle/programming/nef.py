"""3GPP NEF AsSessionWithQoS over HTTP: one subscription per flow and device.

By TS 29.122 (release 17, API version 1.2.3); its schema does not look inside filter strings.
"""

from __future__ import annotations

import re

import msgspec

from lifecycle.programming import http
from lifecycle.programming.rules import FlowRule
from lifecycle.programming.server import Body, DeviceEnd, Made, ServerTarget, class_name

_PROTOCOLS = {"udp": "17", "tcp": "6"}
"""IANA Assigned Internet Protocol Numbers."""

_FILTER = re.compile(r"permit +(in|out) .*from +(\S+) +(\S+) +to +(\S+) +(\S+)")
"""IPFilterRule text; its protocol may be a number or a name."""


class NefSettings(http.ServerSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How to reach a 3GPP NEF and what to ask it for (TS 29.122, release 17).

    Attributes:
        url: API root, before `/3gpp-as-session-with-qos/v1`.
        scs_as_id: who we are to the operator.
        notification_destination: http or https URL that the network reports to.
        qos_references: the operator's names of classes, by 5QI.
    """

    scs_as_id: str
    notification_destination: str
    qos_references: dict[int, str] = msgspec.field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not re.fullmatch(r"[A-Za-z0-9._~-]+", self.scs_as_id):
            raise ValueError(
                f"cannot use scs_as_id {self.scs_as_id!r}; use letters, digits and . _ ~ -"
            )
        if not re.fullmatch(r"https?://[^\s/]+\S*", self.notification_destination):
            raise ValueError(
                f"cannot use notificationDestination {self.notification_destination!r}; "
                "use an http or https URL that the network can reach"
            )

    @property
    def scope(self) -> str:
        """Our collection of subscriptions, without the last path segment."""
        return f"{self.url.rstrip('/')}/3gpp-as-session-with-qos/v1/{self.scs_as_id}"


def _filter(rule: FlowRule, end: DeviceEnd) -> str:
    """Return IPFilterRule text (RFC 6733 §4.3.1) in the shape of 3GPP TS 29.214 §5.3.8."""
    device, server = f"{end.device} {end.device_port}", f"{end.server} {end.server_port}"
    protocol = _PROTOCOLS[rule.transport_protocol.value]
    if end.sends:
        return f"permit in {protocol} from {device} to {server}"
    return f"permit out {protocol} from {server} to {device}"


class _Flow(msgspec.Struct, frozen=True, rename="camel"):
    """FlowInfo of TS 29.122 §5.2.1.2.14, as far as it is read."""

    flow_descriptions: tuple[str, ...] = ()

    @property
    def tuples(self) -> set[tuple[str, ...]]:
        """The direction, addresses and ports of its filters."""
        found = map(_FILTER.match, self.flow_descriptions)
        return {each.groups() for each in found if each}


class _Subscription(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    """What a server shows of a subscription; None is not shown."""

    link: str | None = msgspec.field(default=None, name="self")
    applied_qos_ref: str | None = None
    ue_ipv4_addr: str | None = None
    ue_ipv6_addr: str | None = None
    flow_info: tuple[_Flow, ...] = ()

    def is_for(self, other: _Subscription) -> bool:
        """Whether both are for the same flow of the same device."""
        return (
            (self.ue_ipv4_addr, self.ue_ipv6_addr) == (other.ue_ipv4_addr, other.ue_ipv6_addr)
            and len(self.flow_info) == 1
            and self.flow_info[0].tuples == other.flow_info[0].tuples
        )


class NefTarget(ServerTarget):
    """One NEF."""

    kind = "nef"
    settings_type = NefSettings
    collection = "/subscriptions"

    def body(self, rule: FlowRule, end: DeviceEnd) -> Body:
        """Return the body of an AsSessionWithQoSSubscription (3GPP TS 29.122 §5.14).

        One flow each: a known open implementation passes on only the last of several.
        """
        reference = class_name(rule, self._server.qos_references, setting="qos_references")
        return {
            "supportedFeatures": "0",  # hexadecimal, TS 29.571: none
            "notificationDestination": self._server.notification_destination,
            "ueIpv6Addr" if end.is_ipv6 else "ueIpv4Addr": end.device,
            "flowInfo": [{"flowId": 1, "flowDescriptions": [_filter(rule, end)]}],
            "qosReference": reference,
        }

    async def create(self, body: Body) -> Made:
        """POST it."""
        reply = await self._api.request("POST", self.collection, body)
        shown = _Subscription()
        if reply.content:
            shown = http.read_answer(reply, _Subscription)
        made = reply.headers.get("location") or shown.link
        if not made:
            raise http.unusable(reply, "it has neither a Location nor a self")
        granted = http.text_of(shown.applied_qos_ref)
        detail = f"granted as {granted}" if granted else ""
        return Made(id=http.linked(reply, made), detail=detail)

    async def look(self, body: Body) -> str:
        """GET all of ours."""
        reply = await self._api.request("GET", self.collection, may_be_gone=True)
        asked = msgspec.convert(body, _Subscription)
        for each in () if http.is_gone(reply) else http.read_answer(reply, list[_Subscription]):
            if each.link and each.is_for(asked):
                return http.linked(reply, each.link)
        return ""


TARGET = NefTarget
