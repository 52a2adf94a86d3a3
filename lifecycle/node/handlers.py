"""Decorators that tie a method to a declared endpoint, and the matching of the two.

Every declared subscription, service server and action server has exactly one handler, and every
handler an endpoint.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import msgspec

from lifecycle.errors import LifecycleError, nearest
from lifecycle.manifest.model import EndpointKind
from lifecycle.plan.model import PlannedEndpoint

F = TypeVar("F", bound=Callable[..., Any])

Key = tuple[EndpointKind, str]
"""Kind and declared name: what identifies an endpoint within its node."""

_ATTRIBUTE = "__lifecycle_handlers__"
_DECORATORS = {
    EndpointKind.SUBSCRIPTION: "@on_message",
    EndpointKind.SERVICE_SERVER: "@on_service",
    EndpointKind.ACTION_SERVER: "@on_action",
}


class _Mark(msgspec.Struct, frozen=True, kw_only=True):
    """What a decorator leaves on a function."""

    kind: EndpointKind | None  # None for a timer
    name: str = ""
    period_s: float = 0.0
    decides: bool = False  # on an action's goals, instead of executing them


class ActionHandler(msgspec.Struct, frozen=True, kw_only=True):
    """What an action server gives its goals to; without `accept` it takes all."""

    execute: Callable[..., Any]
    accept: Callable[..., Any] | None = None

    def __call__(self, goal_handle: Any) -> Any:
        """Execute a goal."""
        return self.execute(goal_handle)


def on_message(subscription: str) -> Callable[[F], F]:
    """Let a method receive a declared subscription's messages, only while the node is active.

    It may be `async def`, and may take rclpy's message info as a second argument.

    Args:
        subscription: the name as the manifest declares it, before remapping.

    Example:
        >>> class Viewer(LifecycleNode):
        ...     @on_message("/robot/video")
        ...     def show(self, image):
        ...         self.get_logger().info(f"{len(image.data)} bytes")
    """
    return _marker(_Mark(kind=EndpointKind.SUBSCRIPTION, name=subscription))


def on_service(service: str) -> Callable[[F], F]:
    """Let a method answer a declared service server, from connect until disconnect.

    ROS has no way to refuse a request politely, so a service answers in inactive/connected too;
    a handler that must not is free to look at `self.is_active`. It may be `async def`, and may
    return None when it has filled in `response`.

    Example:
        >>> class Base(LifecycleNode):
        ...     @on_service("reset")
        ...     def reset(self, request, response):
        ...         response.success = True
    """
    return _marker(_Mark(kind=EndpointKind.SERVICE_SERVER, name=service))


def on_action(action: str) -> Callable[[F], F]:
    """Let a method execute the goals of a declared action server.

    Goals are rejected unless the node is active, and by `@on_goal` if there is one. Requests to
    cancel are accepted; the method sees them as `goal_handle.is_cancel_requested`. It says what
    became of the goal by `succeed()`, `abort()` or `canceled()`, and returns the result, or None
    for an empty one. A goal that it leaves undecided is aborted, and so is one whose method raises;
    the traceback is logged.

    Example:
        >>> class Base(LifecycleNode):
        ...     @on_action("dock")
        ...     async def dock(self, goal_handle):
        ...         while goal_handle.is_active and self.distance() > 0.01:
        ...             if goal_handle.is_cancel_requested:
        ...                 goal_handle.canceled()
        ...                 return None
        ...             await self.sleep(0.1)
        ...         if goal_handle.is_active:
        ...             goal_handle.succeed()
        ...         return Dock.Result()

    Write it as `async def` unless it returns at once: a sync one keeps its node, and all nodes of
    its process, from everything else, so that no request to cancel gets through either. Several
    goals are executed at a time.

    When the node leaves the active state, or the action is taken off its connection, its goals are
    aborted, and clients have their answer before on_deactivate or on_shutdown runs. The method goes
    on: it should return once `goal_handle.is_active` is false.
    """
    return _marker(_Mark(kind=EndpointKind.ACTION_SERVER, name=action))


def on_goal(action: str) -> Callable[[F], F]:
    """Let a method decide on the goals of a declared action server; without one all are accepted.

    It is given the goal and returns whether to accept it; only while the node is active. It may be
    `async def`.

    Example:
        >>> class Base(LifecycleNode):
        ...     @on_goal("dock")
        ...     def may_dock(self, goal):
        ...         return goal.station in self.stations
    """
    return _marker(_Mark(kind=EndpointKind.ACTION_SERVER, name=action, decides=True))


def on_timer(*, period_s: float) -> Callable[[F], F]:
    """Call a method every `period_s` seconds (> 0) while the node is active.

    Example:
        >>> class Talker(LifecycleNode):
        ...     @on_timer(period_s=0.1)
        ...     def tick(self):
        ...         self.publisher("chatter").publish(String(data="hello"))
    """
    if not period_s > 0:
        raise LifecycleError(f"cannot call a method every {period_s!r} s; period_s must be > 0")
    return _marker(_Mark(kind=None, period_s=period_s))


def _marker(mark: _Mark) -> Callable[[F], F]:
    def decorate(function: F) -> F:
        setattr(function, _ATTRIBUTE, (*getattr(function, _ATTRIBUTE, ()), mark))
        return function

    return decorate


def _marks(node_class: type) -> list[tuple[str, _Mark]]:
    """Return (method name, mark) of a class; an override inherits what it overrides."""
    found: dict[str, tuple[_Mark, ...]] = {}
    for base in node_class.__mro__:
        for name, value in vars(base).items():
            marks = getattr(value, _ATTRIBUTE, None) if callable(value) else None
            if marks:
                found.setdefault(name, marks)
    return [(name, mark) for name, marks in found.items() for mark in marks]


def needs_handler(kind: EndpointKind) -> bool:
    """Whether endpoints of a kind give something to a method."""
    return kind in _DECORATORS


def match(
    node: object, endpoints: Iterable[PlannedEndpoint], *, name: str
) -> tuple[dict[Key, Callable[..., Any]], list[tuple[Callable[..., Any], float]]]:
    """Pair the decorated methods of a node, called `name`, with the endpoints that need a handler.

    Returns:
        What handles each endpoint; and what is called each so many seconds.

    Raises:
        LifecycleError: with every mistake, and the nearest spelling.
    """
    class_ = type(node).__name__
    wanted = [(each.kind, each.name) for each in endpoints if needs_handler(each.kind)]
    methods: dict[Key, str] = {}
    deciders: dict[Key, str] = {}
    timers: list[tuple[Callable[..., Any], float]] = []
    problems: list[str] = []
    for method, mark in _marks(type(node)):
        if mark.kind is None:
            timers.append((getattr(node, method), mark.period_s))
            continue
        key, taken = (mark.kind, mark.name), deciders if mark.decides else methods
        decorator = "@on_goal" if mark.decides else _DECORATORS[mark.kind]
        if key not in wanted:
            declared = [each for kind, each in wanted if kind is mark.kind]
            problems.append(
                f"cannot use handler {class_}.{method}: {decorator}({mark.name!r}) names no "
                f"{mark.kind.noun} that {name} declares; {alternatives(mark.name, declared)}"
            )
        elif key in taken:
            problems.append(
                f"cannot use both handlers {class_}.{taken[key]} and {class_}.{method}: "
                f"{decorator}({mark.name!r})"
            )
        else:
            taken[key] = method
    problems += [
        f"cannot serve {kind.noun} {each!r} of {name}: no method of {class_} is decorated with "
        f"{_DECORATORS[kind]}({each!r})"
        for kind, each in wanted
        if (kind, each) not in methods
    ]
    if problems:
        raise LifecycleError("\n".join(problems))
    handlers = {key: getattr(node, method) for key, method in methods.items()}
    for key, method in deciders.items():
        handlers[key] = ActionHandler(execute=handlers[key], accept=getattr(node, method))
    return handlers, timers


def alternatives(name: str, declared: Iterable[str]) -> str:
    """Return "did you mean 'x'? declared: …", the end of a message about an unknown `name`."""
    names = list(declared)
    near = nearest(name, names)
    listed = ", ".join(repr(each) for each in names) or "none"
    return (f"did you mean {near!r}? " if near else "") + f"declared: {listed}"
