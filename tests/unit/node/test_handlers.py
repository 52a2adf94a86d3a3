"""Handlers and endpoints are matched one to one, and every mismatch is told at once."""

from __future__ import annotations

import pytest

from lifecycle.errors import LifecycleError
from lifecycle.manifest.model import EndpointKind
from lifecycle.node.handlers import (
    match,
    on_action,
    on_message,
    on_service,
    on_timer,
)
from tests.builders import planned_endpoint

SCAN = planned_endpoint(EndpointKind.SUBSCRIPTION, "scan")
RESET = planned_endpoint(EndpointKind.SERVICE_SERVER, "reset")
DOCK = planned_endpoint(EndpointKind.ACTION_SERVER, "dock")
VIDEO = planned_endpoint(EndpointKind.PUBLISHER, "video")


class Base:
    @on_message("scan")
    def see(self, message: object) -> None: ...

    @on_service("reset")
    def reset(self, request: object, response: object) -> None: ...

    @on_action("dock")
    def dock(self, goal: object) -> None: ...

    @on_timer(period_s=0.5)
    def tick(self) -> None: ...


def test_an_override_without_the_decorator_still_handles() -> None:
    class Special(Base):
        def see(self, message: object) -> None: ...

    node = Special()
    handlers, timers = match(node, [SCAN, RESET, DOCK], name="/base")
    assert handlers[SCAN.kind, "scan"] == node.see
    assert timers == [(node.tick, 0.5)]


def test_one_method_may_handle_two_subscriptions() -> None:
    class Both:
        @on_message("front")
        @on_message("rear")
        def see(self, message: object) -> None: ...

    front = planned_endpoint(EndpointKind.SUBSCRIPTION, "front")
    rear = planned_endpoint(EndpointKind.SUBSCRIPTION, "rear")
    node = Both()
    handlers, _ = match(node, [front, rear], name="/both")
    assert [handlers[each.kind, each.name] for each in (front, rear)] == [node.see, node.see]


def test_a_handler_of_another_kind_does_not_count() -> None:
    class Wrong:
        @on_service("scan")
        def see(self, request: object, response: object) -> None: ...

    with pytest.raises(LifecycleError) as error:
        match(Wrong(), [SCAN], name="/base")
    assert str(error.value).splitlines() == [
        (
            "cannot use handler Wrong.see: @on_service('scan') names no service server that /base "
            "declares; declared: none"
        ),
        (
            "cannot serve subscription 'scan' of /base: no method of Wrong is decorated with "
            "@on_message('scan')"
        ),
    ]


def test_two_handlers_for_one_subscription_are_an_error() -> None:
    class Twice:
        @on_message("scan")
        def first(self, message: object) -> None: ...

        @on_message("scan")
        def second(self, message: object) -> None: ...

    with pytest.raises(LifecycleError) as error:
        match(Twice(), [SCAN], name="/base")
    assert str(error.value) == (
        "cannot use both handlers Twice.first and Twice.second: @on_message('scan')"
    )


@pytest.mark.parametrize("period_s", [0, -1.0, float("nan")])
def test_a_timer_needs_a_positive_period(period_s: float) -> None:
    with pytest.raises(LifecycleError) as error:
        on_timer(period_s=period_s)
    assert str(error.value) == f"cannot call a method every {period_s!r} s; period_s must be > 0"
