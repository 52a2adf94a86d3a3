"""What ends report, and what nobody does: peers that no graph shows, marks, flows without a report.

The old version believed a report that its own graph contradicted, read marks once, and called a
flow ok of which neither end reports anything.
"""

from __future__ import annotations

from collections.abc import Iterator

import psutil

from tests.outside.case import NOBODY, OK, REFUSED, UNVERIFIABLE, VIOLATED, Case
from tests.outside.cases.healthy import PAIR
from tests.outside.running import Run

PORT_BASE, DOMAIN_GAIN, OFFSET_D1, PARTICIPANT_GAIN = 7400, 250, 10, 2
"""DDSI-RTPS 9.6.2.3: ports of a domain, and of a participant's metatraffic."""

PROFILE = """\
<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"><profiles>
<transport_descriptors><transport_descriptor><transport_id>u</transport_id><type>UDPv4</type>
<interfaceWhiteList><address>127.0.0.1</address></interfaceWhiteList>
</transport_descriptor></transport_descriptors>
<participant profile_name="p" is_default_profile="true"><rtps>
<useBuiltinTransports>false</useBuiltinTransports>
<userTransports><transport_id>u</transport_id></userTransports>
<builtin><metatrafficUnicastLocatorList><locator><udpv4><address>127.0.0.1</address>
<port>{own}</port></udpv4></locator></metatrafficUnicastLocatorList>
<initialPeersList><locator><udpv4><address>127.0.0.1</address><port>{peer}</port></udpv4></locator>
</initialPeersList></builtin></rtps></participant></profiles></dds>
"""


def _udp_ports(pid: int) -> Iterator[int]:
    """Ports of the UDP sockets of a process."""
    return (each.laddr.port for each in psutil.Process(pid).net_connections("udp4"))


def _metatraffic_port(run: Run, process: str) -> int:
    """Where the participant of a process is found by others."""
    first = PORT_BASE + DOMAIN_GAIN * run.domain_id + OFFSET_D1
    found: list[int] = []

    def known() -> bool:
        found[:] = [
            port
            for port in _udp_ports(run.pid_of(process))
            if first <= port < first + DOMAIN_GAIN and (port - first) % PARTICIPANT_GAIN == 0
        ]
        return bool(found)

    run.wait(known, "its metatraffic port")
    return found[0]


def _hidden(run: Run, *words: str, of: str = "listener") -> None:
    """Start a stranger that only one process of the system is found by, and that finds only it."""
    profile = run.directory / "hidden.xml"
    profile.write_text(PROFILE.format(own=39123, peer=_metatraffic_port(run, of)))
    run.stranger(
        "stranger",
        *words,
        FASTRTPS_DEFAULT_PROFILES_FILE=str(profile),
        ROS_AUTOMATIC_DISCOVERY_RANGE="SYSTEM_DEFAULT",
    )


def hidden_publisher_when_active(run: Run) -> None:
    run.until_active()
    _hidden(run, "pub:/chatter")


def hidden_publisher_before_the_gate(run: Run) -> None:
    run.until("node", node="/listener", reach="started")
    _hidden(run, "pub:/chatter")


def hidden_subscription(run: Run) -> None:
    run.until_active()
    _hidden(run, "sub:/chatter", of="talker")


def tools_that_come_and_go(run: Run) -> None:
    run.until_active()
    for _ in range(3):
        run.stranger("_ros2cli_77", "sub:/chatter", "for:0.4", wait=False).wait(10)


def liar(run: Run) -> None:
    run.program("liar.py")


def liar_beside_verify(run: Run) -> None:
    liar(run)
    run.stranger("listener", "sub:/chatter")


def node_of_ours(run: Run) -> None:
    run.program("-m", "lifecycle", "run", "own.yaml", "talker", "--manual", wait=False)


def verify_beside(run: Run) -> None:
    run.until_active()
    beside = run.lifecycle("verify", "{}", "--strict")
    assert beside.returncode == 0, beside.stdout + beside.stderr


SLOW = PAIR.replace(
    '    run: {python: "nodes:Listener"}\n',
    '    run: {python: "slow:SlowListener"}\n',
)
SLOW_LISTENER = {
    "slow.py": (
        "import time\nfrom nodes import Listener\n\n\nclass SlowListener(Listener):\n"
        "    def on_connect(self, state=None):\n        time.sleep(4)\n"
    )
}

MARKED = """\
manifest_version: 1
system: marked
discovery: {range: localhost}
nodes:
  talker:
    run: {python: "%s"}
    interface: {publishers: [{name: chatter, type: std_msgs/msg/String}]}
    flows: {publishers: {chatter: {unique: strictly_required, dscp: EF, transport: network}}}
  listener:
    run: {python: "nodes:Listener"}
    interface: {subscriptions: [{name: chatter, type: std_msgs/msg/String}]}
"""
RESETTING = {
    "resetting.py": '''"""A talker that takes the mark of its sockets away again."""
import itertools, os, socket, stat, threading, time
from nodes import Talker


def reset():
    for name in os.listdir("/proc/self/fd"):
        try:
            each = socket.socket(fileno=os.dup(int(name)))
        except OSError:
            continue
        with each:
            try:
                if each.getsockopt(socket.IPPROTO_IP, socket.IP_TOS):
                    each.setsockopt(socket.IPPROTO_IP, socket.IP_TOS, 0)
            except OSError:
                pass


def marked():
    """Yield sockets that have a mark."""
    for name in os.listdir("/proc/self/fd"):
        try:
            if not stat.S_ISSOCK(os.fstat(int(name)).st_mode):
                continue
            each = socket.socket(fileno=os.dup(int(name)))
        except OSError:
            continue
        if each.family == socket.AF_INET and each.getsockopt(socket.IPPROTO_IP, socket.IP_TOS):
            yield each
        else:
            each.close()


class WhenActive(Talker):
    def on_activate(self):
        super().on_activate()
        threading.Timer(0.7, reset).start()


class WhenConnected(Talker):
    def on_connect(self, state=None):
        threading.Timer(0.05, reset).start()


class UntilActive(Talker):
    is_active = False

    def on_connect(self, state=None):
        threading.Thread(target=self.flicker, daemon=True).start()

    def flicker(self):
        while not (sockets := list(marked())):
            time.sleep(0.01)
        was = sockets[0].getsockopt(socket.IPPROTO_IP, socket.IP_TOS)
        for mark in itertools.cycle((0, was)):
            for each in sockets:
                each.setsockopt(socket.IPPROTO_IP, socket.IP_TOS, mark)
            if self.is_active and not mark:
                return
            time.sleep(0.003 if mark else 0.001)

    def on_activate(self):
        super().on_activate()
        self.is_active = True
'''
}

FOREIGN = """\
manifest_version: 1
system: foreign
discovery: {range: localhost}
%snodes:
  talker:
    run: {command: [python3, talker.py]}
    managed: false
    interface: {publishers: [{name: chatter, type: std_msgs/msg/String}]}
  listener:
    run: {%s}
    managed: false
    interface: {subscriptions: [{name: chatter, type: std_msgs/msg/String}]}
"""
PLAIN = {
    "talker.py": (
        "import rclpy\nfrom std_msgs.msg import String\nrclpy.init()\n"
        'node = rclpy.create_node("talker")\n'
        'publisher = node.create_publisher(String, "chatter", 10)\n'
        'node.create_timer(0.1, lambda: publisher.publish(String(data="hello")))\n'
        "try:\n    rclpy.spin(node)\nexcept BaseException:\n    pass\n"
    ),
    "listener.py": (
        "import rclpy\nfrom rclpy.node import Node\nfrom std_msgs.msg import String\n\n\n"
        "class Listener(Node):\n    def __init__(self):\n        super().__init__('listener')\n"
        "        self.create_subscription(String, 'chatter', lambda _: None, 10)\n\n\n"
        "if __name__ == '__main__':\n    rclpy.init()\n"
        "    try:\n        rclpy.spin(Listener())\n    except BaseException:\n        pass\n"
    ),
}
LYING = """\
manifest_version: 1
system: lying
discovery: {range: localhost}
nodes:
  talker:
    run: {%s}
    managed: false
    interface: {publishers: [{name: chatter, type: std_msgs/msg/String, qos: {depth: 10}}]}
    flows: {publishers: {chatter: {transport: network}}}
  listener:
    run: {python: "nodes:Listener"}
    interface: {subscriptions: [{name: chatter, type: std_msgs/msg/String}]}
"""
LIAR = {
    "liar.py": '''"""A plain node of depth 1 that reports, as a node in a host, depth 10."""
import json
import os
import rclpy
from rcl_interfaces.srv import SetParameters
from rclpy.qos import QoSProfile
from std_msgs.msg import String
from std_srvs.srv import Trigger

rclpy.init()
node = rclpy.create_node("talker")
publisher = node.create_publisher(String, "chatter", QoSProfile(depth=1))


def gids(infos):
    return sorted(bytes(each.endpoint_gid)[:16].hex() for each in infos)


def describe(_, response):
    (own,) = gids(node.get_publishers_info_by_topic("/chatter"))
    peers = gids(node.get_subscriptions_info_by_topic("/chatter"))
    machine = "/etc/machine-id" if os.path.exists("/etc/machine-id") else os.devnull
    publishes = {
        "kind": "publishers",
        "name": "chatter",
        "resolved": "/chatter",
        "type": "std_msgs/msg/String",
        "qos": {
            "history": "KEEP_LAST",
            "depth": 10,
            "reliability": "RELIABLE",
            "durability": "VOLATILE",
            "liveliness": "AUTOMATIC",
        },
        "gid": own,
        "mapped": True,
        "matched": len(peers),
        "peers": peers,
        "nfes": [
            {
                "transport_protocol": "udp",
                "internet_protocol": "ipv4",
                "transport_port": 40001,
                "internet_address": "127.0.0.1",
            }
        ],
    }
    document = {
        "identity": {
            "machine_id": open(machine).read().strip(),
            "process_id": os.getpid(),
            "node_id": "/talker@" + own[:24],
        },
        "name": "/talker",
        "state": "",
        "connected": True,
        "rmw": "rmw_fastrtps_cpp",
        "transports": ["udpv4"],
        "serializations": ["cdr"],
        "paradigms": ["publish-subscribe"],
        "endpoints": [publishes],
    }
    response.success, response.message = True, json.dumps(document)
    return response


node.create_service(Trigger, "~/get_configuration", describe)
node.create_service(SetParameters, "~/map_to", lambda _, response: response)
node.create_timer(0.1, lambda: publisher.publish(String(data="lie")))
print("ready", flush=True)
try:
    rclpy.spin(node)
except BaseException:
    pass
''',
}
HONEST = """\
manifest_version: 1
system: honest
discovery: {range: localhost}
nodes:
  talker:
    run: {%s}
    interface: {publishers: [{name: chatter, type: std_msgs/msg/String, qos: {depth: 10}}]}
  listener:
    run: {python: "nodes:Listener"}
    interface: {subscriptions: [{name: chatter, type: std_msgs/msg/String}]}
"""
ATTACHED, LIES = "attach: true", "command: [python3, liar.py]"
COMMAND, HOSTED = "command: [python3, listener.py]", 'python: "listener:Listener"'
TRUST = "policy: {trust: [flow.unreported]}\n"

CASES = (
    Case(
        attack="a publisher that no graph shows feeds the listener after the gate",
        manifest=PAIR,
        verb=("up", "--strict", "--stop-after", "10"),
        story=hidden_publisher_when_active,
        exit_code=4,
        verdict=VIOLATED,
        findings=("graph.unknown-peer",),
    ),
    Case(
        attack="a publisher that no graph shows is there before the gate",
        manifest=SLOW,
        files=SLOW_LISTENER,
        verb=("up", "--strict", "--stop-after", "2", "--timeout", "12"),
        story=hidden_publisher_before_the_gate,
        findings=("graph.unknown-peer",),
        **REFUSED,
    ),
    Case(
        attack="a subscription that no graph shows listens to the talker",
        manifest=PAIR,
        verb=("up", "--strict", "--stop-after", "10"),
        story=hidden_subscription,
        exit_code=4,
        verdict=VIOLATED,
        findings=("graph.unknown-peer",),
    ),
    Case(
        attack="`ros2 topic echo` beside a strict robot disturbs nothing",
        manifest=PAIR,
        verb=("up", "--strict", "--stop-after", "3"),
        strangers=(("_ros2cli_4711", "sub:/chatter"),),
        verdict=OK,
        activated=frozenset({"talker", "listener"}),
    ),
    Case(
        attack="tools that come and go disturb nothing",
        manifest=PAIR,
        verb=("up", "--strict", "--stop-after", "9"),
        story=tools_that_come_and_go,
        verdict=OK,
    ),
    Case(
        attack="a node takes its mark away after it was activated",
        manifest=MARKED % "resetting:WhenActive",
        files=RESETTING,
        verb=("up", "--strict", "--stop-after", "4"),
        exit_code=4,
        verdict=VIOLATED,
        findings=("flow.dscp-not-applied",),
    ),
    Case(
        attack="a node takes its mark away between connect and gate",
        manifest=MARKED % "resetting:WhenConnected",
        files={**RESETTING, **SLOW_LISTENER},
        verb=("up", "--strict", "--stop-after", "2", "--timeout", "8"),
        says=("DSCP",),
        **REFUSED,
    ),
    Case(
        attack="a node takes its mark away and gives it back until it is active",
        manifest=MARKED % "resetting:UntilActive",
        files=RESETTING,
        verb=("up", "--strict", "--stop-after", "4"),
        exit_code=4,
        verdict=VIOLATED,
        findings=("flow.dscp-not-applied",),
    ),
    Case(
        attack="a node that keeps its mark is ok",
        manifest=MARKED % "nodes:Talker",
        verb=("up", "--strict", "--stop-after", "3"),
        verdict=OK,
    ),
    Case(
        attack="a flow between two programs that report nothing",
        manifest=FOREIGN % ("", COMMAND),
        files=PLAIN,
        verb=("up", "--stop-after", "1"),
        verdict=UNVERIFIABLE,
        findings=("flow.unreported",),
        says=("flow.unreported",),
        quick=True,
    ),
    Case(
        attack="a strict gate and a flow between two programs that report nothing",
        manifest=FOREIGN % ("", COMMAND),
        files=PLAIN,
        verb=("up", "--strict", "--stop-after", "1", "--timeout", "6"),
        exit_code=5,
        verdict=UNVERIFIABLE,
        findings=("flow.unreported",),
    ),
    Case(
        attack="the manifest trusts what nobody reports",
        manifest=FOREIGN % (TRUST, COMMAND),
        files=PLAIN,
        verb=("up", "--strict", "--stop-after", "1"),
        verdict=OK,
        says=("flow.unreported",),
    ),
    Case(
        attack="one end in our host proves the flow",
        manifest=FOREIGN % ("", HOSTED),
        files=PLAIN,
        verb=("up", "--strict", "--stop-after", "1"),
        verdict=OK,
        not_findings=("flow.unreported",),
    ),
    Case(
        attack="a manifest trusts a rule that there is not",
        manifest=FOREIGN % ("policy: {trust: [flow.unreportet]}\n", COMMAND),
        files=PLAIN,
        verb=("check",),
        exit_code=3,
        says=("system.lifecycle.yaml:4:18", "flow.unreported"),
    ),
    Case(
        attack="a foreign node says of itself what only it can know",
        manifest=LYING % ATTACHED,
        files=LIAR,
        verb=("up", "--strict", "--stop-after", "1", "--timeout", "8"),
        story=liar,
        exit_code=5,
        verdict=UNVERIFIABLE,
        findings=("graph.qos-unverifiable", "flow.wrong-transport"),
        activated=NOBODY,
        quick=True,
    ),
    Case(
        attack="a program that the system starts says of itself what only it can know",
        manifest=LYING % LIES,
        files=LIAR,
        verb=("up", "--stop-after", "1"),
        verdict=UNVERIFIABLE,
        findings=("graph.qos-unverifiable", "flow.wrong-transport"),
    ),
    Case(
        attack="a foreign node passes for one of a host where no supervisor runs",
        manifest=(LYING % 'python: "nodes:Talker"').replace(
            'run: {python: "nodes:Listener"}', "run: {attach: true}\n    managed: false"
        ),
        files=LIAR,
        verb=("verify", "--strict", "--timeout", "4"),
        story=liar_beside_verify,
        exit_code=4,
        verdict=VIOLATED,
        findings=("config.missing-report",),
    ),
    Case(
        attack="a node of ours that no supervisor started proves what it says",
        manifest=HONEST % ATTACHED,
        files={"own.yaml": HONEST % 'python: "nodes:Talker"'},
        verb=("up", "--strict", "--stop-after", "1"),
        story=node_of_ours,
        verdict=OK,
        activated=frozenset({"talker", "listener"}),
    ),
    Case(
        attack="`verify` from another process proves what nodes say under their supervisor",
        manifest=HONEST % 'python: "nodes:Talker"',
        verb=("up", "--strict", "--stop-after", "12"),
        story=verify_beside,
        verdict=OK,
    ),
)
