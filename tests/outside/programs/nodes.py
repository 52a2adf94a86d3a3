"""Nodes of the systems that are tried. Each notes what it does and receives in `$OUTSIDE/marks`."""

from __future__ import annotations

import os
import time
from pathlib import Path

from std_msgs.msg import String
from std_srvs.srv import Trigger

from lifecycle import LifecycleNode, on_message, on_service, on_timer


def mark(node: str, what: str) -> None:
    """Append one line; several processes do so at once."""
    path = Path(os.environ["OUTSIDE"], "marks")
    descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        os.write(descriptor, f"{time.time():.3f} {node} {what}\n".encode())
    finally:
        os.close(descriptor)


class Marked(LifecycleNode):
    """Notes that it was activated and deactivated."""

    def on_activate(self) -> None:
        mark(self.get_name(), "activated")

    def on_deactivate(self) -> None:
        mark(self.get_name(), "deactivated")


class Talker(Marked):
    """Publishes `hello` on `chatter` ten times a second."""

    @on_timer(period_s=0.1)
    def speak(self) -> None:
        self.publisher("chatter").publish(String(data="hello"))


class Listener(Marked):
    """Notes each message of `chatter`."""

    @on_message("chatter")
    def receive(self, message: String) -> None:
        mark(self.get_name(), f"received {message.data}")


class Server(Marked):
    """Serves `/reset`, and answers `real`."""

    @on_service("/reset")
    def reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        del request
        response.success, response.message = True, "real"
        return response


class Client(Marked):
    """Calls `/reset` four times a second and notes each answer."""

    @on_timer(period_s=0.25)
    async def ask(self) -> None:
        answer = await self.client("/reset").call_async(Trigger.Request())
        mark(self.get_name(), f"received {answer.message}")
