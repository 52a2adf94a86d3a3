"""`up` on a host that it shares: with other PID namespaces, and with processes it did not start."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import uuid
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
from rclpy.node import Node
from std_msgs.msg import String

from lifecycle.errors import ExitCode
from lifecycle.run_directory import RUN_VARIABLE
from tests.ros.supervisor.running import ROOT, command, environment, marked, pair, up
from tests.shared_memory import owned_by

pytestmark = pytest.mark.thorough

OPEN = {"policy/undeclared_nodes": "open"}

# Root of a user namespace of its own where this user may not make PID namespaces.
ELSEWHERE = (
    "unshare",
    *(() if os.getuid() == 0 else ("--user", "--map-root-user")),
    *("--pid", "--fork", "--kill-child", "--mount-proc"),
)

HEARS = (
    "import rclpy; from rclpy.node import Node; from std_msgs.msg import String\n"
    "rclpy.init(); node = Node('late'); got = []\n"
    "node.create_subscription(String, 'alive', got.append, 10)\n"
    "while not got: rclpy.spin_once(node)\n"
)


def in_shared_memory(names: frozenset[str]) -> set[str]:
    return {name for name in names if Path("/dev/shm", name).exists()}


@pytest.mark.alone  # what others leave in /dev/shm would be removed, and said
def test_the_shared_memory_of_another_pid_namespace_is_left_alone(
    tmp_path: Path, domain_id: int, make_node: Callable[..., Node]
) -> None:
    try:
        subprocess.run([*ELSEWHERE, "true"], check=True, capture_output=True, timeout=30)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"no PID namespace can be made here: {error}")
    node = make_node("alive")
    publisher = node.create_publisher(String, "alive", 10)
    owned = owned_by([os.getpid()])
    assert in_shared_memory(owned) == owned != set()
    with up(
        pair(tmp_path, domain_id, edit=OPEN),
        *("--stop-after", "0"),
        runtime=tmp_path,
        through=ELSEWHERE,
    ) as run:
        assert run.finish() == ExitCode.OK, run.events[-3:]
    # What tests before this one left may be removed, and is named then.
    said = " ".join(each["message"] for each in run.of_kind("notice"))
    assert not [each for each in owned if each in said]
    assert in_shared_memory(owned) == owned
    with subprocess.Popen([sys.executable, "-c", HEARS]) as late:
        for _ in range(1500):
            publisher.publish(String(data="still here"))
            try:
                assert late.wait(0.02) == 0
                break
            except subprocess.TimeoutExpired:
                continue
        else:
            late.kill()
            pytest.fail("a new subscriber does not receive what the living node publishes")


_LAST = "ended after it was active, exit code 0"


@pytest.mark.parametrize(
    "before",
    [
        pytest.param("exec > >(cat > {log})", id="process substitution"),
        pytest.param("exec > >(tee {log} | cat > {log}.copy)", id="pipeline in a substitution"),
        pytest.param("sleep 60 & echo $! > {job}; exec > {log}", id="background job"),
        pytest.param("(sleep 60 & echo $! > {job}); exec > {log}", id="job of a subshell"),
    ],
)
def test_a_process_that_was_there_before_it_became_the_supervisor_is_not_ended(
    tmp_path: Path, fresh_domain: int, wait_until: Callable[..., None], before: str
) -> None:
    log, job = tmp_path / "printed", tmp_path / "job"
    manifest = pair(tmp_path, fresh_domain, misbehave="configure:fork")
    shell = before.format(log=shlex.quote(str(log)), job=shlex.quote(str(job)))
    line = shlex.join([*command("up"), str(manifest), "--stop-after", "0"])
    errors = tmp_path / "errors"
    mark = uuid.uuid4().hex
    # Not into a pipe: the job that stays would hold its other end open.
    with errors.open("w") as stderr:
        done = subprocess.run(
            ["bash", "-c", f"{shell}\nexec {line}"],
            cwd=ROOT,
            env=environment(tmp_path, mark),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=stderr,
            timeout=120,
            check=False,
        )
    try:
        assert done.returncode == ExitCode.OK, log.read_text() + errors.read_text()
        if job.exists():
            assert psutil.Process(int(job.read_text())).name() == "sleep"
        # Whoever writes the log for us reads on until we have ended.
        wait_until(lambda: _LAST in log.read_text())
        # The one that `configure:fork` left is the run's.
        left = [each.pid for each in marked(mark) if RUN_VARIABLE in each.environ()]
        assert left == []
    finally:
        for each in marked(mark):
            each.kill()
