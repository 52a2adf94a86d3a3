"""`lifecycle export`: a manifest as files of another system. Needs no ROS and starts nothing."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any

import click

from lifecycle.cli.common import F, load_plan, manifest_arguments, say, write_text
from lifecycle.errors import ExitCode, UsageError
from lifecycle.manifest.model import EndpointPolicy


def _into(help_: str) -> Callable[[F], F]:
    """Add `--output DIR`."""
    folder = click.Path(path_type=Path)
    return click.option("-o", "--output", type=folder, required=True, metavar="DIR", help=help_)


@click.group("export")
def command() -> None:
    """Write what a manifest declares as files of another system.

    Verified flows are exported by `lifecycle flows --export`.
    """


@command.command("sros2")
@manifest_arguments
@_into("Write policy.xml there; one that is there is replaced.")
def sros2(manifest: str, assignments: tuple[str, ...], output: Path) -> int:
    """Write access control for ROS 2 security.

    Only what the manifest declares is allowed. policy.xml has one enclave for each process, and one
    for each supervisor, whose paths are printed; `ros2 security create_permission` makes signed
    permissions of it.
    """
    from lifecycle.export.sros2 import enclaves_of, render_policy

    plan = load_plan(manifest, assignments)
    enclaves = enclaves_of(plan)
    for each in enclaves:  # as the manifest spells it, and rcl would refuse it
        if not re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", each.path):
            raise UsageError(
                f"cannot use enclave {each.path!r} of process {each.processes[0]!r}; "
                "write an absolute name of letters, digits and '_', as in '/robot/camera'"
            )
    write_text(output / "policy.xml", render_policy(enclaves))
    for node in plan.nodes:
        if node.endpoint_policy is EndpointPolicy.OPEN:
            say(
                f"{node.full_name} may make endpoints that are not declared (endpoints: open): "
                "these are denied; declare those that it needs"
            )
    for each in enclaves:
        click.echo(f"{each.path}: {', '.join(each.processes) or 'a supervisor'}")
    return ExitCode.OK


_WRITTEN_FOR = {
    "systemd": (
        "Write a systemd unit for each machine.\n\n"
        "Type=notify, ready once active and verified; the watchdog is the supervisor's event loop. "
        "Check the file with `systemd-analyze verify`, copy it to /etc/systemd/system."
    ),
    "kubernetes": (
        "Write a Kubernetes object for each machine.\n\n"
        "It is for the node of the machine's name, ready once active and verified, live while the "
        "supervisor answers. `kubectl apply -f FILE` takes it."
    ),
}


def _engine_option(function: F) -> F:
    """Add what both engines' commands take."""
    for add in (
        click.option(
            "--up",
            "more",
            default="",
            metavar="OPTIONS",
            help="Further options of `lifecycle up`, in one word: '--strict --program nft'.",
        ),
        click.option(
            "--at",
            default="",
            metavar="PATH",
            help="Where the manifest is when it is started; default: where it is here, and "
            "/system/NAME in an image.",
        ),
        _into("Write a file for each machine there; one of its name is replaced."),
        manifest_arguments,
    ):
        function = add(function)
    return function


@command.command("systemd", help=_WRITTEN_FOR["systemd"])
@_engine_option
@click.option(
    "--program",
    default="/opt/lifecycle/bin/lifecycle",
    show_default=True,
    metavar="PATH",
    help="Where `lifecycle` is on the machines.",
)
def systemd(
    *, manifest: str, assignments: tuple[str, ...], output: Path, at: str, more: str, program: str
) -> int:
    """Write a unit for each machine."""
    for option, path in (("--program", program), ("--at", at)):
        if path and not path.startswith("/"):
            raise UsageError(
                f"cannot use {option} {path!r} in a unit: a service has no working directory "
                "of ours; write an absolute path"
            )
    return _write(
        "systemd",
        output,
        manifest=at or str(Path(manifest).resolve()),
        folder=str(PurePosixPath(at).parent if at else Path.cwd()),
        program=program,
        **_started(manifest, assignments, more),
    )


@command.command("kubernetes", help=_WRITTEN_FOR["kubernetes"])
@_engine_option
@click.option(
    "--image",
    required=True,
    metavar="IMAGE",
    help="Has `lifecycle`, ROS 2 and the programs of all nodes; see examples/deploy.",
)
def kubernetes(
    *, manifest: str, assignments: tuple[str, ...], output: Path, at: str, more: str, image: str
) -> int:
    """Write an object for each machine."""
    if not image or re.search(r"\s", image) or image.startswith("-"):
        raise UsageError(f"cannot use image {image!r}; write it as in 'registry/robot:1'")
    started = _started(manifest, assignments, more)
    if started["programs_networks"]:
        raise UsageError(
            "cannot program networks from a container without root: engines give capabilities to "
            "root alone there",
            hint="program them on the machine: lifecycle export systemd … --up '--program …'",
        )
    inside = at or f"/system/{Path(manifest).name}"
    return _write("kubernetes", output, manifest=inside, image=image, **started)


def _started(manifest: str, assignments: tuple[str, ...], more: str) -> dict[str, Any]:
    """Return what a deployment says of the system: its plan, and words of `lifecycle up`.

    Raises:
        ClickException: `up` would refuse them.
    """
    from lifecycle.cli.verbs.up import command as up

    words = tuple(shlex.split(more))
    given = up.make_context("up", ["MANIFEST", *words]).params
    return {
        "plan": load_plan(manifest, assignments),
        "words": (*assignments, *words),
        "timeout_s": given["timeout"] or 0.0,
        "programs_networks": bool(given["targets"]),
    }


def _write(engine: str, output: Path, **deployment: Any) -> int:
    from lifecycle.export.engines import ENGINES, Deployment

    for name, text in ENGINES[engine](Deployment(**deployment)).items():
        write_text(output / name, text)
        click.echo(str(output / name))
    return ExitCode.OK
