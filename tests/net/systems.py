"""Node classes of the tests on several hosts.

N1 and N2 are the example of *Unique Network Flows*: N1 publishes video and battery state, N2 takes
both. `LateListener` stands in for one of the nine systems'. The environment of a process may ask
for more: HOLD_CONFIGURE_FILE holds configure until that file is there, HOLD_START_FILE and its like
another stage, all for HOLD_S seconds at most, and FAIL_CONFIGURE makes configure fail.

`Stamped` and `Timed` are N1 and N2 that know the true delay, by a clock that all hosts of this
machine share; with BUSY_S `Timed` is busy for so long now and then, or once BUSY_FILE is there.
`SimulatedTime` publishes a
time that is far from any clock's.
"""

from __future__ import annotations

import os
import statistics
import time
from collections import deque
from pathlib import Path

from builtin_interfaces.msg import Time
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String

from examples.nine_systems.nodes import Listener
from lifecycle import LifecycleNode, on_message

_PERIOD_S = 0.02
_HOLD_S = 20.0


def hold(stage: str) -> None:
    file = os.environ.get(f"HOLD_{stage}_FILE", "")
    end = time.monotonic() + float(os.environ.get("HOLD_S", _HOLD_S))
    while file and not Path(file).exists() and time.monotonic() < end:
        time.sleep(0.01)


def configure() -> None:
    hold("CONFIGURE")
    if os.environ.get("FAIL_CONFIGURE"):
        raise RuntimeError("no screen")


class Source(LifecycleNode):
    """N1."""

    def on_configure(self, state):
        configure()
        self.create_timer(_PERIOD_S, self._tick)

    def _tick(self) -> None:
        self.publisher("video").publish(String(data="v" * 500))
        self.publisher("battery").publish(String(data="b" * 100))


class Sink(LifecycleNode):
    """N2."""

    _heard: frozenset[str] = frozenset()

    def __init__(self, *arguments, **options) -> None:
        hold("START")
        super().__init__(*arguments, **options)

    def on_configure(self, state):
        configure()

    def on_connect(self, state):
        hold("CONNECT")

    def on_activate(self, state):
        hold("ACTIVATE")

    def on_deactivate(self, state):
        hold("DEACTIVATE")

    @on_message("video")
    def see(self, message: String) -> None:
        self._note("video")

    @on_message("battery")
    def gauge(self, message: String) -> None:
        self._note("battery")

    def _note(self, topic: str) -> None:
        if topic not in self._heard:
            self._heard |= {topic}
            print("heard both" if len(self._heard) == 2 else f"heard {topic}", flush=True)


class LateListener(Listener):
    """Is not configured before it may be."""

    def on_configure(self, state):
        configure()


class Stamped(Source):
    """N1, whose video says when it was sent."""

    def _tick(self) -> None:
        self.publisher("video").publish(String(data=str(time.monotonic_ns())))
        self.publisher("battery").publish(String())


class Timed(Sink):
    """N2, which prints the median of its last delays."""

    def __init__(self, *arguments, **options) -> None:
        super().__init__(*arguments, **options)
        self._delays_ms = deque[float](maxlen=200)
        self._count = 0

    @on_message("video")
    def see(self, message: String) -> None:
        self._delays_ms.append((time.monotonic_ns() - int(message.data)) / 1e6)
        self._count += 1
        if self._count % 10 == 0:
            print(f"median {statistics.median(self._delays_ms)}", flush=True)
            if Path(os.environ.get("BUSY_FILE", "/")).exists():
                time.sleep(float(os.environ.get("BUSY_S", "0")))


class SimulatedTime(LifecycleNode):
    """Says that it is 1970."""

    _tick_s = 0

    def on_configure(self, state):
        self.create_timer(0.1, self._tick)

    def _tick(self) -> None:
        self._tick_s += 1
        self.publisher("/clock").publish(Clock(clock=Time(sec=self._tick_s)))
