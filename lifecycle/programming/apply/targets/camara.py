"""CAMARA QualityOnDemand over HTTP: one session per flow and device, renewed before it expires.

Owns: the paths of QualityOnDemand 1.1.0, the states of a session and when it is prolonged. Bodies
are `rules.camara`.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence

import msgspec

from lifecycle.programming.apply.http import Api, Fields, as_segment, show, text_of
from lifecycle.programming.apply.ledger import Entry
from lifecycle.programming.apply.remote import Body, Made, RemoteRequest, ServerOptions, asks_of
from lifecycle.programming.apply.settings import ServerSettings
from lifecycle.programming.apply.target import HttpError
from lifecycle.programming.rules.camara import CamaraSettings, camara_sessions
from lifecycle.programming.rules.rules import FlowRule

KIND = "camara"

_COMPARED = ("applicationServer", "devicePorts", "applicationServerPorts", "qosProfile")

_MARGIN = 0.2
"""A session is prolonged when this part of what was asked for is left, …"""

_MARGIN_S = (5.0, 300.0)
"""… but at least and at most so many seconds before it expires."""

_POLL_S = 0.25

_STATUSES = ("REQUESTED", "AVAILABLE", "UNAVAILABLE")
"""QosStatus of QualityOnDemand 1.1.0."""

_LONGEST_S = 2**31 - 1
"""Largest `duration`, an int32."""


class CamaraTargetSettings(ServerSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How to reach a CAMARA QualityOnDemand 1.1.0 interface and what to ask it for.

    Attributes:
        url: everything before `/sessions`.
        devices, qos_profiles, default_qos_profile, duration_s, sink, public_addresses,
            device_by_token: see rules.camara.CamaraSettings.
        wait_s: how long a session may take to become available; 0 does not wait.
    """

    devices: tuple[str, ...]
    qos_profiles: dict[int, str] = msgspec.field(default_factory=dict)
    default_qos_profile: str = ""
    duration_s: int = 3600
    sink: str = ""
    public_addresses: dict[str, str] = msgspec.field(default_factory=dict)
    device_by_token: bool = False
    wait_s: float = 10.0

    def asked(self) -> CamaraSettings:
        """Return what goes into bodies.

        Raises:
            ValueError: a value is not allowed.
        """
        asked: CamaraSettings = self.part(CamaraSettings)
        return asked


class CamaraService:
    """One QualityOnDemand interface, see remote.Service.

    Args:
        settings: see CamaraTargetSettings.
        api: at `settings.url`.
    """

    kind = KIND

    def __init__(self, settings: CamaraTargetSettings, api: Api) -> None:
        self._settings = settings
        self._api = api
        self._expires: dict[str, tuple[float, float]] = {}
        """By key, when a session expires: since the epoch, and on the clock that goes forward."""

    @property
    def scope(self) -> str:
        """URL of the server."""
        return self._api.url

    def asks(self, rules: Sequence[FlowRule]) -> tuple[tuple[RemoteRequest, ...], tuple[str, ...]]:
        """Return one session per flow and device."""
        return asks_of(camara_sessions(rules, self._settings.asked()))

    def create(self, body: Body) -> Made:
        """POST it and wait a little until it is available.

        Raises:
            HttpError: refused, or the network cannot provide it.
        """
        reply = self._api.request("POST", "/sessions", body)
        session = reply.object()
        id_ = session.identifier("sessionId")
        if not id_:
            raise HttpError(
                f"cannot tell what {self._api.url}/sessions has made: its answer has no sessionId",
                status=reply.status,
                uncertain=True,
            )
        try:
            session = self._settled(id_, session)
            if _status(session) != "UNAVAILABLE":
                return self._made(id_, session, body)
            why = _why(session)
            self.delete(id_)
        except HttpError as error:
            error.uncertain = True  # it was made, whatever became of asking for its state
            raise
        raise HttpError(
            f"cannot get this QoS: the network made session {id_} unavailable ({why})",
            status=reply.status,
        )

    def find(self, body: Body) -> Made | None:
        """Look through the device's sessions for one that asks for the same."""
        asked = {"device": body["device"]} if "device" in body else {}
        reply = self._api.request("POST", "/retrieve-sessions", asked, may_be_gone=True)
        for each in reply.objects():
            id_ = each.identifier("sessionId")
            if id_ and not _differs(body, each, missing=True):
                return self._made(id_, each, body)
        return None

    def see(self, id_: str, body: Body) -> Made | None:
        """GET it; one that has ended counts as different, for it has to be deleted first."""
        reply = self._api.request("GET", _path(id_), may_be_gone=True)
        return None if reply.gone else self._made(id_, reply.object(), body)

    def update(self, id_: str, before: Body, body: Body) -> Made:  # noqa: ARG002 - Service
        """Delete and create: a session cannot be changed, and two for one flow are a conflict."""
        self.delete(id_)
        return self.create(body)

    def delete(self, id_: str) -> None:
        """DELETE it."""
        self._api.request("DELETE", _path(id_), may_be_gone=True)

    def prolong(self, entry: Entry, body: Body) -> Made | None:
        """Extend a session that is due; make a new one where it cannot be extended any further."""
        due_s = self.due_in_s(entry)
        if due_s is None or due_s > 0:
            return None
        try:
            reply = self._api.request(
                "POST",
                f"{_path(entry.id)}/extend",
                {"requestedAdditionalDuration": self._settings.duration_s},
                may_be_gone=True,
            )
        except HttpError as error:
            # Not in a state to be extended, or over the profile's limit.
            if error.status not in (400, 409):
                raise
        else:
            if not reply.gone:
                made = self._made(entry.id, reply.object(), body)
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

    def _settled(self, id_: str, session: Fields) -> Fields:
        """Ask until the session is more than requested, for `wait_s`."""
        wait_s = _POLL_S
        deadline_s = self._api.clock.steady_s() + self._settings.wait_s
        while _status(session) == "REQUESTED":
            left_s = deadline_s - self._api.clock.steady_s()
            if left_s <= 0:
                break
            self._api.pause(min(wait_s, left_s))
            wait_s *= 2
            session = self._api.request("GET", _path(id_)).object()
        return session

    def _made(self, id_: str, session: Fields, body: Body) -> Made:
        status = _status(session)
        if status == "UNAVAILABLE":
            return Made(id=id_, differs=f"it ended: {_why(session)}")
        granted = session.whole("duration", 1, _LONGEST_S)
        detail = "requested, not yet available" if status == "REQUESTED" else ""
        if granted is not None and granted < self._settings.duration_s:
            detail = f"granted for {granted} s instead of {self._settings.duration_s} s"
        return Made(
            id=id_,
            expires_s=self._expires_s(session, granted),
            detail=detail,
            differs=_differs(body, session),
        )

    def _expires_s(self, session: Fields, granted_s: int | None) -> float | None:
        """When a session ends, seconds since the epoch; the latest it can, if nothing says when."""
        text = session.text("expiresAt")
        if text:
            when = _parse_time(text)
            if when is None:
                session.refuse("expiresAt", "a date and time with a time zone (RFC 3339)", text)
            return when
        return None if granted_s is None else self._api.clock.now_s() + granted_s


def _path(id_: str) -> str:
    return f"/sessions/{as_segment(id_)}"


def _status(session: Fields) -> str:
    return session.one_of("qosStatus", _STATUSES)


def _why(session: Fields) -> str:
    return text_of(session.text("statusInfo")) or "no reason given"


def _differs(asked: Body, seen: Fields, *, missing: bool = False) -> str:
    """Why what the server shows is not what was asked for; empty if it is."""
    for key in _COMPARED:
        found = seen.values.get(key)
        if (key in seen.values or missing) and found != asked.get(key):
            return f"the server has {key} {show(found)}"
    return ""


def _parse_time(text: str) -> float | None:
    """RFC 3339 as seconds since the epoch; None if it is not, or has no time zone."""
    try:
        # Python 3.10 reads neither Z nor fractions of other than 3 or 6 digits.
        when = dt.datetime.fromisoformat(_plain_fraction(text.upper().replace("Z", "+00:00")))
        return None if when.tzinfo is None else when.timestamp()
    except (ValueError, OverflowError):
        return None


def _plain_fraction(text: str) -> str:
    head, dot, rest = text.partition(".")
    digits = len(rest) - len(rest.lstrip("0123456789"))
    return f"{head}.{rest[:digits][:6]:0<6}{rest[digits:]}" if dot else text


class CamaraOptions(ServerOptions[CamaraTargetSettings]):
    """A QualityOnDemand interface."""

    kind = KIND
    settings_type = CamaraTargetSettings

    @classmethod
    def url(cls, settings: CamaraTargetSettings) -> str:
        """Return what precedes `/sessions`."""
        return settings.url.rstrip("/")

    @classmethod
    def service(cls, settings: CamaraTargetSettings, api: Api) -> CamaraService:
        """Return what asks it."""
        return CamaraService(settings, api)


TARGET = CamaraOptions
