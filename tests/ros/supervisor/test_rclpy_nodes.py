"""`run: python` with classes that rclpy's own users write, none of them changed for us."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import rclpy_nodes
import running
from running import LIMITS, Up, verb

from lifecycle.errors import UsageError

_NODES = "tests.ros.supervisor.rclpy_nodes"
_STRING = "std_msgs/msg/String"
_LATCHED = {"depth": 1, "durability": "TRANSIENT_LOCAL"}


def node(reference: str, *, interface: dict[str, Any] | None = None, **keys: Any) -> dict[str, Any]:
    run = {"python": reference if ":" in reference else f"{_NODES}:{reference}"}
    for key in ("arguments", "executor", "threads", "environment", "working_directory"):
        if key in keys:
            run[key] = keys.pop(key)
    return {"run": run, "interface": interface or {}, "timeouts": LIMITS, **keys}


TALKS = {
    "publishers": [
        {"name": "words", "type": _STRING, "qos": {"depth": 7}},
        {"name": "name", "type": _STRING, "qos": _LATCHED},
    ],
    "service_servers": [{"name": "reset", "type": "std_srvs/srv/Trigger"}],
}
HEARS = {
    "subscriptions": [
        {"name": "words", "type": _STRING, "qos": {"depth": 10}},
        {"name": "name", "type": _STRING, "qos": _LATCHED},
    ]
}


def log_of(up: Up, process: str) -> str:
    (path,) = (up.runtime / "log").glob(f"20*/{process}.log")
    return path.read_text(encoding="utf-8")


def is_proven(up: Up) -> bool:
    verdict = up.of_kind("verdict")[-1]["verdict"]
    return (verdict["verdict"], verdict["findings"]) == ("ok", [])


def test_plain_nodes_are_verified_completely_and_released(
    fresh_domain: int, tmp_path: Path, wait_until: Any
) -> None:
    manifest = running.write(
        tmp_path,
        fresh_domain,
        {
            "talker": node(
                "Talker",
                managed=False,
                interface=TALKS,
                namespace="/there",
                remap={"words": "/words"},
                arguments={"word": "hi", "period_s": 0.05},
                parameters={"loud": True},
            ),
            "listener": node(
                "Listener", managed=False, interface=HEARS, remap={"name": "/there/name"}
            ),
        },
        policy={"unverifiable": "block"},
    )
    with running.up(manifest, runtime=tmp_path) as up:
        up.until("system", reached="active")
        wait_until(lambda: "heard HI" in log_of(up, "listener"))
        wait_until(lambda: "heard talker" in log_of(up, "listener"))
        assert "heard CONSTRUCTED" not in log_of(up, "listener")
        wait_until(lambda: "matched with 1" in log_of(up, "talker"))
        assert is_proven(up)
        assert verb("pause", str(manifest), runtime=tmp_path).returncode == 0
        # Held again, it still reports to whoever asks.
        held = verb("verify", str(manifest), "--strict", runtime=tmp_path)
        assert held.returncode == 0, held.stdout
        assert verb("resume", str(manifest), runtime=tmp_path).returncode == 0
        assert verb("down", str(manifest), runtime=tmp_path).returncode == 0
        assert up.finish() == 0
        assert "Traceback" not in log_of(up, "talker")
        up.assert_gate_held()
        up.assert_nothing_left()


def test_what_every_node_has_may_be_declared(fresh_domain: int, tmp_path: Path) -> None:
    rosout = {"name": "/rosout", "type": "rcl_interfaces/msg/Log"}
    events = {"name": "/parameter_events", "type": "rcl_interfaces/msg/ParameterEvent"}
    said = {"name": "~/transition_event", "type": "lifecycle_msgs/msg/TransitionEvent"}
    listed = {"name": "~/list_parameters", "type": "rcl_interfaces/srv/ListParameters"}
    state = {"name": "~/get_state", "type": "lifecycle_msgs/srv/GetState"}
    plain = {**TALKS, "publishers": [*TALKS["publishers"], rosout, events]}
    managed = {"publishers": [rosout, said], "service_servers": [listed, state]}
    manifest = running.write(
        tmp_path,
        fresh_domain,
        {
            "talker": node("Talker", managed=False, interface=plain),
            "managed": node("rclpy.lifecycle:LifecycleNode", interface=managed),
        },
        policy={"unverifiable": "block", "unheard": "ignore"},
    )
    with running.up(manifest, "--stop-after", "0.5", runtime=tmp_path) as up:
        up.until("system", reached="active")
        assert is_proven(up)
        assert up.finish() == 0


def test_a_plain_node_does_nothing_while_the_gate_is_closed(
    fresh_domain: int, tmp_path: Path
) -> None:
    more = {"publishers": [*TALKS["publishers"], {"name": "shouts", "type": _STRING}]}
    manifest = running.write(
        tmp_path,
        fresh_domain,
        {
            "talker": node("Talker", managed=False, interface={**TALKS, **more}),
            "listener": node("Listener", managed=False, interface=HEARS),
        },
    )
    with running.up(manifest, "--timeout", "2", runtime=tmp_path) as up:
        assert up.finish() == 4
        assert [each["message"] for each in up.verdict["findings"]] == [
            "the publisher of /shouts in /talker is declared, and is not there"
        ]
        assert "heard" not in log_of(up, "listener")
        assert "/words is dropped" in log_of(up, "talker").replace("'", "").replace(
            "words", "/words"
        )


def test_a_node_of_rclpy_lifecycle_is_driven_by_its_own_state_machine(
    fresh_domain: int, tmp_path: Path, wait_until: Any
) -> None:
    says = [
        {"name": "words", "type": _STRING, "qos": {"depth": 7}},
        {"name": "status", "type": _STRING, "qos": {"depth": 1}},
    ]
    hears = [{"name": "words", "type": _STRING, "qos": {"depth": 10}}]
    manifest = running.write(
        tmp_path,
        fresh_domain,
        {
            "managed": node("Managed", interface={"publishers": says}),
            "listener": node(
                "Listener",
                managed=False,
                interface={"subscriptions": hears},
                endpoints="open",
                after={"managed": "configured"},
                executor="events",
            ),
        },
        policy={"unverifiable": "block"},
    )
    with running.up(manifest, runtime=tmp_path) as up:
        states = [
            up.until("node", node="/managed", state=each)["state"]
            for each in ("configuring", "inactive", "activating", "active")
        ]
        assert states[-1] == "active"
        up.met("system", reached="active")
        wait_until(lambda: "heard managed" in log_of(up, "listener"))
        assert is_proven(up)
        assert verb("down", str(manifest), runtime=tmp_path).returncode == 0
        assert up.finish() == 0
        up.assert_gate_held()


def test_an_events_executor_survives_that_endpoints_are_destroyed_while_peers_come_and_go(
    fresh_domain: int, tmp_path: Path
) -> None:
    def crossing(there: str, back: str, published: int) -> dict[str, Any]:
        heard = [{"name": f"in{at}", "type": _STRING} for at in range(8)]
        said = [{"name": f"out{at}", "type": _STRING} for at in range(published)]
        remap = {f"in{at}": f"{there}{at}" for at in range(8)}
        remap |= {f"out{at}": f"{back}{at}" for at in range(published)}
        made = node(
            "tests.ros.supervisor.systems:Crossing",
            interface={"subscriptions": heard, "publishers": said},
            executor="events",
        )
        return {**made, "remap": remap}

    def write(published: int) -> str:
        nodes = {"a": crossing("x", "y", published), "b": crossing("y", "x", published)}
        return str(running.write(tmp_path, fresh_domain, nodes))

    with running.up(Path(write(9)), runtime=tmp_path) as up:
        up.until("system", reached="active")
        for order, published in (("restart", 9), ("apply", 8)):
            done = verb(order, write(published), runtime=tmp_path)
            assert done.returncode == 0, done.stdout + done.stderr
        assert verb("down", str(up.manifest), runtime=tmp_path).returncode == 0
        assert up.finish() == 0, up.said()
        ends = [each for each in up.of_kind("process") if each["state"] == "exited"]
        assert ends
        assert not [each for each in ends if "SIGSEGV" in str(each)]


@pytest.mark.thorough
@pytest.mark.parametrize("executor", ["single", "events"])
def test_what_a_coroutine_raises_ends_the_process_with_its_traceback(
    executor: str, fresh_domain: int, tmp_path: Path
) -> None:
    raising = node("Raising", managed=False, executor=executor)
    manifest = running.write(tmp_path, fresh_domain, {"raising": raising})
    with running.up(manifest, "--stop-after", "20", runtime=tmp_path) as up:
        assert up.until("process", state="exited")["detail"] == "exit status 1"
        assert "OSError: the sensor is on fire" in log_of(up, "raising")


@pytest.mark.parametrize("executor", ["single", "events"])
def test_a_node_that_destroys_itself_in_a_process_that_goes_on_is_shown_as_dead(
    executor: str, fresh_domain: int, tmp_path: Path, wait_until: Any
) -> None:
    leaving = {
        key: node(reference, managed=managed, process="shared", executor=executor)
        for key, reference, managed in (
            ("plain", "Leaving", False),
            ("managed", "tests.ros.supervisor.systems:Leaving", True),
            ("quiet", "tests.ros.supervisor.systems:Quiet", True),
        )
    }
    manifest = running.write(tmp_path, fresh_domain, leaving)

    def shown() -> dict[str, tuple[str, str]]:
        done = verb("status", str(manifest), "--format", "json", runtime=tmp_path)
        nodes = json.loads(done.stdout)["nodes"]
        return {each["node"]: (each["state"], each["died"]) for each in nodes}

    with running.up(manifest, runtime=tmp_path) as up:
        up.until("system", reached="active")
        gone = f"destroyed by its own code; pid {up.pid_of('shared')} runs on"
        wait_until(lambda: [died for _, died in shown().values()].count(gone) == 2)
        assert shown() == {"/plain": ("", gone), "/managed": ("", gone), "/quiet": ("active", "")}
        up.until_found("graph.missing-node", "/managed")
        assert verb("down", str(manifest), runtime=tmp_path).returncode == 0
        up.finish()
        assert "Traceback" not in log_of(up, "shared")


@pytest.mark.thorough
def test_a_function_may_return_several_nodes_of_one_process(
    fresh_domain: int, tmp_path: Path, wait_until: Any
) -> None:
    # Beside the manifest, and not where `up` was started.
    (tmp_path / "beside.py").write_text(f"from {_NODES} import pair")
    shared = {"process": "both", "managed": False, "arguments": {"word": "pair"}}
    manifest = running.write(
        tmp_path,
        fresh_domain,
        {
            # By the names that the code gives them.
            "talker": node("beside:pair", interface=TALKS, **shared),
            "ears": node("beside:pair", interface=HEARS, **shared),
        },
    )
    with running.up(manifest, runtime=tmp_path) as up:
        up.until("system", reached="active")
        wait_until(lambda: "[ears]: heard pair" in log_of(up, "both"))
        assert is_proven(up)


@pytest.mark.thorough
def test_callbacks_run_in_several_threads_where_the_executor_has_them(
    fresh_domain: int, tmp_path: Path
) -> None:
    adder = {
        "service_servers": [{"name": each, "type": "std_srvs/srv/SetBool"} for each in _SERVICES],
        "service_clients": [{"name": "inner", "type": "std_srvs/srv/SetBool"}],
        "action_servers": [{"name": "count", "type": "test_msgs/action/Fibonacci"}],
    }
    calls = {"service_clients": [{"name": "outer", "type": "std_srvs/srv/SetBool"}]}
    manifest = running.write(
        tmp_path,
        fresh_domain,
        {
            "adder": node("Adder", managed=False, interface=adder, executor="multi", threads=2),
            "caller": node("Caller", managed=False, interface=calls),
        },
        policy={"unverifiable": "block"},
    )
    with running.up(manifest, "--stop-after", "30", runtime=tmp_path) as up:
        up.until("gate")
        assert is_proven(up)
        # Its callback raises with the answer: the process ends.
        up.until("process", process="caller", state="exited")
        assert "RuntimeError: answered True" in log_of(up, "caller")


_SERVICES = ("inner", "outer")


@pytest.mark.thorough
def test_a_hung_callback_is_noticed_whatever_the_executor_unless_others_go_on_beside_it(
    fresh_domain: int, tmp_path: Path, wait_until: Any
) -> None:
    limits = {**LIMITS, "silent_s": 0.5}

    def sleeper(executor: str, **arguments: Any) -> dict[str, Any]:
        made = node("Sleeper", managed=False, executor=executor, arguments=arguments)
        return {**made, "timeouts": limits}

    manifest = running.write(
        tmp_path,
        fresh_domain,
        {
            "many": sleeper("multi"),
            "events": sleeper("events"),
            "beside": sleeper("multi", alone=True),
        },
    )
    with running.up(manifest, runtime=tmp_path) as up:
        for kind in ("silent", "alive"):
            for name in ("/many", "/events"):
                up.met(kind, node=name)
        assert {each["cause"] for each in up.of_kind("silent")} <= {"hung"}
        wait_until(lambda: "slept" in log_of(up, "beside"))
        up.catch_up()
        assert {each["node"] for each in up.of_kind("silent")} == {"/many", "/events"}


@pytest.mark.thorough
def test_what_a_callback_of_rclpy_lifecycle_raises_is_logged_and_ends_the_bring_up(
    fresh_domain: int, tmp_path: Path
) -> None:
    (tmp_path / "src").mkdir()
    (tmp_path / "src" / "elsewhere.py").write_text(f"from {_NODES} import Broken")
    environment = {"PYTHONPATH": str(tmp_path / "src")}
    broken = node("elsewhere:Broken", environment=environment)
    manifest = running.write(tmp_path, fresh_domain, {"broken": broken})
    with running.up(manifest, runtime=tmp_path) as up:
        assert up.finish() == 6
        assert [each["message"] for each in up.verdict["findings"]] == [
            "cannot configure '/broken': /broken: on_configure returned ERROR"
        ]
        assert "OSError: no such camera" in log_of(up, "broken")


@pytest.mark.thorough
def test_flows_of_plain_nodes_are_unique_and_marked_as_the_manifest_asks(
    fresh_domain: int, tmp_path: Path, wait_until: Any
) -> None:
    alone = {"unique": "strictly_required"}
    manifest = running.write(
        tmp_path,
        fresh_domain,
        {
            "talker": node(
                "Talker",
                managed=False,
                interface=TALKS,
                flows={"publishers": {"words": {**alone, "dscp": "EF"}}},
            ),
            "listener": node(
                "Listener",
                managed=False,
                interface=HEARS,
                flows={"subscriptions": {"words": alone}},
            ),
        },
        links=[{"topic": "/words", "from": "talker", "to": "listener", "unique": "strongly"}],
        policy={"unverifiable": "block"},
    )
    with running.up(manifest, runtime=tmp_path) as up:
        up.until("system", reached="active")
        wait_until(lambda: "heard hello" in log_of(up, "listener"))
        assert is_proven(up)
        flows = up.of_kind("verdict")[-1]["verdict"]["flows"]
        assert [(each["unique"], each["dscp"]) for each in flows if each["topic"] == "/words"] == [
            ("strongly", 46)
        ]
        assert verb("down", str(manifest), runtime=tmp_path).returncode == 0
        assert up.finish() == 0
        up.assert_nothing_left()


@pytest.mark.thorough
def test_nodes_of_rclpy_run_in_a_test_as_ours_do(lifecycle_node: Any, tmp_path: Path) -> None:
    says = [{"name": "words", "type": _STRING, "qos": {"depth": 7}}]
    shared = {"managed": False, "process": "both", "arguments": {"word": "pair"}}
    manifest = running.write(
        tmp_path,
        0,
        {
            "managed": node(
                "Managed",
                name="other",
                remap={"words": "other_words"},
                interface={"publishers": says},
            ),
            "talker": node("pair", interface=TALKS, **shared),
            "ears": node("pair", interface=HEARS, **shared),
            "loud": node(
                "Talker",
                managed=False,
                parameters={"loud": True},
                remap={"words": "loud_words", "name": "loud_name", "reset": "loud_reset"},
                interface=TALKS,
            ),
        },
    )
    ears = lifecycle_node(manifest, "ears")
    ears.publish("words", rclpy_nodes.String(data="from the test"))
    assert ears.wait_for_log("heard from the test")
    ears.wait_for_log("heard pair")  # by the talker, which the same function makes

    managed = lifecycle_node(manifest, "managed", to="inactive")
    assert (managed.state, managed.node.get_name()) == ("inactive", "other")
    managed.change("activate")
    assert managed.received("words").data == "managed"

    loud = lifecycle_node(manifest, "loud")
    assert "HELLO" in {loud.received("words").data for _ in range(2)}
    assert loud.call("reset", rclpy_nodes.Trigger.Request()) is not None
    assert loud.state == ""
    with pytest.raises(UsageError, match="a plain node has no states"):
        loud.change("activate")
