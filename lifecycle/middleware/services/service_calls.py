"""Call ROS services from asyncio, with a deadline and retries.

Owns: one executor thread on the observer's node where that is its own, the bridge from rclpy's
futures to asyncio's, and the rule for requests that stay unanswered: rmw_fastrtps drops a reply
when the client's reader is not matched yet, so what may be repeated is repeated until its deadline.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Awaitable, Callable
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.client import Client
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, ShutdownException, SingleThreadedExecutor
from rclpy.task import Future

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.rcl.graph import GraphObserver

_FIRST_ATTEMPT_S = 0.1
"""So long a server of rmw_fastrtps waits for the client's reader before it drops its reply."""
_LONGEST_ATTEMPT_S = 2.0
_MATCH_CHECK_S = 0.02
"""No event reports a match, which follows a moment after discovery shows the service."""
_UNMATCHED_S = 0.5
"""So long a service that is in the graph may keep its client unmatched before it is asked anyway:
rmw_fastrtps calls a client ready only while all servers of the name are matched
(rmw_service_server_is_available.cpp), and one that cannot be would hide the one that answers."""


class ServiceUnansweredError(MiddlewareError):
    """A service was not there or, if `found`, did not answer before the deadline."""

    def __init__(self, service: str, *, found: bool, timeout_s: float) -> None:
        what = "it did not answer" if found else "nobody offers it"
        super().__init__(f"cannot call service {service!r}: {what} within {timeout_s:g} s")
        self.found = found


class ServiceCalls:
    """Calls services on the observer's node, from one asyncio loop; `destroy` it first.

    Attributes:
        group: reentrant, for all that is made on the node: on a node that others spin, replies must
            come while one of its callbacks waits.
    """

    def __init__(self, observer: GraphObserver) -> None:
        self._observer = observer
        self._clients: dict[tuple[str, type[Any]], Client] = {}
        self.group = ReentrantCallbackGroup()
        self._destroyed = False
        self._executor: SingleThreadedExecutor | None = None
        if observer.owns_node:
            # Never EventsExecutor: on Jazzy's wheels it spins at full load and loses every call.
            self._executor = SingleThreadedExecutor(context=observer.node.context)
            self._executor.add_node(observer.node)
            self._thread = threading.Thread(target=self._spin, name="service-calls", daemon=True)
            self._thread.start()

    async def call(
        self,
        service: str,
        type_: type[Any],
        timeout_s: float,
        *,
        repeat: bool = True,
        before: Callable[[], Awaitable[None]] | None = None,
        **fields: Any,
    ) -> Any:
        """Wait for `service`, send a request of these fields, and return the response.

        Args:
            service: fully qualified name.
            type_: service class.
            timeout_s: seconds, > 0, for all of it.
            repeat: the request does no harm when it arrives twice.
            before: awaited when the first request is about to leave; what it raises keeps it back.
            fields: of the request.

        Raises:
            ServiceUnansweredError: at the deadline, or as soon as the service is forgotten once the
                request was sent.
        """
        deadline = asyncio.get_running_loop().time() + timeout_s
        try:
            client = await self._usable(service, type_, deadline)
            if client is None:
                raise ServiceUnansweredError(service, found=False, timeout_s=timeout_s)
            if before is not None:
                await before()
            attempt_s = _FIRST_ATTEMPT_S if repeat else timeout_s
            answered = await _ask(client, type_.Request(**fields), deadline, attempt_s)
        except InvalidHandle as error:
            # Its node left, and its client was destroyed meanwhile.
            raise ServiceUnansweredError(service, found=False, timeout_s=timeout_s) from error
        if answered is None:
            raise ServiceUnansweredError(service, found=True, timeout_s=timeout_s)
        return answered.result()

    def forget(self, prefix: str) -> None:
        """Drop the clients of services whose name starts with `prefix`, of a node that left."""
        for key in [key for key in self._clients if key[0].startswith(prefix)]:
            self._observer.node.destroy_client(self._clients.pop(key))

    def destroy(self) -> None:
        """Stop the thread and drop the clients; again is harmless."""
        self._destroyed = True
        if self._executor is not None:
            self._executor.shutdown()
            self._thread.join()
        self.forget("")

    def _spin(self) -> None:
        assert self._executor is not None
        with contextlib.suppress(ExternalShutdownException, ShutdownException):
            while not self._destroyed:
                # Another thread may destroy something of the node while it is put in a wait set.
                with contextlib.suppress(InvalidHandle):
                    self._executor.spin()
                    return

    def _client(self, service: str, type_: type[Any]) -> Client:
        client = self._clients.get((service, type_))
        if client is None:
            client = self._observer.node.create_client(type_, service, callback_group=self.group)
            self._clients[service, type_] = client
        return client

    async def _usable(self, service: str, type_: type[Any], deadline: float) -> Client | None:
        """Return a client matched with all servers, or long enough with some; None if none came.

        A server of an ended process does not count, although discovery shows it until its lease
        ends: a request to it is lost.
        """
        loop = asyncio.get_running_loop()
        offered_s: float | None = None
        while True:
            # Made anew where the node has left, and comes again, meanwhile.
            client, now_s = self._client(service, type_), loop.time()
            if not self._observer.serves(service):
                offered_s = None
            elif client.service_is_ready():
                break
            elif offered_s is None:
                offered_s = now_s
            is_late = now_s >= deadline
            if offered_s is not None and (is_late or now_s - offered_s >= _UNMATCHED_S):
                break
            if is_late or self._destroyed:
                return None
            await asyncio.sleep(min(_MATCH_CHECK_S, deadline - now_s))
        return client


async def _ask(client: Client, request: object, deadline: float, attempt_s: float) -> Future | None:
    """Send a request, again after each attempt, ever longer; None if no answer came in time."""
    loop = asyncio.get_running_loop()
    answered = asyncio.Event()
    waiting = asyncio.ensure_future(answered.wait())
    sent: list[Future] = []

    def notify(_: Future) -> None:
        with contextlib.suppress(RuntimeError):  # the loop was closed meanwhile
            loop.call_soon_threadsafe(answered.set)

    try:
        while (left_s := deadline - loop.time()) > 0:
            sent.append(client.call_async(request))
            sent[-1].add_done_callback(notify)
            await asyncio.wait((waiting,), timeout=min(attempt_s, left_s))
            if answered.is_set():
                return next(each for each in sent if each.done())
            attempt_s = min(2 * attempt_s, _LONGEST_ATTEMPT_S)
        return None
    finally:
        waiting.cancel()
        for pending in sent:
            client.remove_pending_request(pending)
