"""3GPP NEF AsSessionWithQoS over HTTP: one subscription per flow and device.

By TS 29.122 (release 17, API version 1.2.3); its schema does not look inside filter strings.
"""

from __future__ import annotations

import contextlib
import ipaddress
import re
from typing import TYPE_CHECKING

import msgspec
from msgspec import to_builtins
from msgspec.structs import replace

from lifecycle.programming import http
from lifecycle.programming.rules import FlowRule
from lifecycle.programming.server import Body, DeviceEnd, Made, ServerTarget, class_name, differs

if TYPE_CHECKING:
    import httpx

_FIXED = ("ueIpv4Addr", "ueIpv6Addr")
"""What no PUT may change: another device needs another subscription."""

_COMPARED = (*_FIXED, "qosReference", "notificationDestination", "flowInfo")

_PROTOCOLS = {"udp": "17", "tcp": "6"}
"""IANA Assigned Internet Protocol Numbers."""


class NefSettings(http.ServerSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How to reach a 3GPP NEF and what to ask it for (TS 29.122, release 17).

    Attributes:
        url: API root, before `/3gpp-as-session-with-qos/v1`.
        scs_as_id: who we are to the operator.
        notification_destination: http or https URL that the network reports to.
        qos_references: the operator's names of classes, by 5QI.
        protocol_by_name: write `udp` instead of `17`, as some servers want it.
    """

    scs_as_id: str
    notification_destination: str
    qos_references: dict[int, str] = msgspec.field(default_factory=dict)
    protocol_by_name: bool = False

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


def _filter(rule: FlowRule, end: DeviceEnd, settings: NefSettings) -> str:
    """Return IPFilterRule text (RFC 6733 §4.3.1) in the shape of 3GPP TS 29.214 §5.3.8."""
    device, server = f"{end.device} {end.device_port}", f"{end.server} {end.server_port}"
    name = rule.transport_protocol.value
    protocol = name if settings.protocol_by_name else _PROTOCOLS[name]
    if end.sends:
        return f"permit in {protocol} from {device} to {server}"
    return f"permit out {protocol} from {server} to {device}"


def _spelled(text: str) -> str:
    """A filter in one spelling: servers write `17` and `udp`, and other spaces."""
    words = [_PROTOCOLS.get(each.lower(), each) for each in text.split()]
    for index, each in enumerate(words):
        with contextlib.suppress(ValueError):
            words[index] = str(ipaddress.ip_address(each))
    return " ".join(words)


class _Flow(msgspec.Struct, frozen=True, rename="camel"):
    """FlowInfo of TS 29.122 §5.2.1.2.14, as far as it is read."""

    flow_descriptions: tuple[str, ...] = ()


class _Subscription(msgspec.Struct, frozen=True, kw_only=True, rename="camel", omit_defaults=True):
    """What a server shows of a subscription; None is not shown."""

    link: str | None = msgspec.field(default=None, name="self")
    applied_qos_ref: str | None = None
    ue_ipv4_addr: str | None = None
    ue_ipv6_addr: str | None = None
    qos_reference: str | None = None
    notification_destination: str | None = None
    flow_info: tuple[_Flow, ...] | None = None


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
            "flowInfo": [{"flowId": 1, "flowDescriptions": [_filter(rule, end, self._server)]}],
            "qosReference": reference,
        }

    def create(self, body: Body) -> Made:
        """POST it.

        Raises:
            HttpError: refused, or the answer does not say what was made.
        """
        reply = self._api.request("POST", self.collection, body)
        shown = _shown(reply)
        made = reply.headers.get("location") or shown.link
        if not made:
            raise http.unusable(reply, "it has neither a Location nor a self")
        return Made(id=http.linked(reply, made), detail=_refused(shown))

    def look(self, id_: str, body: Body) -> Made | None:
        """GET it, or all of ours."""
        path = self.path(id_) if id_ else self.collection
        reply = self._api.request("GET", path, may_be_gone=True)
        if http.is_gone(reply):
            return None
        if id_:
            return Made(id=id_, differs=_differs(body, _shown(reply)))
        for each in http.read_answer(reply, tuple[_Subscription, ...]):
            if each.link and not _differs(body, each, missing=True):
                return Made(id=http.linked(reply, each.link))
        return None

    def update(self, id_: str, before: Body, body: Body) -> Made:
        """PUT it, so that what the network has reserved for a flow stays reserved."""
        if any(before.get(key) != body.get(key) for key in _FIXED):
            return super().update(id_, before, body)
        reply = self._api.request("PUT", self.path(id_), body, may_be_gone=True)
        if http.is_gone(reply):
            return self.create(body)
        return Made(id=id_, detail=_refused(_shown(reply)))


def _shown(reply: httpx.Response) -> _Subscription:
    """Return what an answer shows; it may be without a body.

    Raises:
        HttpError: a field is not what the interface has there.
    """
    return http.read_answer(reply, _Subscription) if reply.content else _Subscription()


def _refused(subscription: _Subscription) -> str:
    """Note it if the server granted another reference than was asked for."""
    granted = http.text_of(subscription.applied_qos_ref)
    return f"granted as {granted}" if granted else ""


def _differs(asked: Body, seen: _Subscription, *, missing: bool = False) -> str:
    def in_one_spelling(each: _Subscription) -> _Subscription:
        if each.flow_info is None:
            return each
        flows = (sorted(map(_spelled, flow.flow_descriptions)) for flow in each.flow_info)
        return replace(each, flow_info=tuple(_Flow(tuple(filters)) for filters in flows))

    wanted = to_builtins(in_one_spelling(msgspec.convert(asked, _Subscription)))
    return differs(wanted, in_one_spelling(seen), _COMPARED, missing=missing)


TARGET = NefTarget
