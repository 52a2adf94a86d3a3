"""Node classes of the supervisor's tests: a healthy pair, and one that misbehaves as told.

The environment variable of the process, MISBEHAVE=step:way, names the callback and the way.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import subprocess
import threading
import time
from pathlib import Path

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node
from std_msgs.msg import String

from lifecycle import LifecycleNode, on_message
from lifecycle.errors import LifecycleError


def misbehave(step: str) -> None:
    wanted, _, way = os.environ.get("MISBEHAVE", "").partition(":")
    if step != wanted:
        return
    print(f"about to {way} in {step}", flush=True)
    if way == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if way == "kill-with-participant":
        context = rclpy.Context()
        context.init(args=[])
        rclpy.create_node("short_lived", context=context)
        os.kill(os.getpid(), signal.SIGKILL)
    if way == "exit":
        os._exit(9)
    if way == "hang":
        threading.Event().wait()
    if way == "raise":
        raise RuntimeError("the sensor is on fire")
    if way == "unmark" and Path(os.environ.get("MISBEHAVE_IF", "/")).exists():
        # Other code of the process, a library of sockets, say.
        for number in [int(each.name) for each in Path("/proc/self/fd").iterdir()]:
            with contextlib.suppress(OSError), socket.socket(fileno=os.dup(number)) as each:
                each.setsockopt(socket.IPPROTO_IP, socket.IP_TOS, 0)
    if way == "wait":
        # Until a test says so, and bounded; its transition's limit is longer.
        end = time.monotonic() + 4.0
        while not Path(os.environ["MISBEHAVE_IF"]).exists() and time.monotonic() < end:
            time.sleep(0.1)
    if way == "fork":
        # A grandchild in a session of its own that outlives whoever made it.
        subprocess.Popen(["sleep", "300"], start_new_session=True)


class Talker(LifecycleNode):
    def __init__(self) -> None:
        misbehave("construct")
        super().__init__()

    def on_configure(self, state):
        self.create_timer(0.02, self._tick)
        misbehave("configure")

    def on_connect(self, state):
        misbehave("connect")

    def on_activate(self, state):
        misbehave("activate")

    def on_deactivate(self, state):
        misbehave("deactivate")

    def _tick(self) -> None:
        misbehave("active")
        self.publisher("chatter").publish(String(data="hello"))


class Numbered(Talker):
    """Says which process it is."""

    def _tick(self) -> None:
        self.publisher("chatter").publish(String(data=f"pid {os.getpid()}"))


class Counting(Talker):
    """Sends another message each time."""

    _count = 0

    def _tick(self) -> None:
        self._count += 1
        self.publisher("chatter").publish(String(data=str(self._count)))


class Stillborn(Talker):
    """Is killed once before it has started, when others have discovered its endpoints."""

    def __init__(self) -> None:
        super().__init__()
        file = Path(os.environ["MISBEHAVE_IF"])
        if file.exists():
            file.unlink()
            time.sleep(0.1)
            os.kill(os.getpid(), signal.SIGKILL)


class Moody(Talker):
    """Is well while the file MOOD is there, once it is active."""

    def health(self):
        if self.is_active and not Path(os.environ["MOOD"]).exists():
            return "in a mood"
        return None


class Diagnosed(Talker):
    """Publishes what it is on /diagnostics: an error while the file MOOD is not there."""

    def _tick(self) -> None:
        well = Path(os.environ["MOOD"]).exists()
        status = DiagnosticStatus(
            name="talker: mood",
            level=DiagnosticStatus.OK if well else DiagnosticStatus.ERROR,
            message="well" if well else "in a mood",
        )
        self.publisher("diagnostics").publish(DiagnosticArray(status=[status]))


class Chatty(Talker):
    """Prints a megabyte a second, says how it is taken down, and has a child that nothing ends."""

    _child: subprocess.Popen[bytes] | None = None

    def on_configure(self, state):
        super().on_configure(state)
        if self._child is None:
            stubborn = "trap '' INT TERM HUP; sleep 300 & while :; do wait; sleep 1; done"
            self._child = subprocess.Popen(["sh", "-c", stubborn], start_new_session=True)

    def on_deactivate(self, state):
        print("deactivated", flush=True)

    def on_cleanup(self, state):
        print("cleaned up", flush=True)

    def on_shutdown(self, state):
        print("shut down", flush=True)

    def _tick(self) -> None:
        super()._tick()
        print("\n".join(["x" * 5000] * 4), flush=True)


class Monitor(LifecycleNode):
    @on_message("/diagnostics")
    def _diagnosed(self, message: DiagnosticArray) -> None:
        for each in message.status:
            print(f"diagnosed {each.name} as {each.message}", flush=True)


class Listener(LifecycleNode):
    _heard = ""

    @on_message("chatter")
    def hear(self, message: String) -> None:
        if message.data != self._heard:
            self._heard = message.data
            print(f"heard {message.data}", flush=True)


class Leaving(LifecycleNode):
    """Destroys itself a moment after it was activated; its process goes on."""

    async def leave(self) -> None:
        await self.sleep(0.2)
        self.destroy_node()

    def on_activate(self) -> None:
        self.executor.create_task(self.leave)


class Crossing(LifecycleNode):
    """Hears of several topics, and publishes some of its own."""

    @on_message("in0")
    @on_message("in1")
    @on_message("in2")
    @on_message("in3")
    @on_message("in4")
    @on_message("in5")
    @on_message("in6")
    @on_message("in7")
    def heard(self, message: String) -> None:
        pass


class Quiet(LifecycleNode):
    """Has what its manifest declares, and does nothing with it."""


class Eager(Talker):
    """Once it is connected its own code activates it: from a timer and from a thread."""

    def on_connect(self, state):
        # rclpy's own: those of the node are gated as its data are.
        self._own_timer = Node.create_timer(self, 0.05, self._from_timer)
        threading.Thread(target=self._from_thread, daemon=True).start()

    async def _from_timer(self) -> None:
        if self.lifecycle.state.connected:
            Node.destroy_timer(self, self._own_timer)
            await self._activate("timer")

    def _from_thread(self) -> None:
        end = time.monotonic() + 10.0
        while not self.lifecycle.state.connected and time.monotonic() < end:
            time.sleep(0.1)
        asyncio.run(self._activate("thread"))

    async def _activate(self, whence: str) -> None:
        try:
            await self.lifecycle.change("activate")
        except LifecycleError as refused:
            print(f"{whence}: {refused}", flush=True)


class Forgetful(Node):
    """Undeclares its parameter once the file FORGET is there."""

    def __init__(self) -> None:
        super().__init__("arm")
        self.declare_parameter("gain", 2.5)
        self.create_timer(0.1, self._look)

    def _look(self) -> None:
        if self.has_parameter("gain") and Path(os.environ["FORGET"]).exists():
            self.undeclare_parameter("gain")
