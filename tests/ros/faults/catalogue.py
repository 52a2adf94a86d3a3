"""Every fault of the suite, grouped by the stage that must catch it."""

from __future__ import annotations

from tests.installation import PYTHON
from tests.ros.faults.system import BARE_DDS, NODES, ExitCode, Fault, foreign

TALKER = "nodes/talker"
LISTENER = "nodes/listener"


def _command(*arguments: str) -> dict[str, object]:
    """Edits that make the talker a foreign command instead of a class of ours."""
    return {
        f"{TALKER}/run": {"command": foreign(*arguments)},
        f"{TALKER}/managed": False,
        f"{TALKER}/interface": {
            "publishers": [{"name": "/chatter", "type": "std_msgs/msg/String"}]
        },
    }


def _docked(*arguments: str) -> dict[str, object]:
    """Edits that add a foreign command, which declares an action server."""
    dock = {
        "run": {"command": foreign("dock", *arguments)},
        "managed": False,
        "interface": {"action_servers": [{"name": "/dock", "type": "test_msgs/action/Fibonacci"}]},
    }
    return {"nodes/dock": dock}


def _misbehave(node: str, way: str, **timeouts: float) -> dict[str, object]:
    edits: dict[str, object] = {f"nodes/{node}/parameters/misbehave": way}
    edits.update({f"nodes/{node}/timeouts/{step}": seconds for step, seconds in timeouts.items()})
    return edits


def _run(node: str, name: str) -> dict[str, object]:
    return {f"nodes/{node}/run": {"python": name if ":" in name else f"{NODES}:{name}"}}


STATIC = (
    Fault(
        name="two types on one topic",
        quick=True,
        edits={f"{LISTENER}/interface/subscriptions/0/type": "std_msgs/msg/Int32"},
        exit_code=ExitCode.MANIFEST_INVALID,
        subject="/chatter",
        message="std_msgs/msg/Int32",
    ),
    Fault(
        name="the declared QoS profiles are incompatible",
        edits={
            f"{TALKER}/interface/publishers/0/qos": "sensor_data",
            f"{LISTENER}/interface/subscriptions/0/qos": {"reliability": "RELIABLE"},
        },
        exit_code=ExitCode.MANIFEST_INVALID,
        subject="/chatter",
        message="reliability",
    ),
    Fault(
        name="a strictly unique publisher is asked of a command",
        edits={
            **_command("talker"),
            f"{TALKER}/flows": {"publishers": {"/chatter": {"unique": "strictly_required"}}},
        },
        exit_code=ExitCode.MANIFEST_INVALID,
        subject="/chatter",
        message="its participant is made by its own code",
    ),
)

START = (
    Fault(
        name="the module cannot be imported",
        edits=_run("talker", "tests.ros.faults.no_such_module:Talker"),
        exit_code=ExitCode.MANIFEST_INVALID,
        subject="talker",
        message="tests.ros.faults.no_such_module",
    ),
    Fault(
        name="the module raises while it is imported",
        edits=_run("talker", "tests.ros.faults.broken_import:Talker"),
        exit_code=ExitCode.BRING_UP_FAILED,
        subject="talker",
        message="no_such_driver",
    ),
    Fault(
        name="the module has no such class",
        edits=_run("talker", "Talkre"),
        exit_code=ExitCode.MANIFEST_INVALID,
        subject="talker",
        message="Talkre",
    ),
    Fault(
        name="the class is no LifecycleNode",
        edits=_run("talker", "NotALifecycleNode"),
        exit_code=ExitCode.MANIFEST_INVALID,
        subject="talker",
        message="NotALifecycleNode",
    ),
    Fault(
        name="the constructor raises",
        quick=True,
        edits=_run("talker", "RaisesInConstructor"),
        exit_code=ExitCode.BRING_UP_FAILED,
        subject="talker",
        message="no such serial port",
    ),
    Fault(
        name="the process dies while the node is constructed",
        quick=True,
        edits=_run("talker", "DiesInConstructor"),
        exit_code=ExitCode.BRING_UP_FAILED,
        subject="talker",
        message=" died while starting: exit status 9",
    ),
    Fault(
        name="the constructor hangs",
        edits={**_run("talker", "HangsInConstructor"), f"{TALKER}/timeouts/start_s": 1.0},
        exit_code=ExitCode.BRING_UP_FAILED,
        subject="talker",
        message="1 s",
    ),
    Fault(
        name="the command does not exist",
        edits={**_command("talker"), f"{TALKER}/run": {"command": ["/no/such/program"]}},
        exit_code=ExitCode.MANIFEST_INVALID,
        subject="talker",
        message="cannot find program 'program' in '/no/such'",
    ),
    Fault(
        name="the command exits with status 3",
        edits=_command("talker", "--exit", "3"),
        exit_code=ExitCode.BRING_UP_FAILED,
        subject="talker",
        message="exit status 3",
    ),
    Fault(
        name="a node that somebody else should start is not there",
        quick=True,
        edits={f"{LISTENER}/run": {"attach": True}, f"{LISTENER}/timeouts/start_s": 1.0},
        exit_code=ExitCode.BRING_UP_FAILED,
        subject="/listener",
    ),
)

TRANSITIONS = (
    Fault(
        name="a declared subscription has no handler",
        edits=_run("listener", "WithoutHandler"),
        exit_code=ExitCode.MANIFEST_INVALID,
        subject="listener",
        message="@on_message('chatter')",
    ),
    Fault(
        name="a handler names no declared subscription",
        edits=_run("listener", "WithMisspeltHandler"),
        exit_code=ExitCode.MANIFEST_INVALID,
        subject="listener",
        message="@on_message('chater')",
    ),
    *(
        Fault(
            name=f"on_{step} raises",
            quick=step == "activate",
            edits=_misbehave("talker", f"{step}:raise"),
            exit_code=ExitCode.BRING_UP_FAILED,
            subject="/talker",
            message="the sensor is on fire",
            activates=step == "activate",
        )
        for step in ("configure", "connect", "activate")
    ),
    *(
        Fault(
            name=f"on_{step} returns FAILURE",
            edits=_misbehave("listener", f"{step}:failure"),
            exit_code=ExitCode.BRING_UP_FAILED,
            subject="/listener",
            message="FAILURE",
            activates=step == "activate",
        )
        for step in ("configure", "connect", "activate")
    ),
    Fault(
        name="on_configure returns ERROR",
        edits=_misbehave("listener", "configure:error"),
        exit_code=ExitCode.BRING_UP_FAILED,
        subject="/listener",
        message="ERROR",
    ),
    Fault(
        name="on_connect returns something that is no result",
        edits=_misbehave("listener", "connect:nonsense"),
        exit_code=ExitCode.BRING_UP_FAILED,
        subject="/listener",
        message="'done'",
    ),
    *(
        Fault(
            name=f"the process dies in on_{step}",
            edits=_misbehave("talker", f"{step}:{way}"),
            exit_code=ExitCode.BRING_UP_FAILED,
            subject="talker",
            message=how,
            activates=step == "activate",
        )
        for step, way, how in (
            ("configure", "exit", " died while configuring: exit status 9"),
            ("connect", "kill", " died while connecting: killed by SIGKILL"),
            ("activate", "exit", " died while activating: exit status 9"),
        )
    ),
    *(
        Fault(
            name=f"on_{step} hangs",
            quick=step == "connect",
            edits=_misbehave("listener", f"{step}:hang", **{f"{step}_s": 0.4}),
            exit_code=ExitCode.BRING_UP_FAILED,
            subject="/listener",
            message=f"still {step.removesuffix('e')}ing",
            activates=step == "activate",
        )
        for step in ("configure", "connect", "activate")
    ),
    Fault(
        name="an async on_configure awaits for ever",
        quick=True,
        edits={
            **_run("talker", "HangsAsync"),
            **_misbehave("talker", "configure:await", configure_s=0.4),
        },
        exit_code=ExitCode.BRING_UP_FAILED,
        subject="/talker",
        message="0.4 s",
    ),
    Fault(
        name="the whole bring-up takes too long",
        edits=_misbehave("talker", "configure:hang", configure_s=60),
        options=("--timeout", "1.5"),
        exit_code=ExitCode.BRING_UP_FAILED,
        subject="/talker",
        message="1.5 s",
    ),
)

GRAPH = (
    Fault(
        name="a node makes a publisher that it does not declare",
        quick=True,
        edits=_misbehave("talker", "configure:publisher"),
        exit_code=ExitCode.VIOLATED,
        rule="graph.undeclared-publisher",
        subject="/undeclared_out",
        message="/talker",
    ),
    Fault(
        name="a node makes a subscription that it does not declare",
        edits=_misbehave("talker", "connect:subscription"),
        exit_code=ExitCode.VIOLATED,
        rule="graph.undeclared-subscription",
        subject="/undeclared_in",
        message="/talker",
    ),
    Fault(
        name="a command publishes with another QoS than declared",
        quick=True,
        edits=_command("talker", "--publish", "/chatter:std_msgs/msg/String:BEST_EFFORT"),
        exit_code=ExitCode.VIOLATED,
        rule="graph.qos-incompatible",
        subject="/chatter",
        message="reliability",
    ),
    Fault(
        name="a command publishes another type than declared",
        edits=_command("talker", "--publish", "/chatter:std_msgs/msg/Int32:RELIABLE"),
        exit_code=ExitCode.VIOLATED,
        rule="graph.type-mismatch",
        subject="/chatter",
        message="std_msgs/msg/Int32",
    ),
    Fault(
        name="a command does not make the publisher that it declares",
        edits=_command("talker"),
        exit_code=ExitCode.VIOLATED,
        rule="graph.missing-endpoint",
        options=("--timeout", "6"),  # all of it is waited for, and it has to come up in it
        subject="/chatter",
        message="/talker",
    ),
    Fault(
        name="a command offers an action of another type than declared",
        edits=_docked("--serve", "/dock:test_msgs/action/NestedMessage"),
        exit_code=ExitCode.VIOLATED,
        rule="graph.type-mismatch",
        subject="/dock",
        message="test_msgs/action/NestedMessage",
    ),
    Fault(
        name="a command does not make the action server that it declares",
        edits=_docked(),
        exit_code=ExitCode.VIOLATED,
        rule="graph.missing-endpoint",
        options=("--timeout", "6"),
        subject="/dock",
        message="the action server of /dock in /dock is declared, and is not there",
    ),
    Fault(
        name="a command ignores its remap and publishes elsewhere",
        edits=_command("talker", "--publish", "/chattter:std_msgs/msg/String:RELIABLE"),
        exit_code=ExitCode.VIOLATED,
        rule="graph.undeclared-publisher",
        subject="/chattter",
    ),
    Fault(
        name="a command never makes its node",
        edits={
            **_command("talker"),
            f"{TALKER}/run": {"command": [str(PYTHON), "-c", "import time; time.sleep(60)"]},
        },
        exit_code=ExitCode.VIOLATED,
        rule="graph.missing-node",
        options=("--timeout", "5"),
        subject="/talker",
    ),
    Fault(
        name="a node that nobody declared is in the domain",
        edits={},
        intruder=("stranger", "--publish", "/noise:std_msgs/msg/String:RELIABLE"),
        exit_code=ExitCode.VIOLATED,
        rule="graph.undeclared-node",
        subject="/stranger",
    ),
    Fault(
        name="a foreign node has the name of one of ours",
        quick=True,
        edits={},
        intruder=("talker",),
        exit_code=ExitCode.VIOLATED,
        rule="graph.duplicate-node",
        subject="/talker",
    ),
)

DEFINITIONS = (
    Fault(
        name="a publisher was built from another definition of its type",
        quick=True,
        edits=_command(
            *("talker", "--publish", "/chatter:std_msgs/msg/String:RELIABLE"),
            *("--redefine", "std_msgs/msg/String"),
        ),
        exit_code=ExitCode.VIOLATED,
        rule="graph.type-definition-differs",
        subject="/chatter",
        message="which is installed here: it is matched, and the data are not understood",
    ),
    Fault(
        name="a client was built from another definition of its service",
        edits={
            "nodes/asker": {
                "run": {
                    "command": foreign(
                        *("asker", "--call", "/listener/ping:std_srvs/srv/Trigger"),
                        *("--redefine", "std_srvs/srv/Trigger"),
                    )
                },
                "managed": False,
                "interface": {
                    "service_clients": [{"name": "/listener/ping", "type": "std_srvs/srv/Trigger"}]
                },
            }
        },
        exit_code=ExitCode.VIOLATED,
        rule="graph.type-definition-differs",
        subject="/listener/ping",
        message="service client of /listener/ping in /asker",
    ),
    Fault(
        name="an action server was built from another definition of its action",
        edits=_docked(
            *("--serve", "/dock:test_msgs/action/Fibonacci"),
            *("--redefine", "test_msgs/action/Fibonacci"),
        ),
        exit_code=ExitCode.VIOLATED,
        rule="graph.type-definition-differs",
        subject="/dock",
        message="action server of /dock in /dock",
    ),
)

FLOWS = (
    Fault(
        name="a strictly unique subscription on a transport without network flows",
        edits={
            f"{LISTENER}/flows": {"subscriptions": {"chatter": {"unique": "strictly_required"}}},
            f"{LISTENER}/run/environment": {
                "FASTRTPS_DEFAULT_PROFILES_FILE": "$(env FAULT_SHARED_MEMORY_ONLY)"
            },
            "discovery/range": "off",  # localhost would add UDP again
        },
        exit_code=ExitCode.BRING_UP_FAILED,
        subject="/listener",
        message="chatter",
    ),
    Fault(
        name="a foreign node does not tell its queue depth and the manifest insists",
        edits={
            **_command("talker", "--publish", "/chatter:std_msgs/msg/String:RELIABLE"),
            f"{TALKER}/interface/publishers/0/qos": {"depth": 10},
            "policy/unverifiable": "block",
        },
        exit_code=ExitCode.UNVERIFIABLE,
        rule="graph.qos-unverifiable",
        subject="/talker",
        message="depth",
    ),
    Fault(
        name="a foreign subscription cannot prove the unique flow that it strictly requires",
        edits={
            f"{LISTENER}/run": {
                "command": foreign(
                    *("listener", "--subscribe", "/chatter:std_msgs/msg/String:RELIABLE")
                )
            },
            f"{LISTENER}/managed": False,
            f"{LISTENER}/interface": {
                "subscriptions": [{"name": "/chatter", "type": "std_msgs/msg/String"}]
            },
            f"{LISTENER}/flows": {"subscriptions": {"/chatter": {"unique": "strictly_required"}}},
        },
        exit_code=ExitCode.VIOLATED,
        rule="flow.unverifiable",
        subject="/chatter",
        message="is not proven: /listener does not report",
    ),
    Fault(
        name="nobody measures the rate that the manifest declares and the gate is strict",
        edits={
            f"{TALKER}/flows": {"publishers": {"chatter": {"rate_hz": 500}}},
            f"{LISTENER}/run": {
                "command": foreign(
                    *("listener", "--subscribe", "/chatter:std_msgs/msg/String:RELIABLE")
                )
            },
            f"{LISTENER}/managed": False,
            f"{LISTENER}/interface": {
                "subscriptions": [{"name": "/chatter", "type": "std_msgs/msg/String"}]
            },
        },
        exit_code=ExitCode.UNVERIFIABLE,
        rule="flow.not-measured",
        subject="/chatter",
        message="rate_hz 500",
        options=("--strict",),
    ),
)

ACTIVE = (
    Fault(
        name="data arrive less often than the manifest says",
        edits={f"{TALKER}/flows": {"publishers": {"chatter": {"rate_hz": 500}}}},
        exit_code=ExitCode.VIOLATED,
        rule="flow.rate",
        subject="/chatter: /talker → /listener",
        message=" Hz < 500 Hz - 5%",
        options=("--stop-after", "2"),
        activates=True,
    ),
    Fault(
        name="a process dies after the system is active",
        quick=True,
        edits=_misbehave("talker", "active:kill"),
        exit_code=ExitCode.BRING_UP_FAILED,
        subject="talker",
        message=" died: killed by SIGKILL",
        options=("--stop-after", "20"),  # it is over as soon as the process dies
        activates=True,
    ),
    Fault(
        name="a node makes an undeclared publisher once it is active",
        edits=_misbehave("talker", "active:publisher"),
        exit_code=ExitCode.VIOLATED,
        rule="graph.undeclared-publisher",
        subject="/undeclared_out",
        options=("--stop-after", "3"),
        activates=True,
    ),
)

CHATTER = "/chatter:std_msgs/msg/String:RELIABLE"
_ELSEWHERE = {
    f"{LISTENER}/run": {
        "command": foreign("listener", "--subscribe", CHATTER),
        "environment": {
            "FASTRTPS_DEFAULT_PROFILES_FILE": "$(env FAULT_FOREIGN_PARTITION)",
            "RMW_FASTRTPS_USE_QOS_FROM_XML": "1",
        },
    },
    f"{LISTENER}/managed": False,
    f"{LISTENER}/interface": {
        "subscriptions": [{"name": "/chatter", "type": "std_msgs/msg/String"}]
    },
    "policy/unpublished": "ignore",
}
"""Edits that make the listener a foreign command whose subscription is in another partition."""

OUTSIDERS = (
    Fault(
        name="the listener is in a foreign partition",
        edits=_ELSEWHERE,
        exit_code=ExitCode.VIOLATED,
        rule="graph.unmatched-link",
        subject="/chatter",
        message="the publisher matched none",
        options=("--strict", "--timeout", "6"),
    ),
    Fault(
        name="the listener is in a foreign partition and a tool listens instead",
        edits=_ELSEWHERE,
        intruder=("_ros2cli_4711", "--subscribe", CHATTER),
        exit_code=ExitCode.UNVERIFIABLE,  # the listener is in no host of ours and reports nothing
        rule="graph.unmatched-link",
        subject="/chatter",
        message="the publisher matched 1 of 2, and does not tell which",
        options=("--strict", "--timeout", "6"),
    ),
    *(
        Fault(
            name=f"{tool} publishes on a declared topic",
            edits={},
            intruder=(tool, "--publish", CHATTER, *more),
            exit_code=ExitCode.VIOLATED,
            rule="graph.undeclared-publisher",
            subject="/chatter",
            message=f"the manifest does not declare the publisher of /chatter in {full}",
            options=("--strict",),
        )
        for tool, full, more in (
            ("rqt_robot_steering", "/rqt_robot_steering", ()),
            ("rosbag2_player", "/far/away/rosbag2_player", ("--ros-args", "-r", "__ns:=/far/away")),
            ("_lifecycle_observer_1", "/_lifecycle_observer_1", ()),
        )
    ),
    Fault(
        name="a tool that publishes and serves what it likes serves a declared service too",
        edits={},
        intruder=(
            *("rviz_17", "--publish", "/goal_pose:std_msgs/msg/String:RELIABLE"),
            *("--answer", "/listener/ping:std_srvs/srv/Trigger"),
        ),
        exit_code=ExitCode.VIOLATED,
        rule="graph.undeclared-service-server",
        subject="/listener/ping",
        options=("--strict",),
    ),
    Fault(
        name="a tool answers whoever would change the state of a declared node",
        edits={},
        intruder=("rviz2", "--answer", "/talker/change_state:lifecycle_msgs/srv/ChangeState"),
        exit_code=ExitCode.VIOLATED,
        rule="graph.undeclared-service-server",
        subject="/talker/change_state",
        message="/rviz2",
        options=("--strict",),
    ),
    Fault(
        name="a tool has a server of a declared action",
        quick=True,
        edits=_docked("--serve", "/dock:test_msgs/action/Fibonacci"),
        intruder=("rqt_action", "--serve", "/dock:test_msgs/action/Fibonacci"),
        exit_code=ExitCode.VIOLATED,
        rule="graph.undeclared-action-server",
        subject="/dock",
        message="/rqt_action",
    ),
    Fault(
        name="a tool listens where nobody is tolerated",
        edits={"policy/tolerated_nodes": []},
        intruder=("_ros2cli_4711", "--subscribe", CHATTER),
        exit_code=ExitCode.VIOLATED,
        rule="graph.undeclared-node",
        subject="/_ros2cli_4711",
    ),
    Fault(
        name="a plain DDS program may write a declared topic",
        quick=True,
        edits={},
        intruder=("--write", "rt/chatter:std_msgs::msg::dds_::String_"),
        intruder_is=BARE_DDS,
        exit_code=ExitCode.VIOLATED,
        rule="graph.unattributed-endpoint",
        subject="/chatter",
        message="(a participant of Cyclone DDS, at 127.0.0.1, GID ",
        options=("--strict", "--timeout", "6"),
    ),
    Fault(
        name="a plain DDS program may answer for a declared service",
        edits={},
        intruder=("--write", "rr/listener/pingReply:std_srvs::srv::dds_::Trigger_Response_"),
        intruder_is=BARE_DDS,
        exit_code=ExitCode.VIOLATED,
        rule="graph.unattributed-endpoint",
        subject="/listener/ping",
        options=("--strict", "--timeout", "6"),
    ),
)

FAULTS = STATIC + START + TRANSITIONS + GRAPH + DEFINITIONS + FLOWS + ACTIVE + OUTSIDERS
