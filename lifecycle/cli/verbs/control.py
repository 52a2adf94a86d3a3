"""`lifecycle status`, `down`, `pause`, `resume`, `restart` and `mode`: they ask a supervisor."""

from __future__ import annotations

import os
import shutil
import sys
from typing import TYPE_CHECKING, Any

import click

from lifecycle.cli import common
from lifecycle.errors import ExitCode, UsageError
from lifecycle.measure.flows import measured_summary
from lifecycle.printable import columns, count, one_line, sentence

if TYPE_CHECKING:
    from pathlib import Path

    from lifecycle.supervisor.control.protocol import NodeStatus, SystemStatus
    from lifecycle.verify.outcome import ConnectionReport

_HEADS = ("node", "process", "pid", "state", "matched", "unique flows", "")
_BESIDE, _LEAST = 58, 16
"""Columns that the cells beside a node's name take most often, and that the name keeps."""

_RED, _YELLOW, _PLAIN = "\x1b[31m", "\x1b[33m", "\x1b[0m"


def status_text(
    status: SystemStatus, *, width: int = 0, height: int = 0, colour: bool = False
) -> str:
    """Return a status as lines: system, what was measured, and one for each node and connection.

    Args:
        status: of a system.
        width: columns that a line should not pass; 0 wraps none.
        height: lines of a screen, on which no node is wrapped: where there is no room, nodes that
            are as they should be are left out; 0 shows all.
        colour: mark nodes that are not as they should be by ANSI colours.
    """
    measured = one_line(measured_summary(status.measured))
    above = [status_head(status), *([measured] if measured else [])]
    longest = max(_LEAST, width - _BESIDE) if height else 0
    heads, *rows = columns([_HEADS, *(_row(each, longest) for each in status.nodes)])
    shown = []
    for line, node in zip(rows, status.nodes, strict=True):
        style = _style(node) if colour else ""
        coloured = f"{style}{line}{_PLAIN}" if style else line
        shown.append([coloured, *map(_connection, node.connections)])
    if not height:
        return common.wrapped([*above, heads, *(line for each in shown for line in each)], width)
    above = [*common.wrapped(above, width).splitlines(), heads]
    return "\n".join([*above, *_that_fit(status, shown, height - len(above))])


def status_head(status: SystemStatus) -> str:
    """Return in one line what is going on."""
    verdict = "not judged yet" if status.verdict is None else status.verdict.value
    verdict += f" ({status.not_ok})" if status.not_ok else ""
    living = sum(not node.died and node.next_try_s is None for node in status.nodes)
    number = "" if living == len(status.nodes) else f" {living}/{len(status.nodes)}"
    mode = f", mode {status.mode}" if status.mode else ""
    applied = f", revision {status.revision}: {status.manifest}" if status.revision > 1 else ""
    phase = f"{status.phase} ({status.ends})" if status.ends else status.phase
    return one_line(
        f"{status.system}: {phase}{number}{mode}, verdict {verdict}, "
        f"domain {status.domain_id}, supervisor {status.supervisor}, "
        f"up for {status.elapsed_s:.1f} s{applied}"
    )


def _that_fit(status: SystemStatus, shown: list[list[str]], height: int) -> list[str]:
    """Return the lines of as many nodes as fit, those that are not active first, in their order."""
    if sum(map(len, shown)) <= height:
        return [line for each in shown for line in each]
    by_need = sorted(range(len(shown)), key=lambda each: _style(status.nodes[each]) == "")
    left, kept = height - 1, set[int]()
    for each in by_need:
        left -= len(shown[each])
        if left < 0:
            break
        kept.add(each)
    more = f"… {len(shown) - len(kept)} more nodes: lifecycle status {status.system}"
    return [*(line for each in sorted(kept) for line in shown[each]), one_line(more)]


def _style(node: NodeStatus) -> str:
    """Return the colour of a node; empty for one that is as it should be."""
    if node.died or node.findings:
        return _RED
    return _YELLOW if node.managed and node.state != "active" else ""


def _connection(connection: ConnectionReport) -> str:
    """Return one connection in one line: what it is, what it is to and what it carries."""
    made = "established" if connection.established else "waits for peers"
    state = f"failed: {connection.error}" if connection.error else made
    urls, carries = ", ".join(connection.urls), ", ".join(connection.mappings) or "nothing"
    return one_line(f"  connection {connection.name} {state}; {urls}; carries {carries}")


def _row(node: NodeStatus, longest: int) -> tuple[str, ...]:
    """Return the cells of a node, below _HEADS; printable."""
    name = node.node
    if longest and len(name) > longest:
        name = f"…{name[1 - longest :]}"
    process = "not ours" if node.process_state is None else node.process_state.value
    known = node.matched or node.unreported < node.endpoints or not node.endpoints
    cells = (
        name,
        process,
        str(node.pid or "–"),
        "dead" if node.died else (node.state if node.managed else node.reach.value) or "–",
        f"{node.matched if known else '–'}/{node.endpoints}",
        f"{node.unique_flows}/{node.flows}",
        node.died or (f"silent: {node.silent}" if node.silent else node.doing) or _history(node),
    )
    return tuple(map(one_line, cells))


def _history(node: NodeStatus) -> str:
    """Say since when a node's process runs, how often it was started again, and after what."""
    parts = []
    if node.next_try_s is not None:
        parts.append(f"starts again in {node.next_try_s:.1f} s")
    elif node.restarts and node.uptime_s is not None:
        parts.append(f"up for {node.uptime_s:.1f} s")
    if node.restarts:
        parts.append(f"restarted {count(node.restarts, 'time')}")
    if (last := node.last_failure) is not None:
        stderr = f" ({last.stderr})" if last.stderr else ""
        parts.append(f"last failure {last.at}: {sentence(last.message)}{stderr}")
    return "; ".join(parts)


@click.command("status")
@click.argument(
    "target",
    required=False,
    metavar="[TARGET]",
    shell_complete=common.completing("manifests systems"),
)
@common.assignments_argument
@common.machine_option("As it was given to `lifecycle up`.")
@common.format_option("text", "json")
@click.option("--watch", is_flag=True, help="Show it again at every change; Ctrl-C ends.")
@click.option(
    "--probe",
    type=click.Choice(["live", "ready"]),
    help="For health checks: print no status, exit with 0 while the supervisor answers (live), or "
    "while the system is active and not violated (ready), else with 6.",
)
def status_command(
    *,
    target: str | None,
    assignments: tuple[str, ...],
    machine: str,
    format_: str,
    watch: bool,
    probe: str | None,
) -> int:
    """Show a running system: its nodes, their processes and states, and the last verdict.

    TARGET is a manifest or the name of a system; without one, all that run are listed. Exits with
    4 if the last verdict is violated.
    """
    if watch and probe is not None:
        raise UsageError("cannot probe and watch at once; a probe prints nothing")
    if target is None:
        if watch:
            raise UsageError("cannot watch without a TARGET", hint="lifecycle status lists them")
        return _list_running(format_)
    path = common.target_run(target, assignments, machine)
    if watch:
        return _watch(path, format_)

    # takes long to import, and a wrong name needs none
    from lifecycle.supervisor.control.protocol import status
    from lifecycle.verify.outcome import Outcome

    with common.asking(path):
        seen = status(path)
    if probe is not None:
        ready = seen.phase in ("measuring", "active") and seen.verdict is not Outcome.VIOLATED
        return ExitCode.OK if ready or probe == "live" else ExitCode.BRING_UP_FAILED
    if format_ == "json":
        click.echo(common.json_of(seen))
    else:
        click.echo(status_text(seen, width=common.terminal_width()))
    return ExitCode.VIOLATED if seen.verdict is Outcome.VIOLATED else ExitCode.OK


def _watch(path: Path, format_: str) -> int:
    from lifecycle.cli.standard_streams import watched
    from lifecycle.supervisor.control.protocol import follow
    from lifecycle.verify.outcome import Outcome

    verdict, is_json = None, format_ == "json"
    with watched(whole=not is_json) as show, common.asking(path):
        for seen in follow(path):
            status, verdict = seen.status, seen.status.verdict
            if is_json:
                show(common.json_of(status))
            elif sys.stdout.isatty():
                width, height = shutil.get_terminal_size()
                show(status_text(status, width=width, height=height, colour=True))
            else:
                show(status_text(status))
    common.say(f"{path.name}: its supervisor has ended")
    return ExitCode.VIOLATED if verdict is Outcome.VIOLATED else ExitCode.OK


def _list_running(format_: str) -> int:
    from lifecycle.run_directory import left_behind, lost, run_roots, running

    roots = run_roots(os.environ)
    names = [each.name for each in running(*roots)]
    if format_ == "json":
        click.echo(common.json_of(names))
    else:
        click.echo("\n".join(names) or "no system runs")
        for each in left_behind(*roots):
            common.say(str(lost(each)))
    return ExitCode.OK


def _give_order(
    verb: str,
    target: str,
    assignments: tuple[str, ...],
    *,
    machine: str,
    timeout: float,
    node: str = "",
    mode: str = "",
) -> int:
    """Have a running supervisor carry out an order; say why where it does not.

    Returns:
        Its exit code: 2 if the order does not fit what the system is doing, 4 or 5 if the gate
        stays closed, 6 if a step failed or took longer than `timeout` seconds.

    Raises:
        UsageError: no such run.
        ManifestError: the manifest cannot be loaded.
    """
    plan = None
    if verb == "pause":  # which may be of a manifest that has changed
        path = common.target_run(target, assignments, machine)
    else:
        path, plan = common.target_plan(target, assignments, machine)
    from lifecycle.supervisor.control.protocol import ControlRequest, Question, order

    question = Question(ask=ControlRequest(verb), node=node, plan=plan, mode=mode)
    answer = order(path, question, timeout)
    if answer.error:
        common.say(answer.error)
    assert answer.exit_code is not None
    return answer.exit_code


_order_timeout = common.timeout_option(60.0, "How long to wait for it.")


@click.command("down")
@common.target_arguments
@common.timeout_option(60.0, "How long it may take.")
def down_command(
    *,
    target: str,
    assignments: tuple[str, ...],
    machine: str,
    timeout: float,
) -> int:
    """End a running system in reverse order, and wait until nothing of it is left.

    TARGET is a manifest, or the name of a running system as `lifecycle status` shows it. Where the
    supervisor itself was killed, what it left behind is ended too.
    """
    path = common.target_run(target, assignments, machine)
    from lifecycle.supervisor.control.protocol import down

    try:
        return down(path, timeout)
    except TimeoutError:
        common.say(f"cannot end {path.name!r} within {timeout:g} s; it still runs")
        return ExitCode.BRING_UP_FAILED


@click.command("pause")
@common.target_arguments
@_order_timeout
def pause_command(target: str, assignments: tuple[str, ...], **options: Any) -> int:
    """Deactivate every managed node of a running system, in reverse order: data stops.

    Processes, connections and flows stay as they are. TARGET is a manifest, or the name of a
    running system as `lifecycle status` shows it. Only an active system can be paused; a manifest
    that has changed since it was started is said, and does not keep it from being paused.
    """
    return _give_order("pause", target, assignments, **options)


@click.command("resume")
@common.target_arguments
@_order_timeout
def resume_command(target: str, assignments: tuple[str, ...], **options: Any) -> int:
    """Verify a paused system again, and activate it only if the gate opens.

    TARGET is a manifest, or the name of a running system as `lifecycle status` shows it. Exits
    with 4 if the gate stays closed: then the system stays paused, and can be asked again; with 2 if
    the manifest is not the one that runs.
    """
    return _give_order("resume", target, assignments, **options)


@click.command("restart")
@common.target_argument
@click.argument(
    "words",
    nargs=-1,
    metavar="[NODE] [NAME:=VALUE]...",
    shell_complete=common.completing("nodes arguments"),
)
@common.machine_option("As it was given to `lifecycle up`.")
@_order_timeout
def restart_command(target: str, words: tuple[str, ...], **options: Any) -> int:
    """Take a running system down and bring it up again, or only the process of NODE.

    What comes back is verified together with what stayed, and activated only if the gate opens: in
    a paused system it stays inactive. NODE is a key of the manifest or a node's full name; other
    nodes of its process restart with it, all others stay active.

    What is restarted is what was started. A manifest or parameter file that has changed since is
    refused (exit 2), naming what differs; `lifecycle apply MANIFEST` takes it.
    """
    nodes, assignments = _split(words)
    if len(nodes) > 1:
        raise UsageError(f"cannot restart {', '.join(nodes)} at once; name one node, or none")
    return _give_order("restart", target, assignments, node="".join(nodes), **options)


@click.command("mode")
@common.target_argument
@click.argument(
    "words",
    nargs=-1,
    metavar="NAME [NAME:=VALUE]...",
    shell_complete=common.completing("arguments"),
)
@common.machine_option("As it was given to `lifecycle up`.")
@_order_timeout
def mode_command(target: str, words: tuple[str, ...], **options: Any) -> int:
    """Enter a mode of a running system: another set of its nodes is active.

    Nodes that the mode keeps inactive are deactivated in reverse order; those that it has active
    and the mode before had not are verified and activated only if the gate opens. If it stays
    closed the system goes back to the mode before, and this exits with 4. NAME is one of `modes:`
    of the manifest; `lifecycle status` shows which it is in.
    """
    names, assignments = _split(words)
    if len(names) != 1:
        raise UsageError("cannot enter a mode without its name; name one of the manifest's")
    return _give_order("mode", target, assignments, mode=names[0], **options)


def _split(words: tuple[str, ...]) -> tuple[list[str], tuple[str, ...]]:
    """Return the words that are none, and those that are `NAME:=VALUE`."""
    names = [word for word in words if ":=" not in word]
    return names, tuple(word for word in words if ":=" in word)
