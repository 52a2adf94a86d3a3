"""The command line: the table of verbs, their options' errors, and the one error boundary.

A verb's module is imported only when it is used, so that verbs that need no ROS start fast; its
function returns an exit code (None means 0).
"""

from __future__ import annotations

import gc
import importlib
import os
import signal
import sys
from types import FrameType
from typing import NamedTuple, NoReturn

import click
from click.shell_completion import CompletionItem

from lifecycle.cli.common import COMPLETE, say
from lifecycle.cli.standard_streams import own_streams
from lifecycle.errors import ExitCode, LifecycleError, UsageError, did_you_mean, exhausted


class Verb(NamedTuple):
    """One verb.

    Attributes:
        about: one line for the list of verbs.
        example: how it is used, below its --help.
        needs: ROS: it makes participants, here or in processes that it starts; LINUX: it is about
            what runs or ran; empty: it is about manifests.
        module: below cli/verbs/, which has it as `command`; `MODULE:NAME` has it as `NAME_command`;
            empty for one of the verb's name.
    """

    about: str
    example: str
    needs: str = ""
    module: str = ""


ROS, LINUX = "ros", "linux"

VERBS = {
    "check": Verb(
        "check a manifest without running anything; needs no ROS",
        "check robot.lifecycle.yaml --strict",
    ),
    "plan": Verb(
        "show the computational graph, participants, ports and bring-up order",
        "plan robot.lifecycle.yaml --format json",
    ),
    "up": Verb(
        "start, configure, connect, verify, and only then activate; Ctrl-C ends",
        "up robot.lifecycle.yaml rate:=5 --report verdict.json",
        ROS,
    ),
    "pause": Verb(
        "deactivate a running system in reverse order: data stops",
        "pause robot",
        LINUX,
        "control:pause",
    ),
    "resume": Verb(
        "verify a paused system again, and activate it", "resume robot", LINUX, "control:resume"
    ),
    "restart": Verb(
        "take one node or all of a running system down, and up again through the gate",
        "restart robot /camera",
        LINUX,
        "control:restart",
    ),
    "mode": Verb(
        "enter another mode of a running system: who is active, through the gate",
        "mode robot docking",
        LINUX,
        "control:mode",
    ),
    "apply": Verb(
        "have a running system run by another manifest, through the gate, or back",
        "apply robot.lifecycle.yaml --dry-run",
        LINUX,
    ),
    "down": Verb("end a running system in reverse order", "down robot", LINUX, "control:down"),
    "status": Verb(
        "show what a running supervisor sees", "status robot --watch", LINUX, "control:status"
    ),
    "verify": Verb(
        "judge a running system, started by anyone; for CI",
        "verify robot.lifecycle.yaml --format junit",
        ROS,
    ),
    "flows": Verb("show every network flow and how unique it is", "flows robot --export nft", ROS),
    "graph": Verb(
        "picture of what runs, beside what was declared",
        "graph robot --format svg --output robot.svg",
        ROS,
    ),
    "export": Verb(
        "write a manifest for other systems: systemd, containers' engines, sros2",
        "export systemd robot.lifecycle.yaml -o units",
    ),
    "import": Verb(
        "write a manifest from a ROS 2 launch file, gaps marked; starts nothing",
        "import robot.launch.py > robot.lifecycle.yaml",
        "",
        "import_",
    ),
    "capture": Verb(
        "write a manifest from a running system, gaps marked",
        "capture --domain 7 --output robot.lifecycle.yaml",
        ROS,
    ),
    "logs": Verb(
        "show what the processes of the latest run have written, or follow it",
        "logs camera --follow",
        LINUX,
    ),
    "history": Verb(
        "show what happened in a run, from its journal",
        "history --system robot",
        LINUX,
    ),
    "run": Verb(
        "run one node of a manifest in this terminal, without a supervisor",
        "run robot.lifecycle.yaml camera --manual",
        ROS,
    ),
    "ports": Verb(
        "DDS port arithmetic and platform limits",
        "ports --domain 7 --participant 3",
        "",
    ),
    "init": Verb(
        "make a package of one's own: nodes, manifest, tests, CI workflow", "init my_robot"
    ),
    "schema": Verb(
        "print the manifest's JSON Schema, or install it for editors",
        "schema --install",
        "",
        "init:schema",
    ),
}
"""All verbs, in the order of the pipeline."""

_ORDERLY = frozenset({ExitCode.OK, ExitCode.VIOLATED, ExitCode.UNVERIFIABLE})
"""Exit codes that no exception becomes: what made participants has closed them itself."""


def _ros_hint() -> str:
    from lifecycle.middleware.versions import INSTALL

    return f"{INSTALL} for its Python"


def _check_ros(verb: str) -> None:
    """Refuse a verb that needs ROS 2, before anything is imported for it.

    Raises:
        UsageError: there is no ROS 2 here, or not the RMW that the environment names.
        MiddlewareError: loading it would end this process: /dev/shm is full.
    """
    from importlib.util import find_spec

    if find_spec("rclpy") is None:
        raise UsageError(
            f"cannot run 'lifecycle {verb}': it needs ROS 2, and this Python has no rclpy",
            hint=_ros_hint(),
        )
    from lifecycle.middleware.process.shared_memory import check_room
    from lifecycle.middleware.versions import check_rmw

    check_room()
    check_rmw(os.environ)
    if not os.environ.get("HOME"):
        from lifecycle.run_directory import home_directory

        # rcl asks the variable alone, and makes no node with logs without it.
        if home := home_directory(os.environ):
            os.environ["HOME"] = home


class _Verbs(click.Group):
    """Loads a verb's module on first use."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Look first whether there is such a verb, and one that needs the RMW can have it."""
        if ctx.resilient_parsing:  # for shell completion
            return super().resolve_command(ctx, args)
        if args and args[0] not in VERBS and not args[0].startswith("-"):
            hint = did_you_mean(args[0], VERBS) or "lifecycle --help lists the verbs"
            raise UsageError(f"cannot find the verb {args[0]!r}", hint=hint)
        verb = VERBS.get(args[0]) if args else None
        if verb and verb.needs and sys.platform != "linux":
            raise UsageError(
                f"cannot run 'lifecycle {args[0]}' on {sys.platform}: nodes are run and watched on "
                "Linux",
                hint="what is about manifests works here: check, plan, export, import, init, "
                "schema",
            )
        if verb and verb.needs == ROS and not {"-h", "--help"} & {*args}:
            _check_ros(args[0])
        return super().resolve_command(ctx, args)

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - click's signature
        """Verbs in the order of the pipeline."""
        return list(VERBS)

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem[str]]:
        """Complete verbs without importing them."""
        if incomplete.startswith("-"):
            return click.Command.shell_complete(self, ctx, incomplete)
        return [
            CompletionItem(name, help=verb.about)
            for name, verb in VERBS.items()
            if name.startswith(incomplete)
        ]

    def get_command(
        self,
        ctx: click.Context,  # noqa: ARG002 - click's signature
        cmd_name: str,
    ) -> click.Command | None:
        """Import the module of a verb."""
        if cmd_name not in VERBS:
            return None
        verb = VERBS[cmd_name]
        module, _, name = (verb.module or cmd_name).partition(":")
        found = getattr(
            importlib.import_module(f"lifecycle.cli.verbs.{module}"),
            f"{name}_command" if name else "command",
        )
        assert isinstance(found, click.Command)
        found.epilog = f"Example: lifecycle {verb.example}"
        return found

    def format_commands(
        self,
        ctx: click.Context,  # noqa: ARG002 - click's signature
        formatter: click.HelpFormatter,
    ) -> None:
        """List verbs without importing them."""
        with formatter.section("Verbs"):
            formatter.write_dl([(name, verb.about) for name, verb in VERBS.items()])


@click.command(cls=_Verbs, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="ros-lifecycle-manifests")
def cli() -> None:
    """Declare a ROS 2 system, start it, and activate it only once it is verified."""


def program() -> int:
    """Run `lifecycle` as a process of its own."""
    if COMPLETE in os.environ:
        from click.shell_completion import shell_complete

        return shell_complete(cli, {}, "lifecycle", COMPLETE, os.environ[COMPLETE])
    verb = sys.argv[1:2]
    if verb == ["run"]:  # whose streams are the user's node's
        return main()
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
    code = own_streams(waits=verb != ["up"])(main(is_program=True))
    if "rclpy" in sys.modules:
        from lifecycle.middleware.fastdds.prober import leave_all
        from lifecycle.middleware.process.shared_memory import holds_shared_memory

        leave_all()
        if code not in _ORDERLY and not (verb == ["up"] and code == ExitCode.INTERRUPTED):
            gc.collect()  # what an error may have kept of a participant leaves the graph with it
        if holds_shared_memory():
            return code
    # All is written, and the graph was left. Ending the interpreter takes 0.2 s where ROS was used;
    # only that removes shared memory that Fast DDS still has, of a peer's port that was killed.
    os._exit(code)


_interrupts: list[int] = []


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    """Do what Python does by default, and note it."""
    _interrupts.append(number)
    signal.default_int_handler(number, frame)


def main(arguments: list[str] | None = None, *, is_program: bool = False) -> int:
    """Run the command line; the one place where exceptions become exit codes.

    Args:
        arguments: those of the process if left out.
        is_program: the process ends with it; verbs have this as `obj` of their context.

    Returns:
        The exit code, see `lifecycle.errors.ExitCode`.
    """
    try:
        result = cli.main(
            args=arguments, prog_name="lifecycle", standalone_mode=False, obj=is_program
        )
    except (click.Abort, KeyboardInterrupt):
        return ExitCode.INTERRUPTED
    except Exception as error:  # noqa: BLE001 - the boundary: report our bug, whatever it is
        # An import, or a class that is being made, raises an error of its own for an interrupt.
        return ExitCode.INTERRUPTED if _interrupts else _report(error)
    return int(result or 0)


def _report(error: Exception) -> int:
    """Say on standard error why a command failed; return its exit code."""
    if isinstance(error, click.ClickException):
        error.show()
        return ExitCode.USAGE
    if isinstance(error, LifecycleError):
        say(str(error))
        return error.exit_code
    if (used_up := exhausted(error)) is not None:
        say(str(used_up))
        return used_up.exit_code
    if isinstance(error, ImportError) and "rclpy" in f"{error.name} {error}":
        # Of another Python, most often: ROS 2 has its C extensions for one version only.
        version = sys.version.split()[0]
        message = f"cannot import rclpy with Python {version}: {error}; {_ros_hint()}"
        say(" ".join(message.split()))
        return ExitCode.USAGE
    import traceback

    traceback.print_exception(error)
    say("this is a bug in lifecycle: please report it with the trace above")
    return ExitCode.INTERNAL
