"""What is declared of data is measured where they arrive, and judged; real DDS, real processes."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import UInt64

from lifecycle.errors import ExitCode
from tests.ros.supervisor.running import LIMITS, up, verb, write

pytestmark = pytest.mark.ros

NODES = "tests.ros.measure.nodes"
BOUNDS = {"max_delay_ms": 20, "quantile": 0.9, "rate_hz": 80, "loss": 0.05, "max_silence_s": 1}
QOS = {"reliability": "BEST_EFFORT", "depth": 5}
SUBJECT = "/numbers: /source → /sink"
SEEN_S = 8.0
"""A violation is found within 2 s, or once the sample decides, on a machine with time for it."""


def system(
    directory: Path, domain_id: int, *, sink: Mapping[str, Any] = {}, **keys: Any
) -> tuple[Path, Path]:
    """Write a system and the file of its fault; return both paths."""
    fault = directory / "fault"
    fault.write_text("")
    numbers = [{"name": "numbers", "type": "std_msgs/msg/UInt64", "qos": QOS}]
    nodes = {
        "source": {
            "run": {"python": f"{NODES}:Source", "environment": {"FAULT": str(fault)}},
            "timeouts": LIMITS,
            "interface": {"publishers": numbers},
        },
        "sink": {
            "run": {"python": f"{NODES}:Sink", "environment": {"FAULT": str(fault)}},
            "timeouts": LIMITS,
            "interface": {"subscriptions": numbers},
            **sink,
        },
    }
    links = [{"topic": "/numbers", "from": "source", "to": "sink", **keys.pop("bounds", BOUNDS)}]
    return write(directory, domain_id, nodes, links=links, **keys), fault


def bounds_of(verdict: Mapping[str, Any]) -> dict[str, str]:
    flows = verdict.get("measured", ())
    return {each["name"]: each["outcome"] for flow in flows for each in flow["bounds"]}


PLAIN = {"run": {"python": f"{NODES}:PlainSink"}, "managed": False}


def program(kind: str, **environment: str) -> dict[str, Any]:
    code = f"from tests.ros.measure import nodes; nodes.main({kind!r})"
    run = {"command": [sys.executable, "-c", code], "environment": environment}
    return {"run": run, "managed": False}


@pytest.mark.parametrize("sink", ["ours", "plain"])
def test_numbers_that_are_kept_are_ok_once_they_are_decided(
    tmp_path: Path, fresh_domain: int, sink: str
) -> None:
    plain = {**PLAIN, "run": {**PLAIN["run"], "environment": {"FAULT": str(tmp_path / "fault")}}}
    manifest, _ = system(tmp_path, fresh_domain, sink=plain if sink == "plain" else {})
    with up(manifest, "--stop-after", "0.5", "--strict", runtime=tmp_path) as run:
        assert run.finish() == ExitCode.OK, run.events[-5:]
        assert bounds_of(run.verdict) == dict.fromkeys(
            ("max_delay_ms", "rate_hz", "loss", "max_silence_s"), "ok"
        )
        (flow,) = run.verdict["measured"]
        assert flow["rate_hz"] == pytest.approx(100, rel=0.2)
        assert 0 < flow["p50_ms"] <= flow["p99_ms"]
        line = "measured: /numbers /source → /sink: delay p90"
        assert any(each["message"].startswith(line) for each in run.of_kind("notice"))
        run.assert_gate_held()


def test_each_fault_of_a_running_system_is_found_and_each_recovery(
    tmp_path: Path, fresh_domain: int
) -> None:
    manifest, fault = system(tmp_path, fresh_domain)
    with up(manifest, runtime=tmp_path) as run:
        run.until("system", reached="active")
        run.until_verdict(lambda verdict: set(bounds_of(verdict).values()) == {"ok"})
        for wrong, rule in (
            ("busy", "flow.delay"),
            ("slow", "flow.rate"),
            ("lossy", "flow.loss"),
            ("silent", "flow.silent"),
        ):
            since, begun_s = len(run.events), time.monotonic()
            fault.write_text(wrong)
            run.until_found(rule, SUBJECT, since=since)
            found_s = time.monotonic() - begun_s
            assert found_s < SEEN_S, (wrong, found_s)
            since = len(run.events)
            fault.write_text("")
            run.until_verdict(lambda verdict: verdict["verdict"] == "ok", since=since)
        run.process.terminate()
        assert run.finish() == ExitCode.OK


def test_a_callback_that_takes_message_info_is_refused_with_the_events_executor(
    tmp_path: Path, fresh_domain: int
) -> None:
    informed = {"run": {"python": f"{NODES}:Informed", "executor": "events"}}
    manifest, _ = system(tmp_path, fresh_domain, sink=informed)
    with up(manifest, runtime=tmp_path) as run:
        assert run.finish() == ExitCode.BRING_UP_FAILED
        (failed, *_) = run.of_kind("failure")
        assert "cannot give the callback of '/numbers' message info" in failed["message"]


def test_a_violated_number_takes_a_strict_system_back_to_inactive(
    tmp_path: Path, fresh_domain: int
) -> None:
    manifest, fault = system(tmp_path, fresh_domain)
    fault.write_text("slow")
    with up(manifest, "--strict", "--stop-after", "1", runtime=tmp_path) as run:
        taken = run.until("consequence")
        assert (taken["action"], taken["rule"], taken["subject"]) == ("pause", "flow.rate", SUBJECT)
        for node in ("/source", "/sink"):
            run.met("node", node=node, state="inactive")
        assert run.finish() == ExitCode.VIOLATED


def test_a_run_for_some_seconds_waits_until_a_loss_alone_is_decided(
    tmp_path: Path, fresh_domain: int
) -> None:
    manifest, fault = system(tmp_path, fresh_domain, bounds={"loss": 0.05})
    fault.write_text("lossy")
    with up(manifest, "--stop-after", "0", runtime=tmp_path) as run:
        assert run.finish() == ExitCode.VIOLATED
        assert [each["rule"] for each in run.verdict["findings"]] == ["flow.loss"]


def test_what_is_to_be_done_about_a_violated_number_is_done(
    tmp_path: Path, fresh_domain: int
) -> None:
    manifest, fault = system(tmp_path, fresh_domain, on_violation={"flow.silent": "stop"})
    with up(manifest, runtime=tmp_path) as run:
        run.until("system", reached="active")
        fault.write_text("silent")
        assert run.finish() == ExitCode.VIOLATED
        (finding,) = run.verdict["findings"]
        assert (finding["rule"], finding["subject"]) == ("flow.silent", SUBJECT)


def test_data_are_measured_anew_after_each_order_and_what_was_before_is_no_fault(
    tmp_path: Path, fresh_domain: int
) -> None:
    modes = {"normal": {}, "quiet": {"inactive": ["source"]}}
    kept = {"rate_hz": 60, "max_silence_s": 1.5}
    manifest, fault = system(tmp_path, fresh_domain, bounds=kept, modes=modes)
    orders = (("restart", "source"), ("mode", "quiet"), ("mode", "normal"), ("pause",), ("resume",))
    with up(manifest, runtime=tmp_path) as run:
        run.until("system", reached="active")
        run.until_verdict(lambda verdict: set(bounds_of(verdict).values()) == {"ok"})
        for order, *what in orders:
            done = verb(order, "system", *what, runtime=tmp_path)
            assert done.returncode == ExitCode.OK, done.stderr
            time.sleep(4.0)
            for verdict in (each["verdict"] for each in run.of_kind("verdict")):
                named = {each["rule"] for each in verdict["findings"]}
                assert named.isdisjoint({"flow.rate", "flow.silent"}), (order, what)
        fault.write_text("slow")
        run.until_found("flow.rate", SUBJECT)


def test_what_others_publish_is_measured_anew_after_a_restart_another_qos_and_a_standstill(
    tmp_path: Path, fresh_domain: int
) -> None:
    def changed(reliability: str) -> Path:
        qos = {"reliability": reliability}
        numbers = [{"name": "numbers", "type": "std_msgs/msg/UInt64", "qos": qos}]
        source = program("PlainSource", RELIABILITY=reliability)
        sink = program("PlainSink", RELIABILITY=reliability, FAULT=str(tmp_path / "fault"))
        bounds = {"rate_hz": 60, "max_silence_s": 1, "measure": True}
        nodes = {
            "source": {**source, "restart": "on-failure", "interface": {"publishers": numbers}},
            "sink": {
                **sink,
                "interface": {"subscriptions": numbers},
                "flows": {"subscriptions": {"numbers": bounds}},
            },
        }
        return write(tmp_path, fresh_domain, nodes, policy={"trust": ["flow.unreported"]})

    (tmp_path / "fault").write_text("")
    with up(changed("RELIABLE"), runtime=tmp_path) as run:
        run.until("system", reached="active")
        run.until_verdict(lambda verdict: set(bounds_of(verdict).values()) == {"ok"})
        since = len(run.of_kind("verdict"))
        assert verb("restart", "system", "source", runtime=tmp_path).returncode == ExitCode.OK
        time.sleep(4.0)
        run.catch_up()
        os.kill(run.pid_of("source"), signal.SIGKILL)
        run.until("restarted", process="source")
        time.sleep(4.0)
        applied = verb("apply", str(changed("BEST_EFFORT")), runtime=tmp_path)
        assert applied.returncode == ExitCode.OK, applied.stderr
        time.sleep(4.0)
        run.signal(signal.SIGSTOP)
        time.sleep(2.0)
        run.signal(signal.SIGCONT)
        time.sleep(4.0)
        run.catch_up()
        for verdict in (each["verdict"] for each in run.of_kind("verdict")[since:]):
            named = {each["rule"] for each in verdict["findings"]}
            assert named.isdisjoint({"flow.rate", "flow.silent"})
        status = verb("status", "system", "--format", "json", runtime=tmp_path)
        assert set(bounds_of(json.loads(status.stdout)).values()) == {"ok"}, status.stdout


def test_verify_measures_what_runs_already(tmp_path: Path, fresh_domain: int) -> None:
    manifest, fault = system(tmp_path, fresh_domain)
    with up(manifest, runtime=tmp_path) as run:
        run.until("system", reached="active")
        judged = verb("verify", str(manifest), "--timeout", "15", runtime=tmp_path)
        assert judged.returncode == ExitCode.OK, judged.stdout
        assert "/numbers /source → /sink: delay p90" in judged.stdout
        fault.write_text("slow")
        run.until_found("flow.rate", SUBJECT)
        judged = verb("verify", str(manifest), "--timeout", "1", runtime=tmp_path)
        assert judged.returncode == ExitCode.VIOLATED
        assert "flow.rate" in judged.stdout


def test_what_a_node_of_others_takes_is_unverifiable_and_strict_refuses_it(
    tmp_path: Path, fresh_domain: int
) -> None:
    own = program("PlainSink", FAULT=str(tmp_path / "fault"))
    manifest, fault = system(tmp_path, fresh_domain, sink=own)
    with up(manifest, "--strict", runtime=tmp_path) as run:
        assert run.finish() == ExitCode.UNVERIFIABLE
        named = {each["expected"] for each in run.verdict["findings"]}
        assert {"max_delay_ms 20 for 0.9", "rate_hz 80", "loss 0.05", "max_silence_s 1"} <= named

    # A subscription of ours measures it where the manifest asks for that.
    manifest, fault = system(tmp_path, fresh_domain, sink=own, bounds={**BOUNDS, "measure": True})
    with up(manifest, "--stop-after", "0.5", runtime=tmp_path) as run:
        assert run.finish() == ExitCode.OK, run.events[-5:]
        assert set(bounds_of(run.verdict).values()) == {"ok"}
        assert not [each for each in run.verdict["findings"] if each["rule"] == "flow.not-measured"]
    with up(manifest, runtime=tmp_path) as run:
        run.until("system", reached="active")
        fault.write_text("slow")
        run.until_found("flow.rate", SUBJECT)


@pytest.mark.parametrize("reliability", ["BEST_EFFORT", "RELIABLE"])
def test_the_message_lost_event_does_not_count_what_a_full_queue_drops(
    make_node: Callable[..., Node], spin_until: Callable[..., None], reliability: str
) -> None:
    """If it did, the loss of a topic with several publishers could be measured by it."""
    got: list[int] = []
    lost: list[object] = []
    node = make_node("both")
    qos = QoSProfile(depth=5, reliability=ReliabilityPolicy[reliability])
    publisher = node.create_publisher(UInt64, "numbers", qos)
    events = SubscriptionEventCallbacks(message_lost=lost.append)
    node.create_subscription(
        UInt64, "numbers", lambda message: got.append(message.data), qos, event_callbacks=events
    )
    spin_until(publisher.get_subscription_count, node)
    for number in range(20):
        publisher.publish(UInt64(data=number))
    end_s = time.monotonic() + 1.0
    spin_until(lambda: time.monotonic() > end_s, node)
    assert (got, lost) == ([15, 16, 17, 18, 19], [])
