"""Nodes wait for what others show in the graph, whoever wrote them: a topic, a service, a value."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from rcl_interfaces.msg import ParameterType

from lifecycle.errors import ExitCode
from tests.ros.supervisor.running import LIMITS, ROOT, Up, up, verb, write

LATE = "tests.ros.supervisor.late_driver"
SOON_S = 1.5
"""A node is started so soon after what it waits for, also on a busy machine; idle 0.1 s."""

DRIVER = {
    "managed": False,
    "interface": {
        "publishers": [{"name": "scan", "type": "std_msgs/msg/String"}],
        "service_servers": [{"name": "~/reset", "type": "std_srvs/srv/Trigger"}],
        "parameters": {"ready": {"type": "bool"}},
    },
    "namespace": "/front",
    "remap": {"scan": "/laser"},
    "timeouts": LIMITS,
}
BARE: dict[str, Any] = {"managed": False, "endpoints": "open", "timeouts": LIMITS}
BOTH = {"publishes": "scan", "serves": "~/reset"}


def command(name: str) -> list[str]:
    return [sys.executable, "-m", LATE, name]


class Late:
    """A driver whose topic and service come late, and a viewer that waits for it."""

    def __init__(self, folder: Path, domain_id: int) -> None:
        self.folder, self.domain_id = folder, domain_id
        self.file = folder / "notes"
        self.file.touch()

    def environment(self, comes: str) -> dict[str, str]:
        path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH", ""))))
        return {"NOTES": str(self.file), "COMES": comes, "PYTHONPATH": path}

    def driver(self, way: str, comes: str, **rest: Any) -> dict[str, Any]:
        run = {"python": f"{LATE}:Driver"} if way == "python" else {"command": command("driver")}
        return {"run": {**run, "environment": self.environment(comes)}, **DRIVER, **rest}

    def viewer(self, way: str, ready: object, **rest: Any) -> dict[str, Any]:
        run = {"python": f"{LATE}:ManagedViewer"} if way == "managed" else {}
        run = run or {"command": command("viewer")}
        known = BARE | ({"managed": True} if way == "managed" else {})
        run = {**run, "environment": self.environment("")}
        return {"run": run, **known, "after": {"driver": ready}, **rest}

    def write(self, driver: Mapping[str, Any], viewer: Mapping[str, Any]) -> Path:
        return write(self.folder, self.domain_id, {"driver": driver, "viewer": viewer})

    def noted(self, what: str) -> list[float]:
        """When it was noted, each time: `viewer started`."""
        lines = self.file.read_text().splitlines()
        return [float(each.rpartition(" ")[2]) for each in lines if each.startswith(f"{what} ")]


@pytest.fixture
def late(tmp_path: Path, fresh_domain: int) -> Late:
    return Late(tmp_path, fresh_domain)


@contextlib.contextmanager
def running(manifest: Path, *options: str) -> Iterator[Up]:
    with up(manifest, *options, runtime=manifest.parent) as found:
        yield found
        found.assert_nothing_left()


def end(found: Up) -> None:
    assert verb("down", str(found.manifest), runtime=found.runtime).returncode == 0
    assert found.finish() == 0


@pytest.mark.parametrize("driver", ["python", "command"])
@pytest.mark.parametrize("viewer", ["plain", "managed"])
def test_a_node_waits_until_a_driver_publishes_and_serves(
    late: Late, driver: str, viewer: str
) -> None:
    manifest = late.write(late.driver(driver, "publishes:1 serves:0.7"), late.viewer(viewer, BOTH))
    with running(manifest) as found:
        found.until("system", reached="active")
        (served,), (published,) = late.noted("driver serves"), late.noted("driver publishes")
        (began,) = late.noted("viewer configures" if viewer == "managed" else "viewer started")
        assert served < began < served + SOON_S
        if viewer == "managed":  # its process is not held, nor is its start
            assert late.noted("viewer constructed")[0] < published
        end(found)


def test_what_never_comes_ends_the_bring_up_and_is_named_with_its_place(late: Late) -> None:
    manifest = late.write(late.driver("command", "publishes:0.5"), late.viewer("plain", BOTH))
    lines = manifest.read_text().splitlines()
    line = next(i for i, each in enumerate(lines, 1) if each.strip().startswith("serves:"))
    with running(manifest, "--timeout", "8") as found:
        found.until("node", node="/front/driver", reach="started")
        time.sleep(1.5)  # what it publishes has come
        status = verb("status", str(manifest), runtime=found.runtime).stdout
        assert "waits to start until /front/driver serves ~/reset" in status
        assert found.finish() == ExitCode.BRING_UP_FAILED
        (failure,) = found.of_kind("failure")
        assert failure["rule"] == "run.deadline"
        said = f"/viewer waits to start until /front/driver serves ~/reset ({manifest}:{line}:"
        assert said in failure["message"]
        assert late.noted("viewer started") == []


def test_a_held_driver_runs_no_callback_and_the_deadline_says_so(late: Late) -> None:
    manifest = late.write(late.driver("python", ""), late.viewer("plain", {"parameter": "ready"}))
    with running(manifest, "--timeout", "3") as found:
        assert found.finish() == ExitCode.BRING_UP_FAILED
        (failure,) = found.of_kind("failure")
        assert "/front/driver has parameter ready: true" in failure["message"]
        assert "none of its callbacks runs before the gate opens" in failure["message"]


def test_a_node_waits_until_a_parameter_of_a_driver_is_set(
    late: Late, set_parameter: Callable[..., None]
) -> None:
    manifest = late.write(
        late.driver("command", "publishes:0 serves:0"), late.viewer("plain", {"parameter": "ready"})
    )
    with running(manifest) as found:
        found.until("node", node="/front/driver", reach="started")
        time.sleep(1.0)
        assert late.noted("viewer started") == []
        kind = ParameterType.PARAMETER_BOOL
        set_parameter("/front/driver", "ready", type=kind, bool_value=True)
        set_s = time.time()
        found.until("system", reached="active")
        (began,) = late.noted("viewer started")
        assert set_s - SOON_S < began < set_s + SOON_S
        end(found)


@pytest.mark.thorough
def test_a_node_waits_for_a_driver_that_others_start(late: Late) -> None:
    attached = {key: each for key, each in late.driver("command", "").items() if key != "run"}
    manifest = late.write({**attached, "attach": True}, late.viewer("managed", BOTH))
    with running(manifest) as found:
        found.until("node", node="/viewer", reach="started")
        environment = {**os.environ, **late.environment("publishes:0.5 serves:0.5")}
        remaps = ("__ns:=/front", "scan:=/laser")
        named = [word for each in remaps for word in ("-r", each)]
        with subprocess.Popen([*command("driver"), "--ros-args", *named], env=environment) as one:
            try:
                found.until("system", reached="active")
                assert late.noted("driver serves")[0] < late.noted("viewer configures")[0]
                end(found)
            finally:
                one.send_signal(signal.SIGTERM)


@pytest.mark.thorough
def test_one_that_comes_again_with_its_driver_waits_again(late: Late) -> None:
    again = {"restart": "on-failure", "on_failure": "dependents"}
    manifest = late.write(
        late.driver("command", "publishes:0.7 serves:0.7", **again), late.viewer("plain", BOTH)
    )
    with running(manifest) as found:
        found.until("system", reached="active")
        os.kill(found.pid_of("driver"), signal.SIGKILL)
        found.until("restarted", process="driver")
        found.until("system", reached="active")
        (_, served), (_, began) = late.noted("driver serves"), late.noted("viewer started")
        assert served < began < served + SOON_S
        end(found)
