"""Clients that are made for one call, or whose node left, while a call is under way."""

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


def test_a_fresh_client_is_made_for_one_call_and_dropped_with_it_or_with_its_node() -> None:
    async def main() -> None:
        node = _Node()
        observer: Any = types.SimpleNamespace(node=node, owns_node=False)
        calls = ServiceCalls(observer)

        def ask(*, fresh: bool) -> asyncio.Future[Any]:
            return asyncio.ensure_future(
                calls.call(SERVICE, GetState, 5.0, repeat=False, fresh=fresh)
            )

        kept = ask(fresh=False)
        await asyncio.sleep(0.01)
        proving = ask(fresh=True)
        await asyncio.sleep(0.01)
        old, new = node.made
        assert node.destroyed == []
        new.asked[0].set_result("new")
        assert await proving == "new"
        assert node.destroyed == [new]
        old.asked[0].set_result("old")
        assert await kept == "old"
        asking = ask(fresh=True)
        await asyncio.sleep(0.01)
        calls.forget("/base/")
        asking.cancel()
        await asyncio.wait({asking})
        assert sorted(node.destroyed, key=id) == sorted(node.made, key=id)
        assert calls.open(SERVICE, GetState)
        calls.destroy()
        assert sorted(node.destroyed, key=id) == sorted(node.made, key=id)

    asyncio.run(main())
