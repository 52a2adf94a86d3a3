"""Clients that are made anew, or whose node left, while a call of theirs is under way."""

from __future__ import annotations

import asyncio
import types
from typing import Any

import pytest

pytest.importorskip("rclpy")

from lifecycle_msgs.srv import GetState
from rclpy.task import Future

from lifecycle.middleware.services.service_calls import ServiceCalls

SERVICE = "/base/get_state"


class _Client:
    def __init__(self, name: str) -> None:
        self.srv_name = name
        self.asked: list[Future] = []

    def service_is_ready(self) -> bool:
        return True

    def call_async(self, request: object) -> Future:
        del request
        self.asked.append(Future())
        return self.asked[-1]

    def remove_pending_request(self, future: Future) -> None:
        del future


class _Node:
    def __init__(self) -> None:
        self.made: list[_Client] = []
        self.destroyed: list[_Client] = []

    def create_client(self, type_: type, name: str, **options: Any) -> _Client:
        del type_, options
        self.made.append(_Client(name))
        return self.made[-1]

    def destroy_client(self, client: _Client) -> None:
        self.destroyed.append(client)


def test_a_call_under_way_keeps_its_client_until_it_is_answered() -> None:
    async def main() -> None:
        node = _Node()
        observer: Any = types.SimpleNamespace(node=node, owns_node=False)
        calls = ServiceCalls(observer)

        async def ask() -> Any:
            request = GetState.Request()
            return await calls.call(SERVICE, GetState, request, timeout_s=5.0, repeat=False)

        first = asyncio.ensure_future(ask())
        await asyncio.sleep(0.01)
        calls.renew(SERVICE, GetState)
        second = asyncio.ensure_future(ask())
        await asyncio.sleep(0.01)
        old, new = node.made
        assert node.destroyed == []
        new.asked[0].set_result("new")
        assert await second == "new"
        old.asked[0].set_result("old")
        assert await first == "old"
        assert node.destroyed == [old]
        calls.renew(SERVICE, GetState)  # nobody waits for it: it goes at once
        assert node.destroyed == [old, new]
        calls.destroy()
        assert node.destroyed == node.made

    asyncio.run(main())


def test_a_client_that_was_replaced_goes_with_its_node() -> None:
    async def main() -> None:
        node = _Node()
        observer: Any = types.SimpleNamespace(node=node, owns_node=False)
        calls = ServiceCalls(observer)
        request = GetState.Request()
        asking = asyncio.ensure_future(
            calls.call(SERVICE, GetState, request, timeout_s=5.0, repeat=False)
        )
        await asyncio.sleep(0.01)
        calls.renew(SERVICE, GetState)
        calls.forget("/base/")
        assert node.destroyed == node.made
        asking.cancel()
        await asyncio.wait({asking})
        assert node.destroyed == node.made

    asyncio.run(main())
