"""What the ros2 command does with a system that `up` brought up, and with one that is held."""

from __future__ import annotations

import signal

from tests.outside.case import NOBODY, OK, Case
from tests.outside.running import Run

MANIFEST = """\
manifest_version: 1
system: pair
discovery: {range: localhost}
nodes:
  talker:
    run: {python: "nodes:Talker"}
    interface:
      publishers: [{name: chatter, type: std_msgs/msg/String}]
      parameters: {rate: {type: int, default_value: 7}}
  listener:
    run: {python: "nodes:Listener"}
    interface:
      subscriptions: [{name: chatter, type: std_msgs/msg/String}]
  server:
    run: {python: "nodes:Server"}
    interface: {service_servers: [{name: /reset, type: std_srvs/srv/Trigger}]}
"""
HELD = (
    MANIFEST
    + """\
  missing:
    run: {attach: true}
    managed: false
    timeouts: {start_s: 40}
    interface: {}
"""
)
EVERYBODY = frozenset({"talker", "listener", "server"})


def look_around(run: Run) -> None:
    run.until_active()
    run.python("client.py", "nodes", "/talker", "/listener", "/server")
    topics = run.python("client.py", "topics", "/chatter").splitlines()
    assert "/chatter std_msgs/msg/String" in topics
    services = run.python("client.py", "services", "/reset", "/talker/get_state").splitlines()
    assert "/reset std_srvs/srv/Trigger" in services
    assert "/talker/get_state lifecycle_msgs/srv/GetState" in services
    assert run.python("client.py", "echo", "/chatter") == "hello\n"
    assert run.python("client.py", "state", "/talker") == "active\n"
    assert run.python("client.py", "state", "/server") == "active\n"
    assert "rate" in run.python("client.py", "params", "/talker").split()
    assert run.python("client.py", "get", "/talker", "rate") == "7\n"
    assert run.python("client.py", "set", "/talker", "no_such", "1") != "done\n"
    run.signal(signal.SIGINT)


def take_down_one(run: Run) -> None:
    run.until_active()
    assert run.python("client.py", "change", "/talker", "deactivate") == "done\n"
    assert run.python("client.py", "state", "/talker") == "inactive\n"
    run.wait(lambda: bool(run.marks("talker", "deactivated")), "its callback ran")
    run.signal(signal.SIGINT)


def force_the_gate(run: Run) -> None:
    """The system waits for a node that never comes; each of the others is asked to go on."""
    for node in sorted(EVERYBODY):
        run.until("node", node=f"/{node}", reach="configured")
    for node in sorted(EVERYBODY):
        assert run.python("client.py", "change", f"/{node}", "activate") == "refused\n"
        assert run.python("client.py", "state", f"/{node}") == "inactive\n"
    run.signal(signal.SIGINT)


CASES = (
    Case(
        attack="ros2 looks around: nodes, topics, services, a message, states and parameters",
        manifest=MANIFEST,
        verb=("up", "--strict"),
        story=look_around,
        exit_code=130,
        verdict=OK,
        activated=EVERYBODY,
    ),
    Case(
        attack="ros2 lifecycle set deactivates a node of an active system",
        manifest=MANIFEST,
        verb=("up",),
        story=take_down_one,
        exit_code=130,
        activated=EVERYBODY,
    ),
    Case(
        attack="ros2 lifecycle set activates nodes before the gate",
        manifest=HELD,
        verb=("up", "--strict"),
        story=force_the_gate,
        exit_code=130,
        activated=NOBODY,
        received=NOBODY,
        quick=True,
    ),
)
