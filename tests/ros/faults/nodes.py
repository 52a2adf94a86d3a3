"""Nodes of the fault suite: healthy ones, and each kind of broken one.

Every callback appends one line, `<node> <callback>`, to the file named by FAULT_MARKERS before it
does anything else, so that a test can tell afterwards what really ran. A node's parameter
`misbehave` names the callback and the way, as in `connect:raise`; what cannot be chosen by a
parameter (construction, handlers) is a class of its own.
"""

from __future__ import annotations

import os
import signal
import threading

from std_msgs.msg import Int32, String
from std_srvs.srv import Trigger

from lifecycle import ERROR, FAILURE, LifecycleNode, on_message, on_service


def mark(node: str, callback: str) -> None:
    """Append a marker line; O_APPEND keeps lines of several processes whole."""
    descriptor = os.open(os.environ["FAULT_MARKERS"], os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    try:
        os.write(descriptor, f"{node} {callback}\n".encode())
    finally:
        os.close(descriptor)


def hang() -> None:
    threading.Event().wait()


class Marked(LifecycleNode):
    """Marks every callback and misbehaves where its parameter says so."""

    def on_configure(self, state):
        return self._step("configure")

    def on_connect(self, state):
        return self._step("connect")

    def on_activate(self, state):
        return self._step("activate")

    def on_deactivate(self, state):
        return self._step("deactivate")

    def on_cleanup(self, state):
        return self._step("cleanup")

    def _step(self, callback: str):
        mark(self.get_name(), callback)
        step, _, way = self.get_parameter("misbehave").value.partition(":")
        return self._misbehave(way) if step == callback else None

    def _misbehave(self, way: str):
        match way:
            case "raise":
                raise RuntimeError("the sensor is on fire")
            case "failure":
                return FAILURE
            case "error":
                return ERROR
            case "nonsense":
                return "done"
            case "exit":
                os._exit(9)
            case "kill":
                os.kill(os.getpid(), signal.SIGKILL)
            case "hang":
                hang()
            case "publisher":
                self.create_publisher(Int32, "/undeclared_out", 1)
            case "subscription":
                self.create_subscription(Int32, "/undeclared_in", lambda _: None, 1)
            case _:
                raise AssertionError(f"no such misbehaviour: {way!r}")
        return None


class Talker(Marked):
    """Publishes once active; `misbehave: active:kill` dies of it."""

    def on_configure(self, state):
        self.create_timer(0.02, self._tick)
        self._ticks = 0
        return super().on_configure(state)

    def _tick(self) -> None:
        self.publisher("chatter").publish(String(data="hello"))
        self._ticks += 1
        if self._ticks == 5:
            self._step("active")


class Listener(Marked):
    @on_message("chatter")
    def hear(self, message: String) -> None:
        mark(self.get_name(), "message")

    @on_service("~/ping")
    def ping(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = True
        return response


class WithoutHandler(Marked):
    """Declares a subscription in the manifest but handles nothing."""

    @on_service("~/ping")
    def ping(self, request: Trigger.Request, response: Trigger.Response) -> None: ...


class WithMisspeltHandler(Marked):
    @on_message("chater")
    def hear(self, message: String) -> None: ...

    @on_service("~/ping")
    def ping(self, request: Trigger.Request, response: Trigger.Response) -> None: ...


class RaisesInConstructor(Talker):
    def __init__(self) -> None:
        mark("talker", "construct")
        raise RuntimeError("no such serial port")


class DiesInConstructor(Talker):
    def __init__(self) -> None:
        mark("talker", "construct")
        os._exit(9)


class HangsInConstructor(Talker):
    def __init__(self) -> None:
        mark("talker", "construct")
        hang()


class HangsAsync(Talker):
    """Awaits for ever in the callback that `misbehave` names."""

    async def on_configure(self, state):
        super().on_configure(state)
        await self._maybe_for_ever("configure")

    async def on_activate(self, state):
        super().on_activate(state)
        await self._maybe_for_ever("activate")

    def _misbehave(self, way: str):
        return None

    async def _maybe_for_ever(self, callback: str) -> None:
        if self.get_parameter("misbehave").value == f"{callback}:await":
            from rclpy.task import Future

            await Future()


class NotALifecycleNode:
    """Anything but a node."""
