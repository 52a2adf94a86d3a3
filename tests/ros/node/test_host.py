"""The host process: told what to host by a socket, obeying it, gone when it ends."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from host_process import HostProcess, driver_in, hosted
from msgspec.structs import replace
from planning import publisher, subscription
from rclpy.action import ActionClient
from test_msgs.action import Fibonacci

from lifecycle.manifest.model import Executor, Run, RunKind, Timeouts
from lifecycle.network.ports import participant_ports
from lifecycle.node.host.control import Event, Operation

HERE = Path(__file__).parent
CONFIGURE, CONNECT, ACTIVATE = Operation.CONFIGURE, Operation.CONNECT, Operation.ACTIVATE
Start = Callable[..., HostProcess]


def test_two_nodes_in_one_process_are_brought_up_and_end_with_the_channel(start: Start) -> None:
    host = start(
        hosted("one", "Good", publisher("out")),
        hosted("two", "Good", publisher("out"), namespace="/robot"),
    )
    assert host.read() == Event(kind="ready")
    for node in ("/one", "/robot/two"):
        configured = host.do(node, CONFIGURE)
        assert (configured.ok, configured.state, configured.connected) == (True, "inactive", False)
        connected = host.do(node, CONNECT)
        assert (connected.ok, connected.state, connected.connected) == (True, "inactive", True)
        assert connected.configuration is not None
        assert connected.configuration.endpoints[0].gid
        active = host.do(node, ACTIVATE)
        assert (active.ok, active.state, active.connected) == (True, "active", True)
        assert active.configuration is None
    told = host.do("/one", Operation.GET_CONFIGURATION).configuration
    assert told is not None
    assert (told.name, told.identity.process_id) == ("/one", host.process.pid)
    host.hang_up()
    assert host.wait() == 0


@pytest.mark.parametrize("joins", [True, False])
def test_a_host_that_joins_a_running_system_has_the_others_announce_themselves_to_it(
    start: Start, fresh_domain: int, joins: bool
) -> None:
    """Where another participant would listen; what makes it answer has a vendor id of ours."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", participant_ports(fresh_domain, 9).discovery_unicast))
        other.settimeout(10.0)
        start(hosted("one", "Good"), joins=joins).until("ready")
        vendors = {other.recv(65536)[6:8]}
        other.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                vendors.add(other.recv(65536)[6:8])
    assert vendors == ({b"\x01\x0f", b"LC"} if joins else {b"\x01\x0f"})


@pytest.mark.parametrize("class_", ["Good", "Plain", "Theirs"])
def test_a_host_asks_for_its_sender_sockets_before_it_can_have_a_peer_and_never_again(
    start: Start, class_: str
) -> None:
    """Fast DDS lists them without a lock, and extends the list when the first peer is matched."""
    run = Run(kind=RunKind.PYTHON, python=f"senders_asked:{class_}")
    out = publisher("out")
    host = start(
        hosted("one", class_, out, run=run, managed=class_ != "Plain"),
        hosted("two", "Good", out),
    )
    host.until("ready")
    for node in ("/two",) if class_ == "Plain" else ("/one", "/two"):
        assert host.do(node, CONFIGURE).ok
        assert host.do(node, CONNECT).ok
    told = host.do("/two", Operation.GET_CONFIGURATION).configuration
    assert told is not None
    assert told.endpoints[0].nfes
    assert told.endpoints[0].nfes[-1].medium == "shm"
    host.hang_up()
    assert host.wait() == 0
    said = [each for each in host.log.read_text().split("\n") if each == "asked"]
    assert said == ["asked"]


def test_every_change_of_state_is_told_before_the_reply(start: Start) -> None:
    host = start(hosted("one", "Good"))
    host.until("ready")
    host.ask("/one", CONFIGURE)
    reply, before = host.until("reply")
    states = [event.state for event in before if event.kind == "state"]
    assert states == ["configuring", "inactive"]
    assert reply.state == "inactive"


def test_a_transition_that_somebody_else_caused_is_told_too(
    start: Start, fresh_domain: int
) -> None:
    host = start(hosted("one", "Good"))
    host.until("ready")
    with driver_in(fresh_domain) as driver:
        assert driver.set("/one", "configure")
    assert host.states(2) == ["configuring", "inactive"]


def test_a_refused_command_is_answered_with_the_reason_and_the_node_lives(start: Start) -> None:
    host = start(hosted("one", "Good"))
    host.until("ready")
    reply = host.do("/one", ACTIVATE)
    assert (reply.ok, reply.state) == (False, "unconfigured")
    assert reply.error == (
        "cannot activate in state 'unconfigured'; allowed here: configure, shutdown"
    )
    assert host.do("/one", CONFIGURE).ok


def test_a_command_to_a_node_that_is_not_here_is_answered(start: Start) -> None:
    host = start(hosted("one", "Good"))
    host.until("ready")
    reply = host.do("/two", CONFIGURE)
    assert (reply.ok, reply.error) == (
        False,
        "cannot find node '/two'; this process hosts /one",
    )


def test_an_answer_that_comes_after_its_server_was_destroyed_is_lost_and_the_node_lives(
    start: Start,
) -> None:
    host = start(hosted("one", "Late"))
    host.until("ready")
    assert host.do("/one", CONFIGURE).ok
    assert host.do("/one", CONNECT).ok


@pytest.mark.parametrize(
    ("class_", "reason"),
    [
        ("Raising", "OSError: no such camera"),
        (
            "Goood",
            "cannot use 'hosted:Goood': hosted has no 'Goood'; did you mean 'Good'?",
        ),
        (
            "Plain",
            (
                "cannot manage /one: 'hosted:Plain' makes a plain node, a Plain; say "
                "`managed: false`, or subclass lifecycle.LifecycleNode"
            ),
        ),
    ],
)
def test_a_node_that_cannot_be_constructed_ends_the_process_with_the_reason(
    start: Start, class_: str, reason: str
) -> None:
    host = start(hosted("one", class_))
    assert host.read() == Event(kind="failed", node="/one", ok=False, error=reason)
    assert host.wait() == 1
    # Nothing of the user's was on the way: the reason says it all.
    assert ("Traceback" in host.log.read_text()) is (class_ not in {"Goood", "Plain"})


def test_a_module_that_does_not_exist_is_named(start: Start) -> None:
    spec = hosted("one", "Good")
    run = replace(spec.run, python="nowhere.nodes:Camera")
    host = start(replace(spec, run=run))
    assert host.read().error == (
        "cannot import 'nowhere.nodes:Camera': no module 'nowhere'; "
        f"it is looked for in {HERE} and in what is installed"
    )
    assert host.wait() == 1


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_process_well(start: Start, number: signal.Signals) -> None:
    host = start(hosted("one", "Good"))
    host.until("ready")
    host.do("/one", CONFIGURE)
    os.kill(host.process.pid, number)
    assert host.states(2) == ["shuttingdown", "finalized"]
    assert host.wait() == 0


def test_a_command_that_arrives_while_the_process_leaves_is_passed_over(start: Start) -> None:
    """As systemd's SIGTERM to all of a unit at once has it happen."""
    host = start(hosted("one", "Good"))
    host.until("ready")
    os.kill(host.process.pid, signal.SIGTERM)
    with contextlib.suppress(OSError):
        while host.process.poll() is None:
            host.ask("/one", CONFIGURE)
            with contextlib.suppress(subprocess.TimeoutExpired):
                host.wait(0.01)  # nobody reads the answers, which must have room
    assert host.wait() == 0
    assert "Traceback" not in host.log.read_text()


def test_an_async_callback_that_waits_does_not_keep_the_process(start: Start) -> None:
    host = start(hosted("one", "Stuck"))
    host.until("ready")
    host.ask("/one", CONFIGURE)
    assert host.states(1) == ["configuring"]
    host.hang_up()
    assert host.wait() == 0  # 1 would say that it was given up
    assert "cannot go on with /one: on_configure" in host.log.read_text()


def test_a_callback_that_blocks_does_not_keep_the_process_beyond_its_bound(
    start: Start, wait_until: Callable[..., None]
) -> None:
    classes = ("Blocking", "BlockingConstructor")
    hosts = [start(hosted("one", each, timeouts=Timeouts(shutdown_s=0.1))) for each in classes]
    hosts[0].until("ready")
    hosts[0].ask("/one", CONFIGURE)
    assert hosts[0].states(1) == ["configuring"]
    wait_until(lambda: "constructing" in hosts[1].log.read_text())
    for host in hosts:
        host.hang_up()
    for host in hosts:
        assert host.wait() == 1
        assert "a callback blocks; the process ends without it" in host.log.read_text()


def test_a_plain_node_gets_its_planned_name_when_alone(start: Start, fresh_domain: int) -> None:
    plain = hosted("one", "Plain", managed=False, namespace="/robot", remap=(("out", "there"),))
    host = start(replace(plain, parameters=(("label", "1: left"),)))
    host.until("ready")
    with driver_in(fresh_domain) as driver:
        driver.spin_until(lambda: driver.node.count_publishers("/robot/there") == 1)
        driver.spin_until(lambda: "one" in driver.node.get_node_names())
    host.hang_up()
    assert host.wait() == 0
    assert "label 1: left\n" in host.log.read_text()


def test_a_supervisor_that_goes_before_it_speaks_leaves_nothing(tmp_path: Path) -> None:
    ours, theirs = socket.socketpair()
    with theirs:
        process = subprocess.Popen(
            [sys.executable, "-m", "lifecycle.node.host.host", str(theirs.fileno())],
            pass_fds=[theirs.fileno()],
        )
    ours.close()
    assert process.wait(30) == 0


def test_importing_the_host_needs_no_ros_and_preloading_starts_nothing() -> None:
    code = """
import sys, threading
from lifecycle.node.host import host
assert not [name for name in sys.modules if name.startswith("rclpy")], "host imports rclpy"
host.preload()
import rclpy
assert not rclpy.ok()
assert threading.active_count() == 1
import os
files = ["/proc/self/fd/" + name for name in os.listdir("/proc/self/fd")]
links = [os.readlink(file) for file in files if os.path.lexists(file)]
assert not [link for link in links if link.startswith("socket")], links
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=30)


def test_what_hosts_are_forked_from_imports_only_what_every_node_needs() -> None:
    code = (
        "import sys; from lifecycle.node.host.host import preload; preload(); "
        "print(*sys.modules); preload(['example_interfaces/msg/No', 'sensor_msgs/msg/Imu']); "
        "print('sensor_msgs' in sys.modules)"
    )
    modules, also = subprocess.check_output(
        [sys.executable, "-c", code], text=True, timeout=30
    ).splitlines()
    unused = {"asyncio", "click", "jsonschema", "lifecycle.graph", "lifecycle.plan.build"}
    assert unused.union({"lifecycle.verify.judge", "rclpy.action", "sensor_msgs"}).isdisjoint(
        modules.split()
    )
    assert also == "True"


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        (
            "nothing",
            (
                "cannot use 'hosted:nothing': it returned None, not /one; return the node, or a "
                "list of nodes; the host spins and destroys them"
            ),
        ),
        (
            "two",
            (
                "cannot host /second, which 'hosted:two' returns: no node is declared for it "
                "beside /one; add a node of that name with the same `run:` and `process: one`"
            ),
        ),
    ],
)
def test_a_function_returns_exactly_the_nodes_that_are_declared(
    start: Start, name: str, reason: str
) -> None:
    host = start(hosted("one", name, managed=False))
    assert host.read() == Event(kind="failed", node="/one", ok=False, error=reason)
    assert host.wait() == 1


def test_a_node_that_shuts_rclpy_down_ends_its_process_well(start: Start) -> None:
    host = start(hosted("one", "Ending", managed=False))
    host.until("ready")
    host.ask("/one", ACTIVATE)
    assert host.wait() == 0
    assert "rclpy was shut down by a node's own code" in host.log.read_text()


def test_a_node_that_another_makes_is_hosted_where_it_is_declared(start: Start) -> None:
    out = replace(publisher("out"), resolved="/there/out")
    host = start(
        hosted("main", "WithHelper", managed=False),
        hosted("helper", "WithHelper", out, managed=False, namespace="/there"),
    )
    told = host.do("/there/helper", Operation.GET_CONFIGURATION).configuration
    assert told is not None
    (report,) = told.endpoints
    assert (report.name, report.resolved, report.mapped) == ("out", "/there/out", True)
    assert report.qos is not None
    assert report.qos.depth == 3
    assert host.do("/main", ACTIVATE).ok


def test_what_the_action_of_a_plain_node_raises_is_reported_until_a_goal_ends_well(
    start: Start, fresh_domain: int
) -> None:
    host = start(hosted("one", "Acting", managed=False))
    host.until("ready")
    assert host.do("/one", ACTIVATE).ok

    def fault() -> str:
        told = host.do("/one", Operation.GET_CONFIGURATION).configuration
        assert told is not None
        (report,) = told.endpoints
        return report.fault

    assert fault() == ""
    with driver_in(fresh_domain) as driver:
        client = ActionClient(driver.node, Fibonacci, "/count")
        driver.spin_until(client.server_is_ready)
        for order, expected in ((0, "its handler raised OSError: no such number"), (1, "")):
            sent = client.send_goal_async(Fibonacci.Goal(order=order))
            driver.spin_until(sent.done)
            ended = sent.result().get_result_async()
            driver.spin_until(ended.done)
            assert fault() == expected
        client.destroy()


def test_a_node_of_rclpy_lifecycle_is_activated_by_its_supervisor_alone(
    start: Start, fresh_domain: int
) -> None:
    host = start(hosted("one", "Theirs", publisher("out")))
    with driver_in(fresh_domain) as driver:
        host.until("ready")
        # What rclpy itself answers with an exception that ends the process.
        assert not driver.change("/one", label="deactivate")
        assert driver.set("/one", "configure")
        assert not driver.set("/one", "activate")
        assert driver.state("/one") == (2, "inactive")
        active = host.do("/one", ACTIVATE)
        assert (active.ok, active.state, active.connected) == (True, "active", True)
        assert driver.set("/one", "deactivate")
        assert driver.set("/one", "activate")  # once let through, by any client
        assert driver.set("/one", "deactivate")
        assert driver.set("/one", "cleanup")
        assert driver.set("/one", "configure")
        assert not driver.set("/one", "activate")
    host.hang_up()
    assert host.wait() == 0
    assert "cannot take transition number 3 in state 'inactive': the gate" in host.log.read_text()


@pytest.mark.parametrize("executor", [Executor.MULTI, Executor.EVENTS])
def test_nodes_of_every_kind_share_an_executor_with_threads_of_its_own(
    start: Start, executor: Executor
) -> None:
    def run(name: str) -> Run:
        return Run(kind=RunKind.PYTHON, python=f"hosted:{name}", executor=executor)

    host = start(
        hosted("ours", "Echo", publisher("out"), subscription("in"), run=run("Echo")),
        hosted("theirs", "Theirs", publisher("out"), run=run("Theirs")),
        hosted("plain", "WithHelper", managed=False, run=run("WithHelper")),
    )
    host.until("ready")
    for each in (CONFIGURE, CONNECT, ACTIVATE, Operation.DEACTIVATE, ACTIVATE):
        assert host.do("/ours", each).ok
        assert host.do("/theirs", each).ok
    for each in (ACTIVATE, Operation.DEACTIVATE, ACTIVATE):
        assert host.do("/plain", each).ok
    host.hang_up()
    assert host.wait() == 0
    assert "Traceback" not in host.log.read_text()
