"""`lifecycle export`: a manifest as files of another system. Needs no ROS and starts nothing."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import click

from lifecycle.cli.common import F, load_plan, manifest_arguments, say, write_text
from lifecycle.errors import ExitCode, UsageError
from lifecycle.manifest.model import EndpointPolicy
from lifecycle.printable import lines

if TYPE_CHECKING:
    from lifecycle.export.sros2 import Enclave


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
    for each supervisor; `ros2 security create_permission` makes signed permissions of it, by the
    commands that are printed.
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
    click.echo(lines(_next_commands(enclaves, output, plan.domain_id)))
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


def _engine_command(engine: str) -> click.Command:
    in_image = engine != "systemd"

    @manifest_arguments
    @_into("Write a file for each machine there; one of its name is replaced.")
    @click.option(
        "--at",
        default="",
        metavar="PATH",
        help="Where the manifest is when it is started; default: "
        + ("in the image, /system/NAME." if in_image else "where it is here."),
    )
    @click.option(
        "--up",
        "more",
        default="",
        metavar="OPTIONS",
        help="Further options of `lifecycle up`, in one word: '--strict --program nft'.",
    )
    def write(
        manifest: str,
        assignments: tuple[str, ...],
        output: Path,
        at: str,
        more: str,
        **rest: str,
    ) -> int:
        from lifecycle.export.engines import ENGINES, Deployment

        words, timeout_s = _up_options(more, container=in_image)
        image, program = rest.get("image", ""), rest.get("program", "")
        if in_image and (not image or re.search(r"\s", image) or image.startswith("-")):
            raise UsageError(f"cannot use image {image!r}; write it as in 'registry/robot:1'")
        for option, path in (("--program", program), ("--at", at)):
            if not in_image and path and not path.startswith("/"):
                raise UsageError(
                    f"cannot use {option} {path!r} in a unit: a service has no working directory "
                    "of ours; write an absolute path"
                )
        here = str(Path(manifest).resolve())
        inside = f"/system/{Path(manifest).name}" if in_image else here
        deployment = Deployment(
            plan=load_plan(manifest, assignments),
            manifest=at or inside,
            words=(*assignments, *words),
            image=image,
            program=program,
            folder=str(PurePosixPath(at).parent if at else Path.cwd()),
            timeout_s=timeout_s,
            programs_networks=any(each.startswith("--program") for each in words),
        )
        for name, text in ENGINES[engine](deployment).items():
            write_text(output / name, text)
            click.echo(str(output / name))
        for word in (*assignments, *words):
            _say_secret(word, engine)
        return ExitCode.OK

    if in_image:
        write = click.option(
            "--image",
            required=True,
            metavar="IMAGE",
            help="Has `lifecycle`, ROS 2 and the programs of all nodes; see examples/deploy.",
        )(write)
    else:
        write = click.option(
            "--program",
            default="/opt/lifecycle/bin/lifecycle",
            show_default=True,
            metavar="PATH",
            help="Where `lifecycle` is on the machines.",
        )(write)
    return click.command(engine, help=_WRITTEN_FOR[engine])(write)


for _engine in _WRITTEN_FOR:
    command.add_command(_engine_command(_engine))


_VARIABLES = {
    "systemd": "EnvironmentFile= or LoadCredential=",
    "kubernetes": "a Secret, by valueFrom: secretKeyRef",
}
"""By what each engine gives a process variables that are in none of the files written here."""


def _say_secret(word: str, engine: str) -> None:
    """Say that a word of the command line seems to be secret, and is written as it is."""
    from lifecycle.plan.processes import shown

    name, is_argument, value = word.partition(":=")
    if not is_argument:
        name, _, value = word.lstrip("-").partition("=")
    if not value or shown(name, value) == value:
        return
    variable = name.upper().replace("-", "_")
    say(
        f"warning: the value of {name!r} is in what was written as it was given, and will be "
        "in a command line, which every user of the machine can read; have the manifest take "
        f"it from the environment, 'default: $(env {variable} \"\")', leave it out here, and "
        f"give it by {_VARIABLES[engine]}"
    )


def _up_options(more: str, *, container: bool) -> tuple[tuple[str, ...], float]:
    """Return further words of `lifecycle up`, and the `--timeout` in them, seconds; 0 for none.

    Raises:
        UsageError: `up` would refuse them, or what they ask for cannot be had from an engine.
    """
    from lifecycle.cli.verbs.up import command as up

    try:
        words = tuple(shlex.split(more))
    except ValueError as error:
        raise UsageError(f"cannot read --up {more!r}: {error}") from error
    try:
        given = up.make_context("up", ["MANIFEST", *words]).params
    except click.exceptions.Exit as error:
        raise UsageError(f"cannot start a system with --up {more!r}") from error
    except click.ClickException as error:
        raise UsageError(
            f"cannot use --up {more!r}: {error.format_message()}", hint="lifecycle up --help"
        ) from error
    if given["assignments"]:
        raise UsageError(
            f"cannot take {given['assignments'][0]!r} from --up; "
            "write arguments of the manifest after the manifest"
        )
    if given["machine"]:
        raise UsageError("cannot use --machine in --up: each file names its machine")
    if given["until"] != "active":
        raise UsageError(
            f"cannot use --until {given['until']} in --up: only an active system is ever ready"
        )
    if container and given["targets"]:
        raise UsageError(
            "cannot program networks from a container without root: engines give capabilities to "
            "root alone there",
            hint="program them on the machine: lifecycle export systemd … --up '--program …'",
        )
    return words, given["timeout"] or 0.0


def _next_commands(enclaves: tuple[Enclave, ...], output: Path, domain_id: int) -> str:
    """Return what to do with the files, as lines for a shell."""
    from lifecycle.export.sros2 import OVERRIDE

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
