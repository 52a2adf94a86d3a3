"""A plan as units and manifests of the engines that start programs: each machine's part as one.

Owns: what systemd and Kubernetes are given so that the supervisor of a machine is started with it,
is ready only once its system is active and verified, is ended when its event loop hangs, and is
started again where that can help and the manifest leaves that to the engine. Pure.

Sources: systemd.service(5), systemd.exec(5); the Kubernetes API v1 and apps/v1.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable, Iterator, Mapping

import msgspec
import yaml

from lifecycle.errors import ExitCode, UsageError
from lifecycle.manifest.model import THIS_HOST, Resources, Restart, Timeouts
from lifecycle.plan.model import Plan
from lifecycle.printable import one_line
from lifecycle.run_directory import run_name

START_MARGIN_S = 60.0
"""For imports, and for discovery; the deadlines of bring-up end it before."""

STOP_S = 30
"""What is left after so long is killed, unless the deadlines of an orderly shutdown are longer."""

BRING_UP_S = 30
"""`lifecycle up` without `--timeout`: for everything, and 1 s more for each process."""

WATCHDOG_S = 10
PROBE_S = 5
"""How often a container's engine asks, and how long it waits for the answer."""

_USER = 1000
_LONGEST_NAME = 63

_USELESS = (
    ExitCode.USAGE.value,
    ExitCode.MANIFEST_INVALID.value,
    ExitCode.VIOLATED.value,
    ExitCode.UNVERIFIABLE.value,
    ExitCode.SUPERVISION_GAVE_UP.value,
)
"""Exit codes after which the same command would end the same way, or that say so themselves."""


class Deployment(msgspec.Struct, frozen=True, kw_only=True):
    """What is to be started, and with what.

    Attributes:
        plan: all machines of it.
        manifest: path of the manifest where it is started: on the machine, or in the image.
        words: further words of `lifecycle up`: arguments and options.
        timeout_s: of the whole bring-up, where `words` set one; 0 for none.
        image: of containers; has the programs of all nodes.
        program: path of `lifecycle`; in containers it is found by name.
        folder: where `lifecycle up` is started, and looks for relative programs; "/" if empty.
        programs_networks: it is told to program networks, which takes CAP_NET_ADMIN.
    """

    plan: Plan
    manifest: str
    words: tuple[str, ...] = ()
    timeout_s: float = 0.0
    image: str = ""
    program: str = "/opt/lifecycle/bin/lifecycle"
    folder: str = ""
    programs_networks: bool = False

    @property
    def machines(self) -> tuple[str, ...]:
        """Names of the machines that have a part of it; one empty name where none is declared."""
        named = tuple(dict.fromkeys(each.machine for each in self.plan.processes))
        return ("",) if set(named) <= {THIS_HOST} else named

    def name(self, machine: str) -> str:
        """Return what the part of one machine is called: a DNS label, RFC 1123, its alone."""
        name = self._label(machine)
        alike = [each for each in self.machines if self._label(each) == name]
        if len(alike) <= 1 and len(name) <= _LONGEST_NAME:
            return name
        # Too long, or spelled differently only in what a label does not have.
        digest = hashlib.sha256(f"{self.plan.system} {machine}".encode()).hexdigest()[:6]
        where = f"-{_dns_label(machine)}"[: _LONGEST_NAME // 2]
        system = _dns_label(self.plan.system)[: _LONGEST_NAME - len(where) - len(digest) - 1]
        return "-".join(each.strip("-") for each in (system, where, digest) if each.strip("-"))

    def _label(self, machine: str) -> str:
        return _dns_label(self.plan.system + (f"-{machine}" if machine else ""))

    def arguments(self, machine: str) -> tuple[str, ...]:
        """Return the words of `lifecycle` that start a machine's part."""
        where = ("--machine", machine) if machine else ()
        return ("up", self.manifest, *where, *self.words)

    def restarts(self, machine: str) -> bool:
        """Return whether a machine's supervisor restarts nodes itself, and may give up."""
        return any(
            each.supervision.restart is not Restart.NO
            for each in self.plan.nodes
            if each.machine == machine or not machine
        )

    def limited(self, machine: str) -> Iterator[tuple[str, Resources]]:
        """Yield a machine's processes that systemd is to limit, by name, and what they may use."""
        for each in self.plan.processes:
            if each.run.resources is not None and machine in ("", each.machine):
                yield each.name, each.run.resources

    def probe(self, what: str) -> tuple[str, ...]:
        """Return the command that says, in a container, whether it is "live" or "ready"."""
        return ("lifecycle", "status", run_name(self.plan).rpartition("@")[0], "--probe", what)

    @property
    def start_s(self) -> int:
        """Seconds within which a part is ready or has given up, by its own deadlines."""
        steps = self._longest(
            lambda limits: (
                limits.start_s + limits.configure_s + limits.connect_s + limits.activate_s
            )
        )
        whole = self.timeout_s or BRING_UP_S + len(self.plan.processes)
        return math.ceil(max(steps, whole) + START_MARGIN_S)

    @property
    def stop_s(self) -> int:
        """Seconds within which a part has ended in order, by its own deadlines."""
        steps = self._longest(
            # Both disconnect and cleanup have `cleanup_s`.
            lambda limits: limits.deactivate_s + 2 * limits.cleanup_s + limits.shutdown_s
        )
        return max(STOP_S, math.ceil(steps + PROBE_S))

    def _longest(self, seconds: Callable[[Timeouts], float]) -> float:
        """Return how long it takes at most where one level of nodes waits for another."""
        return sum(
            max(seconds(self.plan.node(key).timeouts) for key in level)
            for level in self.plan.levels
        )


def systemd(deployment: Deployment) -> dict[str, str]:
    """Return a service unit for each machine, by file name."""
    return {
        f"{deployment.name(machine)}.service": _systemd_unit(deployment, machine)
        for machine in deployment.machines
    }


def _systemd_unit(deployment: Deployment, machine: str) -> str:
    name, restarts = deployment.name(machine), deployment.restarts(machine)
    folder = deployment.folder
    allowed = "CAP_NET_ADMIN" if deployment.programs_networks else ""
    service: list[tuple[str, object]] = [
        ("Type", "notify"),
        ("NotifyAccess", "main"),
        ("ExecStart", _command((deployment.program, *deployment.arguments(machine)))),
        *([("WorkingDirectory", folder.replace("%", "%%"))] if folder else []),
        ("TimeoutStartSec", deployment.start_s),
        ("TimeoutStopSec", deployment.stop_s),
        # SIGTERM to the supervisor alone, which takes its nodes down in order.
        ("KillMode", "mixed"),
        ("WatchdogSec", WATCHDOG_S),
        # Nodes are restarted by the supervisor, or all of it by systemd, never both. One that is
        # killed, or hangs, cannot restart anything: that is systemd's in any case.
        ("Restart", "on-abnormal" if restarts else "on-failure"),
        *([] if restarts else [("RestartPreventExitStatus", " ".join(map(str, _USELESS)))]),
        ("RestartSec", 2),
        ("RuntimeDirectory", name),
        ("StateDirectory", name),
        ("Environment", f"XDG_RUNTIME_DIR=%t/{name}"),
        ("Environment", f"ROS_HOME=%S/{name}"),
        # Root alone may have systemd limit what it starts: here it is root without a capability.
        *([] if any(deployment.limited(machine)) else [("DynamicUser", "yes")]),
        ("NoNewPrivileges", "yes"),
        ("ProtectSystem", "strict"),
        ("ProtectHome", "read-only"),
        ("RestrictSUIDSGID", "yes"),
        ("LockPersonality", "yes"),
        ("CapabilityBoundingSet", allowed),
        *([("AmbientCapabilities", allowed)] if allowed else []),
    ]
    sections: dict[str, list[tuple[str, object]]] = {
        "Unit": [
            ("Description", _title(deployment, machine)),
            ("Wants", "network-online.target"),
            ("After", "network-online.target"),
        ],
        "Service": service,
        "Install": [("WantedBy", "multi-user.target")],
    }
    parts = [
        f"[{name}]\n" + "".join(f"{key}={value}\n" for key, value in entries)
        for name, entries in sections.items()
    ]
    return _head(deployment, machine) + "\n".join(parts)


_ENVIRONMENT = {"HOME": "/tmp", "ROS_LOG_DIR": "/tmp/log"}  # noqa: S108 - the container's own


def kubernetes(deployment: Deployment) -> dict[str, str]:
    """Return the objects of each machine, by file name: one pod on the node of its name."""
    return {
        f"{deployment.name(machine)}.yaml": _head(deployment, machine)
        + yaml.dump(
            _kubernetes_object(deployment, machine),
            Dumper=_Plain,
            sort_keys=False,
            allow_unicode=True,
            width=100,
        )
        for machine in deployment.machines
    }


def _kubernetes_object(deployment: Deployment, machine: str) -> dict[str, object]:
    name = deployment.name(machine)
    labels = {
        "app.kubernetes.io/name": deployment.name(""),
        "app.kubernetes.io/instance": name,
        "app.kubernetes.io/component": "supervisor",
    }
    spec = _pod(deployment, machine)
    return {
        "apiVersion": "apps/v1",
        "kind": "Deployment",
        "metadata": {"name": name, "labels": labels},
        "spec": {
            "replicas": 1,
            # The supervisor restarts nodes, the engine a supervisor; never two of a system.
            "strategy": {"type": "Recreate"},
            "selector": {"matchLabels": {"app.kubernetes.io/instance": name}},
            "template": {"metadata": {"labels": labels}, "spec": spec},
        },
    }


def _pod(deployment: Deployment, machine: str) -> dict[str, object]:
    for name, resources in deployment.limited(machine):  # as the supervisor cannot do there
        raise UsageError(
            f"{resources.at.spelled}: cannot give process {name!r} its 'run.resources' in a "
            "container of Kubernetes: systemd limits what a process may use, "
            "and does not run there",
            hint="leave 'resources' out and limit the whole container (resources.limits), or write "
            "a unit: lifecycle export systemd",
        )

    def probe(what: str, failures: int) -> dict[str, object]:
        return {
            "exec": {"command": list(deployment.probe(what))},
            "periodSeconds": PROBE_S,
            "timeoutSeconds": PROBE_S,
            "failureThreshold": failures,
        }

    # podman 4 shares a volume among all pods that call it the same.
    volume = deployment.name(machine)
    container: dict[str, object] = {
        "name": "supervisor",
        "image": deployment.image,
        "command": ["lifecycle"],
        "args": [each.replace("$(", "$$(") for each in deployment.arguments(machine)],
        "env": [{"name": name, "value": value} for name, value in _ENVIRONMENT.items()],
        # Live as soon as it answers at all; until then it has the time that bring-up may take.
        "startupProbe": probe("live", math.ceil(deployment.start_s / PROBE_S)),
        "livenessProbe": probe("live", max(1, WATCHDOG_S // PROBE_S)),
        "readinessProbe": probe("ready", 1),
        "securityContext": {
            "runAsNonRoot": True,
            "runAsUser": _USER,
            "runAsGroup": _USER,
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
            "seccompProfile": {"type": "RuntimeDefault"},
        },
        "volumeMounts": [{"name": volume, "mountPath": "/tmp"}],  # noqa: S108
    }
    spec: dict[str, object] = {
        "hostNetwork": True,
        "hostIPC": True,
        "dnsPolicy": "ClusterFirstWithHostNet",
        "terminationGracePeriodSeconds": deployment.stop_s,
        "containers": [container],
        "volumes": [{"name": volume, "emptyDir": {}}],
    }
    if machine and machine != THIS_HOST:
        # A node's name is a DNS name: capitals and `_` cannot be in it.
        node = _dns_label(machine)[:_LONGEST_NAME]
        alike = [each for each in deployment.machines if _dns_label(each) == node]
        if not node or len(alike) > 1:
            names = ", ".join(map(repr, alike or [machine]))
            raise UsageError(
                f"cannot choose a node of Kubernetes by the name of {names}: a node's name has "
                "letters, digits and '-', in lower case; name machines so that they differ in these"
            )
        spec["nodeSelector"] = {"kubernetes.io/hostname": node}
    return spec


ENGINES: Mapping[str, Callable[[Deployment], dict[str, str]]] = {
    "systemd": systemd,
    "kubernetes": kubernetes,
}
"""What each engine is given: a new one is a function and a line here."""


def _title(deployment: Deployment, machine: str) -> str:
    on = f" on {machine}" if machine else ""
    return f"ROS 2 system {deployment.plan.system}{on}, verified before it is activated"


def _head(deployment: Deployment, machine: str) -> str:
    restarts = deployment.restarts(machine)
    by = "the supervisor restarts nodes, the engine it" if restarts else "the engine restarts all"
    source = one_line(deployment.manifest)
    return f"# {_title(deployment, machine)}.\n# Written by lifecycle export from {source}; {by}.\n"


class _Plain(yaml.SafeDumper):
    """Writes what stands twice twice: an alias surprises people."""

    def ignore_aliases(self, data: object) -> bool:
        """Ignore all."""
        del data
        return True


def _dns_label(text: str) -> str:
    return re.sub(r"[^a-z0-9-]+", "-", text.lower()).strip("-")


def _command(words: tuple[str, ...]) -> str:
    """Return a command line as systemd.service(5) reads it; `%` and `$` stand for themselves."""
    said = []
    for word in words:
        escaped = (
            word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
        )
        # A line break would end the command, and begin a setting of its own.
        escaped = re.sub(r"[\x01-\x1f\x7f]", lambda sign: f"\\x{ord(sign[0]):02x}", escaped)
        plain = re.fullmatch(r"[A-Za-z0-9_@%+=:,./$-]+", escaped)
        said.append(escaped if plain else f'"{escaped}"')
    return " ".join(said)
