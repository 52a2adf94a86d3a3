"""A target that keeps one thing per flow and device at a server: subscriptions, sessions.

What NEF and CAMARA have in common: which ends of a flow are devices of the mobile network, and the
difference between rules, ledger and server. A request is written down before it is sent, so that
what was made is found again even if the answer was lost.
"""

from __future__ import annotations

import abc
import ipaddress
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple
from urllib.parse import quote

import msgspec
from msgspec import to_builtins
from msgspec.structs import replace

from lifecycle.codec import to_json
from lifecycle.errors import UsageError
from lifecycle.programming.http import Api, IpNetwork, ServerSettings, load_settings, text_of
from lifecycle.programming.ledger import Entry, TargetRecord
from lifecycle.programming.rules import FlowRule, RuleSet, expressed
from lifecycle.programming.target import (
    ChangeKind,
    FlowChange,
    HttpError,
    Means,
    PartlyError,
    SettingsError,
    Target,
    TargetChanges,
    each_done,
)

Body = dict[str, Any]
"""Of a request, JSON-able."""


class DeviceEnd(NamedTuple):
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


def device_ends(rule: FlowRule, networks: Sequence[IpNetwork]) -> tuple[DeviceEnd, ...]:
    """Return the ends of a flow that are devices: one or both.

    Raises:
        ValueError: none is, or an end that has to be known is not.
    """
    if ipaddress.ip_address(rule.destination_address).is_loopback:
        raise ValueError("it never leaves its machine")
    if not rule.source_address:
        raise ValueError(
            "the address it is sent from is not known; give its machine an address in the manifest"
        )
    source = (rule.source_address, rule.source_port)
    destination = (rule.destination_address, rule.destination_port)
    ends = (DeviceEnd(False, *destination, *source), DeviceEnd(True, *source, *destination))
    found = tuple(
        end for end in ends if any(ipaddress.ip_address(end.device) in each for each in networks)
    )
    if not found:
        text = ", ".join(map(str, networks))
        raise ValueError(f"neither end is a device of the mobile network ({text})")
    return found


def class_name(rule: FlowRule, names: Mapping[int, str], *, setting: str) -> str:
    """Return what the operator calls the class that a flow asks for.

    Raises:
        ValueError: there is no name.
    """
    if rule.five_qi is None:
        raise ValueError(f"it asks for no 5QI ({rule.asks})")
    if rule.five_qi not in names:
        raise ValueError(
            f"the operator's name for 5QI {rule.five_qi} is not known; add it to {setting}"
        )
    return names[rule.five_qi]


class Wanted(msgspec.Struct, frozen=True, kw_only=True):
    """What to ask the network for one flow and one of its ends.

    Attributes:
        key: of the FlowRule, with the direction behind it: unique, and as stable.
        rule: that it is made from.
    """

    key: str
    rule: FlowRule
    body: Body


class Made(msgspec.Struct, frozen=True, kw_only=True):
    """One thing as the server has it.

    Attributes:
        id: what the server calls it.
        expires_s: on the clock of Patience.steady_s; None if it does not expire.
        detail: for people: "granted for 600 s instead of 3600 s".
        differs: why it is not what was asked for; empty if it is.
    """

    id: str
    expires_s: float | None = None
    detail: str = ""
    differs: str = ""


class ServerTarget(Target):
    """One kind of thing at one server.

    Args:
        settings: path of the settings file, so that a later run can remove what this one leaves.

    Attributes:
        collection: path of all things, "/sessions"; without the slash, what an export calls them.
    """

    hint = "give --config FILE"
    collection: ClassVar[str]
    settings_type: ClassVar[type[ServerSettings]]

    def __init__(self, settings: str, means: Means) -> None:
        super().__init__(settings, means)
        path = str(Path(settings).absolute())
        self._server: Any = load_settings(settings).get(self.kind)
        if self._server is None:
            raise SettingsError(
                f"cannot program {self.kind}: settings {path!r} have no key {self.kind!r}"
            )
        self._api = Api(self._server, means)
        self._record = TargetRecord(target=self.kind, scope=self._api.url, settings=path)
        self.name = f"{self.kind} at {self._api.url}"

    @classmethod
    def read(cls, given: Mapping[str, Any]) -> str:
        """Take the path of the settings file, in which the kind of the server is a key."""
        if not given.get("config"):
            raise UsageError(
                f"cannot program {cls.kind} without settings: where it is and who we are",
                hint=cls.hint,
            )
        return str(given["config"])

    @classmethod
    def restore(cls, record: TargetRecord) -> str:
        """Return the settings file of a record, if it is still of the same server."""
        own = load_settings(record.settings).get(cls.kind)
        scope = "" if own is None else own.scope
        if scope != record.scope:
            raise SettingsError(
                f"cannot remove what is at {record.scope}: settings {record.settings!r} are "
                f"{f'of {scope}' if scope else f'without {record.target}'} now"
            )
        return record.settings

    @classmethod
    def token_variables(cls, settings: str) -> frozenset[str]:
        """Return those of every server of the file."""
        servers = load_settings(settings).values()
        return frozenset(each.token.env for each in servers if each.token and each.token.env)

    def export(self, rules: RuleSet) -> str:
        """Return the bodies as JSON: `{"subscriptions": [{key, flow, asks, body}], …}`."""
        wanted, left_out = self._wanted(rules.rules)
        requests = [
            {
                "key": each.key,
                "flow": each.rule.describe(),
                "asks": each.rule.asks,
                "body": each.body,
            }
            for each in wanted
        ]
        left = [*rules.left_out, *left_out]
        return to_json({self.collection[1:]: requests, "left_out": left}).decode() + "\n"

    def _wanted(self, rules: Iterable[FlowRule]) -> tuple[tuple[Wanted, ...], tuple[str, ...]]:
        """Return one request per flow and device, and the flows that none can be made for."""

        def make(rule: FlowRule) -> list[Wanted]:
            return [
                Wanted(
                    key=f"{rule.key} {'from' if end.sends else 'to'} device",
                    rule=rule,
                    body=self.body(rule, end),
                )
                for end in device_ends(rule, self._server.networks)
            ]

        made, left_out = expressed(rules, make)
        return tuple(each for _, of in made for each in of), left_out

    @abc.abstractmethod
    def body(self, rule: FlowRule, end: DeviceEnd) -> Body:
        """Return what is asked for one flow and one of its ends that is a device.

        Raises:
            ValueError: it cannot be asked for.
        """

    @abc.abstractmethod
    def create(self, body: Body) -> Made:
        """Ask for it."""

    @abc.abstractmethod
    def look(self, id_: str, body: Body) -> Made | None:
        """Look at one, and compare it with what was asked for; None if there is none.

        Args:
            id_: what the server calls it; empty looks for one that is just as asked for.
            body: that was asked for.
        """

    def update(self, id_: str, before: Body, body: Body) -> Made:  # noqa: ARG002 - may be compared
        """Change one; here by a new one, after the old, as two for one flow may be a conflict."""
        self.delete(id_)
        return self.create(body)

    def delete(self, id_: str) -> None:
        """Delete one; that it is gone already is no error."""
        self._api.request("DELETE", self.path(id_), may_be_gone=True)

    def path(self, id_: str) -> str:
        """Return the path of one thing."""
        return f"{self.collection}/{quote(id_, safe='')}"

    def plan(self, rules: Sequence[FlowRule]) -> TargetChanges:
        """Compare rules, ledger and server; asks the server about each thing of ours."""
        wanted, left_out = self._wanted(rules)
        changes = tuple(change for change, _ in self._changes(wanted))
        return TargetChanges(target=self.name, changes=changes, left_out=left_out)

    def apply(self, rules: Sequence[FlowRule]) -> TargetChanges:
        """Make it so, one flow after the other.

        Raises:
            PartlyError: for some flows it failed; what was to be deleted stays in the ledger.
        """
        wanted, left_out = self._wanted(rules)
        planned = tuple(self._changes(wanted))  # all of it first: an error here changes nothing
        done, failed = each_done(planned, self._make)
        made = TargetChanges(target=self.name, changes=tuple(done))
        if failed:
            errors = [(change.key, error) for (change, _), error in failed]
            text = [made.render(done=True)] if made.pending else []
            raise PartlyError(self.name, len(planned), errors, done=text)
        return replace(made, left_out=left_out)

    def _changes(self, wanted: Sequence[Wanted]) -> Iterator[tuple[FlowChange, Body]]:
        """Yield what is to be done, with the body that is wanted."""
        keys = {each.key for each in wanted}
        entries = self._entries()
        # Deletions come first: what is in the way of something new goes before it.
        for entry in entries.values():
            if entry.key not in keys:
                yield FlowChange(kind=ChangeKind.DELETE, key=entry.key, what=entry.what), {}
        for each in wanted:
            kind, detail = self._compare(entries.get(each.key), each.body)
            what = f"{each.rule.describe()}, {each.rule.asks}"
            yield FlowChange(kind=kind, key=each.key, what=what, detail=detail), each.body

    def _compare(self, entry: Entry | None, body: Body) -> tuple[ChangeKind, str]:
        if entry is None:
            return ChangeKind.CREATE, ""
        asked: Body = json.loads(entry.body)
        seen = self.look(entry.id, asked)
        if seen is None:
            gone = "gone from the server" if entry.id else "asked for before, but never made"
            return ChangeKind.CREATE, gone
        if not entry.id or (seen.expires_s or math.inf) < (entry.expires_s or math.inf) - 1:
            self._note(entry.key, replace(entry, id=seen.id, expires_s=seen.expires_s))
        if asked != body:
            return ChangeKind.UPDATE, ""
        if seen.differs:
            return ChangeKind.UPDATE, seen.differs
        return ChangeKind.KEEP, seen.detail

    def _make(self, planned: tuple[FlowChange, Body]) -> FlowChange:
        """Make one change; return it with what came of it."""
        change, body = planned
        if change.kind is ChangeKind.KEEP:
            return change
        if change.kind is ChangeKind.CREATE:
            made = self._create(change, body)
            return replace(change, detail=made.detail or change.detail)
        entry = self._entries()[change.key]
        asked = json.loads(entry.body)
        if change.kind is ChangeKind.UPDATE:
            made = self.update(entry.id, asked, body)
            self._note(change.key, _entry(change, body, made))
            return replace(change, detail=made.detail or change.detail)
        found = Made(id=entry.id) if entry.id else self.look("", asked)
        if found is not None:
            self.delete(found.id)
        self._note(change.key, None)
        return change

    def _create(self, change: FlowChange, body: Body) -> Made:
        self._note(change.key, _entry(change, body, None))
        made: Made | None = None
        try:
            made = self.create(body)
        except HttpError as error:
            if not error.uncertain:
                self._note(change.key, None)
                raise
            try:
                made = self.look("", body)
            except HttpError as second:
                raise error from second
            if made is None:
                # The entry stays pending: the server may still be making it.
                raise
        self._note(change.key, _entry(change, body, made))
        return made

    def _entries(self) -> dict[str, Entry]:
        """What is ours there, by key."""
        found = self._ledger.find(self._record)
        return {each.key: each for each in found.entries} if found else {}

    def _note(self, key: str, entry: Entry | None) -> None:
        every = {**self._entries(), key: entry}
        entries = tuple(each for each in every.values() if each is not None)
        self._ledger.put(replace(self._record, entries=entries))


def differs(
    asked: Mapping[str, Any], seen: msgspec.Struct, keys: Iterable[str], *, missing: bool = False
) -> str:
    """Return why what a server shows is not what was asked for; empty if it is.

    Args:
        asked: our body.
        seen: the server's, which leaves out what is not shown; it may add to ours.
        keys: that are compared.
        missing: something that the server does not show differs too.
    """
    shown = to_builtins(seen)
    for key in keys:
        if (missing or key in shown) and shown.get(key) != asked.get(key):
            return f"the server has {key} {text_of(str(shown.get(key)))!r}"
    return ""


def _entry(change: FlowChange, body: Body, made: Made | None) -> Entry:
    return Entry(
        key=change.key,
        what=change.what,
        id="" if made is None else made.id,
        expires_s=None if made is None else made.expires_s,
        body=json.dumps(body, sort_keys=True),
    )
