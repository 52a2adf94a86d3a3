"""A package that `lifecycle init` makes passes its tests, which use the pytest plugin; real DDS."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.ros

_BROKEN = """
from pathlib import Path

MANIFEST = Path(__file__).parents[1] / "manifests" / "pair_of_nodes.lifecycle.yaml"


def test_a_system_that_is_not_as_declared(lifecycle_system):
    lifecycle_system(MANIFEST, "--timeout", "3")


def test_an_expectation_that_fails(lifecycle_system):
    system = lifecycle_system(MANIFEST.with_name("sound.lifecycle.yaml"))
    system.wait_for_log("listener", "received: Hello, world")
    assert system.verdict["verdict"] == "violated"
"""


def _pytest(root: Path, *options: str) -> subprocess.CompletedProcess[str]:
    without = {"PYTEST_XDIST_WORKER", "PYTEST_XDIST_TESTRUNUID", "PYTEST_CURRENT_TEST"}
    environment = {name: value for name, value in os.environ.items() if name not in without}
    for name in ("ROS_DOMAIN_ID", "PYTEST_ADDOPTS"):
        environment.pop(name, None)
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *options],
        cwd=root,
        env={**environment, "PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.fixture
def package(tmp_path: Path) -> Path:
    root = tmp_path / "pair_of_nodes"
    subprocess.run([sys.executable, "-m", "lifecycle", "init", root.name], cwd=tmp_path, check=True)
    return root


def test_a_new_package_passes_its_tests_side_by_side_as_it_is(package: Path) -> None:
    done = _pytest(package, "-n", "2")
    assert done.returncode == 0, done.stdout
    assert "3 passed" in done.stdout


@pytest.mark.thorough
def test_a_test_that_fails_shows_the_verdict_and_the_logs(package: Path) -> None:
    manifest = package / "manifests/pair_of_nodes.lifecycle.yaml"
    sound = manifest.read_text()
    manifest.with_name("sound.lifecycle.yaml").write_text(sound)
    # The node makes what the manifest calls otherwise.
    nodes = package / "pair_of_nodes/nodes.py"
    nodes.write_text(
        f"{nodes.read_text()}\n\n"
        "class Chatty(Talker):\n"
        "    def on_connect(self, state):\n"
        "        self.create_publisher(String, '/undeclared', 1)\n"
    )
    manifest.write_text(sound.replace("nodes:Talker", "nodes:Chatty"))
    (package / "tests/test_system.py").write_text(_BROKEN)
    done = _pytest(package)
    assert done.returncode == 1
    assert "2 failed" in done.stdout
    assert "violated graph.undeclared-publisher: /undeclared" in done.stdout
    assert "lifecycle: verdict on sound.lifecycle.yaml" in done.stdout
    assert "lifecycle: log of listener" in done.stdout


@pytest.mark.thorough
def test_node_code_under_up_is_counted_as_covered(package: Path) -> None:
    pytest.importorskip("coverage")
    coverage = [sys.executable, "-m", "coverage"]
    tests = ["-m", "pytest", "-p", "no:cacheprovider", "-k", "verified"]
    for words in (["run", *tests], ["combine", "-q"], ["report", "--fail-under", "100"]):
        done = subprocess.run(
            [*coverage, *words],
            cwd=package,
            env={**os.environ, "PYTHONPATH": str(package)},
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
