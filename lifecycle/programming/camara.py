"""CAMARA QualityOnDemand 1.1.0: one session per flow and device, renewed before it expires."""

from __future__ import annotations

import asyncio
import datetime as dt
import math
import re
import time
from typing import Annotated, Any, Literal

import msgspec
from msgspec.structs import replace

from lifecycle.programming.http import ID_PATTERN, ServerSettings, is_gone, read_answer, text_of
from lifecycle.programming.ledger import Entry
from lifecycle.programming.rules import FlowRule
from lifecycle.programming.server import (
    Body,
    DeviceEnd,
    Made,
    ServerTarget,
    class_name,
    steady_s,
)
from lifecycle.programming.target import HttpError, PartlyError, each_done

_MARGIN = 0.2
"""A session is prolonged when this part of what was asked for is left, …"""

_MARGIN_S = (5.0, 300.0)
"""… but at least and at most so many seconds before it expires."""

_ENDS = ("applicationServer", "devicePorts", "applicationServerPorts")

_POLLS_S = (0.25, 0.5, 1.0, 2.0, 2.0, 2.0, 2.0)
"""Between looks at a session that is to become available."""

_LONGEST_S = 2**31 - 1
"""Largest `duration`, an int32."""


class CamaraSettings(ServerSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How to reach a CAMARA QualityOnDemand 1.1.0 interface and what to ask it for.

    Attributes:
        url: everything before `/sessions`.
        qos_profiles: the provider's names of profiles, by 5QI.
        duration_s: 1–2147483647; sessions are renewed, or they expire.
    """

    qos_profiles: dict[int, str] = msgspec.field(default_factory=dict)
    duration_s: int = 3600

    def __post_init__(self) -> None:
        super().__post_init__()
        for profile in self.qos_profiles.values():
            if not re.fullmatch(r"[a-zA-Z0-9_.-]{3,256}", profile):
                raise ValueError(
                    f"cannot use qosProfile {profile!r}; "
                    "use 3 to 256 letters, digits, '_', '.' and '-', such as QOS_E"
                )
        if not 1 <= self.duration_s <= _LONGEST_S:
            raise ValueError(f"cannot use a duration of {self.duration_s} s; use 1 to {_LONGEST_S}")


class _Session(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    """SessionInfo of QualityOnDemand 1.1.0, as far as it is read; None is not shown."""

    session_id: Annotated[str, msgspec.Meta(pattern=ID_PATTERN)]
    qos_status: Literal["REQUESTED", "AVAILABLE", "UNAVAILABLE"]
    status_info: str | None = None
    duration: Annotated[int, msgspec.Meta(ge=1, le=_LONGEST_S)] | None = None
    expires_at: Annotated[dt.datetime, msgspec.Meta(tz=True)] | None = None
    application_server: Any = None
    device_ports: Any = None
    application_server_ports: Any = None


class CamaraTarget(ServerTarget):
    """One QualityOnDemand interface."""

    kind = "camara"
    settings_type = CamaraSettings
    collection = "/sessions"

    def body(self, rule: FlowRule, end: DeviceEnd) -> Body:
        """Return the body of a CreateSession (QualityOnDemand 1.1.0).

        It has no protocol and no direction: it treats what goes between a device's ports and a
        server's ports, both ways, UDP and TCP alike.
        """
        profile = class_name(rule, self._server.qos_profiles, setting="qos_profiles")
        address = {"publicAddress": end.device, "privateAddress": end.device}
        device: Body = {"ipv4Address": address}
        if end.is_ipv6:
            device = {"ipv6Address": end.device}
        return {
            "device": device,
            "applicationServer": {"ipv6Address" if end.is_ipv6 else "ipv4Address": end.server},
            "devicePorts": {"ports": [end.device_port]},
            "applicationServerPorts": {"ports": [end.server_port]},
            "qosProfile": profile,
            "duration": self._server.duration_s,
        }

    async def create(self, body: Body) -> Made:
        """POST it and wait a little until it is available."""
        reply = await self._api.request("POST", self.collection, body)
        session = read_answer(reply, _Session)
        id_ = session.session_id
        try:
            for pause_s in _POLLS_S:
                if session.qos_status != "REQUESTED":
                    break
                await asyncio.sleep(pause_s)
                session = read_answer(await self._api.request("GET", self.path(id_)), _Session)
            if session.qos_status == "UNAVAILABLE":
                await self.delete(id_)
        except HttpError as error:
            error.uncertain = True  # it was made, whatever became of asking for its state
            raise
        if session.qos_status == "UNAVAILABLE":
            why = text_of(session.status_info) or "no reason given"
            raise HttpError(
                f"cannot get this QoS: the network made session {id_} unavailable ({why})",
                status=reply.status_code,
            )
        return self._made(session)

    async def look(self, body: Body) -> str:
        """Ask for all of the device."""
        asked = {"device": body["device"]}
        reply = await self._api.request("POST", "/retrieve-sessions", asked, may_be_gone=True)
        for each in () if is_gone(reply) else read_answer(reply, list[_Session]):
            ends = (each.application_server, each.device_ports, each.application_server_ports)
            if ends == tuple(map(body.get, _ENDS)):
                return each.session_id
        return ""

    async def renew(self) -> float | None:
        """Prolong sessions that are due; return seconds until the next is.

        Raises:
            PartlyError: something could not be prolonged and will expire or has expired.
        """
        now = [each for each in self._entries().values() if each.id and self._due_in_s(each) <= 0]
        _, failed = await each_done(now, self._prolong)
        if failed:
            errors = [(entry.key, error) for entry, error in failed]
            raise PartlyError(self.name, len(self._entries()), errors)
        due_s = min(map(self._due_in_s, self._entries().values()), default=math.inf)
        return None if due_s == math.inf else due_s

    async def _prolong(self, entry: Entry) -> None:
        """Extend a session; make a new one where it cannot be extended any further."""
        path = f"{self.path(entry.id)}/extend"
        body = {"requestedAdditionalDuration": self._server.duration_s}
        made = None
        try:
            reply = await self._api.request("POST", path, body, may_be_gone=True)
        except HttpError as error:
            # Not in a state to be extended, or over the profile's limit.
            if error.status not in (400, 409):
                raise
        else:
            if not is_gone(reply):
                made = self._made(read_answer(reply, _Session))
        if made is None or (made.expires_s or 0.0) <= (entry.expires_s or 0.0) + 1:
            await self.delete(entry.id)
            await self._create(replace(entry, id="", expires_s=None))
        else:
            self._note(entry.key, replace(entry, expires_s=made.expires_s))

    def _due_in_s(self, entry: Entry) -> float:
        """Return seconds until a session must be prolonged; negative once it is late."""
        if entry.expires_s is None:
            return math.inf
        least, most = _MARGIN_S
        margin_s: float = min(max(_MARGIN * self._server.duration_s, least), most)
        return entry.expires_s - steady_s() - margin_s

    def _made(self, session: _Session) -> Made:
        granted = session.duration
        detail = "requested, not yet available" if session.qos_status == "REQUESTED" else ""
        if granted is not None and granted < self._server.duration_s:
            detail = f"granted for {granted} s instead of {self._server.duration_s} s"
        # The latest that it can end, if nothing says when.
        left_s: float | None = granted
        if session.expires_at is not None:
            left_s = session.expires_at.timestamp() - time.time()
        expires_s = None if left_s is None else steady_s() + left_s
        return Made(id=session.session_id, expires_s=expires_s, detail=detail)


TARGET = CamaraTarget
