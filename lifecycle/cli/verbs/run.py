"""`lifecycle run MANIFEST NODE`: one node of a manifest in this terminal, without a supervisor.

A node that is not a Python class replaces this process.
"""

from __future__ import annotations

import os
from pathlib import Path

import click

from lifecycle.cli.common import completing, load_plan, say
from lifecycle.errors import ExitCode, UsageError
from lifecycle.manifest.model import DiscoveryRange, RunKind
from lifecycle.middleware.fastdds.discovery import peers_environment
from lifecycle.middleware.process.control import limit_resources, refuse_new_privileges
from lifecycle.plan.build import find_node
from lifecycle.plan.discovery import reached_hosts

_ROS_ARGUMENTS = "--ros-args"


@click.command("run", context_settings={"ignore_unknown_options": True})
@click.argument("manifest", metavar="MANIFEST", shell_complete=completing("manifests"))
@click.argument("node", metavar="NODE", shell_complete=completing("nodes"))
@click.argument(
    "words",
    nargs=-1,
    type=click.UNPROCESSED,
    shell_complete=completing("arguments"),
    metavar=f"[NAME:=VALUE]... [{_ROS_ARGUMENTS} ...]",
)
@click.option(
    "--auto/--manual",
    "auto",
    default=True,
    show_default=True,
    help="bring the node up, or leave its transitions to `ros2 lifecycle` and others",
)
def command(manifest: str, node: str, words: tuple[str, ...], *, auto: bool) -> int:
    """Run NODE of MANIFEST in this terminal until Ctrl-C; nothing is verified.

    NODE is a key under `nodes:` or a fully qualified name. What follows --ros-args goes to ROS.
    """
    if ":=" in node:
        hint = "it comes before the arguments: lifecycle run MANIFEST NODE NAME:=VALUE"
        raise UsageError(f"cannot find the node in {node!r}", hint=hint)
    split = words.index(_ROS_ARGUMENTS) if _ROS_ARGUMENTS in words else len(words)
    plan = load_plan(manifest, words[:split])
    planned = find_node(plan, node)
    environment = {"ROS_DOMAIN_ID": str(plan.domain_id)}
    if plan.discovery_range is not DiscoveryRange.SYSTEM_DEFAULT:
        environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] = plan.discovery_range.value.upper()
    environment.update(peers_environment(reached_hosts(plan, {planned.machine}), os.environ))
    os.environ.update({**environment, **dict(planned.run.environment)})
    if planned.run.kind is RunKind.ATTACH:
        raise UsageError(
            f"cannot run {planned.full_name}: it is attached, and started outside of the manifest"
        )
    resources = planned.run.resources.properties() if planned.run.resources is not None else ()
    if resources:
        scope = "".join(f" -p {each}" for each in resources)
        say(
            f"warning: the resources of {planned.full_name} are not limited here, as by lifecycle "
            f"up: systemd-run --user --scope{scope} lifecycle run ..."
        )
    if planned.run.limits:
        limit_resources(planned.run.limits.resources())
    if planned.run.no_new_privileges:
        refuse_new_privileges()
    beside = str(Path(planned.at.file).absolute().parent)
    if planned.run.working_directory:
        os.chdir(planned.run.working_directory)
    if planned.run.kind is RunKind.COMMAND:
        process = next(each for each in plan.processes if each.name == planned.process)
        os.environ.update(dict(process.environment))
        argv = [*process.argv, *words[split:]]
        try:
            os.execvp(argv[0], argv)  # noqa: S606 - the manifest's own command
        except OSError as error:
            raise UsageError(f"cannot run {argv[0]!r}: {error.strerror}") from error
    # Late: everything before this works without ROS, and says what is wrong without it.
    from lifecycle.node.host.standalone import run
    from lifecycle.node.planned import load_nodes
    from lifecycle.supervisor.processes.logs import check_log_root

    check_log_root(os.environ)
    run(
        load_nodes(planned.run.python, (beside,)),
        lifecycle="auto" if auto else "manual",
        spec=planned,
        domain_id=plan.domain_id,
        arguments=list(words[split:]),
        interrupted=ExitCode.INTERRUPTED,
    )
