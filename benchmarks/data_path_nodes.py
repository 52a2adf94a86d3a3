"""The programs of the data path benchmark: each once as ours and once as a plain rclpy node.

    python benchmarks/data_path_nodes.py ours|plain publish|receive|tick|send|take NUMBER

`publish` times calls, `receive` prints a line for each NUMBER messages, `tick` times NUMBER ticks
of a timer, `send` says when it begins and sends NUMBER images to `take`, which acknowledges each,
four of them on the way. Run by data_path.py.
"""

from __future__ import annotations

import array
import contextlib
import json
import statistics
import sys
import time
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import Image
from std_msgs.msg import String

import lifecycle

PERIOD_S = 0.005
IMAGE_BYTES = 1_000_000
WINDOW = 4
CALLS = 200
ROUNDS = 150


def say(*line: object) -> None:
    print(*line, flush=True)


class Receiver:
    """Says when as many messages have arrived as were asked for."""

    def __init__(self, number: int) -> None:
        self._number = number
        self._count = 0

    def take(self, _: String) -> None:
        """Count."""
        self._count += 1
        if self._count % self._number == 0:
            say("received")


class Ticker:
    """Says how far the intervals of a timer are from its period."""

    def __init__(self, number: int) -> None:
        self._number = number
        self._at_ns: list[int] = []

    def tick(self) -> None:
        """Note when."""
        self._at_ns.append(time.perf_counter_ns())
        if len(self._at_ns) == self._number:
            periods = zip(self._at_ns, self._at_ns[1:], strict=False)
            late_us = sorted(abs(b - a - PERIOD_S * 1e9) / 1000 for a, b in periods)
            mean_us = statistics.fmean(late_us)
            say(json.dumps({"mean_us": mean_us, "p99_us": late_us[len(late_us) * 99 // 100]}))


class Sender:
    """Sends images, never more than `WINDOW` ahead of what is acknowledged."""

    def __init__(self, number: int, publisher: Any) -> None:
        self._left = number
        self._number = number
        self._publisher = publisher
        self._acknowledged = 0
        self._began_s = 0.0
        self._image = Image(data=array.array("B", bytes(IMAGE_BYTES)))

    def begin(self) -> None:
        """Start once somebody is there; called by a timer, harmless again."""
        if not self._began_s and self._publisher().get_subscription_count():
            say("began")
            self._began_s = time.perf_counter()
            for _ in range(WINDOW):
                self._send()

    def acknowledge(self, _: String) -> None:
        """Send the next."""
        self._acknowledged += 1
        if self._acknowledged == self._number:
            took_s = time.perf_counter() - self._began_s
            say(json.dumps({"mb_s": self._number * IMAGE_BYTES / took_s / 1e6}))
        self._send()

    def _send(self) -> None:
        if self._left:
            self._left -= 1
            self._publisher().publish(self._image)


NUMBER = int(sys.argv[3]) if len(sys.argv) > 3 else 0


class OurPublisher(lifecycle.LifecycleNode):
    """Times calls of its publisher, and of a plain one beside it, in turns."""

    def __init__(self) -> None:
        super().__init__("ours", lifecycle="auto")
        self.declare_publisher("out", String)
        self._plain = Node("plain")
        self._plain_publisher = self._plain.create_publisher(String, "plain_out", 10)
        self._found: dict[str, list[float]] = {"plain": [], "ours": [], "by name": []}

    def on_activate(self) -> None:
        """Measure what is published while it is not active yet."""
        publisher = self.publisher("out")
        self._found["inactive"] = [_call_ns(publisher) for _ in range(ROUNDS)]

    @lifecycle.on_timer(period_s=0.01)
    def measure(self) -> None:
        """One round a tick: a callback that takes long would be reported as hanging.

        Short ones, so that a busy moment of the machine hits all of them.
        """
        publisher = self.publisher("out")
        self._found["plain"].append(_call_ns(self._plain_publisher))
        self._found["ours"].append(_call_ns(publisher))
        self._found["by name"].append(_call_by_name_ns(self))
        if len(self._found["plain"]) == ROUNDS:
            found = {name: statistics.median(each) for name, each in self._found.items()}
            say(json.dumps(found))


def _call_ns(publisher: Any) -> float:
    message = String(data="x" * 32)
    began = time.perf_counter_ns()
    for _ in range(CALLS):
        publisher.publish(message)
    return (time.perf_counter_ns() - began) / CALLS


def _call_by_name_ns(node: OurPublisher) -> float:
    message = String(data="x" * 32)
    began = time.perf_counter_ns()
    for _ in range(CALLS):
        node.publisher("out").publish(message)
    return (time.perf_counter_ns() - began) / CALLS


class OurReceiver(lifecycle.LifecycleNode):
    """Receives what data_path.py sends."""

    def __init__(self) -> None:
        super().__init__("ours", lifecycle="auto")
        self.declare_subscription("to_ours", String, 100)
        self._receiver = Receiver(NUMBER)

    @lifecycle.on_message("to_ours")
    def receive(self, message: String) -> None:
        """As in the plain node."""
        self._receiver.take(message)


class OurTicker(lifecycle.LifecycleNode):
    """Has a timer."""

    def __init__(self) -> None:
        super().__init__("ours", lifecycle="auto")
        self._ticker = Ticker(NUMBER)

    @lifecycle.on_timer(period_s=PERIOD_S)
    def tick(self) -> None:
        """As in the plain node."""
        self._ticker.tick()


class OurSender(lifecycle.LifecycleNode):
    """Sends images."""

    def __init__(self) -> None:
        super().__init__("our_sender", lifecycle="auto")
        self.declare_publisher("image", Image, WINDOW)
        self.declare_subscription("taken", String)
        self._sender = Sender(NUMBER, lambda: self.publisher("image"))

    @lifecycle.on_message("taken")
    def receive(self, message: String) -> None:
        """As in the plain node."""
        self._sender.acknowledge(message)

    @lifecycle.on_timer(period_s=0.05)
    def begin(self) -> None:
        """As in the plain node."""
        self._sender.begin()


class OurTaker(lifecycle.LifecycleNode):
    """Takes images."""

    def __init__(self) -> None:
        super().__init__("our_taker", lifecycle="auto")
        self.declare_publisher("taken", String)
        self.declare_subscription("image", Image, WINDOW)

    @lifecycle.on_message("image")
    def receive(self, _: Image) -> None:
        """As in the plain node."""
        self.publisher("taken").publish(String())


def plain(role: str) -> Node:
    """Return the plain node for a role; subscriptions are kept alive by it."""
    node = Node(f"plain_{role}")
    if role == "receive":
        node.create_subscription(String, "to_plain", Receiver(NUMBER).take, 100)
    elif role == "tick":
        node.create_timer(PERIOD_S, Ticker(NUMBER).tick)
    elif role == "take":
        taken = node.create_publisher(String, "taken", 10)
        node.create_subscription(Image, "image", lambda _: taken.publish(String()), WINDOW)
    else:
        publisher = node.create_publisher(Image, "image", WINDOW)
        sender = Sender(NUMBER, lambda: publisher)
        node.create_subscription(String, "taken", sender.acknowledge, 10)
        node.create_timer(0.05, sender.begin)
    return node


OURS = {
    "publish": OurPublisher,
    "receive": OurReceiver,
    "tick": OurTicker,
    "send": OurSender,
    "take": OurTaker,
}


def main() -> None:
    whose, role = sys.argv[1:3]
    if whose == "ours":
        arguments = ["--ros-args", "--log-level", "error"]
        lifecycle.run(OURS[role], arguments=arguments, say=lambda _: None)
    rclpy.init()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(plain(role))


if __name__ == "__main__":
    main()
