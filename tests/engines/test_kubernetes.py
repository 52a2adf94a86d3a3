"""Pods of two machines, as `lifecycle export kubernetes` writes them, run by `podman kube play`.

The image is made from the wheel, without a registry. podman 4 starts pods and restarts containers
as Kubernetes does; its probes need systemd, so they are run here, as the exported file has them.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.engines.waiting import within

pytestmark = [
    pytest.mark.thorough,
    pytest.mark.timeout(300),
    pytest.mark.skipif(
        os.geteuid() != 0 or shutil.which("podman") is None, reason="needs root and podman"
    ),
]

ROOT = Path(__file__).parents[2]
MACHINES = ("robot", "operator")
SETTINGS = """
[containers]
default_ulimits = ["nofile=20000:20000", "nproc=1000:1000"]
netns = "host"
[engine]
runtime = "runc"
cgroup_manager = "cgroupfs"
"""
"""A machine without systemd, and hard limits below podman's."""

_LEFT_OUT = ("__pycache__", "site-packages", "test", "idlelib", "tkinter", "ensurepip")


def _run(
    *command: str | Path,
    environment: dict[str, str] | None = None,
    timeout_s: int = 300,
    codes: tuple[int, ...] = (0,),
) -> str:
    result = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=False, timeout=timeout_s
    )
    assert result.returncode in codes, result.stdout + result.stderr
    return (result.stdout + result.stderr).strip()


def _python(root: Path) -> None:
    """Copy this interpreter, with its standard library, to the same path below `root`."""
    base = Path(sys.base_prefix)
    library = Path(os.__file__).parent
    ignored = shutil.ignore_patterns(*_LEFT_OUT, "config-*", "*.a")
    shutil.copytree(library, root / library.relative_to("/"), ignore=ignored)
    for name in (f"python3.{sys.version_info.minor}", "python3"):
        target = root / base.relative_to("/") / "bin" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(base / "bin" / name, target)
    for library in base.glob("lib/libpython*.so*"):
        shutil.copy2(library, root / library.relative_to("/"))


def _libraries(root: Path) -> None:
    """Copy the system's shared libraries that anything below `root` needs."""
    files = [*root.rglob("*.so*"), Path(sys.base_prefix) / "bin/python3"]
    listed = subprocess.run(
        ["ldd", *map(str, files)], capture_output=True, text=True, check=False
    ).stdout
    for name in set(re.findall(r"(?:=> |^\s)(/(?:usr/)?lib\S+)", listed, re.MULTILINE)):
        target = root / name.lstrip("/")
        if Path(name).exists() and not target.exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(name, target)


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a tar of a root file system in which the wheel is installed, with ROS."""
    folder = tmp_path_factory.mktemp("image")
    root, venv = folder / "root", folder / "root/opt/lifecycle"
    for each in ("etc", "proc", "sys", "dev", "run", "tmp", "system"):
        (root / each).mkdir(parents=True)
    (root / "tmp").chmod(0o1777)  # podman takes a volume's mode from the image
    _run(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", folder, ROOT)
    (wheel,) = folder.glob("*.whl")
    _run(Path(sys.base_prefix) / "bin/python3", "-m", "venv", "--without-pip", venv)
    packages = venv / f"lib/python3.{sys.version_info.minor}/site-packages"
    pip = (sys.executable, "-m", "pip", "--python", venv / "bin/python")
    _run(*pip, "install", "--quiet", f"{wheel}[ros]", timeout_s=300)
    assert (packages / "rclpy").is_dir()
    program = venv / "bin/lifecycle"
    program.write_text(program.read_text().replace(str(root), ""))
    _python(root)
    _libraries(root)
    (root / "etc/passwd").write_text("robot:x:1000:1000::/tmp:/bin/false\n")
    shutil.copytree(ROOT / "examples/first_node", root / "system/examples/first_node")
    archive = folder / "image.tar"
    with tarfile.open(archive, "w") as written:
        written.add(root, ".", filter=_readable)
    shutil.rmtree(root)
    return archive


def _readable(member: tarfile.TarInfo) -> tarfile.TarInfo:
    """Whoever the container runs as can read it."""
    member.uid = member.gid = 0
    member.mode |= 0o555 if member.isdir() or member.mode & 0o100 else 0o444
    return member


@pytest.fixture
def podman(image: Path, tmp_path: Path, lifecycle_domain: int) -> Iterator[Callable[..., str]]:
    """Give `podman`, with a storage of its own and the image `localhost/robot` in it."""
    (tmp_path / "containers.conf").write_text(SETTINGS)
    manifest = yaml.safe_load((ROOT / "manifests/first_node.lifecycle.yaml").read_text())
    manifest["system"] = "kube"
    manifest["machines"] = {name: {} for name in MACHINES}
    manifest["discovery"]["domain_id"] = lifecycle_domain
    manifest["restart"] = "on-failure"
    manifest["nodes"]["talker"]["machine"] = "robot"
    manifest["nodes"]["listener"]["machine"] = "operator"
    (tmp_path / "system").mkdir()
    (tmp_path / "system/kube.lifecycle.yaml").write_text(yaml.safe_dump(manifest))
    with tarfile.open(image, "a") as archive:
        archive.add(tmp_path / "system/kube.lifecycle.yaml", "./system/kube.lifecycle.yaml")
    lifecycle = (sys.executable, "-m", "lifecycle")
    _run(
        *(*lifecycle, "export", "kubernetes", tmp_path / "system/kube.lifecycle.yaml"),
        *("--image", "localhost/robot", "-o", tmp_path),
    )
    environment = {**os.environ, "CONTAINERS_CONF": str(tmp_path / "containers.conf")}
    runs = tempfile.mkdtemp(prefix="podman")  # podman takes no path longer than 50 characters
    storage = ("--root", tmp_path / "storage", "--runroot", runs)

    def call(*words: str | Path, codes: tuple[int, ...] = (0,)) -> str:
        return _run("podman", *storage, *words, environment=environment, codes=codes)

    path = "ENV PATH=/opt/lifecycle/bin"
    call("import", "--quiet", "--change", path, image, "localhost/robot")
    try:
        yield call
    finally:
        for machine in MACHINES:
            call("kube", "down", tmp_path / f"kube-{machine}.yaml")
        call("system", "reset", "--force")
        shutil.rmtree(runs, ignore_errors=True)


def test_two_pods_are_one_system_whose_nodes_we_restart_and_whose_supervisors_the_engine(
    podman: Callable[..., str], tmp_path: Path
) -> None:
    for machine in MACHINES:
        podman("kube", "play", tmp_path / f"kube-{machine}.yaml")
    names = {machine: f"kube-{machine}-pod-0-supervisor" for machine in MACHINES}

    def probe(machine: str, what: str) -> bool:
        (pod,) = yaml.safe_load_all((tmp_path / f"kube-{machine}.yaml").read_text())
        container = pod["spec"]["template"]["spec"]["containers"][0]
        command = container[f"{what}Probe"]["exec"]["command"]
        try:
            podman("exec", names[machine], *command)
        except AssertionError:
            return False
        return True

    def is_ready(machine: str) -> None:
        try:
            within(60, lambda: probe(machine, "readiness"))
        except AssertionError:
            pytest.fail(podman("logs", names[machine]))

    def inspect(machine: str, what: str) -> str:
        return podman("inspect", names[machine], "--format", f"{{{{{what}}}}}")

    def status(machine: str) -> Any:
        command = ("lifecycle", "status", "kube", "--format", "json")
        return yaml.safe_load(podman("exec", names[machine], *command, codes=(0, 4)))

    for machine in MACHINES:
        is_ready(machine)
        assert probe(machine, "liveness")
        assert inspect(machine, ".Config.User") == "1000:1000"
        assert inspect(machine, ".EffectiveCaps") == "[]"
        assert inspect(machine, ".HostConfig.ReadonlyRootfs") == "true"

    # A node that is killed is restarted by its supervisor, and the container goes on.
    (talker,) = (each for each in status("robot")["nodes"] if each["node"] == "/talker")
    podman(
        "exec",
        names["robot"],
        "/opt/lifecycle/bin/python",
        "-c",
        f"import os; os.kill({talker['pid']}, 9)",
    )
    within(20, lambda: any(each["restarts"] for each in status("robot")["nodes"]))
    is_ready("robot")
    assert inspect("robot", ".RestartCount") == "0"

    # A supervisor that is killed is restarted by the engine, and the system is one again.
    os.kill(int(inspect("robot", ".State.Pid")), signal.SIGKILL)
    within(20, lambda: inspect("robot", ".RestartCount") == "1")
    for machine in MACHINES:
        is_ready(machine)
    assert inspect("operator", ".RestartCount") == "0"
