"""A target that keeps one thing per flow and device at a server: subscriptions, sessions.

What NEF and CAMARA have in common: which ends of a flow are devices of the mobile network, and the
difference between rules and ledger. A request is written down before it is sent, so that what was
made is found again even if the answer was lost.
"""

from __future__ import annotations

import abc
import ipaddress
import json
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple
from urllib.parse import quote

from msgspec.structs import replace

from lifecycle.codec import to_json
from lifecycle.errors import UsageError
from lifecycle.programming.http import Api, IpNetwork, ServerSettings, load_settings
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


class Wanted(NamedTuple):
    """What to ask the network for one flow and one of its ends.

    Attributes:
        key: of the FlowRule, with the direction behind it: unique, and as stable.
        rule: that it is made from.
        body: of the request.
    """

    key: str
    rule: FlowRule
    body: Body


class Made(NamedTuple):
    """One thing as the server has made it.

    Attributes:
        id: what the server calls it.
        expires_s: on the clock of `steady_s`; None if it does not expire.
        detail: for people: "granted for 600 s instead of 3600 s".
    """

    id: str
    expires_s: float | None = None
    detail: str = ""


def steady_s() -> float:
    """Return seconds since the host was started, on a clock that only goes forward."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class ServerTarget(Target):
    """One kind of thing at one server.

    Args:
        settings: path of the settings file, so that a later run can remove what this one leaves.

    Attributes:
        collection: path of all things, "/sessions"; without the slash, what an export calls them.
        settings_type: of its key in the settings file.
    """

    takes = ("config",)
    hint = "give --config FILE"
    collection: ClassVar[str]
    settings_type: ClassVar[type[ServerSettings]]

    def __init__(self, settings: str, means: Means) -> None:
        super().__init__(settings, means)
        path = str(Path(settings).absolute())
        self._server: Any = load_settings(settings, self.kind, self.settings_type)
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
        own = load_settings(record.settings, cls.kind, cls.settings_type)
        scope = "" if own is None else own.scope
        if scope != record.scope:
            raise SettingsError(
                f"cannot remove what is at {record.scope}: settings {record.settings!r} are "
                f"{f'of {scope}' if scope else f'without {record.target}'} now"
            )
        return record.settings

    @classmethod
    def token_variables(cls, settings: str) -> frozenset[str]:
        """Return that of the server, if its token is in one."""
        own = load_settings(settings, cls.kind, cls.settings_type)
        named = own is not None and own.token is not None and own.token.env
        return frozenset([named] if named else ())

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
    async def create(self, body: Body) -> Made:
        """Ask for it.

        Raises:
            HttpError: refused, or the answer is of no use.
        """

    @abc.abstractmethod
    async def look(self, body: Body) -> str:
        """Return the id of one that was asked for and not answered; empty if there is none."""

    async def delete(self, id_: str) -> None:
        """Delete one; that it is gone already is no error."""
        await self._api.request("DELETE", self.path(id_), may_be_gone=True)

    def path(self, id_: str) -> str:
        """Return the path of one thing."""
        return f"{self.collection}/{quote(id_, safe='')}"

    async def plan(self, rules: Sequence[FlowRule]) -> TargetChanges:
        """Compare rules and ledger."""
        wanted, left_out = self._wanted(rules)
        changes = tuple(change for change, _ in self._changes(wanted))
        return TargetChanges(target=self.name, changes=changes, left_out=left_out)

    async def apply(self, rules: Sequence[FlowRule]) -> TargetChanges:
        """Make it so, one flow after the other.

        Raises:
            PartlyError: for some flows it failed; what was to be deleted stays in the ledger.
        """
        wanted, left_out = self._wanted(rules)
        changes = self._changes(wanted)
        done, failed = await each_done(changes, self._make)
        made = TargetChanges(target=self.name, changes=tuple(done), left_out=left_out)
        if failed:
            errors = [(change.key, error) for (change, _), error in failed]
            text = [replace(made, left_out=()).render(done=True)] if made.pending else []
            raise PartlyError(self.name, len(changes), errors, done=text)
        return made

    def _changes(self, wanted: Sequence[Wanted]) -> list[tuple[FlowChange, Body]]:
        """Return what is to be done, with the body that is wanted.

        Deletions come first: what is in the way of something new goes before it.
        """
        keys = {each.key for each in wanted}
        entries = self._entries()
        found: list[tuple[FlowChange, Body]] = [
            (FlowChange(kind=ChangeKind.DELETE, key=each.key, what=each.what), {})
            for each in entries.values()
            if each.key not in keys
        ]
        for each in wanted:
            entry, kind, detail = entries.get(each.key), ChangeKind.UPDATE, ""
            if entry is None or not entry.id:
                kind = ChangeKind.CREATE
                detail = "" if entry is None else "asked for before, and not answered"
            elif entry.expires_s is not None and entry.expires_s <= steady_s():
                detail = "it has expired"
            elif json.loads(entry.body) == each.body:
                kind = ChangeKind.KEEP
            what = f"{each.rule.describe()}, {each.rule.asks}"
            found.append((FlowChange(kind=kind, key=each.key, what=what, detail=detail), each.body))
        return found

    async def _make(self, planned: tuple[FlowChange, Body]) -> FlowChange:
        """Make one change; return it with what came of it.

        What is there is deleted before there is something new: two for one flow may be a conflict.
        """
        change, body = planned
        if change.kind is ChangeKind.KEEP:
            return change
        if (entry := self._entries().get(change.key)) is not None:
            if id_ := entry.id or await self.look(json.loads(entry.body)):
                await self.delete(id_)
            self._note(change.key, None)
        if change.kind is ChangeKind.DELETE:
            return change
        entry = Entry(key=change.key, what=change.what, body=json.dumps(body, sort_keys=True))
        made = await self._create(entry)
        return replace(change, detail=made.detail or change.detail)

    async def _create(self, entry: Entry) -> Made:
        """Ask for what an entry says; it stays, without an id, while it may have been made."""
        self._note(entry.key, entry)
        try:
            made = await self.create(json.loads(entry.body))
        except HttpError as error:
            if not error.uncertain:
                self._note(entry.key, None)
            raise
        self._note(entry.key, replace(entry, id=made.id, expires_s=made.expires_s))
        return made

    def _entries(self) -> dict[str, Entry]:
        """What is ours there, by key."""
        found = self._ledger.find(self._record)
        return {each.key: each for each in found.entries} if found else {}

    def _note(self, key: str, entry: Entry | None) -> None:
        every = {**self._entries(), key: entry}
        entries = tuple(each for each in every.values() if each is not None)
        self._ledger.put(replace(self._record, entries=entries))
