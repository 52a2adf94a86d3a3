"""CAMARA QualityOnDemand over HTTP: one session per flow and device, renewed before it expires.

Owns: the paths of QualityOnDemand 1.1.0, its bodies, the states of a session and when it is
prolonged.
"""

from __future__ import annotations

import datetime as dt
import re
from typing import Annotated, Any, Literal

import msgspec

from lifecycle.programming.apply.http import ID_PATTERN, Api, text_of
from lifecycle.programming.apply.ledger import Entry, Ledger
from lifecycle.programming.apply.remote import Made, RemoteTarget, ServerOptions
from lifecycle.programming.apply.settings import ServerSettings
from lifecycle.programming.apply.target import HttpError
from lifecycle.programming.rules.mobile import (
    Body,
    DeviceEnd,
    class_name,
)
from lifecycle.programming.rules.rules import FlowRule

KIND = "camara"

_COMPARED = {
    "applicationServer": "application_server",
    "devicePorts": "device_ports",
    "applicationServerPorts": "application_server_ports",
    "qosProfile": "qos_profile",
}

_MARGIN = 0.2
"""A session is prolonged when this part of what was asked for is left, …"""

_MARGIN_S = (5.0, 300.0)
"""… but at least and at most so many seconds before it expires."""

_POLL_S = 0.25

_LONGEST_S = 2**31 - 1
"""Largest `duration`, an int32."""


class CamaraSettings(ServerSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How to reach a CAMARA QualityOnDemand 1.1.0 interface and what to ask it for.

    Attributes:
        url: everything before `/sessions`.
        qos_profiles: the provider's names of profiles, by 5QI.
        default_qos_profile: for flows whose 5QI is not named; empty leaves them out.
        duration_s: 1–2147483647; sessions are renewed, or they expire.
        sink: https URL that the network reports to; empty for none.
        public_addresses: of devices behind a translation, by private address.
        device_by_token: the access token names the device (three-legged), so that the body must
            not: a server answers 422 UNNECESSARY_IDENTIFIER otherwise.
        wait_s: how long a session may take to become available; 0 does not wait.
    """

    qos_profiles: dict[int, str] = msgspec.field(default_factory=dict)
    default_qos_profile: str = ""
    duration_s: int = 3600
    sink: str = ""
    public_addresses: dict[str, str] = msgspec.field(default_factory=dict)
    device_by_token: bool = False
    wait_s: float = 10.0

    def check(self) -> None:
        """Refuse what a server would refuse."""
        for profile in filter(None, (*self.qos_profiles.values(), self.default_qos_profile)):
            if not re.fullmatch(r"[a-zA-Z0-9_.-]{3,256}", profile):
                raise ValueError(
                    f"cannot use qosProfile {profile!r}; "
                    "use 3 to 256 letters, digits, '_', '.' and '-', such as QOS_E"
                )
        for address in self.public_addresses.values():
            if not re.fullmatch(r"[0-9]{1,3}(\.[0-9]{1,3}){3}", address):
                raise ValueError(f"cannot use public address {address!r}; use an IPv4 address")
        if not 1 <= self.duration_s <= _LONGEST_S:
            raise ValueError(f"cannot use a duration of {self.duration_s} s; use 1 to {_LONGEST_S}")
        if self.sink and not re.fullmatch(r"https://[^\s/]+\S*", self.sink):
            raise ValueError(f"cannot use sink {self.sink!r}; use an https URL, or none")


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
    qos_profile: Any = None

    @property
    def why(self) -> str:
        """Why it ended."""
        return text_of(self.status_info) or "no reason given"


class CamaraTarget(RemoteTarget[CamaraSettings]):
    """One QualityOnDemand interface."""

    kind = KIND
    collection = "/sessions"

    def __init__(self, settings: CamaraSettings, api: Api, ledger: Ledger, path: str) -> None:
        super().__init__(settings, api, ledger, path)
        self._expires: dict[str, tuple[float, float]] = {}
        """By key, when a session expires: since the epoch, and on the clock that goes forward."""

    @staticmethod
    def body(rule: FlowRule, end: DeviceEnd, settings: CamaraSettings) -> Body:
        """Return the body of a CreateSession (QualityOnDemand 1.1.0).

        It has no protocol and no direction: it treats what goes between a device's ports and a
        server's ports, both ways, UDP and TCP alike.
        """
        profile = class_name(
            rule, settings.qos_profiles, settings.default_qos_profile, setting="qos_profiles"
        )
        public = settings.public_addresses.get(end.device, end.device)
        device: Body = {"ipv4Address": {"publicAddress": public, "privateAddress": end.device}}
        if end.is_ipv6:
            device = {"ipv6Address": end.device}
        return {
            **({} if settings.device_by_token else {"device": device}),
            "applicationServer": {"ipv6Address" if end.is_ipv6 else "ipv4Address": end.server},
            "devicePorts": {"ports": [end.device_port]},
            "applicationServerPorts": {"ports": [end.server_port]},
            "qosProfile": profile,
            **({"sink": settings.sink} if settings.sink else {}),
            "duration": settings.duration_s,
        }

    def create(self, body: Body) -> Made:
        """POST it and wait a little until it is available.

        Raises:
            HttpError: refused, or the network cannot provide it.
        """
        reply = self._api.request("POST", self.collection, body)
        session = reply.read(_Session)
        id_ = session.session_id
        try:
            session = self._settled(session)
            if session.qos_status != "UNAVAILABLE":
                return self._made(session, body)
            self.delete(id_)
        except HttpError as error:
            error.uncertain = True  # it was made, whatever became of asking for its state
            raise
        raise HttpError(
            f"cannot get this QoS: the network made session {id_} unavailable ({session.why})",
            status=reply.status,
        )

    def find(self, body: Body) -> Made | None:
        """Look through the device's sessions for one that asks for the same."""
        asked = {"device": body["device"]} if "device" in body else {}
        reply = self._api.request("POST", "/retrieve-sessions", asked, may_be_gone=True)
        for each in () if reply.gone else reply.read(tuple[_Session, ...]):
            if not _differs(body, each, missing=True):
                return self._made(each, body)
        return None

    def see(self, id_: str, body: Body) -> Made | None:
        """GET it; one that has ended counts as different, for it has to be deleted first."""
        reply = self._api.request("GET", self.path(id_), may_be_gone=True)
        return None if reply.gone else self._made(reply.read(_Session), body)

    def update(self, id_: str, before: Body, body: Body) -> Made:  # noqa: ARG002 - RemoteTarget
        """Delete and create: a session cannot be changed, and two for one flow are a conflict."""
        self.delete(id_)
        return self.create(body)

    def prolong(self, entry: Entry, body: Body) -> Made | None:
        """Extend a session that is due; make a new one where it cannot be extended any further."""
        due_s = self.due_in_s(entry)
        if due_s is None or due_s > 0:
            return None
        try:
            reply = self._api.request(
                "POST",
                f"{self.path(entry.id)}/extend",
                {"requestedAdditionalDuration": self._settings.duration_s},
                may_be_gone=True,
            )
        except HttpError as error:
            # Not in a state to be extended, or over the profile's limit.
            if error.status not in (400, 409):
                raise
        else:
            if not reply.gone:
                made = self._made(reply.read(_Session), body)
                if made.expires_s is not None and made.expires_s > (entry.expires_s or 0.0) + 1:
                    return made
        return self.update(entry.id, body, body)

    def due_in_s(self, entry: Entry) -> float | None:
        """Return seconds until a session must be prolonged; negative once it is late."""
        if entry.expires_s is None:
            return None
        least, most = _MARGIN_S
        margin_s = min(max(_MARGIN * self._settings.duration_s, least), most)
        clock = self._api.clock
        left_s, now_s = entry.expires_s - clock.now_s(), clock.steady_s()
        # A clock that is set back meanwhile makes no session last longer.
        known = self._expires.get(entry.key)
        if known is None or known[0] != entry.expires_s:
            known = self._expires[entry.key] = entry.expires_s, now_s + left_s
        return min(left_s, known[1] - now_s) - margin_s

    def _settled(self, session: _Session) -> _Session:
        """Ask until the session is more than requested, for `wait_s`."""
        wait_s = _POLL_S
        deadline_s = self._api.clock.steady_s() + self._settings.wait_s
        path = self.path(session.session_id)
        while session.qos_status == "REQUESTED":
            left_s = deadline_s - self._api.clock.steady_s()
            if left_s <= 0:
                break
            self._api.pause(min(wait_s, left_s))
            wait_s *= 2
            session = self._api.request("GET", path).read(_Session)
        return session

    def _made(self, session: _Session, body: Body) -> Made:
        id_, granted = session.session_id, session.duration
        if session.qos_status == "UNAVAILABLE":
            return Made(id=id_, differs=f"it ended: {session.why}")
        detail = "requested, not yet available" if session.qos_status == "REQUESTED" else ""
        if granted is not None and granted < self._settings.duration_s:
            detail = f"granted for {granted} s instead of {self._settings.duration_s} s"
        # The latest that it can end, if nothing says when.
        expires_s = None if granted is None else self._api.clock.now_s() + granted
        if session.expires_at is not None:
            expires_s = session.expires_at.timestamp()
        return Made(id=id_, expires_s=expires_s, detail=detail, differs=_differs(body, session))


def _differs(asked: Body, seen: _Session, *, missing: bool = False) -> str:
    """Why what the server shows is not what was asked for; empty if it is."""
    for key, field in _COMPARED.items():
        found = getattr(seen, field)
        if (found is not None or missing) and found != asked.get(key):
            return f"the server has {key} {text_of(str(found))!r}"
    return ""


class CamaraOptions(ServerOptions):
    """A QualityOnDemand interface."""

    kind = KIND
    settings_type = CamaraSettings
    target = CamaraTarget


TARGET = CamaraOptions
