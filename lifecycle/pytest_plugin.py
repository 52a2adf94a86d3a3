"""pytest fixtures that bring up a manifest, or one node of it, in a ROS domain of their own.

Owns: `lifecycle_system` (`lifecycle up` in a process of its own, ended with the test),
`lifecycle_node` (one node in the test's process, without a supervisor), `lifecycle_domain`, and
what a failed test shows of them. pytest loads this module in every project (entry point pytest11):
everything else is imported where it is used. Tests may run side by side (pytest-xdist).
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from lifecycle.node.host.in_process import NodeInProcess

__tracebackhide__ = True
"""pytest shows the line of the test that failed, and no frame of this module."""

DOMAINS = (*range(215, 232), *range(70, 102))
"""Their ports lie outside Linux's ephemeral range (32768–60999), where any socket may be."""

UP_S = 60.0
"""For a system to be active; `lifecycle up` has deadlines of its own."""

WAIT_S = 10.0
"""For an event or a line of a log; it ends with what is waited for."""

DOWN_S = 30.0

_LOG_LINES = 60
_LOOK_S = 0.02
_RUNNING = pytest.StashKey[list["LifecycleSystem"]]()


class SystemFailedError(AssertionError):
    """A system did not come up, or was not as declared in the end; says why, with its logs."""


@contextlib.contextmanager
def claimed_domain() -> Iterator[int]:
    """Give a ROS domain that no other test of this machine has, for as long as the block lasts.

    `LIFECYCLE_TEST_DOMAINS=10-19` says which to choose from.
    """
    pool: Sequence[int] = DOMAINS
    if given := os.environ.get("LIFECYCLE_TEST_DOMAINS", ""):
        first, _, last = given.partition("-")
        pool = range(int(first), int(last or first) + 1)
    with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)) as claim:
        for domain in pool:
            try:
                claim.bind(f"\0lifecycle-test-domain-{domain}")
            except OSError:
                continue
            yield domain
            return
        pytest.fail(
            f"all test domains {tuple(pool)} are taken by other tests; see LIFECYCLE_TEST_DOMAINS"
        )


class LifecycleSystem:
    """A running `lifecycle up`; `lifecycle_system(MANIFEST)` returns it once the system is active.

    Attributes:
        manifest: what it brings up.
        domain_id: its ROS domain, which is that of the test's process, too.
        environment: for programs that shall see the system, `ros2` for one: that of the test, which
            has the domain, and where it logs.
        events: what it has reported so far: JSON events, docs/events.md.
        directory: with `log`, the logs of its processes, and `stderr`, what `lifecycle up` said.
    """

    def __init__(
        self,
        manifest: str | os.PathLike[str],
        words: Sequence[str],
        domain_id: int,
        directory: Path,
    ) -> None:
        self.manifest = Path(manifest)
        self.domain_id = domain_id
        self.directory = directory
        self.environment = {
            **os.environ,
            "ROS_LOG_DIR": str(directory / "log"),
            "XDG_RUNTIME_DIR": str(directory),
        }
        self.events: list[dict[str, Any]] = []
        self._result: dict[str, Any] | None = None
        with (directory / "stderr").open("wb") as said:
            self._process = subprocess.Popen(
                [
                    *(sys.executable, "-m", "lifecycle", "up", str(manifest), *words),
                    *("--format", "json", "--domain", str(domain_id)),
                ],
                env=self.environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=said,
                encoding="utf-8",
                errors="replace",
                start_new_session=True,
            )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                document = json.loads(line)
                if "event" in document:
                    self.events.append(document)
                else:
                    self._result = document

    @property
    def verdict(self) -> dict[str, Any]:
        """The last verdict, schemas/verdict.v1.schema.json; without findings before there is one.

        Of a system that has ended it has `run`: why, how far it came, and its exit code.
        """
        if self._result is not None:
            return self._result
        judged = [each["verdict"] for each in self.events if each["event"] == "verdict"]
        return dict(judged[-1]) if judged else {"verdict": "unverifiable", "findings": []}

    def wait_for(
        self, holds: Callable[[dict[str, Any]], object], timeout_s: float = WAIT_S
    ) -> dict[str, Any]:
        """Return the first event, those that came before included, of which something holds.

        Raises:
            TimeoutError: there is none within `timeout_s` seconds.
            SystemFailedError: the system has ended without.
        """
        deadline = time.monotonic() + timeout_s
        looked = 0
        while True:
            over = not self._reader.is_alive()
            for event in self.events[looked:]:
                looked += 1
                if holds(event):
                    return event
            if over:
                raise SystemFailedError(f"the system has ended\n{self.report()}")
            if time.monotonic() > deadline:
                raise TimeoutError(f"cannot find the event within {timeout_s:g} s")
            time.sleep(_LOOK_S)

    def until_active(self, timeout_s: float = UP_S) -> None:
        """Wait until the system is verified and active.

        Raises:
            SystemFailedError: it did not come up; says why, with its verdict and its logs.
        """
        try:
            self.wait_for(
                lambda each: each["event"] == "system" and each["reached"] == "active", timeout_s
            )
        except TimeoutError:
            message = f"the system is not active after {timeout_s:g} s\n{self.report()}"
            raise SystemFailedError(message) from None

    def wait_for_log(self, process: str, text: str, timeout_s: float = WAIT_S) -> str:
        """Return the first line with `text` in it that a process has written.

        Args:
            process: its name: the key of its node, if it has one.
            text: part of a line.
            timeout_s: seconds.

        Raises:
            TimeoutError: there is none in time.
            SystemFailedError: the system has ended without.
        """

        def found(event: dict[str, Any]) -> bool:
            return event["event"] == "log" and event["process"] == process and text in event["line"]

        try:
            return str(self.wait_for(found, timeout_s)["line"])
        except TimeoutError:
            lines = "\n".join(self.log(process)[-_LOG_LINES:]) or "(nothing)"
            raise TimeoutError(
                f"cannot find {text!r} in the log of {process!r} within {timeout_s:g} s:\n{lines}"
            ) from None

    def log(self, process: str) -> list[str]:
        """Return all that a process has written, line by line."""
        logged = [each for each in self.events if each["event"] == "log"]
        return [str(each["line"]) for each in logged if each["process"] == process]

    def stop(self) -> int:
        """End the system as `lifecycle down` does, and return its exit code; again is harmless."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
        try:
            code = self._process.wait(DOWN_S)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
            code = self._process.wait()
        self._reader.join(WAIT_S)
        return code

    def check(self) -> None:
        """End the system, unless that was done, and fail if it was not as declared until then.

        Raises:
            SystemFailedError: its exit code is not 0.
        """
        over = self._process.poll() is not None
        if (code := self.stop()) and not over:
            raise SystemFailedError(f"lifecycle up ended with {code}\n{self.report()}")

    def report(self) -> str:
        """Return the verdict and the end of each log, as a failed test shows them."""
        return "\n".join(f"--- {title}\n{text}" for title, text in self.sections())

    def sections(self) -> Iterator[tuple[str, str]]:
        """Yield what a failed test shows: titles and texts."""
        verdict = self.verdict
        lines = [str(verdict["verdict"])]
        for each in verdict["findings"]:
            lines.append(f"{each['outcome']} {each['rule']}: {each['subject']}: {each['message']}")
            lines += [f"  {name}: {each[name]}" for name in ("at", "hint") if each.get(name)]
        if run := verdict.get("run"):
            lines.append(f"ended: {run['reason']} (exit code {run['exit_code']})")
        yield f"verdict on {self.manifest.name}, domain {self.domain_id}", "\n".join(lines)
        said = (self.directory / "stderr").read_text(encoding="utf-8", errors="replace")
        if said.strip():
            yield "lifecycle up", said.rstrip("\n")
        names = [each["process"] for each in self.events if each["event"] == "log"]
        for name in dict.fromkeys(names):
            yield f"log of {name}", "\n".join(self.log(name)[-_LOG_LINES:])


MakeSystem = Callable[..., LifecycleSystem]
MakeNode = Callable[..., "NodeInProcess"]


@pytest.fixture
def lifecycle_domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """A ROS domain that no other test has; this process and what it starts are placed in it."""
    with claimed_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        if not os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE"):
            monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield domain


@pytest.fixture
def lifecycle_system(
    request: pytest.FixtureRequest, lifecycle_domain: int, tmp_path: Path
) -> Iterator[MakeSystem]:
    """Bring a manifest up in a domain of its own, and end it with the test.

    `lifecycle_system(MANIFEST, "--strict", arguments={"rate": 10}, timeout_s=60)`: the file,
    options of `lifecycle up`, arguments of the manifest, and for how long it may take. It returns
    once the system is verified and active, and raises SystemFailedError if that does not come. The
    test fails, too, if the system is not as declared when it is ended. Of a test that fails, pytest
    shows the verdict and the logs.
    """
    running: list[LifecycleSystem] = request.node.stash.setdefault(_RUNNING, [])

    def make(
        manifest: str | os.PathLike[str],
        *options: str,
        arguments: Mapping[str, object] | None = None,
        timeout_s: float = UP_S,
    ) -> LifecycleSystem:
        directory = tmp_path / f"lifecycle{len(running)}"
        directory.mkdir(mode=0o700)
        words = (*options, *(f"{name}:={value}" for name, value in (arguments or {}).items()))
        system = LifecycleSystem(manifest, words, lifecycle_domain, directory)
        running.append(system)
        system.until_active(timeout_s)
        return system

    try:
        yield make
    finally:
        with contextlib.ExitStack() as ending:
            for each in running:
                ending.callback(each.check)
            running.clear()


@pytest.fixture
def lifecycle_node(
    lifecycle_domain: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Iterator[MakeNode]:
    """Run one node of a manifest in this process, without a supervisor, until the test ends.

    `lifecycle_node(MANIFEST, NODE, arguments={...}, to="inactive")`: the file, the node's key or
    its full name, arguments of the manifest, and the state to bring it to: "unconfigured",
    "inactive" (connected) or "active", the default.
    """
    with contextlib.ExitStack() as nodes:

        def make(
            manifest: str | os.PathLike[str],
            node: str,
            *,
            arguments: Mapping[str, object] | None = None,
            to: str = "active",
        ) -> NodeInProcess:
            from lifecycle.manifest.diagnostics import ManifestError
            from lifecycle.manifest.loading import load
            from lifecycle.plan.build import build_plan, find_node

            given = {name: str(value) for name, value in (arguments or {}).items()}
            try:
                loaded = load(os.fspath(manifest), given)
            except ManifestError as error:
                raise error.with_traceback(None) from None
            plan = build_plan(loaded.manifest, domain_id=lifecycle_domain)
            planned = find_node(plan, node)
            for name, value in (("ROS_LOG_DIR", str(tmp_path)), *planned.run.environment.items()):
                monkeypatch.setenv(name, value)
            if planned.run.working_directory:
                monkeypatch.chdir(planned.run.working_directory)
            with warnings.catch_warnings():
                # rclpy imports lark through its type supports, and lark a deprecated module.
                warnings.simplefilter("ignore", DeprecationWarning)
                from lifecycle.node.host.in_process import NodeInProcess

                made = NodeInProcess(
                    planned,
                    domain_id=plan.domain_id,
                    group=[each for each in plan.nodes if each.process == planned.process],
                )
            nodes.callback(made.close)
            made.bring_to(to)
            return made

        yield make


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Attach what systems said to the report of a test that failed."""
    report = yield
    if report.failed and call.when in ("setup", "call"):
        for system in item.stash.get(_RUNNING, []):
            report.sections += [(f"lifecycle: {title}", text) for title, text in system.sections()]
    return report
