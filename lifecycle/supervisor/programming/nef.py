"""3GPP NEF AsSessionWithQoS over HTTP: one subscription per flow and device.

Owns: the paths, methods and media types of TS 29.122 (release 17, API version 1.2.3) and how a
server's view of a subscription is compared with ours. Bodies are `export.nef`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from lifecycle.export.nef import nef_subscriptions
from lifecycle.export.packet_filter import parse_filter
from lifecycle.export.rules import FlowRule
from lifecycle.supervisor.programming.errors import HttpError
from lifecycle.supervisor.programming.http import (
    MERGE_PATCH,
    Api,
    Reply,
    as_segment,
    last_segment,
)
from lifecycle.supervisor.programming.ledger import Entry
from lifecycle.supervisor.programming.remote import Ask, Body, Made, asks_of
from lifecycle.supervisor.programming.settings import NefTargetSettings

KIND = "nef"

_PATCHABLE = ("notificationDestination", "flowInfo", "qosReference")
"""What AsSessionWithQoSSubscriptionPatch may hold; a device's address is not among it."""

_COMPARED = ("ueIpv4Addr", "ueIpv6Addr", "qosReference", "notificationDestination")

_NO_PATCH = (404, 405, 415, 501)
"""Statuses with which servers say that they know no PATCH."""


def nef_scope(settings: NefTargetSettings) -> str:
    """Return the URL of our collection of subscriptions, without the last word."""
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

    def asks(self, rules: Sequence[FlowRule]) -> tuple[tuple[Ask, ...], tuple[str, ...]]:
        """Return one subscription per flow and device."""
        return asks_of(nef_subscriptions(rules, self._settings.asked()))

    def create(self, body: Body) -> Made:
        """POST it.

        Raises:
            HttpError: refused, or the answer does not say what was made.
        """
        reply = self._api.request("POST", "/subscriptions", body)
        made = last_segment(reply.location) or _id_of(reply.object())
        if not made:
            raise HttpError(
                f"cannot tell what {self._api.url}/subscriptions has made: its answer has neither "
                "a Location nor a self",
                status=reply.status,
                uncertain=True,
            )
        return Made(id=made, detail=_refused(reply.object()))

    def find(self, body: Body) -> Made | None:
        """Look through our subscriptions for one that asks for the same."""
        reply = self._api.request("GET", "/subscriptions", may_be_gone=True)
        for each in reply.body if isinstance(reply.body, list) else ():
            if isinstance(each, dict) and _id_of(each) and not _differs(body, each, missing=True):
                return Made(id=_id_of(each))
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
            reply: Reply | None = self._api.request(
                "PATCH", _path(id_), patch, content_type=MERGE_PATCH
            )
        except HttpError as error:
            if error.status not in _NO_PATCH:
                raise
            reply = self._api.request("PUT", _path(id_), body, may_be_gone=True)
        if reply is None or reply.gone:
            return self.create(body)
        return Made(id=id_, detail=_refused(reply.object()))

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


def _id_of(subscription: dict[str, Any]) -> str:
    link = subscription.get("self")
    return last_segment(link) if isinstance(link, str) else ""


def _refused(subscription: dict[str, Any]) -> str:
    """Say so if the server granted another reference than was asked for."""
    granted = subscription.get("appliedQosRef")
    return f"granted as {granted}" if isinstance(granted, str) and granted else ""


def _differs(asked: Body, seen: dict[str, Any], *, missing: bool = False) -> str:
    """Why what the server shows is not what was asked for; empty if it is.

    Args:
        asked: our body.
        seen: the server's; it may add to it.
        missing: something that the server does not show differs too.
    """
    for key in _COMPARED:
        if (key in seen or missing) and seen.get(key) != asked.get(key):
            return f"the server has {key} {seen.get(key)!r}"
    if ("flowInfo" in seen or missing) and _filters(seen) != _filters(asked):
        return "the server has other filters"
    return ""


def _filters(subscription: Body) -> list[str]:
    """The filters in one spelling: servers write `17` and `udp`, and other spaces."""
    flows = subscription.get("flowInfo")
    texts = [
        text
        for flow in (flows if isinstance(flows, list) else [])
        if isinstance(flow, dict)
        for text in flow.get("flowDescriptions", [])
    ]
    return sorted(map(_spelled, texts))


def _spelled(text: object) -> str:
    try:
        return parse_filter(" ".join(str(text).split())).text()
    except ValueError:
        return str(text)
