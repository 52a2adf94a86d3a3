"""Carries out rounds of the soak on a real system, and judges each by the model.

Owns: `Soaking`: brings the system up, does what a round says, asserts what must follow
(tests.soak.model), and that nothing is left when a run ends.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import shutil
import signal
import socket
import statistics
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import psutil

from lifecycle.middleware.process.shared_memory import leftovers
from tests.ros.supervisor.running import ROOT, command, environment, left_of, verb
from tests.shared_memory import owned_by
from tests.soak.model import (
    DIES,
    HANGS,
    NODES,
    UNMANAGED,
    Condition,
    Expectation,
    Fault,
    Kind,
    Manifest,
    Round,
    State,
    follows,
    process,
)
from tests.soak.nodes import SEEN, address
from tests.soak.running import (
    NotAsPromisedError,
    Transitions,
    Watched,
    assert_activated_on_request,
    assert_gate_held,
)
from tests.soak.system import ISSUED, NAME, PUBLISHES, SUBSCRIBES, TINTED, manifest
from tests.stalls import Stalls

REPORTED_S = 1.0
"""From a fault to the event that names its subject; the time that the machine's scheduler took
meanwhile from us or from the supervisor is not counted (tests.stalls)."""
HANG_TAKEN_S = 0.1
"""A node looks for orders each 0.05 s: so much later it hangs."""
BACK_S = 40.0
"""From the last fault to a system that is as it was; on two busy cores."""
UP_S = 60.0
DOWN_S = 25.0
FLOWS_S = 5.0
"""From a system that is as it was to data that flow to every node; on two busy cores."""
APPLY_S = 15.0
"""`lifecycle apply --timeout`."""

REPORTING = tuple(each for each in NODES if each not in ("pool", "part"))
"""Nodes whose own reports of their states are compared with what was requested."""

_SIGNALS = {"term": signal.SIGTERM, "interrupt": signal.SIGINT}
_BRIEFLY_S = 0.4


class Soaking:
    """The system of the soak, over several runs.

    Args:
        directory: for manifest, run directories and logs.
        domain_id: ROS domain.
        private: we have network and mounts of our own, and may break them.
    """

    def __init__(self, directory: Path, domain_id: int, *, private: bool) -> None:
        self.directory = directory
        self.private = private
        self.mark = uuid.uuid4().hex
        self.runtime = directory / "runtime"
        self.runtime.mkdir()
        if private:
            options = ("-t", "tmpfs", "-o", "size=24m", "tmpfs")
            subprocess.run(["mount", *options, str(self.runtime)], check=True)
        self.stumble = directory / "stumble"
        self.manifest = manifest(directory, domain_id, self.mark, Manifest())
        self.in_force = self.manifest
        self.transitions = _transitions(domain_id)
        self.domain_id = domain_id
        self.stalls = Stalls()
        self.state = State()
        self.run: Watched | None = None
        self.pids: dict[str, int] = {}
        self.back_s: list[float] = []
        self.reported_s: list[float] = []
        self.stalled = 0
        self._began = 0.0
        self._reporters: tuple[int, ...] = ()
        self._late_s = 0.0
        self._spare = leftovers()

    # A run

    def up(self) -> Watched:
        """Bring the system up, unless it is."""
        if self.run is None:
            self._began = time.monotonic()
            self.state = State()
            self.in_force = self.manifest
            for each in self.stumble.iterdir():
                each.unlink()
            for each in sorted((self.runtime / "log").glob("20*"))[:-1]:
                shutil.rmtree(each)
            self.run = Watched(self.manifest, runtime=self.runtime)
            self._until_as_it_was(self.run, UP_S)
            # What is compared with the requests must not be empty because nothing is received.
            deadline = time.monotonic() + DOWN_S
            while missing := self.transitions.not_received():
                if time.monotonic() > deadline:
                    raise NotAsPromisedError(f"transition events are not received of: {missing}")
                time.sleep(0.02)
        return self.run

    def end(self, how: str) -> None:
        """End the run, and assert that it ends as it should, and that nothing is left of it."""
        run, self.run = self.run, None
        assert run is not None
        if how == "down":
            self._verb("down", within_s=DOWN_S)
        else:
            run.process.send_signal(_SIGNALS[how])
        # What was violated meanwhile is over.
        self._ended(run, frozenset({130 if how == "interrupt" else 0}))

    def _ended(self, run: Watched, codes: frozenset[int], *, alone: bool = True) -> None:
        try:
            code = run.process.wait(DOWN_S)
            for each in run._readers:
                each.join(DOWN_S)
            if code not in codes:
                last = [each for each in run.events if "run" in each][-1:]
                raise NotAsPromisedError(
                    f"exit code {code}, not {sorted(codes)}: {last} {run.said()}"
                )
            self._judge(run)
            if not alone:
                self._spare += leftovers()
            self._assert_nothing_left(run)
        except subprocess.TimeoutExpired:
            raise NotAsPromisedError(f"not ended within {DOWN_S:g} s: {run.events[-5:]}") from None
        finally:
            run.close()
            self.state = State()

    def _assert_nothing_left(self, run: Watched) -> None:
        if left := left_of(run.mark, within_s=2.0):
            raise NotAsPromisedError(f"processes are left: {left}")
        if self.private and (segments := set(leftovers()) - set(self._spare)):
            raise NotAsPromisedError(f"shared memory is left: {sorted(segments)}")
        if left := [str(each) for each in (self.runtime / "lifecycle").glob("*/*")]:
            raise NotAsPromisedError(f"run directories are left: {left}")
        if self.private and shutil.which("nft"):
            words = ["nft", "list", "tables"]
            listed = subprocess.run(words, capture_output=True, text=True, check=False)
            if listed.stdout:
                raise NotAsPromisedError(f"nft tables are left: {listed.stdout}")

    def close(self) -> None:
        """End everything, whatever happened."""
        with contextlib.ExitStack() as stack:
            if self.private:
                stack.callback(subprocess.run, ["umount", "-l", str(self.runtime)], check=False)
            stack.callback(self.stalls.close)
            stack.callback(self.transitions.close)
            if self.run is not None:
                stack.callback(self.run.close)

    def abandon(self) -> None:
        """Kill what runs; the next round begins with a system that is brought up anew."""
        run, self.run = self.run, None
        self.state = State()
        if run is not None:
            run.close()

    def measured(self) -> str:
        """Say how fast faults were reported, and how soon the system was as it was."""
        lines = [
            f"{what}: median {statistics.median(found):.3f} s, longest {max(found):.3f} s"
            for what, found in (("reported", self.reported_s), ("back", self.back_s))
            if found
        ]
        if self.stalled:
            lines.append(
                f"stalled and reported as hung for a moment, without a fault: {self.stalled}"
            )
        return "; ".join(lines)

    # A round

    def round(self, done: Round) -> None:
        """Carry out one round.

        Raises:
            NotAsPromisedError: what must follow did not.
        """
        run = self.up()
        for each in self.stumble.iterdir():
            each.unlink()
        before = dict(self.pids)
        since = len(run.events)
        expected, after = follows(self.state, done)
        with self._condition(run, done) as told:
            delayed_s = {each: _run_delay_s(before[_node_of(each)]) for each in done.faults}
            self._reporters = _reporters(run.process.pid)
            self._late_s = sum(map(_run_delay_s, self._reporters))
            times = self._inject(done, before)
            if done.condition is Condition.SUPERVISOR_KILLED:
                self._supervisor_killed(run, done)
                self.state = State()
                return
            if done.condition is Condition.FROZEN:
                time.sleep(done.lasts_s)
            else:
                self._reports(run, done, expected, since, times, delayed_s)
                self._through(run, done, expected, since, times, told)
        healed = time.monotonic()
        if done.condition is Condition.FROZEN:
            times = {each: max(at, healed) for each, at in times.items()}
            self._reports(run, done, expected, since, times, delayed_s)
        if done.manifest is not None and self._end_of_apply(run, expected) == "applied":
            after = dataclasses.replace(after, manifest=done.manifest)
        if expected.goes_on is not None and self._goes_on(run, expected):
            after = expected.goes_on
        elif expected.exit_codes:
            self.run = None
            # While the run ended the intruder may have used a port of the supervisor's.
            self._ended(run, expected.exit_codes, alone=done.condition is not Condition.INTRUDER)
            return
        else:
            for words in expected.heal:
                self._insist(run, words)
        self.state = after
        self._until_as_it_was(run, BACK_S)
        self.back_s.append(time.monotonic() - healed)
        self._until_data_flow()
        self._judge(run)
        self._assert_only_who_must_came_again(expected, before)
        self._assert_nobody_else_was_blamed(run, expected, since)
        if done.ends:
            self.end(done.ends)

    def _inject(self, done: Round, pids: dict[str, int]) -> dict[Fault, float]:
        """Do what is to be done; return when each fault was there."""
        times = {}
        for number, fault in enumerate(done.faults):
            if number and done.spread_s:
                time.sleep(done.spread_s)
            node = _node_of(fault)
            if fault.kind is Kind.STUMBLE:
                (self.stumble / process(fault.target).nodes[0]).write_text(fault.detail)
            times[fault] = time.monotonic()
            with contextlib.suppress(ProcessLookupError, ConnectionError):
                if fault.kind in (Kind.KILL, Kind.STUMBLE):
                    os.kill(pids[node], signal.SIGKILL)
                elif fault.kind in (Kind.STOP, Kind.STOP_BRIEFLY):
                    os.kill(pids[node], signal.SIGSTOP)
                else:
                    self._order(node, _ORDERS.get(fault.kind, fault.kind.value))
        return times

    def _order(self, node: str, word: str) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            sender.sendto(word.encode(), address(self.mark, node))

    def _reports(
        self,
        run: Watched,
        done: Round,
        expected: Expectation,
        since: int,
        times: dict[Fault, float],
        delayed_s: dict[Fault, float],
    ) -> None:
        """Assert that each fault is reported with its subject, in time."""
        # Who is stopped briefly must go on before its watchdog ends it.
        briefly = {each for each in times if each.kind is Kind.STOP_BRIEFLY}
        for fault, at in sorted(times.items(), key=lambda each: each[0] not in briefly):
            own = process(fault.target)
            if own.name in expected.may_fail:
                continue
            names = {own.name, *(f"/{each}" for each in own.nodes)}
            kinds = {"silent"} if fault.kind in HANGS | {Kind.STOP_BRIEFLY} else {"failure"}
            kinds |= {"process"}

            def is_it(event: dict, kinds: set = kinds, names: set = names) -> bool:
                kind = event.get("event")
                subject = {event.get("subject"), event.get("node"), event.get("process")}
                if kind == "process" and event["state"] not in ("stopping", "exited"):
                    return False
                return kind in kinds and bool(subject & names)

            if fault.kind is Kind.ALTER:
                is_it = _finding("param.value-differs", names)
            if fault.kind is Kind.STRAY:
                is_it = _finding("graph.undeclared-publisher", names)
            what = f"report of {fault}"
            _, seen = run.wait(is_it, since=since, within_s=15.0, what=what)
            bound_s = REPORTED_S + (HANG_TAKEN_S if fault.kind in _ORDERS else 0.0)
            # Who reports may have got no processor, and not we.
            late_s = sum(map(_run_delay_s, self._reporters)) - self._late_s
            took_s = min(self.stalls.taken(at, seen), seen - at - late_s)
            if fault.kind in HANGS:
                # A callback that gets no processor does not hang: docs/liveliness.md.
                took_s -= max(0.0, _run_delay_s(self.pids[own.nodes[0]]) - delayed_s[fault])
            self.reported_s.append(took_s)
            if took_s > bound_s:
                raise NotAsPromisedError(
                    f"{fault} was reported after {seen - at:.3f} s, {took_s:.3f} s without what "
                    f"the machine's scheduler took; allowed are {bound_s:g} s"
                )
            if fault.kind is Kind.STOP_BRIEFLY:
                time.sleep(max(0.0, at + _BRIEFLY_S - time.monotonic()))
                os.kill(self.pids[own.nodes[0]], signal.SIGCONT)

    def _through(
        self,
        run: Watched,
        done: Round,
        expected: Expectation,
        since: int,
        times: dict[Fault, float],
        told: float,
    ) -> None:
        """See what must follow while the condition lasts."""
        if expected.consequence in ("deactivate", "pause", "stop", "mode"):
            action = expected.consequence
            run.wait(
                lambda each: each.get("event") == "consequence" and each["action"] == action,
                since=since,
                within_s=15.0,
                what=f"consequence {action}",
            )
        for fault in done.faults:
            if fault.kind is Kind.ALTER and not expected.exit_codes:
                self._order(process(fault.target).nodes[0], "restore")
            if fault.kind is Kind.STRAY:
                self._order(process(fault.target).nodes[0], "unstray")
        if done.condition is not Condition.NONE:
            time.sleep(max(0.0, told + done.lasts_s - time.monotonic()))

    # Conditions

    @contextlib.contextmanager
    def _condition(self, run: Watched, done: Round) -> Iterator[float]:
        began = time.monotonic()
        with contextlib.ExitStack() as stack:
            if done.condition in (Condition.CUT, Condition.LINK_DOWN, Condition.DISK_FULL):
                assert self.private
            if done.condition is Condition.CUT:
                rules = (
                    "add table inet soak; "
                    "add chain inet soak in {type filter hook input priority 0;}; "
                    "add rule inet soak in meta l4proto udp drop"
                )
                subprocess.run(["nft", rules], check=True)
                stack.callback(subprocess.run, ["nft", "delete table inet soak"], check=True)
            elif done.condition is Condition.LINK_DOWN:
                subprocess.run(["ip", "link", "set", "lo", "down"], check=True)
                stack.callback(subprocess.run, ["ip", "link", "set", "lo", "up"], check=True)
            elif done.condition is Condition.DISK_FULL:
                filler = self.runtime / "filler"
                with contextlib.suppress(OSError), filler.open("ab", buffering=0) as file:
                    while file.write(b"x" * 512):
                        pass
                stack.callback(filler.unlink)
            elif done.condition is Condition.FROZEN:
                run.process.send_signal(signal.SIGSTOP)
                stack.callback(run.process.send_signal, signal.SIGCONT)
            elif done.condition is Condition.INTRUDER:
                stack.enter_context(self._intruder(run))
            elif done.condition is Condition.PAUSED:
                self._insist(run, ("pause",))
            elif done.condition is Condition.SAFE:
                self._insist(run, ("mode", "safe"))
            elif done.condition is Condition.STORM:
                stack.enter_context(self._storm(done))
            elif done.condition is Condition.APPLY:
                began = self._begin_apply(run, done)
            yield began

    @contextlib.contextmanager
    def _intruder(self, run: Watched) -> Iterator[None]:
        """A node that was not declared: from when it is reported nobody may become active."""
        since = len(run.events)
        words = [sys.executable, str(ROOT / "tests/ros/faults/foreign.py"), "intruder"]
        variables = {**os.environ, "ROS_DOMAIN_ID": str(self.domain_id)}
        stranger = subprocess.Popen(words, env=variables, stdout=subprocess.PIPE)
        try:
            found = _finding("graph.undeclared-node", {"/intruder"})
            run.wait(found, since=since, within_s=15.0, what="report of the intruder")
            closed = time.monotonic()
            yield
            opened = time.monotonic()
            time.sleep(0.1)
            if early := self.transitions.activated(closed + 0.3, opened):
                raise NotAsPromisedError(f"became active while an intruder was there: {early}")
        finally:
            self._spare += tuple(owned_by([stranger.pid]))
            stranger.kill() if sys.exc_info()[0] else stranger.terminate()
            stranger.wait(DOWN_S)
            assert stranger.stdout is not None
            stranger.stdout.close()

    @contextlib.contextmanager
    def _storm(self, done: Round) -> Iterator[None]:
        orders = [self._start("restart", NAME, *((each,) if each else ())) for each in done.orders]
        try:
            yield
            for each, node in zip(orders, done.orders, strict=True):
                try:
                    _, said = each.communicate(timeout=BACK_S)
                except subprocess.TimeoutExpired:
                    raise NotAsPromisedError(f"lifecycle restart {node} did not end") from None
                if each.returncode not in (0, 2, 6):
                    raise NotAsPromisedError(f"lifecycle restart {node}: {each.returncode}: {said}")
        finally:
            for each in orders:
                if each.poll() is None:
                    each.kill()
                    each.communicate()

    def _begin_apply(self, run: Watched, done: Round) -> float:
        """Have another manifest applied; return when that began, and `later_s` later."""
        assert done.manifest is not None
        name = f"{NAME}-{done.number}"
        path = manifest(self.directory, self.domain_id, self.mark, done.manifest, name)
        words = ["apply", str(path), "--format", "json", "--timeout", f"{APPLY_S:g}"]
        since, asked_s = len(run.events), time.monotonic()
        self._applied = path, self._start(*words)
        if done.manifest != self.state.manifest:
            begun = lambda each: each.get("event") == "apply" and each["stage"] == "begun"  # noqa: E731
            _, asked_s = run.wait(begun, since=since, within_s=15.0, what="beginning of apply")
        time.sleep(max(0.0, asked_s + done.later_s - time.monotonic()))
        return asked_s

    def _end_of_apply(self, run: Watched, expected: Expectation) -> str:
        """Wait for the end of `lifecycle apply`; return what became of it."""
        path, asked = self._applied
        try:
            out, error = asked.communicate(timeout=3 * APPLY_S)
        except subprocess.TimeoutExpired:
            raise NotAsPromisedError("lifecycle apply did not end") from None
        finally:
            if asked.poll() is None:
                asked.kill()
                asked.communicate()
        try:
            report = json.loads(out)
        except ValueError:
            raise NotAsPromisedError(f"lifecycle apply: {asked.returncode}: {out}{error}") from None
        outcome = report["outcome"]
        good = {"applied": {0}, "unchanged": {0}, "rolled_back": {4, 5, 6}}
        if outcome not in expected.outcomes or asked.returncode not in good[outcome]:
            raise NotAsPromisedError(
                f"became {outcome}, not {sorted(expected.outcomes)}, exit code {asked.returncode}: "
                f"{report['error']}"
            )
        if outcome == "applied":
            self.in_force = path
        if outcome == "rolled_back" and not expected.failed | expected.silent:
            back = "is in force again, revision "
            if back not in report["error"] or "active and verified" not in report["error"]:
                raise NotAsPromisedError(f"not as before: {report['error']}")
        return str(outcome)

    def _supervisor_killed(self, run: Watched, done: Round) -> None:
        """Kill the supervisor, and start it again after a while that does not wait for anything."""
        run.process.kill()
        run.process.wait(DOWN_S)
        self._judge(run)
        time.sleep(done.lasts_s)
        self.run = None
        try:
            self.up()
        finally:
            run.close_streams()
        if left := left_of(run.mark, within_s=5.0):
            raise NotAsPromisedError(f"processes of the killed supervisor are left: {left}")

    # Verbs

    def _start(self, name: str, *words: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [*command(name), *words],
            cwd=ROOT,
            env=environment(self.runtime, self.mark),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def _verb(self, name: str, *words: str, within_s: float) -> tuple[int, str]:
        try:
            done = verb(name, NAME, *words, runtime=self.runtime, mark=self.mark, within_s=within_s)
        except subprocess.TimeoutExpired:
            raise NotAsPromisedError(
                f"lifecycle {name} {words} did not end in {within_s:g} s"
            ) from None
        return done.returncode, done.stdout + done.stderr

    def _insist(self, run: Watched, words: tuple[str, ...]) -> None:
        """Give an order until it is carried out: the system may be doing something else."""
        deadline = time.monotonic() + BACK_S
        while True:
            code, said = self._verb(*words, within_s=BACK_S)
            if code == 0:
                return
            if run.process.poll() is not None or time.monotonic() > deadline:
                raise NotAsPromisedError(f"lifecycle {' '.join(words)}: {code}: {said}")
            time.sleep(0.2)

    # Judging

    def _until_as_it_was(self, run: Watched, within_s: float) -> None:
        deadline = time.monotonic() + within_s
        why = ""
        while time.monotonic() < deadline:
            if run.process.poll() is not None:
                raise NotAsPromisedError(
                    f"the run ended, exit code {run.process.returncode}: {run.events[-2:]}"
                    f" {run.said()}"
                )
            why = self._what_lacks(run)
            if not why:
                return
            time.sleep(0.05)
        raise NotAsPromisedError(f"not as it was within {within_s:g} s: {why}")

    def _goes_on(self, run: Watched, expected: Expectation) -> bool:
        """Whether the system comes to be as it was, and does not end."""
        for words in expected.heal:
            with contextlib.suppress(NotAsPromisedError):  # it ended
                self._insist(run, words)
        deadline = time.monotonic() + BACK_S
        while run.process.poll() is None and time.monotonic() < deadline:
            if not self._what_lacks(run):
                return True
            time.sleep(0.05)
        return False

    def _what_lacks(self, run: Watched) -> str:
        status = run.status()
        if status is None:
            return "no status"
        lacks = []
        if (status.phase, status.mode) != ("active", "normal"):
            lacks.append(f"phase {status.phase}, mode {status.mode}")
        if status.verdict is None or status.verdict.value != "ok":
            lacks.append(f"verdict {status.verdict}: {status.not_ok}")
        for node in status.nodes:
            wanted = "" if node.node[1:] in UNMANAGED else "active"
            if node.state != wanted or node.silent or node.died or node.next_try_s is not None:
                lacks.append(f"{node.node}: {node.state} {node.silent} {node.died} {node.doing}")
        if {each.node[1:] for each in status.nodes} != set(self.state.nodes):
            lacks.append(f"nodes {[each.node for each in status.nodes]}")
        if status.manifest != str(self.in_force):
            lacks.append(f"by {status.manifest}")
        if not lacks:
            self.pids = {each.node[1:]: each.pid for each in status.nodes}
            self.pids["part"] = self.pids["pool"]
            lacks += [f"{key} is not there" for key, pid in self.pids.items() if not _runs(pid)]
        return "; ".join(lacks)

    def _until_data_flow(self) -> None:
        """Assert that every node publishes and hears what it is to, by the manifest in force."""
        deadline = time.monotonic() + FLOWS_S
        seen: dict[str, tuple[int, int]] = {}
        wanted = [key for key in self.state.nodes if key in (*PUBLISHES, *SUBSCRIBES)]
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as asking:
            asking.bind(address(self.mark, "asking"))
            asking.settimeout(FLOWS_S)
            while wanted:
                key = wanted[0]
                asking.sendto(SEEN.encode(), address(self.mark, key))
                published, heard, tint, issue = map(int, asking.recv(256).split())
                declared = self.state.manifest
                if tint != (declared.tint if key in TINTED else 0):
                    raise NotAsPromisedError(f"{key} has tint {tint} by {declared}")
                if issue != (declared.issue if key in ISSUED else 0):
                    raise NotAsPromisedError(f"{key} has issue {issue} by {declared}")
                first = seen.setdefault(key, (published, heard))
                publishes = published > first[0] or key not in PUBLISHES
                if publishes and (heard > first[1] or key not in SUBSCRIBES):
                    wanted.remove(key)
                elif time.monotonic() > deadline:
                    raise NotAsPromisedError(
                        f"no data flow: {key} has published {published}, heard {heard}, "
                        f"{FLOWS_S:g} s after {first}"
                    )
                else:
                    wanted.append(wanted.pop(0))
                    time.sleep(0.02)

    def _judge(self, run: Watched) -> None:
        assert_gate_held(tuple(run.events))
        names = [f"/{each}" for each in REPORTING]
        until = time.monotonic()
        assert_activated_on_request(run, self.transitions, self._began, until, names)

    def _assert_only_who_must_came_again(
        self, expected: Expectation, before: dict[str, int]
    ) -> None:
        stayed = self.pids.keys() & before.keys()
        again = {key for key in stayed if self.pids[key] != before[key]}
        if missing := (expected.again & stayed) - again:
            raise NotAsPromisedError(f"did not come again in a new process: {sorted(missing)}")
        if more := again - expected.again - expected.may_again:
            raise NotAsPromisedError(f"came again, and nothing was done to them: {sorted(more)}")

    def _assert_nobody_else_was_blamed(
        self, run: Watched, expected: Expectation, since: int
    ) -> None:
        blamed = expected.failed | expected.silent | expected.may_fail
        names = {name for each in blamed for name in (each, *process(each).nodes)}
        names |= expected.may_again
        events = run.events[since:]
        for number, event in enumerate(events):
            kind = event.get("event")
            if kind == "silent":
                who = event["node"]
                if event["cause"] == "hung" and _came_back(who, events[number:]):
                    # A thread that holds a lock of its process, or of Fast DDS, got no processor.
                    self.stalled += who.strip("/") not in names
                    continue
            elif kind == "failure":
                who = event["subject"]
            else:
                continue
            if who.strip("/") not in names:
                raise NotAsPromisedError(f"nothing was done to {who}: {event}")


def _transitions(domain_id: int) -> Transitions:
    return Transitions(domain_id, (f"/{each}" for each in REPORTING))


def _finding(rule: str, subjects: set[str]) -> Callable[[dict], bool]:
    def is_it(event: dict) -> bool:
        return event.get("event") == "verdict" and any(
            each["rule"] == rule and subjects & {each["subject"], each["node"]}
            for each in event["verdict"]["findings"]
        )

    return is_it


def _came_back(node: str, events: Sequence[dict]) -> bool:
    return any(each.get("event") == "alive" and each["node"] == node for each in events)


def _node_of(fault: Fault) -> str:
    return process(fault.target).nodes[-1 if fault.kind in DIES else 0]


def _run_delay_s(pid: int) -> float:
    """Return how long the main thread of a process was ready and got no processor; 0: gone."""
    try:
        return int(Path(f"/proc/{pid}/schedstat").read_text().split()[1]) / 1e9
    except OSError:
        return 0.0


def _reporters(supervisor: int) -> tuple[int, ...]:
    """Return the pids of a supervisor and of its fork server, which sees its nodes die first."""
    family = psutil.Process(supervisor).children()
    servers = (each.pid for each in family if any("fork_server" in word for word in each.cmdline()))
    return (supervisor, *servers)


def _runs(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.Error:
        return False


_ORDERS = {
    Kind.EXIT_9: "exit9",
    Kind.EXIT_0: "exit0",
    Kind.RAISE: "raise",
    Kind.SLEEP: "sleep",
    Kind.SPIN: "spin",
    Kind.LOCK: "lock",
    Kind.ALTER: "alter",
    Kind.STRAY: "stray",
}
