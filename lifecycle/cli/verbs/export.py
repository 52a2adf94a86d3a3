"""`lifecycle export`: a manifest as files of another system. Needs no ROS and starts nothing."""

from __future__ import annotations

import datetime as dt
import re
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

import click

from lifecycle.cli.common import load_manifest, manifest_arguments
from lifecycle.errors import ExitCode, UsageError
from lifecycle.manifest import EndpointPolicy
from lifecycle.printable import lines

if TYPE_CHECKING:
    from lifecycle.export import Enclave


@click.group("export")
def command() -> None:
    """Write what a manifest declares as files of another system.

    Verified flows are exported by `lifecycle flows --export`.
    """


@command.command("sros2")
@manifest_arguments
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    required=True,
    metavar="DIR",
    help="Write policy.xml and enclaves/… there; files of these names are replaced.",
)
@click.option(
    "--days",
    type=click.IntRange(1, 36500),
    default=365,
    show_default=True,
    metavar="N",
    help="How long the permissions hold, from today, 00:00 UTC.",
)
def sros2(manifest: str, assignments: tuple[str, ...], output: Path, days: int) -> int:
    """Write access control for ROS 2 security: only what the manifest declares is allowed.

    One enclave for each process, and one for each supervisor. policy.xml is what `ros2 security`
    takes; permissions.xml and governance.xml are for whoever signs without it. Nothing is signed:
    the commands that are printed do that.
    """
    from lifecycle.export import documents
    from lifecycle.plan import build_plan

    plan = build_plan(load_manifest(manifest, assignments).manifest)
    today = dt.datetime.now(dt.timezone.utc).replace(hour=0, minute=0, second=0, microsecond=0)
    enclaves, files = documents(plan, not_before=today, not_after=today + dt.timedelta(days=days))
    _check_paths(enclaves)
    for name, text in files.items():
        _write(output / name, text)
    for node in plan.nodes:
        if node.endpoint_policy is EndpointPolicy.OPEN:
            click.echo(
                f"{node.full_name} may make endpoints that are not declared (endpoints: open): "
                "these are denied; declare those that it needs",
                err=True,
            )
    click.echo(lines(_next_commands(enclaves, output, plan.domain_id)))
    return ExitCode.OK


def _check_paths(enclaves: tuple[Enclave, ...]) -> None:
    """Raise UsageError for an enclave's path that the manifest spells and rcl would refuse."""
    for each in enclaves:
        if not re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", each.path):
            raise UsageError(
                f"cannot use enclave {each.path!r} of process {each.processes[0]!r}; "
                "write an absolute name of letters, digits and '_', as in '/robot/camera'"
            )


def _write(path: Path, text: str) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise UsageError(f"cannot write {str(path)!r}: {why}") from error


def _next_commands(enclaves: tuple[Enclave, ...], output: Path, domain_id: int) -> str:
    """Return what to do with the files, as lines for a shell."""
    from lifecycle.export import OVERRIDE

    policy = shlex.quote(str(output / "policy.xml"))
    said = [
        f"# {len(enclaves)} enclaves in {policy}, unsigned; next, beside the keystore's keys:",
        f"export ROS_DOMAIN_ID={domain_id} RMW_IMPLEMENTATION=rmw_fastrtps_cpp",
        "ros2 security create_keystore keystore",
    ]
    for each in enclaves:
        said += [
            f"ros2 security create_enclave keystore {each.path}",
            f"ros2 security create_permission keystore {each.path} {policy}",
        ]
    said.append("# for each process its enclave, in the manifest as run: {environment: {…}}:")
    for each in enclaves:
        if each.processes and not each.chosen:
            said.append(f"#   {', '.join(each.processes)}: {OVERRIDE}: {each.path}")
    said += [
        "# then on each machine, the supervisor in its own:",
        "export ROS_SECURITY_KEYSTORE=$PWD/keystore",
        "export ROS_SECURITY_ENABLE=true ROS_SECURITY_STRATEGY=Enforce",
    ]
    said += [f"{OVERRIDE}={each.path} lifecycle up …" for each in enclaves if not each.processes]
    return "\n".join(said)
