"""The node of the soak: it does on order, in its executor, what real nodes do by mistake.

Orders are words in datagrams to an abstract socket, `address`; `SEEN` is answered with what it has
published and heard. What it is to fail in when it comes again is a file, `STUMBLE_DIRECTORY/NODE`
with `step way` in it, which it takes away.
"""

from __future__ import annotations

import ctypes
import os
import socket
import threading
import time
from pathlib import Path
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import String

from lifecycle import LifecycleNode, on_message
from tests.soak.model import DECLARED_RATE

MARK_VARIABLE = "SOAK_MARK"
STUMBLE_VARIABLE = "SOAK_STUMBLE"
FAILS_VARIABLE = "SOAK_FAILS"
"""`step way` of a node that fails each time."""
SEEN = "seen"


def address(mark: str, node: str) -> str:
    """Return where a node takes orders."""
    return f"\0soak-{mark}-{node}"


class Soaked(LifecycleNode):
    def __init__(self) -> None:
        super().__init__()
        self._orders: list[tuple[str, bytes | str]] = []
        self._published = self._heard = 0
        self._stray: Any = None
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(address(os.environ[MARK_VARIABLE], self.get_name()))
        threading.Thread(target=self._listen, daemon=True).start()
        # rclpy's own: those of the node are gated, and an inactive node takes orders, too.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        Node.create_timer(self, 0.05, self._obey, clock=steady)
        self._stumble("construct")

    def on_configure(self, state: Any) -> None:
        self._stumble("configure")
        self.create_timer(0.1, self._publish)

    def on_connect(self, state: Any) -> None:
        self._stumble("connect")

    def on_activate(self, state: Any) -> None:
        self._stumble("activate")

    def on_deactivate(self, state: Any) -> None:
        self._stumble("deactivate")

    def _publish(self) -> None:
        self._published += 1
        for name in self.declared_publishers():
            self.publisher(name).publish(String(data=f"{os.getpid()}"))

    def declared_publishers(self) -> list[str]:
        found = os.environ.get(f"SOAK_PUBLISHES_{self.get_name()}", "")
        return found.split()

    def _listen(self) -> None:
        while True:
            data, sender = self._socket.recvfrom(64)
            self._orders.append((data.decode(), sender))

    def _obey(self) -> None:
        while self._orders:
            word, sender = self._orders.pop(0)
            if word == SEEN:
                tint = self.get_parameter("tint").value if self.has_parameter("tint") else 0
                found = (self._published, self._heard, tint, os.environ.get("SOAK_ISSUE", "0"))
                self._socket.sendto(" ".join(map(str, found)).encode(), sender)
                continue
            self._misbehave(word)

    def heard(self) -> None:
        self._heard += 1

    def _stumble(self, step: str) -> None:
        fails, _, how = os.environ.get(FAILS_VARIABLE, "").partition(" ")
        if fails == step:
            print(f"fails in {step}: {how}", flush=True)
            self._misbehave(how)
        file = Path(os.environ[STUMBLE_VARIABLE], self.get_name())
        try:
            wanted, way = file.read_text().split()
        except (OSError, ValueError):
            return
        if wanted == step:
            file.unlink(missing_ok=True)
            print(f"stumbles in {step}: {way}", flush=True)
            self._misbehave(way)

    def _misbehave(self, way: str) -> None:
        if way == "raise":
            raise RuntimeError("the soak asked for it")
        if way.startswith("exit"):
            os._exit(int(way[4:]))
        if way == "sleep":
            threading.Event().wait()
        if way == "doze":
            time.sleep(1.6)
        if way == "spin":
            while True:
                pass
        if way == "lock":  # holds the interpreter's lock
            ctypes.PyDLL(None).sleep(3600)
        if way == "alter":
            self.set_parameters([Parameter("rate", value=DECLARED_RATE + 1)])
        if way == "restore":
            self.set_parameters([Parameter("rate", value=DECLARED_RATE)])
        if way == "stray" and self._stray is None:
            self._stray = Node.create_publisher(self, String, "/stray", 1)
        if way == "unstray" and self._stray is not None:
            Node.destroy_publisher(self, self._stray)
            self._stray = None


class Arm(Soaked):
    @on_message("odom")
    def hear(self, message: String) -> None:
        self.heard()


class Filter(Soaked):
    @on_message("video")
    def hear(self, message: String) -> None:
        self.heard()


class Detector(Soaked):
    @on_message("points")
    def hear(self, message: String) -> None:
        self.heard()


class Listener(Soaked):
    @on_message("beat")
    def hear(self, message: String) -> None:
        self.heard()
