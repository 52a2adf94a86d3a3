"""Real sshd(8) on hosts of the tests, with keys, accounts' files and a client's configuration.

Owns: `Ssh`, all of which lies in a directory of the test. Nothing of this machine's own ssh is read
or written.
"""

from __future__ import annotations

import os
import shlex
import shutil
import socket
import subprocess
import time
from pathlib import Path

from tests.net.hosts import Host

_SSHD = shutil.which("sshd", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/usr/local/sbin")
_PROGRAMS = ("ssh", "ssh-keygen")
_UP_S = 10.0
MARK = "LIFECYCLE_TEST_MARK"


def lacking() -> str:
    """Return why no sshd can be run here, in one line; empty if it can."""
    if _SSHD is None or any(shutil.which(each) is None for each in _PROGRAMS):
        return "there is no sshd or ssh here: install openssh-server and openssh-client"
    if Path("/proc/self/uid_map").read_text(encoding="ascii").split()[2] == "1":
        return "sshd changes its user, which a user namespace of one user does not let it: be root"
    return ""


class Ssh:
    """Keys and configuration of one test, and an sshd on each host that `serve` is called for."""

    def __init__(self, directory: Path) -> None:
        directory.mkdir(mode=0o700)
        self._directory = directory
        self._keygen("user")
        self._keygen("stranger")
        (directory / "authorized_keys").write_bytes((directory / "user.pub").read_bytes())
        (directory / "known_hosts").touch()
        self.config = directory / "ssh_config"
        self.write_config("user")

    def write_config(self, key: str) -> None:
        """Write the client's configuration, with one key."""
        self.config.write_text(
            "Host *\n"
            "  User root\n"
            f"  IdentityFile {self._directory / key}\n"
            "  IdentitiesOnly yes\n"
            "  StrictHostKeyChecking yes\n"
            f"  UserKnownHostsFile {self._directory / 'known_hosts'}\n"
            "  GlobalKnownHostsFile none\n"
            f"  SendEnv {MARK}\n"
        )

    @property
    def variables(self) -> dict[str, str]:
        """What has `lifecycle up --hosts` use it."""
        return {"LIFECYCLE_SSH": f"ssh -F {shlex.quote(str(self.config))}"}

    def _keygen(self, name: str) -> None:
        subprocess.run(
            ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(self._directory / name)],
            check=True,
            stdin=subprocess.DEVNULL,
        )

    def serve(self, host: Host, runtime: Path, *, known: bool = True) -> None:
        """Start an sshd on a host, for sessions whose runtime directory this is."""
        assert _SSHD is not None
        key = f"host_{host.name}"
        self._keygen(key)
        public = (self._directory / f"{key}.pub").read_text().split()[:2]
        if known:
            with (self._directory / "known_hosts").open("a") as file:
                file.write(f"{host.ipv4} {' '.join(public)}\n")
        names = ("LIFECYCLE_MACHINE_ID", "XDG_RUNTIME_DIR", "ROS_LOG_DIR")
        given = host.environment(runtime, {})
        runtime.chmod(0o700)
        config = self._directory / f"sshd_config_{host.name}"
        config.write_text(
            f"ListenAddress {host.ipv4}\n"
            f"HostKey {self._directory / key}\n"
            f"AuthorizedKeysFile {self._directory / 'authorized_keys'}\n"
            "PidFile none\nUsePAM no\nStrictModes no\nPermitRootLogin yes\n"
            "PasswordAuthentication no\nKbdInteractiveAuthentication no\n"
            f"AcceptEnv {MARK}\n"
            f"SetEnv {' '.join(f'{each}={given[each]}' for each in names)}\n"
        )
        # Of the host's own: sshd insists on its empty directory.
        host.run("mount", "-t", "tmpfs", "-o", "mode=755", "tmpfs", "/run")
        host.run("mkdir", "-m", "755", "/run/sshd")
        with (self._directory / f"log_{host.name}").open("w") as log:
            host.popen(
                *(_SSHD, "-D", "-e", "-f", str(config)), stdin=subprocess.DEVNULL, stderr=log
            )
        deadline = time.monotonic() + _UP_S
        while True:
            with host.socket(socket.AF_INET, socket.SOCK_STREAM) as sock:
                if sock.connect_ex((host.ipv4, 22)) == 0:
                    return
            assert time.monotonic() < deadline, "sshd does not listen"
            time.sleep(0.02)
