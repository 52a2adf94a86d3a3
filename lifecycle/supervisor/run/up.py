"""`up`: everything around a session that must be there before it and be gone after it.

Owns: the run directory and what a killed supervisor left in it, the environment of the run, the
fork server, the supervisor's own participant and the sweep of shared memory. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import re
import traceback
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING

from msgspec.structs import replace

from lifecycle.errors import ExitCode, MiddlewareError
from lifecycle.manifest.model import Authority, DataLayerSource, EndpointPolicy, RunKind
from lifecycle.middleware.fastdds.discovery import (
    discovery_peers,
    missing_port,
    peers_environment,
)
from lifecycle.middleware.fastdds.profiles import (
    PEERS_VARIABLE,
    RANGE_VARIABLE,
    discovery_environment,
)
from lifecycle.middleware.process.control import (
    adopt_orphans,
    check_descriptors,
    check_memory,
    check_threads,
    exit_after,
)
from lifecycle.middleware.process.shared_memory import sweep
from lifecycle.middleware.rcl.conversions import load_type_support
from lifecycle.middleware.versions import DISTRIBUTIONS
from lifecycle.plan.discovery import reached_hosts
from lifecycle.plan.model import Plan, PlannedProcess
from lifecycle.run_directory import (
    FORK_SERVER,
    RunDirectory,
    RunRecord,
    boot_id,
    run_name,
    runtime_root,
)
from lifecycle.supervisor.connections import discovery_server
from lifecycle.supervisor.connections.networks import open_networks
from lifecycle.supervisor.control.protocol import SystemStatus
from lifecycle.supervisor.control.status import ended_early
from lifecycle.supervisor.nodes.system import System
from lifecycle.supervisor.processes.fork_server import ForkServer, end_run
from lifecycle.supervisor.processes.fork_server_main import ForkServerProcess
from lifecycle.supervisor.processes.logs import (
    begin_logs,
    check_log_root,
    log_directory,
)
from lifecycle.supervisor.run.events import (
    Emitter,
    Event,
    Listener,
    Notice,
    RunStarted,
    StepFailedError,
)
from lifecycle.supervisor.run.journal import Journal, ServiceManager
from lifecycle.supervisor.run.options import (
    UpOptions,
    UpResult,
    local_processes,
    observer_connections,
    own_machines,
)
from lifecycle.supervisor.run.signals import Ending
from lifecycle.supervisor.shell.supervisor import Means, Supervisor

if TYPE_CHECKING:
    from lifecycle.supervisor.nodes.observer_participant import ObserverParticipant

LEAVE_S = 10.0
"""A participant leaves within 0.2 s, over connections that are not answered within 4 s.

Where it is made, Fast DDS may wait for ever for threads that it cannot have."""


THREADS = 24
"""A supervisor has up to 16, most of them its participant's."""

Conclude = Callable[[UpResult], ExitCode]


def up(
    plan: Plan,
    options: UpOptions,
    listener: Listener,
    *,
    process: ForkServerProcess,
    ending: Ending,
    on_start: Callable[[Callable[[], SystemStatus]], None],
    conclude: Conclude,
) -> UpResult:
    """Bring a system up, hold it, take it down. Blocks; call it from the main thread.

    It changes this process for good: orphans of its children become its own children, and the
    variables that place the system in the graph are set in its environment.

    Args:
        plan: what to bring up.
        options: how.
        listener: gets every event, in this thread. If it raises it gets nothing more; the run
            goes on to its end, and then what it raised is raised.
        process: of a fork server that was started before; used, and ended by the caller, too.
        ending: entered by the caller, who has it note signals during this call.
        on_start: given the way to ask for the status, once there is a system.
        conclude: given how the run ended, once nothing of the system runs any more; returns the
            exit code. What it does not write may be lost: leaving the graph comes after it, and
            where Fast DDS hangs in that, this process ends with that exit code after `LEAVE_S`.

    Raises:
        UsageError: another supervisor has this system in this domain, the plan has nothing for
            this host, the run directory or the options of a network to program cannot be used.
        MiddlewareError: no participant can be made in the plan's domain.
        Ended: a signal asked for it before there was a session; nothing is left.
    """
    raised: list[Exception] = []
    processes = local_processes(plan, options.machine)
    service = ServiceManager(os.environ)
    emit = Emitter()
    emit.listen(_guarded(listener, raised))
    emit.listen(service.on_event)
    nodes = (plan.node(key) for each in processes if _hosted(each) for key in each.nodes)
    process.preload(dict.fromkeys(each.type for node in nodes for each in node.endpoints))
    logs = log_directory(os.environ, plan.system)
    directory = RunDirectory.acquire(
        runtime_root(os.environ),
        run_name(plan, options.machine),
        process.run_id,
        processes={process.popen.pid: FORK_SERVER},
    )
    journal = Journal(
        logs, plan.system, directory.run_id, say=lambda text: emit(Notice(message=text))
    )
    emit.listen(journal.on_event)
    try:
        if directory.previous is not None:
            _clean_up_after(directory.previous, emit)
        # Servers may be asked to remove what dead runs left: that must not outlast a signal.
        with ending.raised() if options.program else contextlib.nullcontext():
            networks = open_networks(plan, options, directory, emit, environment=os.environ)
        _enter_graph(plan, options, directory)

        async def run(leaving: contextlib.AsyncExitStack) -> UpResult:
            leaving.callback(service.watch())
            begin_logs(os.environ, logs, plan.system)
            system = System(
                plan,
                emit=emit,
                logs=logs,
                processes=processes,
                options=options,
                # What a fork server that was started before `_enter_graph` has to pass on.
                variables=tuple((n, os.environ[n]) for n in _GRAPH_VARIABLES if n in os.environ),
            )
            fork_server = ForkServer(process)
            try:
                # Before any participant: who asks a server that is not there waits to ask again.
                with ending.raised():
                    await discovery_server.begin(system, fork_server)
                observer_participant = await _observer_participant(plan, options, emit)
                leaving.callback(_succeed(directory, observer_participant).destroy)
                await _adopt(system, observer_participant)
                emit(
                    RunStarted(
                        system=plan.system,
                        domain_id=plan.domain_id,
                        rmw=observer_participant.rmw,
                        discovery_range=plan.discovery_range.value,
                        nodes=tuple(each.name for each in system.nodes.values()),
                        processes=tuple(system.run.processes),
                        log_directory=str(logs),
                    )
                )
                supervisor = Supervisor(
                    system,
                    Means(
                        directory=directory,
                        fork_server=fork_server,
                        participant=observer_participant,
                        networks=networks,
                        ending=ending,
                    ),
                )
                leaving.push_async_callback(supervisor.leave)
                on_start(supervisor.status)
                return await supervisor.run()
            except StepFailedError as error:
                emit(failed := error.failure)
                reason = f"failed: {failed.subject} ({failed.rule})"
                return ended_early(reason, error.exit_code, failed)
            finally:
                await discovery_server.end(system, asyncio.Event())
                fork_server.close()

        result = asyncio.run(_leaving_last(run, conclude))
    finally:
        process.close()
        # Once our own participant is gone, too.
        sweep(within_s=_LET_GO_S)
        journal.close()
        directory.release()
    if raised:
        raise raised[0]
    return result


def _hosted(process: PlannedProcess) -> bool:
    return process.run.kind is RunKind.PYTHON


def _guarded(listener: Listener, raised: list[Exception]) -> Listener:
    """Return a listener whose exception ends no more than itself, see `up`."""

    def guarded(event: Event) -> None:
        if not raised:
            try:
                listener(event)
            except Exception as error:  # noqa: BLE001 - it is not ours, and raised in the end
                traceback.print_exc()
                raised.append(error)

    return guarded


async def _leaving_last(
    run: Callable[[contextlib.AsyncExitStack], Awaitable[UpResult]], conclude: Conclude
) -> UpResult:
    """Run, and leave the graph once nothing of the system runs any more, bounded.

    Fast DDS can hang there with the GIL held: then the process ends with the code all the same, and
    the next `up` cleans up what it could not.
    """
    exit_code = ExitCode.INTERNAL
    leaving = contextlib.AsyncExitStack()
    try:
        result = await run(leaving)
        exit_code = conclude(result)
        return replace(result, exit_code=exit_code)
    finally:
        with contextlib.ExitStack() as bounded:
            bounded.callback(exit_after(LEAVE_S, exit_code))
            await leaving.aclose()


_LET_GO_S = 0.5
"""Others let go of the port of a participant that left when they next send over shared memory: most
within milliseconds, one that sends nothing perhaps never. Then the port stays for who uses it next.
"""


_SERVER_VARIABLE = "ROS_DISCOVERY_SERVER"


async def _observer_participant(
    plan: Plan, options: UpOptions, emit: Emitter
) -> ObserverParticipant:
    """Make the supervisor's participant."""
    # rclpy would import with it what generates Python from IDL: 20 ms, and not without warnings.
    load_type_support("rcl_interfaces/msg/ParameterEvent")
    from lifecycle.supervisor.nodes.observer_participant import ObserverParticipant

    layer = plan.data_layer
    dynamic = layer.source is DataLayerSource.DYNAMIC
    wires = layer.authority is Authority.SUPERVISOR
    with contextlib.ExitStack() as bounded:
        late_s = options.bring_up_s(0) + LEAVE_S
        bounded.callback(exit_after(late_s, ExitCode.BRING_UP_FAILED))
        observer_participant = ObserverParticipant.open(
            plan.domain_id,
            observer_connections(plan, options.machine),
            unplanned=wires and dynamic and plan.policy.undeclared_nodes is EndpointPolicy.OPEN,
            events=wires and (dynamic or layer.events),
            settle_s=plan.discovery.settle_s,
        )
    discovery = observer_participant.discovery
    # Nodes elsewhere would be found: they answer to ports of ours.
    port = missing_port(discovery.domain_id, discovery.urls, os.environ) if plan.processes else None
    if port is not None:
        observer_participant.destroy()
        raise MiddlewareError(
            f"cannot discover nodes of this host in domain {plan.domain_id}: UDP port {port}, by "
            "which all participants find each other, is taken by something else",
            hint=f"`ss -lunp 'sport = :{port}'` says by what; end it, or choose another domain: "
            "`lifecycle ports` says which are safe",
        )
    if unasked_s := discovery.settling.unasked_s:
        emit(
            Notice(
                message=f"who is there is seen within {unasked_s:g} s, before which the gate stays "
                "closed: by this discovery nobody can be asked (discovery.settle_s)"
            )
        )
    if limits := observer_participant.unknown_versions:
        emit(Notice(message=limits))
    if server := os.environ.get(_SERVER_VARIABLE):
        message = f"nodes are found by the discovery server of {_SERVER_VARIABLE}={server}"
        emit(Notice(message=f"{message}; none is while it does not run"))
    return observer_participant


async def _adopt(system: System, observer_participant: ObserverParticipant) -> None:
    if not system.run.options.adopt:
        return
    running, unsettled = await observer_participant.running()
    if unsettled:
        text = f"what runs may not be all that is adopted: {unsettled}"
        system.emit(Notice(message=text))
    system.adopt(running)


_GRAPH_VARIABLES = (
    "ROS_DOMAIN_ID",
    RANGE_VARIABLE,
    PEERS_VARIABLE,
    *(each.profiles_variable for each in DISTRIBUTIONS),
)


def _enter_graph(plan: Plan, options: UpOptions, directory: RunDirectory) -> None:
    """Place this process where the plan's nodes will be, and have participants found quickly.

    Raises:
        UsageError: there can be no ROS log directory.
        MiddlewareError: a package is missing, or a version of one is not known that the plan needs,
            or it cannot have the threads of a participant. Fast DDS would end the process then, or
            wait for ever.
    """
    check_log_root(os.environ)
    # What was loaded stays. To look through all of it whenever garbage is collected takes 40 ms,
    # and once more at the very end, when who asked for the end waits for nothing else.
    gc.freeze()
    adopt_orphans()
    own = own_machines(plan, options.machine)
    check_descriptors(
        sum(each.machine in own and each.run.kind is not RunKind.ATTACH for each in plan.processes)
    )
    check_memory()
    check_threads(THREADS)
    from lifecycle.middleware.fastdds.factory import refuse_unsupported

    hosted = (each for each in plan.processes if _hosted(each) and each.machine in own)
    refuse_unsupported(plan.node(key) for each in hosted for key in each.nodes)
    os.environ["ROS_DOMAIN_ID"] = str(plan.domain_id)
    os.environ[RANGE_VARIABLE] = plan.discovery_range.name
    hosts = reached_hosts(plan, own)
    os.environ.update(peers_environment(hosts, os.environ))
    peers = discovery_peers(plan.domain_id, hosts, os.environ)
    # Routers pass no multicast: all must be here, and no other host be looked for by its address.
    multicast = {each.machine for each in plan.nodes} <= set(own) and not os.environ.get(
        PEERS_VARIABLE
    )
    os.environ.update(
        discovery_environment(directory.path, peers=peers, multicast_endpoints=multicast)
    )


_PREFIX = re.compile(r"[0-9a-f]{24}")


def _succeed(
    directory: RunDirectory, observer_participant: ObserverParticipant
) -> ObserverParticipant:
    """Note our participant; that of a supervisor that was killed counts no more. Return ours."""
    directory.participant = observer_participant.discovery.prefix
    killed = directory.previous
    if killed is not None and killed.boot_id == boot_id() and _PREFIX.fullmatch(killed.participant):
        observer_participant.discovery.ended_participant(killed.participant)
    return observer_participant


def _clean_up_after(record: RunRecord, emit: Emitter) -> None:
    """Sweep what a supervisor left that had no chance to do it itself."""
    ended = end_run(record)
    swept = sweep()
    if ended or swept:
        emit(
            Notice(
                message=f"cleaned up after supervisor {record.supervisor.pid}, which was killed: "
                f"{len(ended)} processes, {len(swept)} files in /dev/shm"
            )
        )
