"""Nodes of rclpy's own classes in our host, which ask for their transitions themselves."""

from __future__ import annotations

import signal

from tests.outside.case import NOBODY, OK, Case
from tests.outside.running import Run

CLASSES = {
    "eager_classes.py": '''\
"""Managed nodes of rclpy's that activate themselves, in a process that hosts them."""

import rclpy
from lifecycle_msgs.srv import ChangeState
from nodes import mark
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn


class Waits(LifecycleNode):
    """Leaves it to others."""

    def __init__(self, **options):
        super().__init__("base", **options)

    def on_configure(self, state):
        mark("base", "configured")
        return super().on_configure(state)

    def on_activate(self, state):
        mark("base", "activated")
        return super().on_activate(state)

    def on_deactivate(self, state):
        mark("base", "deactivated")
        return super().on_deactivate(state)


class InConstructor(Waits):
    def __init__(self):
        super().__init__()
        self.trigger_configure()
        self.trigger_activate()


class SpinsInConstructor(Waits):
    """Asks itself by its services, and waits for the answers."""

    def __init__(self):
        super().__init__()
        client = self.create_client(ChangeState, "~/change_state")
        client.wait_for_service()
        for number in (1, 3):
            request = ChangeState.Request()
            request.transition.id = number
            rclpy.spin_until_future_complete(self, client.call_async(request), timeout_sec=5.0)


class ByTimer(Waits):
    """Once, so long after it was made."""

    after_s = 0.01

    def __init__(self):
        super().__init__()
        self.timer = self.create_timer(self.after_s, self.go)

    def go(self):
        self.timer.cancel()
        self.trigger_configure()
        self.trigger_activate()


class ByLateTimer(ByTimer):
    after_s = 0.3


class Insists(Waits):
    """Again and again, until it is active."""

    def __init__(self):
        super().__init__()
        self.create_timer(0.01, self.trigger_activate)

    def trigger_activate(self):
        try:
            return super().trigger_activate()
        except Exception as error:
            print("not activated:", error, flush=True)


class OnConfigure(Waits):
    """As soon as it is configured."""

    def on_configure(self, state):
        self.timer = self.create_timer(0.0, self.go)
        return super().on_configure(state)

    def go(self):
        self.timer.cancel()
        self.trigger_activate()
'''
}

MISSING = """\
  missing:
    run: {attach: true}
    managed: false
    timeouts: {start_s: 40}
    interface: {}
"""


def hosted(name: str, *, more: str = "") -> str:
    """A node of such a class in our host, and one of ours."""
    return f"""\
manifest_version: 1
system: hosted
discovery: {{range: localhost}}
policy: {{unpublished: ignore}}
nodes:
  base:
    run: {{python: "eager_classes:{name}"}}
    managed: true
  listener:
    run: {{python: "nodes:Listener"}}
    interface: {{subscriptions: [{{name: chatter, type: std_msgs/msg/String}}]}}
{more}"""


def once_each(run: Run) -> None:
    """Each was configured once, activated once, and nobody was deactivated before the end."""
    run.until_active()
    assert [mark[2] for mark in run.marks("base")] == ["configured", "activated"]


def asked_by_another(run: Run) -> None:
    """Another process asks it to activate while the gate waits for a node that never comes."""
    run.until("node", node="/base", reach="configured")
    assert run.python("client.py", "change", "/base", "activate") == "refused\n"
    assert run.python("client.py", "state", "/base") == "inactive\n"
    run.signal(signal.SIGINT)


BOTH = frozenset({"base", "listener"})
REFUSED_LINE = "activates once the gate lets it through"

CASES = (
    *(
        Case(
            attack=f"a hosted class of rclpy.lifecycle {how}",
            manifest=hosted(name),
            files=CLASSES,
            verb=("up", "--strict", "--stop-after", "1"),
            story=once_each,
            verdict=OK,
            activated=BOTH,
            says=says,
            quick=name == "InConstructor",
        )
        for name, how, says in (
            ("Waits", "leaves its activation to the gate", ()),
            (
                "InConstructor",
                "activates itself in its constructor",
                (REFUSED_LINE,),
            ),
            (
                "SpinsInConstructor",
                "has its constructor ask its own services",
                ("the gate of its supervisor is closed",),
            ),
            ("ByTimer", "activates itself by a timer of 0.01 s", ()),
            ("ByLateTimer", "activates itself by a timer of 0.3 s", ()),
            (
                "OnConfigure",
                "activates itself once it is configured",
                (REFUSED_LINE,),
            ),
            ("Insists", "insists on its activation", (REFUSED_LINE,)),
        )
    ),
    *(
        Case(
            attack=f"a hosted class of rclpy.lifecycle activates itself {how} at a closed gate",
            manifest=hosted(name, more=MISSING),
            files=CLASSES,
            verb=("up", "--strict", "--timeout", "4"),
            exit_code=4,
            activated=NOBODY,
        )
        for name, how in (
            ("InConstructor", "in its constructor"),
            ("ByTimer", "by a timer"),
            ("Insists", "again and again"),
        )
    ),
    Case(
        attack="another process asks a hosted class of rclpy.lifecycle to activate before the gate",
        manifest=hosted("Waits", more=MISSING),
        files=CLASSES,
        verb=("up", "--strict"),
        story=asked_by_another,
        exit_code=130,
        activated=NOBODY,
    ),
)
