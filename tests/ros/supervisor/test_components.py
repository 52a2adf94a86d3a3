"""Components are loaded into a real container, verified, activated, and unloaded again.

composition_interfaces is not among the wheels: composition/ stands in for it, on both sides.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from lifecycle.errors import ExitCode
from tests.ros.supervisor.running import BOUND_S, ENOUGH, ROOT, up, verb, write

FOLDER = ROOT / "tests" / "ros" / "supervisor" / "composition"
VARIABLES = {"PYTHONPATH": str(FOLDER)}
CONTAINER = [sys.executable, str(FOLDER / "container.py")]
OPEN = {"managed": False, "endpoints": "open"}  # the services stand in for others too
OURS = {"run": {"command": CONTAINER}, **OPEN}
QOS = {"reliability": "RELIABLE"}  # all that can be seen of it
STRING = "std_msgs/msg/String"


def component(plugin: str, container: str, *, managed: bool = False, **rest: Any) -> dict[str, Any]:
    return {"run": {"component": plugin, "container": container}, "managed": managed, **rest}


def system(folder: Path, domain_id: int, **nodes: Any) -> Path:
    return write(folder, domain_id, nodes, "composed")


def talker_and_hearer(container: str, values: Path) -> dict[str, Any]:
    values.write_text("/**: {ros__parameters: {word: hello}}\n")
    return {
        "talker": component(
            "demo/Talker",
            container,
            namespace="/robot",
            remap={"words": "/news"},
            parameters={"rate": 2.5},
            parameter_files=[str(values)],
            interface={
                "publishers": [{"name": "words", "type": STRING, "qos": QOS}],
                "parameters": {"rate": {"type": "double"}, "word": {"type": "string"}},
            },
        ),
        "hearer": component(
            "demo/Hearer",
            container,
            managed=True,
            remap={"words": "/news"},
            interface={"subscriptions": [{"name": "words", "type": STRING, "qos": QOS}]},
        ),
    }


@pytest.fixture
def pool(fresh_domain: int) -> Iterator[subprocess.Popen[str]]:
    """A container named /pool that others run."""
    process = subprocess.Popen(
        [*CONTAINER, "pool"],
        env={**os.environ, **VARIABLES, "ROS_DOMAIN_ID": str(fresh_domain)},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == "ready\n"
        yield process
    finally:
        process.kill()
        process.wait(BOUND_S)
        process.stdout.close()


def test_components_in_a_container_of_others_come_and_go(
    tmp_path: Path, fresh_domain: int, pool: subprocess.Popen[str]
) -> None:
    nodes = talker_and_hearer("/pool", tmp_path / "values.yaml")
    nodes["hearer"]["run"]["extra_arguments"] = {"use_intra_process_comms": True}
    others = {"run": {"attach": True}, **OPEN}
    manifest = system(tmp_path, fresh_domain, pool=others, **nodes)
    assert pool.stdout is not None
    with up(manifest, runtime=tmp_path, variables=VARIABLES) as run:
        run.until("system", reached="active")
        run.assert_gate_held()
        loaded = {pool.stdout.readline() for _ in range(2)}
        told = "use_intra_process_comms:=True"
        assert loaded == {"loaded /robot/talker\n", f"loaded /hearer {told}\n"}
        judged = verb("verify", str(manifest), *ENOUGH, runtime=tmp_path)
        assert judged.returncode == ExitCode.OK, judged.stdout
        refused = verb("restart", str(manifest), "pool", runtime=tmp_path)
        assert refused.returncode == ExitCode.USAGE
        assert refused.stderr == (
            "cannot restart '/pool': it is attached, no process of this supervisor\n"
        )
        again = verb("restart", str(manifest), "talker", runtime=tmp_path)
        assert again.returncode == ExitCode.OK, again.stderr
        assert [pool.stdout.readline() for _ in range(2)] == [
            "unloaded /robot/talker\n",
            "loaded /robot/talker\n",
        ]
        run.signal(signal.SIGTERM)
        assert run.finish() == ExitCode.OK, run.said()
        unloaded = {pool.stdout.readline() for _ in range(2)}
        assert unloaded == {"unloaded /robot/talker\n", "unloaded /hearer\n"}
        assert pool.poll() is None


@pytest.mark.thorough
def test_what_a_container_did_counts_where_its_reply_is_lost(
    tmp_path: Path, fresh_domain: int
) -> None:
    nodes = talker_and_hearer("container", tmp_path / "values.yaml")
    ours = {"run": {"command": [*CONTAINER, "mute"]}, **OPEN}
    manifest = system(tmp_path, fresh_domain, container=ours, **nodes)
    with up(manifest, runtime=tmp_path, variables=VARIABLES) as run:
        run.until("system", reached="active")
        again = verb("restart", "composed", "talker", runtime=tmp_path)
        assert again.returncode == ExitCode.OK, again.stderr
        (log,) = tmp_path.glob("log/2*/container.log")
        talked = [line for line in log.read_text().splitlines() if "talker" in line]
        assert talked == [f"{did} /robot/talker" for did in ("loaded", "unloaded", "loaded")]
        run.signal(signal.SIGTERM)
        assert run.finish() == ExitCode.OK, run.said()


@pytest.mark.thorough
def test_a_container_of_ours_takes_its_components_along(tmp_path: Path, fresh_domain: int) -> None:
    nodes = talker_and_hearer("container", tmp_path / "values.yaml")
    manifest = system(tmp_path, fresh_domain, container=OURS, **nodes)
    with up(manifest, runtime=tmp_path, variables=VARIABLES) as run:
        run.until("system", reached="active")
        again = verb("restart", str(manifest), "container", runtime=tmp_path)
        assert again.returncode == ExitCode.OK, again.stderr
        run.until("system", reached="active")
        os.kill(run.pid_of("container"), signal.SIGKILL)
        assert run.finish() == ExitCode.BRING_UP_FAILED
        first = run.verdict["findings"][0]
        assert (first["rule"], first["subject"]) == ("run.process-died", "/container")
        run.assert_nothing_left()


@pytest.mark.parametrize(
    ("plugin", "container", "said"),
    [
        ("demo/Nothing", "container", "it says 'no plugin Nothing'"),
        pytest.param("demo/Fatal", "container", "exit status 3", marks=pytest.mark.thorough),
        pytest.param(
            *("demo/Talker", "/nobody", "/nobody/_container/load_node"), marks=pytest.mark.thorough
        ),
    ],
)
def test_what_cannot_be_loaded_ends_the_bring_up_with_the_reason(
    tmp_path: Path, fresh_domain: int, plugin: str, container: str, said: str
) -> None:
    node = component(plugin, container, timeouts={"start_s": 3.0})
    manifest = system(tmp_path, fresh_domain, container=OURS, node=node)
    with up(manifest, runtime=tmp_path, variables=VARIABLES) as run:
        assert run.finish() == ExitCode.BRING_UP_FAILED
        assert said in str(run.verdict), run.verdict
        run.assert_nothing_left()
