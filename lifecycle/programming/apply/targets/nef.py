"""3GPP NEF AsSessionWithQoS over HTTP: one subscription per flow and device.

Owns: the paths, methods and media types of TS 29.122 (release 17, API version 1.2.3) and how a
server's view of a subscription is compared with ours. Bodies are `rules.nef`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from lifecycle.programming.apply.http import (
    MERGE_PATCH,
    Api,
    Fields,
    as_segment,
    show,
    text_of,
)
from lifecycle.programming.apply.ledger import Entry
from lifecycle.programming.apply.remote import Body, Made, RemoteRequest, ServerOptions, asks_of
from lifecycle.programming.apply.settings import ServerSettings
from lifecycle.programming.apply.target import HttpError
from lifecycle.programming.rules.nef import NefSettings, UplinkFilter, nef_subscriptions
from lifecycle.programming.rules.packet_filter import parse_filter
from lifecycle.programming.rules.rules import FlowRule

KIND = "nef"

_PATCHABLE = ("notificationDestination", "flowInfo", "qosReference")
"""What AsSessionWithQoSSubscriptionPatch may hold; a device's address is not among it."""

_COMPARED = ("ueIpv4Addr", "ueIpv6Addr", "qosReference", "notificationDestination")

_NO_PATCH = (404, 405, 415, 501)
"""Statuses of servers without PATCH."""


class NefTargetSettings(ServerSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How to reach a 3GPP NEF and what to ask it for (TS 29.122, release 17).

    Attributes:
        url: API root, before `/3gpp-as-session-with-qos/v1`.
        scs_as_id: who we are to the operator.
        notification_destination, devices, qos_references, default_qos_reference,
            supported_features, protocol_by_name, uplink: see rules.nef.NefSettings.
    """

    scs_as_id: str
    notification_destination: str
    devices: tuple[str, ...]
    qos_references: dict[int, str] = msgspec.field(default_factory=dict)
    default_qos_reference: str = ""
    supported_features: str = "0"
    protocol_by_name: bool = False
    uplink: UplinkFilter = UplinkFilter.IN

    def check(self) -> None:
        """Refuse an id that is no segment of a path."""
        if not re.fullmatch(r"[A-Za-z0-9._~-]+", self.scs_as_id):
            raise ValueError(
                f"cannot use scs_as_id {self.scs_as_id!r}; use letters, digits and . _ ~ -"
            )

    def asked(self) -> NefSettings:
        """Return what goes into bodies.

        Raises:
            ValueError: a value is not allowed.
        """
        asked: NefSettings = self.part(NefSettings)
        return asked


def nef_scope(settings: NefTargetSettings) -> str:
    """Return the URL of our collection of subscriptions, without the last path segment."""
    root = settings.url.rstrip("/")
    return f"{root}/3gpp-as-session-with-qos/v1/{as_segment(settings.scs_as_id)}"


class NefService:
    """One NEF, see remote.Service.

    Args:
        settings: see NefTargetSettings.
        api: at `nef_scope(settings)`.
    """

    kind = KIND

    def __init__(self, settings: NefTargetSettings, api: Api) -> None:
        self._settings = settings
        self._api = api

    @property
    def scope(self) -> str:
        """URL of the server."""
        return self._api.url

    def asks(self, rules: Sequence[FlowRule]) -> tuple[tuple[RemoteRequest, ...], tuple[str, ...]]:
        """Return one subscription per flow and device."""
        return asks_of(nef_subscriptions(rules, self._settings.asked()))

    def create(self, body: Body) -> Made:
        """POST it.

        Raises:
            HttpError: refused, or the answer does not say what was made.
        """
        reply = self._api.request("POST", "/subscriptions", body)
        subscription = reply.object(may_be_empty=True)
        made = reply.created() or subscription.link("self")
        if not made:
            raise HttpError(
                f"cannot tell what {self._api.url}/subscriptions has made: its answer has neither "
                "a Location nor a self",
                status=reply.status,
                uncertain=True,
            )
        return Made(id=made, detail=_refused(subscription))

    def find(self, body: Body) -> Made | None:
        """Look through our subscriptions for one that asks for the same."""
        reply = self._api.request("GET", "/subscriptions", may_be_gone=True)
        for each in reply.objects():
            id_ = each.link("self")
            if id_ and not _differs(body, each, missing=True):
                return Made(id=id_)
        return None

    def see(self, id_: str, body: Body) -> Made | None:
        """GET it."""
        reply = self._api.request("GET", _path(id_), may_be_gone=True)
        if reply.gone:
            return None
        return Made(id=id_, differs=_differs(body, reply.object()))

    def update(self, id_: str, before: Body, body: Body) -> Made:
        """PATCH what may be patched, PUT where there is no PATCH; else delete and create."""
        fixed = {key for key in {*before, *body} if before.get(key) != body.get(key)}
        if fixed - {*_PATCHABLE}:
            self.delete(id_)
            return self.create(body)
        patch = {key: body[key] for key in _PATCHABLE if key in body}
        try:
            reply = self._api.request("PATCH", _path(id_), patch, content_type=MERGE_PATCH)
        except HttpError as error:
            if error.status not in _NO_PATCH:
                raise
            reply = self._api.request("PUT", _path(id_), body, may_be_gone=True)
        if reply.gone:
            return self.create(body)
        return Made(id=id_, detail=_refused(reply.object(may_be_empty=True)))

    def delete(self, id_: str) -> None:
        """DELETE it; 204, and 200 as some servers answer."""
        self._api.request("DELETE", _path(id_), may_be_gone=True)

    def prolong(self, entry: Entry, body: Body) -> Made | None:  # noqa: ARG002 - Service
        """Subscriptions do not expire."""
        return None

    def due_in_s(self, entry: Entry) -> float | None:  # noqa: ARG002 - Service
        """Subscriptions do not expire."""
        return None


def _path(id_: str) -> str:
    return f"/subscriptions/{as_segment(id_)}"


def _refused(subscription: Fields) -> str:
    """Note it if the server granted another reference than was asked for."""
    granted = text_of(subscription.text("appliedQosRef"))
    return f"granted as {granted}" if granted else ""


def _differs(asked: Body, seen: Fields, *, missing: bool = False) -> str:
    """Why what the server shows is not what was asked for; empty if it is.

    Args:
        asked: our body.
        seen: the server's; it may add to it.
        missing: something that the server does not show differs too.

    Raises:
        HttpError: a field is not what the interface has there.
    """
    for key in _COMPARED:
        found = seen.text(key)
        if (key in seen.values or missing) and found != asked.get(key, ""):
            return f"the server has {key} {show(found)}"
    if ("flowInfo" in seen.values or missing) and _shown_filters(seen) != _filters(asked):
        return "the server has other filters"
    return ""


def _shown_filters(seen: Fields) -> list[str]:
    """The filters that a server shows.

    Raises:
        HttpError: they are no list of objects that hold lists of strings.
    """
    flows = seen.values.get("flowInfo")
    if flows is None:
        return []
    if not isinstance(flows, list):
        seen.refuse("flowInfo", "a JSON array", flows)
    for index, flow in enumerate(flows):
        if not isinstance(flow, dict):
            seen.refuse(f"flowInfo[{index}]", "a JSON object", flow)
        texts = flow.get("flowDescriptions", [])
        if not isinstance(texts, list) or not all(isinstance(each, str) for each in texts):
            key = f"flowInfo[{index}].flowDescriptions"
            seen.refuse(key, "a JSON array of strings", texts if texts is not None else "null")
    return _filters(seen.values)


def _filters(subscription: Mapping[str, Any]) -> list[str]:
    """The filters in one spelling: servers write `17` and `udp`, and other spaces."""
    flows = subscription.get("flowInfo", [])
    return sorted(_spelled(text) for flow in flows for text in flow.get("flowDescriptions", []))


def _spelled(text: str) -> str:
    try:
        return parse_filter(" ".join(text.split())).text()
    except ValueError:
        return text


class NefOptions(ServerOptions[NefTargetSettings]):
    """A NEF."""

    kind = KIND
    settings_type = NefTargetSettings

    @classmethod
    def url(cls, settings: NefTargetSettings) -> str:
        """Return the URL of our collection of subscriptions."""
        return nef_scope(settings)

    @classmethod
    def service(cls, settings: NefTargetSettings, api: Api) -> NefService:
        """Return what asks it."""
        return NefService(settings, api)


TARGET = NefOptions
