"""The nodes of the nine systems: one that talks, ones that listen, and both can grow.

The nodes know nothing of transports, addresses or who connects them: the nine manifests differ, the
code does not.
"""

from __future__ import annotations

from std_msgs.msg import String
from std_srvs.srv import Trigger

from lifecycle import LifecycleNode, on_message, on_service, on_timer


class Talker(LifecycleNode):
    """Says hello twenty times a second while it is active."""

    _said = 0

    @on_timer(period_s=0.05)
    def speak(self) -> None:
        self._said += 1
        self.publisher("chatter").publish(String(data=f"hello {self._said}"))


class Listener(LifecycleNode):
    """Says once that it hears something."""

    _heard = False

    @on_message("chatter")
    def hear(self, message: String) -> None:
        if not self._heard:
            print(f"heard {message.data.split()[0]}", flush=True)
        self._heard = True


class Growing(LifecycleNode):
    """Makes one more endpoint some time after it became active, or when it is asked to.

    The parameter `grow_after_s` says when, in seconds; 0 waits for `~/grow`.
    """

    _grown = False

    def on_activate(self) -> None:
        after_s = self.get_parameter("grow_after_s").value
        if after_s > 0 and not self._grown:
            self.create_timer(after_s, self._grow_once)

    @on_service("~/grow")
    def asked_to_grow(self, _: Trigger.Request, response: Trigger.Response) -> None:
        self._grow_once()
        response.success = True

    def _grow_once(self) -> None:
        if not self._grown:
            self._grown = True
            self.grow()

    def grow(self) -> None:
        raise NotImplementedError


class GrowingTalker(Growing, Talker):
    """Publishes news too, once it has grown."""

    def grow(self) -> None:
        self.declare_publisher("news", String)

    @on_timer(period_s=0.05)
    def report(self) -> None:
        if self._grown:
            self.publisher("news").publish(String(data="news at last"))


class GrowingListener(Growing, Listener):
    """Subscribes to news too, once it has grown."""

    _learnt = False

    def grow(self) -> None:
        self.declare_subscription("news", String, callback=self.learn)

    def learn(self, message: String) -> None:
        if not self._learnt:
            print(f"heard {message.data.split()[0]}", flush=True)
        self._learnt = True
