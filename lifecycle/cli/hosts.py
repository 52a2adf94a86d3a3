"""`--hosts` of `lifecycle up`, `status` and `down`: every machine of a manifest from one place.

Owns: options as transports and parts, the run of a coordinator in this process, and its output:
JSON lines, or plain lines with the host in front; live_view.py has the table. Owns also the status
of all hosts as one.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import sys
from collections.abc import Iterable, Iterator, Mapping
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, Protocol

import click

from lifecycle import dataclasses
from lifecycle.cli.common import load_manifest
from lifecycle.cli.report import ReportFile, written_or_said
from lifecycle.cli.up_output import PlainLines, Sink, stdout_writer, verdict_line
from lifecycle.codec import from_json, to_plain
from lifecycle.errors import ExitCode, UsageError
from lifecycle.fleet import (
    NOTABLE_S,
    Coordinator,
    HostStatus,
    LocalTransport,
    Place,
    Record,
    SshTransport,
    Transport,
    destinations,
    down,
    in_place,
    parts_of,
    ranks,
    ssh_command,
    statuses,
    worst,
)
from lifecycle.manifest import noting_files
from lifecycle.plan import build_plan
from lifecycle.printable import json_text, one_line
from lifecycle.supervisor import TIMEOUT_S, UpOptions, from_record, own_machines
from lifecycle.verify import Finding, FlowReport, Outcome, RunEnd, Verdict, render_text

if TYPE_CHECKING:
    from lifecycle.fleet import Part
    from lifecycle.plan import Plan
    from lifecycle.supervisor import Event, SystemStatus

_MORE_S = TIMEOUT_S
"""For supervisors to start, and to end by themselves at the deadline that they have, too."""


def up_on_hosts(
    manifest: str,
    assignments: tuple[str, ...],
    *,
    chosen: tuple[str, ...],
    remote_command: str,
    format_: str,
    options: Mapping[str, Any],
) -> int:
    """Start, follow and end the supervisors of all machines of a manifest.

    Args:
        manifest: its file.
        assignments: `name:=value` of it.
        chosen: `MACHINE=DESTINATION` of `--host`.
        remote_command: of `--remote-command`.
        format_: "text" or "json".
        options: of `lifecycle up`, by name.

    Raises:
        UsageError: an option cannot be used so, or a machine is not declared.
        ManifestError: the manifest has errors.
    """
    with ReportFile(options["report"], strict=options["strict"]) as written:
        return _up(manifest, assignments, chosen, remote_command, format_, options, written)


def _up(  # noqa: PLR0917 - as of up_on_hosts
    manifest: str,
    assignments: tuple[str, ...],
    chosen: tuple[str, ...],
    remote_command: str,
    format_: str,
    options: Mapping[str, Any],
    written: ReportFile,
) -> int:
    _refuse(options)
    domain_id = options["domain"]
    with noting_files() as files:
        loaded = load_manifest(manifest, assignments, quiet=True)
        plan = build_plan(loaded.manifest, domain_id=domain_id)
    if domain_id is None and loaded.manifest.discovery.domain_id is None:
        domain_id = plan.domain_id  # of our environment: the hosts' may have another
    parts, unsent = parts_of(
        plan,
        files,
        arguments=assignments,
        options=tuple(_passed_on({**options, "domain": domain_id})),
    )
    for path in unsent:
        click.echo(
            f"not sent, because it is not in the folder of the manifest: {one_line(path)}; each "
            "host needs it under the same path",
            err=True,
        )
    transports = _transports(plan, chosen, remote_command)
    order = ranks(plan)
    machines = tuple(each.machine for each in parts)
    written.begin(plan)
    with _output(format_, plan.system, machines) as output:
        last = LastVerdicts(machines, output)
        coordinator = Coordinator(
            plan.system,
            [
                _place(part, transports[part.machine], order.get(part.machine, 0), manifest)
                for part in parts
            ],
            last,
            version=version("ros-lifecycle-manifests"),
            bring_up_s=_bring_up_s(plan, parts, options["timeout"]) + _MORE_S,
            again=tuple(f"lifecycle {verb} {manifest} --hosts" for verb in ("up", "down")),  # type: ignore[arg-type]
            until=options["until"],
            stop_after_s=options["stop_after"],
            keep_going=options["keep_going"],
        )
        code = asyncio.run(_run(coordinator))
        unwritten = written_or_said(
            lambda: written.end(last.combined(), plan, machines=last.verdicts)
        )
        return code or unwritten


def _place(part: Part, transport: Transport, rank: int, manifest: str) -> Place:
    is_here = isinstance(transport, LocalTransport)
    return Place(in_place(part, manifest) if is_here else part, transport, rank)


async def _run(coordinator: Coordinator) -> ExitCode:
    loop = asyncio.get_running_loop()
    for number, reason, code in (
        (signal.SIGINT, "interrupted", ExitCode.INTERRUPTED),
        (signal.SIGTERM, "terminated", ExitCode.TERMINATED),
    ):
        loop.add_signal_handler(number, coordinator.stop, reason, code)
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # nohup(1)
        loop.add_signal_handler(signal.SIGHUP, coordinator.leave, "the terminal was closed")
    return await coordinator.run()


def down_on_hosts(
    target: str,
    assignments: tuple[str, ...],
    *,
    chosen: tuple[str, ...],
    remote_command: str,
    timeout_s: float,
) -> int:
    """End the runs of all machines of a manifest, whoever started them; say how it went.

    Raises:
        UsageError: a machine is not declared.
        ManifestError: the manifest has errors.
    """
    plan = build_plan(load_manifest(target, assignments, quiet=True).manifest)
    transports = _transports(plan, chosen, remote_command)
    parts, _ = parts_of(plan, {})
    outcomes = asyncio.run(down(parts, transports, timeout_s))
    for machine, (code, message) in outcomes.items():
        said = message or ("ended" if code is ExitCode.OK else f"exit code {int(code)}")
        click.echo(f"{one_line(machine)} | {one_line(said)}", err=True)
    return worst(code for code, _ in outcomes.values())


def status_of_hosts(
    target: str,
    assignments: tuple[str, ...],
    *,
    chosen: tuple[str, ...],
    remote_command: str,
    format_: str,
    probe: str | None,
) -> int:
    """Show how a system is on all machines of a manifest, or exit as a probe does.

    Raises:
        UsageError: a machine is not declared, or the system runs on none of them.
        ManifestError: the manifest has errors.
    """
    plan = build_plan(load_manifest(target, assignments, quiet=True).manifest)
    transports = _transports(plan, chosen, remote_command)
    parts, _ = parts_of(plan, {})
    asked = statuses(parts, transports, version=version("ros-lifecycle-manifests"))
    found = tuple(map(_readable, asyncio.run(asked)))
    if all(each.is_absent for each in found):
        raise UsageError(
            f"cannot find a running system {plan.system!r} on {', '.join(e.host for e in found)}",
            hint=f"start it: lifecycle up {target} --hosts",
        )
    verdict = _verdict_of(found)
    if probe is not None:
        phases = [_system(each) for each in found]
        answers = all(each is not None for each in phases)
        is_active = all(each is not None and each.phase == "active" for each in phases)
        is_ready = is_active and verdict is not Outcome.VIOLATED
        return ExitCode.OK if answers and (is_ready or probe == "live") else _NOT_READY
    if format_ == "json":
        hosts = [_host_record(each) for each in found]
        record = {"system": plan.system, "domain_id": plan.domain_id}
        record |= {"verdict": verdict and verdict.value, "hosts": hosts}
        click.echo(json_text(json.dumps(record, ensure_ascii=False, separators=(",", ":"))))
    else:
        click.echo("\n".join(_status_lines(plan.system, verdict, found)))
    if verdict is Outcome.VIOLATED:
        return ExitCode.VIOLATED
    is_known = all(each.status is not None for each in found)
    return ExitCode.OK if is_known else ExitCode.UNVERIFIABLE


_NOT_READY = ExitCode.BRING_UP_FAILED


def _readable(host: HostStatus) -> HostStatus:
    if host.status is None or _system(host) is not None:
        return host
    return dataclasses.replace(host, status=None, message="its status cannot be read")


def _system(host: HostStatus) -> SystemStatus | None:
    from lifecycle.supervisor import SystemStatus

    try:
        return None if host.status is None else from_json(json.dumps(host.status), SystemStatus)
    except ValueError:
        return None


def _verdict_of(hosts: Iterable[HostStatus]) -> Outcome | None:
    """Return the worst of all; who does not answer is unverifiable. None: not judged yet."""
    systems = [_system(each) for each in hosts]
    found = [Outcome.UNVERIFIABLE if each is None else each.verdict for each in systems]
    for each in (Outcome.VIOLATED, Outcome.UNVERIFIABLE, None):
        if each in found:
            return each
    return Outcome.OK


def _host_record(host: HostStatus) -> Record:
    plain = to_plain(host)
    assert isinstance(plain, dict)
    if host.clock is not None:
        plain["clock"]["differs"] = host.clock.differs(NOTABLE_S)
    return plain


def _status_lines(
    system: str, verdict: Outcome | None, hosts: tuple[HostStatus, ...]
) -> Iterator[str]:
    """Yield a line for all, and each host's own status with its name in front."""
    from lifecycle.cli.verbs.control import status_text

    judged = "not judged yet" if verdict is None else verdict.value
    silent = [f"{each.host} ({each.message})" for each in hosts if each.status is None]
    unverifiable = f"; unverifiable: {', '.join(silent)}" if silent else ""
    yield one_line(
        f"{system} on {', '.join(e.host for e in hosts)}: verdict {judged}{unverifiable}"
    )
    for host in hosts:
        prefix = f"{one_line(host.host)} | "
        seen = _system(host)
        if seen is not None:
            yield from (prefix + each for each in status_text(seen).splitlines())
        else:
            hint = f"; {host.hint}" if host.hint else ""
            yield prefix + one_line(
                f"cannot be verified at {host.destination}: {host.message}{hint}"
            )
        if host.clock is not None and host.clock.differs(NOTABLE_S):
            yield prefix + clock_text(host.clock.offset_s, host.clock.uncertainty_s)


_REFUSED = {
    "machine": "all machines are started; leave it out",
    "targets": "start that machine by itself: lifecycle up MANIFEST --machine NAME --program …",
    "mapping": "start that machine by itself: lifecycle up MANIFEST --machine NAME --program …",
    "flow_labels": "start that machine by itself: lifecycle up MANIFEST --machine NAME --program …",
}
_FLAGS = {"mapping": "--dscp-from-5qi", "targets": "--program"}


def _refuse(options: Mapping[str, Any]) -> None:
    for name, hint in _REFUSED.items():
        if options[name]:
            flag = _FLAGS.get(name, f"--{name.replace('_', '-')}")
            raise UsageError(f"cannot use {flag} with --hosts", hint=hint)


def _passed_on(options: Mapping[str, Any]) -> Iterator[str]:
    """Yield the options that each supervisor gets; when to end is the coordinator's to say."""
    for name in ("strict", "keep_going", "timings", "adopt"):
        if options[name]:
            yield f"--{name.replace('_', '-')}"
    for node in options["without"]:
        yield f"--except={node}"
    if options["until"] != "active":
        yield from (f"--until={options['until']}", "--hold")
    for name in ("timeout", "domain"):
        if options[name] is not None:
            yield f"--{name}={options[name]}"


def _bring_up_s(plan: Plan, parts: tuple[Part, ...], timeout_s: float | None) -> float:
    counts = [sum(each.machine == part.machine for each in plan.processes) for part in parts]
    return UpOptions(timeout_s=timeout_s).bring_up_s(max(counts))


def _transports(plan: Plan, chosen: tuple[str, ...], remote_command: str) -> dict[str, Transport]:
    """Return the way to each machine.

    Raises:
        UsageError: what was chosen is no `MACHINE=DESTINATION`, or LIFECYCLE_SSH cannot be read.
    """
    try:
        ssh = ssh_command(os.environ.get("LIFECYCLE_SSH", ""))
    except ValueError as error:
        raise UsageError(
            f"cannot read LIFECYCLE_SSH: {error}", hint="write a command line: ssh -F FILE"
        ) from error
    by_hand: dict[str, str] = {}
    for each in chosen:
        name, equals, destination = each.partition("=")
        if not name or not equals or not destination or destination.startswith("-"):
            raise UsageError(f"cannot read --host {each!r}; write MACHINE=[USER@]HOST")
        by_hand[name] = destination
    local = own_machines(plan, "")
    return {
        machine: SshTransport(
            machine=machine, destination=place, remote_command=remote_command, ssh=ssh
        )
        if place
        else LocalTransport()
        for machine, place in destinations(plan, by_hand, local.__contains__).items()
    }


class LastVerdicts:
    """Keeps the last verdict of each host on its way to the output, and makes one of all.

    Args:
        machines: of all.
        output: what all events are passed on to.

    Attributes:
        verdicts: by machine; None of one whose supervisor gave none. Of one that ended well it is
            what it found when all were asked to end: it may be the last to go, and the absence of
            those before it is no finding on the system.
    """

    def __init__(self, machines: Iterable[str], output: HostsOutput) -> None:
        self.verdicts: dict[str, Verdict | None] = dict.fromkeys(machines)
        self._output = output
        self._messages: dict[str, str] = {}
        self._judged: dict[str, Verdict | None] = {}
        self._at_end: dict[str, Verdict | None] = {}
        self._reached: str | None = None
        self._end: Record = {"reason": "", "exit_code": int(ExitCode.INTERNAL)}

    def __call__(self, host: str, record: Record) -> None:
        """Take one event, see fleet.coordinator.Listener."""
        kind = record.get("event")
        if kind is None:
            self.verdicts[host] = self._last(_verdict_in(record), self._at_end.get(host))
        elif kind == "verdict" and isinstance(record.get("verdict"), dict):
            self._judged[host] = _verdict_in(record["verdict"])
        elif kind == "ending" and not host:
            self._at_end = dict(self._judged)
        elif kind == "end" and not host:
            self._end = record
        elif kind in {"active", "reached"} and not host:
            self._reached = str(record.get("reached", "active"))
        elif kind == "host" and record["message"]:
            self._messages[host] = str(record["message"])
        self._output(host, record)

    @staticmethod
    def _last(last: Verdict | None, before: Verdict | None) -> Verdict | None:
        if last is None or before is None or last.run is None or last.run.exit_code:
            return last
        return dataclasses.replace(before, run=last.run)

    def combined(self) -> Verdict:
        """Return the verdict of all: what any found, and who found it where not all did."""
        found = {name: each for name, each in self.verdicts.items() if each is not None}
        lacking = [name for name in self.verdicts if name not in found]
        reason = str(self._end["reason"])
        if lacking:
            why = (f"{name} ({self._messages.get(name, 'it did not run')})" for name in lacking)
            reason += f"; no verdict of {', '.join(why)}"
        run = RunEnd(reason=reason, reached=self._reached, exit_code=self._end["exit_code"])
        outcomes = {each.verdict for each in found.values()}
        outcomes |= {Outcome.UNVERIFIABLE} if lacking else set[Outcome]()
        worst_first = (Outcome.VIOLATED, Outcome.UNVERIFIABLE, Outcome.OK)
        return Verdict(
            verdict=next(each for each in worst_first if each in outcomes),
            blocking=bool(lacking) or any(each.blocking for each in found.values()),
            findings=tuple(self._findings(found)),
            flows=_flows(found.values()),
            open_endpoints=tuple(
                dict.fromkeys(e for v in found.values() for e in v.open_endpoints)
            ),
            tolerated=tuple(dict.fromkeys(e for v in found.values() for e in v.tolerated)),
            judged=not lacking and all(each.judged for each in found.values()),
            run=run,
        )

    def _findings(self, found: Mapping[str, Verdict]) -> Iterator[Finding]:
        seen: dict[tuple[object, ...], tuple[Finding, list[str]]] = {}
        for name, verdict in found.items():
            for each in verdict.findings:
                key = (each.rule, each.outcome, each.subject, each.node, each.endpoint)
                seen.setdefault(key, (each, []))[1].append(name)
        for finding, by in seen.values():
            if len(by) == len(self.verdicts):
                yield finding
            else:
                message = f"{finding.message} (found by the supervisor of {', '.join(by)})"
                yield dataclasses.replace(finding, message=message)


def _flows(verdicts: Iterable[Verdict]) -> tuple[FlowReport, ...]:
    """Return each flow once, as the worst of its reports has it."""
    order = (Outcome.OK, Outcome.UNVERIFIABLE, Outcome.VIOLATED)
    found: dict[tuple[str, str, str], FlowReport] = {}
    for verdict in verdicts:
        for each in verdict.flows:
            known = found.setdefault((each.topic, each.publisher, each.subscription), each)
            if order.index(each.outcome) > order.index(known.outcome):
                found[each.topic, each.publisher, each.subscription] = each
    return tuple(found.values())


def _verdict_in(record: Record) -> Verdict | None:
    """Return the last verdict of a host's supervisor; None for what is none of ours."""
    try:
        found = from_json(json.dumps({"blocking": False, **record}), Verdict)
    except ValueError:
        return None
    blocking = found.blocking or found.verdict is Outcome.VIOLATED
    return dataclasses.replace(found, blocking=blocking)


class HostsOutput(Protocol):
    """Takes what a coordinator says, see fleet.coordinator.Listener."""

    def __call__(self, host: str, record: Record) -> None:
        """Show one event of a host, or of all."""


@contextlib.contextmanager
def _output(format_: str, system: str, hosts: tuple[str, ...]) -> Iterator[HostsOutput]:
    """Give the output for a format, and for text what suits the terminal."""
    with stdout_writer(_json_notice if format_ == "json" else None) as writer:
        if format_ == "json":
            yield JsonHosts(writer)
        elif sys.stdout.isatty():
            from lifecycle.cli.live_view import LiveHosts

            with LiveHosts(system, hosts, writer=writer) as live:
                yield live
        else:
            yield PlainHosts(writer)


def _json_notice(message: str) -> str:
    return json.dumps({"host": "", "event": "notice", "message": message}) + "\n"


class JsonHosts:
    """One JSON object per line; `host` is whose it is, empty for what is about all."""

    def __init__(self, sink: Sink) -> None:
        self._sink = sink

    def __call__(self, host: str, record: Record) -> None:
        """Write one event."""
        del host  # in the record
        text = json.dumps(record, ensure_ascii=False, separators=(",", ":"))
        self._sink.put(json_text(text) + "\n", kept=record.get("event") != "log")


class PlainHosts:
    """A line per event that has one for people, with its host in front."""

    def __init__(self, sink: Sink) -> None:
        self._sink = sink
        self._hosts: dict[str, PlainLines] = {}

    def __call__(self, host: str, record: Record) -> None:
        """Write one event, if it has a line for people."""
        if "event" not in record:
            self._finish(host, record)
            return
        line = describe(record)
        if line is not None:
            self._sink.put((f"{host} | " if host else "") + one_line(line) + "\n")
            return
        event = event_of(record)
        if event is None:
            return
        if host not in self._hosts:
            self._hosts[host] = PlainLines(_Prefixed(self._sink, f"{one_line(host)} | "))
        self._hosts[host](event)

    def _finish(self, host: str, record: Record) -> None:
        """Write the last verdict of a host, in full where it is not ok; its flows are many."""
        verdict = _verdict_in(record)
        if verdict is None:
            _Prefixed(self._sink, f"{one_line(host)} | ").put("its last verdict cannot be read")
            return
        is_ok = verdict.verdict is Outcome.OK
        text = verdict_line(verdict) if is_ok else render_text(verdict, flows=False)
        _Prefixed(self._sink, f"{one_line(host)} | ").put(text)


def event_of(record: Record) -> Event | None:
    """Return the event of a host's supervisor; None for what is none, or none that we know."""
    try:
        return from_record({name: each for name, each in record.items() if name != "host"})
    except ValueError:
        return None


class _Prefixed:
    """A sink for the lines of one host."""

    def __init__(self, sink: Sink, prefix: str) -> None:
        self._sink = sink
        self._prefix = prefix

    def put(self, text: str, *, kept: bool = True) -> None:
        for line in text.splitlines():
            self._sink.put(f"{self._prefix}{line}\n", kept=kept)

    def close(self) -> None:
        """Leave it open for other hosts."""


def describe(record: Record) -> str | None:
    """Return the line for people about an event of the coordinator.

    None for an event of a supervisor, and where there is nothing to say.
    """
    teller = _TELLERS.get(str(record.get("event")))
    return None if teller is None else teller(record)


def _hosts_found(record: Record) -> str:
    places = ", ".join(f"{name} ({place})" for name, place in record["destinations"].items())
    return f"{record['system']} on {places}"


def _host_changed(record: Record) -> str:
    state, message = record["state"], record["message"]
    text = message or ("supervisor started" if state == "started" else state)
    if state == "failed":
        text = f"failed: {message}"
    elif state == "ended":
        text = f"supervisor ended, exit code {record['exit_code']}"
        text += f": {message}" if message else ""
    text += f" (pid {record['pid']})" if record["pid"] else ""
    return text + (f"; {record['hint']}" if record["hint"] else "")


def _clock(record: Record) -> str | None:
    return clock_text(record["offset_s"], record["uncertainty_s"]) if record["differs"] else None


def clock_text(offset_s: float, uncertainty_s: float) -> str:
    """Say in one line that the clock of a host differs from ours."""
    where = "ahead of" if offset_s > 0 else "behind"
    return (
        f"its clock is {abs(offset_s):.3f} s {where} this host's (± {uncertainty_s:.3f} s): times "
        "in messages and logs differ by that; synchronise them, with chrony or PTP"
    )


def _active(record: Record) -> str:
    hosts = ", ".join(record["hosts"])
    return f"system active on all hosts ({hosts}) after {record['elapsed_s']:.2f} s"


def _reached(record: Record) -> str:
    hosts = ", ".join(record["hosts"])
    return f"system {record['reached']} on all hosts ({hosts}) after {record['elapsed_s']:.2f} s"


def _end(record: Record) -> str:
    codes = ", ".join(
        f"{host} {'–' if code is None else code}" for host, code in record["exit_codes"].items()
    )
    return f"ended: {record['reason']}; exit code {record['exit_code']} ({codes})"


_TELLERS = {
    "hosts": _hosts_found,
    "host": _host_changed,
    "clock": _clock,
    "stderr": lambda record: str(record["line"]),
    "active": _active,
    "reached": _reached,
    "ending": lambda record: f"ending all: {record['reason']}",
    "end": _end,
}
