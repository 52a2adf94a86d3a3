"""A target that keeps one thing per flow at a server: subscriptions, sessions.

Owns: the difference between rules, ledger and server, and the order in which it is made up for. A
request is written down before it is sent, so that what was made is found again even if the answer
was lost. What a thing is and how it is asked for is the service's.
"""

from __future__ import annotations

import abc
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import msgspec
from msgspec.structs import replace

from lifecycle.errors import LifecycleError, UsageError
from lifecycle.programming.apply.http import Api, as_segment
from lifecycle.programming.apply.ledger import (
    Entry,
    Ledger,
    TargetRecord,
)
from lifecycle.programming.apply.settings import ServerSettings, load_settings
from lifecycle.programming.apply.target import (
    ChangeKind,
    FlowChange,
    HttpError,
    PartlyError,
    SettingsError,
    TargetChanges,
    deletions,
    describe_rule,
)
from lifecycle.programming.apply.targets.registry import (
    TargetOptions,
    Targets,
    settings_types,
)
from lifecycle.programming.rules.mobile import (
    Body,
    DeviceEnd,
    Requests,
    document,
    requests_of,
)
from lifecycle.programming.rules.rules import FlowRule, RuleSet


class Made(msgspec.Struct, frozen=True, kw_only=True):
    """One thing as the server has it.

    Attributes:
        id: what the server calls it.
        expires_s: seconds since the epoch; None if it does not expire.
        detail: for people: "granted for 600 s instead of 3600 s".
        differs: why it is not what was asked for; empty if it is.
    """

    id: str
    expires_s: float | None = None
    detail: str = ""
    differs: str = ""


_S = TypeVar("_S", bound=ServerSettings)


class RemoteTarget(abc.ABC, Generic[_S]):
    """One kind of thing at one server, see Target.

    Args:
        settings: of the server.
        api: at `settings.scope`.
        ledger: of the system.
        path: of the settings file, so that a later run can remove what this one leaves.

    Attributes:
        kind: name of the target: "nef", "camara".
        collection: path of all things, "/sessions"; without the slash, what an export calls them.
    """

    kind: ClassVar[str]
    collection: ClassVar[str]

    def __init__(self, settings: _S, api: Api, ledger: Ledger, path: str) -> None:
        self._settings = settings
        self._api = api
        self._ledger = ledger
        self._path = path

    @property
    def name(self) -> str:
        """The server."""
        return f"{self.kind} at {self._api.url}"

    @staticmethod
    @abc.abstractmethod
    def body(rule: FlowRule, end: DeviceEnd, settings: _S) -> Body:
        """Return what is asked for one flow and one of its ends that is a device.

        Raises:
            ValueError: it cannot be asked for.
        """

    @classmethod
    def requests(cls, settings: _S, rules: Sequence[FlowRule]) -> Requests:
        """Return one request per flow and device, and each flow that cannot be asked for."""
        return requests_of(rules, settings.devices, lambda rule, end: cls.body(rule, end, settings))

    @abc.abstractmethod
    def create(self, body: Body) -> Made:
        """Ask for it."""

    @abc.abstractmethod
    def find(self, body: Body) -> Made | None:
        """Look for one that was asked for with this body; None if there is none."""

    @abc.abstractmethod
    def see(self, id_: str, body: Body) -> Made | None:
        """Look at one, and compare it with what was asked for; None if it is gone."""

    @abc.abstractmethod
    def update(self, id_: str, before: Body, body: Body) -> Made:
        """Change one; the id may become another."""

    def delete(self, id_: str) -> None:
        """Delete one; that it is gone already is no error."""
        self._api.request("DELETE", self.path(id_), may_be_gone=True)

    def path(self, id_: str) -> str:
        """Return the path of one thing."""
        return f"{self.collection}/{as_segment(id_)}"

    def prolong(self, entry: Entry, body: Body) -> Made | None:  # noqa: ARG002 - what expires has it
        """Prolong one that is due; None if it is not, or never expires."""
        return None

    def due_in_s(self, entry: Entry) -> float | None:  # noqa: ARG002 - likewise
        """Return seconds until it must be prolonged; None if never."""
        return None

    def plan(self, rules: Sequence[FlowRule]) -> TargetChanges:
        """Compare rules, ledger and server; asks the server about each thing of ours."""
        found = self.requests(self._settings, rules)
        wanted = {each.key for each in found.requests}
        entries = self._entries()
        changes = [
            FlowChange(kind=ChangeKind.DELETE, key=each.key, what=each.what)
            for each in entries.values()
            if each.key not in wanted
        ]
        for each in found.requests:
            kind, detail = self._compare(entries.get(each.key), each.body)
            what = describe_rule(each.rule)
            changes.append(FlowChange(kind=kind, key=each.key, what=what, detail=detail))
        return TargetChanges(
            target=self.name, changes=tuple(changes), left_out=tuple(map(str, found.left_out))
        )

    def apply(self, rules: Sequence[FlowRule]) -> TargetChanges:
        """Make it so, one flow after the other.

        Raises:
            PartlyError: for some flows it failed; the others are done.
        """
        found = self.requests(self._settings, rules)
        bodies = {each.key: each.body for each in found.requests}
        return self._carried_out(self.plan(rules), bodies)

    def _carried_out(self, planned: TargetChanges, bodies: Mapping[str, Body]) -> TargetChanges:
        done: list[FlowChange] = []
        errors: list[tuple[str, LifecycleError]] = []
        # Deletions come first in the plan: what is in the way of something new goes before it.
        for change in planned.changes:
            try:
                detail = self._make(change, bodies.get(change.key, {}))
            except LifecycleError as error:  # noqa: PERF203 - the other flows go on
                errors.append((change.key, error))
            else:
                done.append(replace(change, detail=detail or change.detail))
        made = replace(planned, changes=tuple(done))
        if errors:
            text = [replace(made, left_out=()).render(done=True)]
            raise PartlyError(
                self.name, len(planned.changes), errors, done=text if made.pending else ()
            )
        return made

    def dry_run(self, rules: Sequence[FlowRule]) -> str:
        """Return the bodies as JSON, one per flow; asks no server."""
        shown = [
            {"key": each.key, "flow": describe_rule(each.rule), "body": each.body}
            for each in self.requests(self._settings, rules).requests
        ]
        return json.dumps(shown, indent=2, ensure_ascii=False) + "\n"

    def remove(self) -> TargetChanges:
        """Delete everything of ours at the server.

        Raises:
            PartlyError: some could not be deleted; they stay in the ledger.
        """
        entries = [(each.key, each.what) for each in self._entries().values()]
        return self._carried_out(deletions(self.name, entries), {})

    def renew(self) -> float | None:
        """Prolong what is due.

        Raises:
            PartlyError: something could not be prolonged and will expire or has expired.
        """
        errors: list[tuple[str, LifecycleError]] = []
        for entry in self._entries().values():
            if not entry.id:
                continue
            try:
                made = self.prolong(entry, json.loads(entry.body))
            except LifecycleError as error:
                errors.append((entry.key, error))
            else:
                if made is not None:
                    self._note(replace(entry, id=made.id, expires_s=made.expires_s))
        if errors:
            raise PartlyError(self.name, len(self._entries()), errors)
        due = [self.due_in_s(each) for each in self._entries().values()]
        return min((each for each in due if each is not None), default=None)

    def _compare(self, entry: Entry | None, body: Body) -> tuple[ChangeKind, str]:
        if entry is None:
            return ChangeKind.CREATE, ""
        asked: Body = json.loads(entry.body)
        if not entry.id:
            found = self.find(asked)
            if found is None:
                return ChangeKind.CREATE, "asked for before, but never made"
            entry = replace(entry, id=found.id)
            self._note(entry)
        seen = self.see(entry.id, asked)
        if seen is None:
            return ChangeKind.CREATE, "gone from the server"
        if seen.expires_s != entry.expires_s:
            self._note(replace(entry, expires_s=seen.expires_s))
        if asked != body:
            return ChangeKind.UPDATE, ""
        if seen.differs:
            return ChangeKind.UPDATE, seen.differs
        return ChangeKind.KEEP, seen.detail

    def _make(self, change: FlowChange, body: Body) -> str:
        """Make one change; returns what is to be reported of it."""
        entry = self._entries().get(change.key)
        if change.kind is ChangeKind.DELETE:
            assert entry is not None
            self._delete(entry)
        elif change.kind is ChangeKind.UPDATE:
            assert entry is not None
            made = self.update(entry.id, json.loads(entry.body), body)
            self._note(_entry(change, body, made))
            return made.detail
        elif change.kind is ChangeKind.CREATE:
            return self._create(change, body)
        return ""

    def _create(self, change: FlowChange, body: Body) -> str:
        self._note(_entry(change, body, None))
        try:
            made = self.create(body)
        except HttpError as error:
            if not error.uncertain:
                self._forget(change.key)
                raise
            try:
                found = self.find(body)
            except HttpError as second:
                raise error from second
            if found is None:
                # The entry stays pending: the server may still be making it.
                raise
            made = found
        self._note(_entry(change, body, made))
        return made.detail

    def _delete(self, entry: Entry) -> None:
        id_ = entry.id
        if not entry.id:
            found = self.find(json.loads(entry.body))
            id_ = "" if found is None else found.id
        if id_:
            self.delete(id_)
        self._forget(entry.key)

    def _entries(self) -> dict[str, Entry]:
        """What is ours there, by key."""
        record = self._ledger.record(self.kind, self._api.url)
        return {} if record is None else {each.key: each for each in record.entries}

    def _note(self, entry: Entry) -> None:
        self._keep({**self._entries(), entry.key: entry})

    def _forget(self, key: str) -> None:
        self._keep({each: entry for each, entry in self._entries().items() if each != key})

    def _keep(self, entries: Mapping[str, Entry]) -> None:
        scope, every = self._api.url, tuple(entries.values())
        if every:
            record = TargetRecord(target=self.kind, scope=scope, settings=self._path, entries=every)
            self._ledger.put(record)
        else:
            self._ledger.drop(self.kind, scope)


def _entry(change: FlowChange, body: Body, made: Made | None) -> Entry:
    return Entry(
        key=change.key,
        what=change.what,
        id="" if made is None else made.id,
        expires_s=None if made is None else made.expires_s,
        body=json.dumps(body, sort_keys=True),
    )


class ServerOptions(TargetOptions):
    """The options of one server: a settings file, in which its kind is a key.

    Args:
        path: of the file.

    Attributes:
        target: what keeps things there.
    """

    hint = "give --config FILE"
    target: ClassVar[type[RemoteTarget[Any]]]

    def __init__(self, path: str) -> None:
        self._path = path

    @classmethod
    def read(cls, given: Mapping[str, Any]) -> ServerOptions:
        """Take the path."""
        if not given.get("config"):
            raise UsageError(
                f"cannot program {cls.kind} without settings: where it is and who we are",
                hint=cls.hint,
            )
        return cls(given["config"])

    @classmethod
    def restore(cls, record: TargetRecord, means: Targets) -> RemoteTarget[Any]:
        """Return the server of a record, if it is still that of the settings file."""
        own = load_settings(record.settings, settings_types()).get(cls.kind)
        scope = "" if own is None else own.scope
        if scope != record.scope:
            raise SettingsError(
                f"cannot remove what is at {record.scope}: settings {record.settings!r} are "
                f"{f'of {scope}' if scope else f'without {record.target}'} now"
            )
        return cls(record.settings).open(means)

    def open(self, means: Targets) -> RemoteTarget[Any]:
        """Return the server."""
        own = self._own()
        api = Api(
            own.scope,
            token=own.token,
            timeout_s=own.timeout_s,
            ca_file=own.ca_file,
            patience=means.patience,
            clock=means.clock,
            deadline=means.deadline,
        )
        return self.target(own, api, means.ledger, str(Path(self._path).absolute()))

    def export(self, rules: RuleSet, system: str) -> str:  # noqa: ARG002 - TargetOptions
        """Return the bodies as JSON: `{"subscriptions": [{key, flow, asks, body}], …}`."""
        found = self.target.requests(self._own(), rules.rules)
        return document(self.target.collection[1:], found, rules.left_out) + "\n"

    def token_variables(self) -> frozenset[str]:
        """Return those of every server of the file."""
        servers = load_settings(self._path, settings_types()).values()
        return frozenset(each.token.env for each in servers if each.token and each.token.env)

    def _own(self) -> ServerSettings:
        """What the file says of this server."""
        own = load_settings(self._path, settings_types()).get(self.kind)
        if own is None:
            path = str(Path(self._path).absolute())
            raise SettingsError(
                f"cannot program {self.kind}: settings {path!r} have no key {self.kind!r}"
            )
        return own
