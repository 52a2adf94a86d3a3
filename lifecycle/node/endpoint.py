"""One endpoint of a node: what it is, how code wants it made, where it is now, and its handover.

rclpy's matched events are handled in a group of the framework's: an author's callback that awaits
something must not delay the event of a peer that appeared or left.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import msgspec
from rclpy.event_handler import (
    EventHandler,
    QoSPublisherEventType,
    QoSSubscriptionEventType,
    UnsupportedEventTypeError,
)
from rclpy.publisher import Publisher
from rclpy.task import Future

from lifecycle.errors import LifecycleError, nearest
from lifecycle.manifest.model import EndpointKind
from lifecycle.node.connections import Connection
from lifecycle.node.handlers import Key
from lifecycle.plan.model import PlannedEndpoint

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup
    from rclpy.node import Node
    from rclpy.subscription import Subscription

    from lifecycle.node.gate import DeclaredPublisher
    from lifecycle.node.services import Turns


CLIENTS = frozenset({EndpointKind.SERVICE_CLIENT, EndpointKind.ACTION_CLIENT})


class UnknownEndpointError(LifecycleError, KeyError):
    """Code asked for an endpoint by a name that no interface declares."""


def find_endpoint(spelling: str, declared: Iterable[Key], *, node: str) -> Key:
    """Return the endpoint that `publishers/video` means, or `video` if one kind of `node` has it.

    Raises:
        UnknownEndpointError: it means none, or more than one.
    """
    by_spelling = {kind.spell(name): (kind, name) for kind, name in declared}
    if spelling in by_spelling:
        return by_spelling[spelling]
    named = [each for each, (_, name) in by_spelling.items() if name == spelling]
    if len(named) == 1:
        return by_spelling[named[0]]
    if named:
        raise UnknownEndpointError(
            f"cannot tell which {spelling!r} of {node} is meant",
            hint=f"write {' or '.join(map(repr, named))}",
        )
    hint = "endpoints are declared at configure; ask from on_configure on"
    if by_spelling:
        # A word is nearest to one of its own kind: `vidoe` to `video`, with a kind to all of it.
        words = {name: each for each, (_, name) in by_spelling.items()}
        words |= {each: each for each in by_spelling}
        near = words.get(nearest(spelling, words), "")
        listed = ", ".join(map(repr, by_spelling))
        hint = (f"did you mean {near!r}? " if near else "") + f"declared: {listed}"
    raise UnknownEndpointError(f"cannot find endpoint {spelling!r} of {node}", hint=hint)


def wire_name(entity: Any) -> str:
    """Return an entity's name on the wire, as rcl resolved it; empty if it is unknown."""
    for attribute in ("topic_name", "service_name", "action_name"):
        name = getattr(entity, attribute, None)
        if name is not None:
            return str(name)
    return ""


def count_peers(entity: Publisher | Subscription) -> int:
    """Return how many remote endpoints are matched with a publisher or subscription."""
    if isinstance(entity, Publisher):
        return int(entity.get_subscription_count())
    return int(entity.get_publisher_count())


def watch_matches(
    node: Node,
    entity: Publisher | Subscription,
    group: CallbackGroup,
    changed: Callable[[], None],
) -> Callable[[], None]:
    """Call `changed` each time that peers of an endpoint were matched or unmatched.

    The executor of `node` calls; the endpoint may be on another participant. Returns what ends
    it, before the endpoint is destroyed.
    """
    event = QoSSubscriptionEventType.RCL_SUBSCRIPTION_MATCHED
    if isinstance(entity, Publisher):
        event = QoSPublisherEventType.RCL_PUBLISHER_MATCHED
    try:
        handler = EventHandler(
            callback_group=group,
            callback=lambda _: changed(),
            event_type=event,
            parent_impl=entity.handle,
        )
    except UnsupportedEventTypeError:
        return lambda: None  # an RMW without the event: counts are then read on request
    node.add_waitable(handler)

    def stop() -> None:
        node.remove_waitable(handler)
        handler.destroy()

    return stop


def refuse_unfit(kind: EndpointKind, options: Iterable[str]) -> None:
    """Raise LifecycleError for what endpoints of a kind cannot have."""
    for name in options:
        fitting = _FITTING.get(name, (kind,))
        if kind not in fitting:
            nouns = ", ".join(f"{each.noun}s" for each in fitting)
            raise LifecycleError(f"cannot set {name} of a {kind.noun}; only of {nouns}")


_FITTING = {
    "raw": (EndpointKind.SUBSCRIPTION,),
    "event_callbacks": (EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION),
    "introspection": (EndpointKind.SERVICE_SERVER, EndpointKind.SERVICE_CLIENT),
}


class Placement(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """The rclpy object of an endpoint on one connection.

    Attributes:
        unwatch: ends that its peers or its server are watched; None where they are not.
    """

    connection: Connection
    entity: Any
    unwatch: Callable[[], None] | None = None


class Endpoint(msgspec.Struct, kw_only=True, eq=False):
    """One endpoint and where it is now.

    Attributes:
        planned: as it is declared; without a name if only the code that made it knows of it.
        callback: its handler, where code gave one with the declaration.
        interface: the message, service or action class, once it is imported.
        handler: takes messages, requests or goals; None where the kind has no handler.
        handle: what authors publish by; None for other kinds.
        placement: where it is; None while it is mapped nowhere.
        handover: it is on two connections now; None usually.
        is_late: it was declared after configure, and goes with cleanup.
        error: why it could not be made as asked; empty if it was.
        fault: what its handler raised at the last goal of an action; empty if it returned.
        given_name: fully qualified, given by `remap`; empty for the name that was declared.
        lossy, size_bytes: the author's hints for negotiation; None without one.
        options: how it is made, as far as code says it by `set_options`.
    """

    planned: PlannedEndpoint
    callback: Callable[..., Any] | None = None
    interface: Any = None
    handler: Callable[..., Any] | None = None
    handle: DeclaredPublisher | None = None
    placement: Placement | None = None
    handover: Handover | None = None
    is_late: bool = False
    error: str = ""
    fault: str = ""
    given_name: str = ""
    lossy: bool | None = None
    size_bytes: int | None = None
    options: dict[str, Any] = {}

    @property
    def kind(self) -> EndpointKind:
        """What it is: a publisher, a subscription."""
        return self.planned.kind

    @property
    def name(self) -> str:
        """As declared."""
        return self.planned.name

    @property
    def key(self) -> Key:
        """Kind and declared name."""
        return self.kind, self.name

    @property
    def spelling(self) -> str:
        """`publishers/video`."""
        return self.kind.spell(self.name)

    @property
    def wire_name(self) -> str:
        """Fully qualified name as it is now, or will be once it is mapped."""
        made = "" if self.placement is None else wire_name(self.placement.entity)
        return made or self.given_name or self.planned.resolved

    @property
    def entity(self) -> Any:
        """The rclpy object; None while it is mapped nowhere."""
        return None if self.placement is None else self.placement.entity

    @property
    def connection(self) -> Connection | None:
        """Where it is mapped; None while it is nowhere."""
        return None if self.placement is None else self.placement.connection


def interface_name(interface: type[Any]) -> str:
    """Return `package/msg/Type` of a generated class; raises LifecycleError for another."""
    package, _, rest = interface.__module__.partition(".")
    kind = rest.partition(".")[0]
    if kind not in {"msg", "srv", "action"}:
        raise LifecycleError(
            f"cannot declare an endpoint of type {interface!r}; "
            "give a message, service or action class such as std_msgs.msg.String"
        )
    return f"{package}/{kind}/{interface.__name__}"


SETTLE_S = 0.25
"""The old one lives on after the new one has matched as many peers as it had."""

PATIENCE_S = 4.0
"""Both live at most so long, if the new one never matches as many.

A participant that others have not noticed at once is announced again after 3 s.
"""


class Handover:
    """The time in which an endpoint is on two connections: make before break.

    Both ends of a flow learn of each other at different moments, so a match seen here does not
    prove that the other side has seen it: the old one stays a little longer than that. Meanwhile a
    publisher publishes by the old one, and a subscription receives by both.

    Attributes:
        old: where it is until then.
        done: the old one is destroyed.
    """

    def __init__(
        self, old: Placement, peers_before: int, turns: Turns, finish: Callable[[], None]
    ) -> None:
        self.old = old
        self.done: Future = Future()
        self._peers_before = peers_before
        self._turns = turns
        self._finish = finish
        self._settles = False
        self._call_off = turns.call_after(PATIENCE_S, self.end)

    def peers_changed(self, peers: int) -> None:
        """The new one has so many peers now."""
        if peers >= self._peers_before and not self._settles and not self.done.done():
            self._settles = True
            self._call_off()
            self._call_off = self._turns.call_after(SETTLE_S, self.end)

    def end(self) -> None:
        """Break now; again is harmless."""
        if self.done.done():
            return
        self._call_off()
        self.done.set_result(None)
        self._finish()
