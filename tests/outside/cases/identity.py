"""Whose an endpoint is, what counts as noise, and where the time comes from."""

from __future__ import annotations

from tests.outside.case import NOBODY, OK, REFUSED, UNVERIFIABLE, VIOLATED, Case
from tests.outside.running import Run

RESET = """\
manifest_version: 1
system: reset
discovery: {range: localhost}
nodes:
  server:
    run: {python: "nodes:Server"}
    interface: {service_servers: [{name: /reset, type: std_srvs/srv/Trigger}]}
  client:
    run: {python: "nodes:Client"}
    interface: {service_clients: [{name: /reset, type: std_srvs/srv/Trigger}]}
"""

PAIR = """\
manifest_version: 1
system: pair
discovery: {range: localhost}
nodes:
  talker:
    run: {python: "nodes:Talker"}
    interface: {publishers: [{name: chatter, type: std_msgs/msg/String}]}
%s
  listener:
    run: {python: "nodes:Listener"}
    interface: {subscriptions: [{name: chatter, type: std_msgs/msg/String}]}
"""

SIMULATED = """\
manifest_version: 1
system: simulated
discovery: {range: localhost}
%s
nodes:
  talker:
    run: {python: "nodes:Talker"}
    %s
    interface: {publishers: [{name: chatter, type: std_msgs/msg/String}]}
  listener:
    run: {python: "nodes:Listener"}
    interface: {subscriptions: [{name: chatter, type: std_msgs/msg/String}]}
%s"""

CLOCK = """\
  simulator:
    run: {python: "more:%s"}
    interface: {publishers: [{name: /clock, type: rosgraph_msgs/msg/Clock}]}
"""

FOREIGN = """\
manifest_version: 1
system: foreign
discovery: {range: localhost}
nodes:
  one:
    run: {command: [python3, raw.py]}
    managed: false
    interface: {publishers: [{name: /chatter, type: std_msgs/msg/String}]}
"""

RAW = """
import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import String

rclpy.init()
node = Node("one")
node.create_publisher(String, "/chatter", 1)
node.create_publisher(String, "/other", QoSProfile(depth=1, avoid_ros_namespace_conventions=True))
try:
    rclpy.spin(node)
except BaseException:
    node.destroy_node()
    rclpy.try_shutdown()
"""

OWN_FLOW = "    flows: {publishers: {chatter: {unique: strictly_required}}}"

ONE = """\
manifest_version: 1
system: one
discovery: {range: localhost}
nodes:
  one:
    run: {python: "more:%s"}
    managed: false
    interface: {%s}
"""

MORE = {
    "more.py": '''
from lifecycle import LifecycleNode, on_timer
from nodes import Marked, Server, mark
from rclpy.action import ActionServer
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci


class Simulator(Marked):
    @on_timer(period_s=0.1)
    def step(self):
        now = Clock()
        now.clock.sec = self.now = getattr(self, "now", 0) + 1
        self.publisher("/clock").publish(now)


class Paused(Marked):
    pass


class Acts(Node):
    """A plain node with an action server, whose hidden parts are as asked."""

    def __init__(self):
        super().__init__("one")
        self.server = ActionServer(self, Fibonacci, "/dock", lambda _: Fibonacci.Result())
        self.more()

    def more(self):
        pass


class Twice(Acts):
    def more(self):
        self.again = ActionServer(self, Fibonacci, "/dock", lambda _: Fibonacci.Result())


class HalfStatus(Acts):
    """Its only `status` has another type."""

    def __init__(self):
        Node.__init__(self, "one")
        for part in ("send_goal", "cancel_goal", "get_result"):
            type_ = {
                "send_goal": Fibonacci.Impl.SendGoalService,
                "cancel_goal": Trigger,
                "get_result": Fibonacci.Impl.GetResultService,
            }[part]
            self.create_service(type_, f"/dock/_action/{part}", lambda _, response: response)
        self.create_publisher(Fibonacci.Impl.FeedbackMessage, "/dock/_action/feedback", 1)
        self.create_publisher(String, "/dock/_action/status", 1)


class Noisy(Node):
    topic = "~/transition_event"

    def __init__(self):
        super().__init__("one", enable_rosout=False)
        self.create_publisher(String, self.topic, 1)


class Logs(Noisy):
    topic = "/rosout"


class Plain(Node):
    def __init__(self):
        super().__init__("one")


class TwoServers(Node):
    def __init__(self):
        super().__init__("one")
        for _ in range(2):
            self.create_service(Trigger, "/reset", lambda _, response: response)
'''
}

ANSWERING = """
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger


def answer(_, response):
    response.message = "real"
    return response


rclpy.init()
node = rclpy.create_node("server")
qos = QoSProfile(depth=10, reliability=ReliabilityPolicy.%s)
node.create_service(Trigger, "/reset", answer, qos_profile=qos)
try:
    rclpy.spin(node)
except BaseException:
    node.destroy_node()
    rclpy.try_shutdown()
"""
ANSWERED = RESET.replace('{python: "nodes:Server"}', "{command: [python3, answering.py]}").replace(
    "    interface: {service_servers", "    managed: false\n    interface: {service_servers"
)

BRIEFLY = ("up", "--strict", "--stop-after", "2", "--timeout", "6")
DOCK = "action_servers: [{name: /dock, type: test_msgs/action/Fibonacci}]"


def _intruders(*strangers: tuple[str, str], manifest: str = RESET, quick: bool = False) -> Case:
    """Strangers that are named as what is hidden, or as tools: each is found."""
    return Case(
        attack=f"another process has a node {', '.join(map(': '.join, strangers))}",
        manifest=manifest,
        verb=BRIEFLY,
        strangers=strangers,
        received=NOBODY,
        quick=quick,
        violated=tuple(f"/{name}" for name, _ in strangers),
        **REFUSED,
    )


def _node(attack: str, program: str, interface: str = "", *findings: str) -> Case:
    return Case(
        attack=attack,
        manifest=ONE % (program, interface),
        files=MORE,
        verb=BRIEFLY,
        exit_code=4,
        verdict=VIOLATED,
        findings=findings,
    )


def _late_clock(run: Run) -> None:
    run.until("node", node="/talker")
    run.stranger("rosbag2_player", "clock")


SIM = "parameters: {use_sim_time: true}"
PARAMETERS = {"p.yaml": "/**:\n  ros__parameters: {use_sim_time: true}\n"}

CASES = (
    _intruders(("_server_x", "srv:/reset"), quick=True),
    _intruders(
        ("_server_flow_0", "srv:/reset"),
        ("_client_x", "cli:/reset"),
        ("_ros2cli_4711", "srv:/reset"),
        ("transform_listener_impl_5f", "srv:/reset"),
    ),
    _intruders(("_talker_x", "pub:/chatter"), ("_listener_x", "sub:/chatter"), manifest=PAIR % ""),
    _intruders(("_talker_flow_0", "pub:/chatter"), manifest=PAIR % OWN_FLOW),
    Case(
        attack="verify is asked while a hidden node of a stranger serves",
        manifest=RESET,
        verb=("verify", "--strict"),
        strangers=(("_server_x", "srv:/reset"),),
        exit_code=4,
        verdict=VIOLATED,
        findings=("graph.undeclared-node",),
    ),
    Case(
        attack="a service is served and asked as declared",
        manifest=RESET,
        verdict=OK,
        received=frozenset({"real"}),
    ),
    Case(
        attack="a service is served by another program as declared",
        manifest=ANSWERED,
        files={"answering.py": ANSWERING % "RELIABLE"},
        verb=("up", "--stop-after", "2"),
        received=frozenset({"real"}),
    ),
    Case(
        attack="a server of a declared service is none that DDS matches with its client",
        manifest=ANSWERED,
        files={"answering.py": ANSWERING % "BEST_EFFORT"},
        verb=BRIEFLY,
        findings=("graph.unmatched-client",),
        says=("matched on service /reset: the client counts no server as available",),
        **REFUSED,
    ),
    Case(
        attack="a publisher has a participant of its own",
        manifest=PAIR % OWN_FLOW,
        verb=("up", "--stop-after", "2"),
        received=frozenset({"hello"}),
        not_findings=("graph.undeclared-node", "graph.undeclared-publisher"),
    ),
    Case(
        attack="tools look at a system",
        manifest=RESET,
        strangers=(
            ("_ros2cli_4711", "sub:/rosout", "cli:/reset"),
            ("rviz2", "sub:/clock_offset"),
            ("transform_listener_impl_5f", "sub:/tf"),
        ),
        verb=("up", "--stop-after", "2"),
        not_findings=("graph.undeclared-node",),
    ),
    _node(
        "a declared node has a second server of its service",
        "TwoServers",
        "service_servers: [{name: /reset, type: std_srvs/srv/Trigger}]",
        "graph.undeclared-service-server",
    ),
    _node("a node has two servers of one action", "Twice", DOCK),
    _node(
        "status and cancel_goal of an action have another type",
        "HalfStatus",
        DOCK,
        "graph.type-mismatch",
    ),
    Case(
        attack="an action is served as declared",
        manifest=ONE % ("Acts", DOCK),
        files=MORE,
        verb=("up", "--stop-after", "2"),
        not_findings=("graph.type-mismatch", "graph.undeclared-action-server"),
    ),
    _node(
        "a node publishes strings on its transition_event",
        "Noisy",
        "",
        "graph.undeclared-publisher",
    ),
    _node("a node publishes strings on /rosout", "Logs", "", "graph.undeclared-publisher"),
    Case(
        attack="another program's node publishes on a topic of DDS without the prefix of ROS",
        manifest=FOREIGN,
        files={"raw.py": RAW},
        verb=BRIEFLY,
        exit_code=4,
        verdict=VIOLATED,
        findings=("graph.undeclared-publisher",),
        says=("dds:",),
    ),
    Case(
        attack="a plain node has only what rclpy gives it",
        manifest=ONE % ("Plain", ""),
        files=MORE,
        verb=("up", "--stop-after", "2"),
        verdict=OK,
    ),
    *(
        Case(
            attack=f"nobody publishes the time of a node: {how}",
            manifest=SIMULATED % (document, node, ""),
            files=PARAMETERS,
            verb=BRIEFLY,
            findings=("time.no-clock",),
            **REFUSED,
        )
        for how, document, node in (
            ("in line", "", SIM),
            ("for the whole system", "use_sim_time: true", ""),
            ("from a file for all nodes", "", "parameter_files: [p.yaml]"),
        )
    ),
    Case(
        attack="check is asked of a system whose time nobody publishes",
        manifest=SIMULATED % ("", SIM, ""),
        verb=("check",),
        says=("no node declares a publisher of '/clock'",),
    ),
    Case(
        attack="an undeclared player publishes the time",
        manifest=SIMULATED % ("", SIM, ""),
        strangers=(("rosbag2_player", "clock"),),
        verb=("up", "--stop-after", "2"),
        verdict=UNVERIFIABLE,
        findings=("time.undeclared-clock",),
        says=("rosbag2_player",),
    ),
    Case(
        attack="two players publish the time",
        manifest=SIMULATED % ("", SIM, ""),
        strangers=(("rosbag2_player", "clock"), ("rqt_clock", "clock")),
        verb=BRIEFLY,
        findings=("time.several-clocks",),
        **REFUSED,
    ),
    Case(
        attack="the player begins late",
        manifest=SIMULATED % ("", SIM, ""),
        verb=("up", "--stop-after", "2"),
        story=_late_clock,
        verdict=UNVERIFIABLE,
        not_findings=("time.no-clock",),
    ),
    Case(
        attack="a declared simulator publishes the time",
        manifest=SIMULATED % ("", SIM, CLOCK % "Simulator"),
        files=MORE,
        verb=("up", "--stop-after", "3"),
        verdict=OK,
    ),
    Case(
        attack="a declared simulator never publishes the time",
        manifest=SIMULATED % ("", SIM, CLOCK % "Paused"),
        files=MORE,
        verb=("up", "--stop-after", "4"),
        verdict=UNVERIFIABLE,
        findings=("time.silent-clock",),
    ),
)
