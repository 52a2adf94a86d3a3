"""Units of two machines, as `lifecycle export systemd` writes them, started by systemd itself.

Each machine is a network namespace with a manager of systemd in a mount namespace of its own. It is
a user manager, of root and with its sockets where a machine's are: it starts, watches, restarts and
stops services as that does, DynamicUser= included, without being the first process of anything.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.engines.waiting import within
from tests.net.hosts import Host, Hosts, lacking
from tests.second_try import SECOND_TRY

ROOT = Path(__file__).parents[2]
SYSTEMD = Path("/lib/systemd/systemd")
MACHINES = ("robot", "operator")
pytestmark = [
    SECOND_TRY,
    pytest.mark.thorough,
    pytest.mark.alone,
    pytest.mark.timeout(200),
    pytest.mark.skipif(
        bool(lacking()) or not SYSTEMD.exists(),
        reason=lacking() or "needs systemd",
    ),
]

_BOOT = """
mount --make-rprivate / &&
mount -t tmpfs tmpfs /run && mount -t tmpfs tmpfs /dev/shm &&
mkdir -p /run/systemd/system /run/units &&
printf '[Unit]\\nDefaultDependencies=no\\n' > /run/units/basic.target &&
mkdir /run/home && mount --bind /root /run/home && mount -t tmpfs -o mode=755 tmpfs /root &&
for each in $FROM_HOME; do
    mkdir /root/$each && mount --bind /run/home/$each /root/$each || exit
done &&
for each in $GROUPS_; do mkdir $each && echo $$ > $each/cgroup.procs || exit; done &&
exec env -i PATH="$PATH" XDG_RUNTIME_DIR=/run SYSTEMD_UNIT_PATH=/run/units \
    $SYSTEMD --user --unit=basic.target --log-target=null
"""
"""A user manager runs only where systemd has booted, which it knows by /run/systemd/system. Who a
service runs as may not enter /root, where the interpreter may be."""


def _groups(name: str) -> list[Path]:
    """Return the control groups that a manager of that name gets, one a hierarchy."""
    found = []
    for line in Path("/proc/self/cgroup").read_text().splitlines():
        _, controllers, path = line.split(":", 2)
        for folder in {"": ("unified", ""), "name=systemd": ("systemd",)}.get(controllers, ()):
            group = Path("/sys/fs/cgroup", folder, path.lstrip("/"))
            if (group / "cgroup.procs").exists():
                found.append(group / f"lifecycle-{os.getpid()}-{name}")
                break
    return found


def _from_home() -> set[str]:
    """Return what of root's home a service needs: the interpreter, this checkout."""
    needed = (Path(sys.base_prefix).resolve(), Path(sys.prefix), ROOT)
    return {each.parts[2] for each in needed if each.is_relative_to("/root")}


class Machine:
    """One machine on which systemd runs."""

    def __init__(self, host: Host, unit: str) -> None:
        self.unit = unit
        self._groups = _groups(host.name)
        groups = " ".join(map(str, self._groups))
        self._manager = subprocess.Popen(
            ["nsenter", "-t", str(host.pid), "-n", "--", "unshare", "--mount", "sh", "-c", _BOOT],
            env={
                **os.environ,
                "GROUPS_": groups,
                "FROM_HOME": " ".join(_from_home()),
                "SYSTEMD": str(SYSTEMD),
            },
        )
        within(10, lambda: self.systemctl("is-system-running", check=False) == "running")
        # As that of a machine's manager: whoever a service runs as may write to it.
        subprocess.run(self.command("chmod", "a+w", "/run/systemd/notify"), check=True)

    def close(self) -> None:
        """Wait for the manager, whose host has ended, and remove its control groups."""
        self._manager.wait(10)
        for group in self._groups:
            for folder in sorted(group.rglob("*/"), reverse=True):
                folder.rmdir()
            group.rmdir()

    def command(self, *words: str) -> list[str]:
        """Return the command line that runs `words` there."""
        enter = ("nsenter", "-t", str(self._manager.pid), "-n", "-m", "--")
        return [*enter, *words]

    def copy(self, source: Path, target: str) -> None:
        """Copy a file or a folder to that machine."""
        script = 'mkdir -p "${2%/*}" && cp -r "$1" "$2"'
        subprocess.run(self.command("sh", "-c", script, "sh", str(source), target), check=True)

    def systemctl(self, *words: str, check: bool = True) -> str:
        """Return what systemctl(1) says."""
        done = subprocess.run(
            self.command("systemctl", *words),
            capture_output=True,
            text=True,
            check=False,
            timeout=100,
        )
        assert not check or done.returncode == 0, done.stdout + done.stderr
        return done.stdout.strip()

    def begin(self, verb: str) -> subprocess.Popen[bytes]:
        """Begin `systemctl start`, which ends once the unit is ready, or `stop`."""
        return subprocess.Popen(self.command("systemctl", verb, self.unit))

    def show(self, name: str) -> str:
        """Return a property of the unit."""
        return self.systemctl("show", "--value", "-p", name, self.unit)

    def status(self) -> Any:
        """Return what `lifecycle status` says there to root."""
        words = ("-m", "lifecycle", "status", "units", "--format", "json")
        command = self.command("env", "-C", str(ROOT), sys.executable, *words)
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.stdout, done.stderr
        return json.loads(done.stdout)

    def kill(self, pid: int, number: int) -> None:
        """Send a process of this machine a signal."""
        assert str(pid) in self.systemctl("status", "--no-pager", self.unit, check=False)
        os.kill(pid, number)


@pytest.fixture
def machines(tmp_path: Path, lifecycle_domain: int) -> Iterator[tuple[Machine, Machine]]:
    """Give the two machines, with their units in place."""
    with Hosts() as hosts, contextlib.ExitStack() as after:
        pair = hosts.bridged(*MACHINES)
        manifest = yaml.safe_load((ROOT / "manifests/first_node.lifecycle.yaml").read_text())
        manifest["system"] = "units"
        manifest["machines"] = {each.name: {"address": each.ipv4} for each in pair}
        manifest["discovery"] = {"domain_id": lifecycle_domain, "range": "subnet"}
        manifest["restart"] = "on-failure"
        manifest["nodes"]["talker"]["machine"] = "robot"
        manifest["nodes"]["listener"]["machine"] = "operator"
        manifest["nodes"]["listener"]["run"]["resources"] = {"tasks_max": 321}
        system = tmp_path / "system"
        shutil.copytree(ROOT / "examples/first_node", system / "examples/first_node")
        (system / "units.lifecycle.yaml").write_text(yaml.safe_dump(manifest))
        subprocess.run(
            [
                *(sys.executable, "-m", "lifecycle", "export", "systemd"),
                *(system / "units.lifecycle.yaml", "-o", tmp_path / "units"),
                *("--at", "/run/system/units.lifecycle.yaml"),
                *("--program", Path(sys.executable).with_name("lifecycle")),
            ],
            check=True,
        )
        made = []
        for host in pair:
            machine = Machine(host, f"units-{host.name}.service")
            after.callback(machine.close)
            after.callback(host.close)
            machine.copy(tmp_path / "units" / machine.unit, "/run/units/")
            machine.copy(system, "/run/system")
            (tmp_path / "output.conf").write_text(  # there is no journal
                f"[Service]\nStandardOutput=append:{tmp_path}/{host.name}.log\n"
            )
            machine.copy(tmp_path / "output.conf", f"/run/units/{machine.unit}.d/")
            machine.systemctl("daemon-reload")
            made.append(machine)
        yield made[0], made[1]


def start(machines: tuple[Machine, Machine]) -> None:
    """Start both, and wait until both are ready."""
    first = machines[0].begin("start")
    time.sleep(2)
    assert first.poll() is None, "a machine alone is no verified system"
    assert machines[0].show("ActiveState") == "activating"
    assert machines[1].begin("start").wait(60) == 0
    assert first.wait(10) == 0
    for machine in machines:
        status = machine.status()
        assert (status["phase"], status["verdict"]) == ("active", "ok")


def stop(machines: tuple[Machine, Machine]) -> set[str]:
    """Stop both at once, so that none goes on without the other; return what they ended with."""
    ends = [machine.begin("stop") for machine in machines]
    assert [end.wait(60) for end in ends] == [0, 0]
    for machine in machines:
        assert machine.show("TasksCurrent") in ("[not set]", "0")
        assert not machine.systemctl("list-units", "--no-legend", "--type=scope", "run-*")
    return {machine.show("Result") for machine in machines}


def test_two_units_are_one_system_and_start_returns_once_it_is_verified_and_active(
    machines: tuple[Machine, Machine],
) -> None:
    robot, operator = machines
    start(machines)
    # What a process may use is limited by systemd, in a scope that the supervisor ends.
    (listener,) = operator.status()["nodes"]
    scope = Path(f"/proc/{listener['pid']}/cgroup").read_text().split("/")[-1].strip()
    assert operator.systemctl("show", "--value", "-p", "TasksMax", scope) == "321"

    assert stop(machines) == {"success"}
    start(machines)

    # A node that is killed is restarted by its supervisor, and the unit goes on.
    (talker,) = (each for each in robot.status()["nodes"] if each["node"] == "/talker")
    robot.kill(talker["pid"], signal.SIGKILL)
    within(20, lambda: any(each["restarts"] for each in robot.status()["nodes"]))
    assert robot.show("NRestarts") == "0"

    # A supervisor that hangs is killed by the watchdog, and started again.
    robot.kill(int(robot.show("MainPID")), signal.SIGSTOP)
    within(30, lambda: robot.show("NRestarts") == "1")
    within(60, lambda: robot.show("ActiveState") == "active")
    assert operator.show("NRestarts") == "0"

    stop(machines)
