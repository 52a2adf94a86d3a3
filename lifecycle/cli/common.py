"""Options that several verbs share, loading a manifest, and finding a running system."""

from __future__ import annotations

import contextlib
import os
import shutil
import stat
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.shell_completion import CompletionItem

from lifecycle.codec import to_json
from lifecycle.errors import UsageError, did_you_mean
from lifecycle.printable import json_text, lines
from lifecycle.programming import TARGETS

if TYPE_CHECKING:
    from lifecycle.manifest.model import Manifest
    from lifecycle.plan.model import Plan
    from lifecycle.plan.programs import Resolution
    from lifecycle.programming.target import Program

F = TypeVar("F", bound=Callable[..., Any])


def manifest_arguments(function: F) -> F:
    """Add `MANIFEST [NAME:=VALUE …]` to a verb."""
    function = assignments_argument(function)
    complete = completing("manifests")
    return click.argument("manifest", metavar="MANIFEST", shell_complete=complete)(function)


def assignments_argument(function: F) -> F:
    """Add `[NAME:=VALUE …]` to a verb; with MANIFEST before it, `PACKAGE FILE` may be that."""
    return click.argument(
        "assignments",
        nargs=-1,
        metavar="[NAME:=VALUE]...",
        shell_complete=completing("arguments"),
        callback=_of_package,
    )(function)


def _of_package(ctx: click.Context, _: click.Parameter, words: tuple[str, ...]) -> tuple[str, ...]:
    """Take `PACKAGE FILE` for the file that a package has installed, as `ros2 launch` does.

    Raises:
        UsageError: there is no such package, no such file in it, or several.
    """
    package = ctx.params.get("manifest")
    if package is None or is_manifest(package) or not words or ":=" in words[0]:
        return words
    from lifecycle.manifest.installed_types import find_resource, list_resources, search_prefixes

    prefixes = search_prefixes()
    index = None if "/" in package else find_resource("packages", package, prefixes)
    if index is None:
        near = did_you_mean(package, list_resources("packages", prefixes))
        hint = near or "source the setup file of the package's workspace"
        raise UsageError(f"cannot find a file or a package {package!r}", hint=hint)
    share = index.parents[3] / package  # of PREFIX/share/ament_index/resource_index/packages/NAME
    found = sorted(share.rglob("*.yaml"))
    named = [str(each) for each in found if each.name == words[0]]
    if len(named) != 1:
        known = [each.name for each in found if each.name.endswith(".lifecycle.yaml")]
        there = ", ".join(named or known) or "none"
        number = "several" if named else "no"
        raise UsageError(
            f"cannot choose {words[0]!r}: {number} such manifest in {str(share)!r}: {there}"
        )
    ctx.params["manifest"] = named[0]
    return words[1:]


def format_option(*formats: str) -> Callable[[F], F]:
    """Add `--format`; the first is the default."""
    return click.option(
        "--format", "format_", type=click.Choice(formats), default=formats[0], show_default=True
    )


def timeout_option(
    default_s: float | None, help_: str, *, or_0: bool = False, default: str = ""
) -> Callable[[F], F]:
    """Add `--timeout SECONDS`, more than 0, or at least 0 with `or_0`.

    Args:
        default_s: None where it depends.
        help_: what it is for.
        or_0: allow 0.
        default: on what it depends, for people.
    """
    return click.option(
        "--timeout",
        type=click.FloatRange(min=0, min_open=not or_0),
        default=default_s,
        show_default=default or True,
        metavar="SECONDS",
        help=help_,
    )


def parse_assignments(assignments: tuple[str, ...]) -> dict[str, str]:
    """Parse `name:=value` arguments, as `ros2 launch` spells them.

    Raises:
        UsageError: an argument without `:=` or with an empty name, or a name given twice.
    """
    values: dict[str, str] = {}
    for word in assignments:
        name, separator, value = word.partition(":=")
        if not separator or not name:
            raise UsageError(f"cannot read argument {word!r}; write name:=value")
        if name in values:
            raise UsageError(f"cannot set argument {name!r} twice")
        values[name] = value
    return values


run_commands_option = click.option(
    "--run-commands",
    is_flag=True,
    help="Run the programs of $(command …), as `lifecycle up` does; without it what they would "
    "write is left out, and said.",
)
"""`--run-commands` of a verb that only looks at a manifest."""


def load_plan(
    path: str,
    assignments: tuple[str, ...],
    *,
    quiet: bool = False,
    machine: str | None = None,
    run_commands: bool = True,
    domain_id: int | None = None,
) -> Plan:
    """Load and check a manifest, and plan it; print warnings to stderr unless `quiet`.

    Args:
        path: the file.
        assignments: `name:=value` arguments.
        quiet: print nothing.
        machine: what its nodes run is looked for, too, as `up --machine` would start it; None looks
            for nothing.
        run_commands: see `load`.
        domain_id: in the place of the manifest's.

    Raises:
        ManifestError: with every diagnostic.
    """
    from lifecycle.manifest.diagnostics import ManifestError, Severity
    from lifecycle.manifest.loading import load
    from lifecycle.plan.build import build_plan

    loaded = load(path, parse_assignments(assignments), run_commands=run_commands)
    warnings = loaded.warnings
    if machine is not None:
        found = resolve(loaded.manifest, machine).diagnostics
        if any(each.severity is Severity.ERROR for each in found):
            raise ManifestError((*warnings, *found))
        warnings = (*warnings, *found)
    if not quiet:
        for warning in warnings:
            say(str(warning))
    return build_plan(loaded.manifest, domain_id=domain_id)


def resolve(manifest: Manifest, machine: str = "") -> Resolution:
    """Look for what the nodes of a valid manifest run on this host, without running it.

    Raises:
        UsageError: the manifest declares no such machine.
    """
    from lifecycle.plan.programs import resolve_programs
    from lifecycle.supervisor.run.options import own_machines

    own = own_machines(manifest, machine)
    return resolve_programs(manifest, environment=os.environ, is_ours=own.__contains__)


def json_of(value: object) -> str:
    """Return a value as JSON that a terminal can show."""
    return json_text(to_json(value).decode())


def output_option(what: str) -> Callable[[F], F]:
    """Add `--output FILE` to a verb that prints `what`."""
    return click.option(
        "--output",
        type=click.Path(dir_okay=False, path_type=Path),
        metavar="FILE",
        help=f"Write the {what} there instead of printing it.",
    )


def write_text(path: Path, text: str) -> None:
    """Write a file, and the folders that it is in.

    Raises:
        UsageError: it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_text(path, text)
    except (OSError, ValueError) as error:
        raise unwritable(path, error) from error


def unwritable(path: Path, error: OSError | ValueError, what: str = "") -> UsageError:
    """Return the error for a file that cannot be written; `what` says which it is."""
    why = error.strerror if isinstance(error, OSError) else error
    return UsageError(f"cannot write {what}{str(path)!r}: {why}")


def replace_text(path: Path, text: str) -> None:
    """Write a file so that a reader sees the old one or the new one, whole.

    What is no regular file, `/dev/null` or a pipe, is written to and stays what it is.

    Raises:
        OSError: it cannot be written.
    """
    with contextlib.suppress(FileNotFoundError):
        if not stat.S_ISREG(path.stat().st_mode):
            path.write_text(text, encoding="utf-8")
            return
    whole = path.resolve()
    part = whole.with_name(f".{whole.name}.{os.getpid()}")
    try:
        with part.open("x", encoding="utf-8") as file:
            file.write(text)
        part.replace(whole)
    except OSError:
        part.unlink(missing_ok=True)
        raise


def say(text: str) -> None:
    """Say something on standard error, printable: parts of it are what others have chosen."""
    click.echo(lines(text), err=True)


def terminal_width() -> int:
    """Return how many columns standard output has; 0 where it is no terminal."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else 0


def wrapped(text: Iterable[str], width: int) -> str:
    """Return lines, those that are longer than `width` continued below; 0 continues none."""
    wrap = textwrap.TextWrapper(
        width, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False
    ).wrap
    return "\n".join(each for line in text for each in (wrap(line) if width else [line]))


def target_arguments(function: F) -> F:
    """Add `TARGET [NAME:=VALUE …]` and `--machine` to a verb."""
    function = machine_option("As it was given to `lifecycle up`.")(function)
    return target_argument(assignments_argument(function))


def target_argument(function: F) -> F:
    """Add `TARGET`: a manifest, or a running system."""
    complete = completing("manifests systems")
    return click.argument("target", metavar="TARGET", type=_Target(), shell_complete=complete)(
        function
    )


class _Target(click.types.StringParamType):
    def get_missing_message(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        """Name what may be meant, where no target is given."""
        del param, ctx
        return f"It is a manifest, or a system; running: {', '.join(_systems()) or 'none'}"


def machine_option(help_: str) -> Callable[[F], F]:
    """Add `--machine`."""
    return click.option(
        "--machine",
        default="",
        metavar="NAME",
        help=help_,
    )


def target_run(target: str, assignments: tuple[str, ...], machine: str) -> Path:
    """Return the run directory that a target names: a manifest's, or a system's by name.

    A manifest that is no longer the one that runs is reported on stderr, and makes no difference.

    Raises:
        UsageError: no such run.
        ManifestError: the manifest cannot be loaded, so that its domain is not known.
    """
    path, plan = target_plan(target, assignments, machine)
    if plan is not None:
        from lifecycle.supervisor.control.protocol import differences

        if found := differences(path, plan):
            listed = "\n".join(found)
            say(f"{plan.manifest_path} is not the manifest that {path.name} runs:\n{listed}")
    return path


@contextlib.contextmanager
def asking(path: Path) -> Iterator[None]:
    """Say which supervisor, that of a run directory, does not answer or is gone."""
    try:
        yield
    except TimeoutError as error:
        from lifecycle.run_directory import silent

        raise silent(path) from error
    except (FileNotFoundError, ConnectionRefusedError) as error:
        from lifecycle.run_directory import lost

        raise lost(path) from error


def is_manifest(target: str) -> bool:
    """Return whether a target is the file of a manifest, and not the name of a running system."""
    return os.path.isfile(target)


def target_plan(
    target: str, assignments: tuple[str, ...], machine: str
) -> tuple[Path, Plan | None]:
    """Return the run directory that a target names, and the plan if it is a manifest.

    Raises:
        UsageError: no such run, or arguments for a system that is named.
        ManifestError: the manifest cannot be loaded.
    """
    from lifecycle.run_directory import find_run, run_name, run_roots

    roots = run_roots(os.environ)
    if not is_manifest(target):
        if assignments:
            raise UsageError(
                f"cannot use {' '.join(assignments)} with the running system {target!r}",
                hint="arguments belong to a manifest; name its file",
            )
        return find_run(roots, target), None
    plan = load_plan(target, assignments, quiet=True)
    return find_run(roots, run_name(plan, machine)), plan


def read_networks(
    targets: Sequence[str], given: Mapping[str, Any], *, option: str
) -> Program | None:
    """Return the networks that were chosen; None where nothing was given.

    Raises:
        UsageError: they do not fit together.
    """
    if not targets and not any(given.values()):
        return None
    # What programs networks takes long to import.
    from lifecycle.programming.programmer import read_program

    return read_program(targets, given, option=option)


def network_options(*names: str, help_: str, multiple: bool = False) -> Callable[[F], F]:
    """Add the option that chooses networks, what each of them needs, and what flows get."""
    options = (
        click.option(*names, type=click.Choice(TARGETS), multiple=multiple, help=help_),
        click.option("--device", metavar="DEV", help="tc: the device, eth0."),
        click.option("--rate", metavar="RATE", help="tc: rate of the link behind it, 20mbit."),
        click.option(
            "--guarantee",
            metavar="CLASS=RATE",
            multiple=True,
            help="tc: rate of a class, ef=2mbit; above its burst peak.",
        ),
        click.option(
            "--queue",
            metavar="TIME",
            help="tc: how long the queue of a class may become at that rate.  [default: 50ms]",
        ),
        click.option(
            "--match",
            type=click.Choice(("flow", "mark")),
            help="tc: look at 5-tuples, or at what is marked.  [default: flow]",
        ),
        click.option(
            "--config",
            metavar="FILE",
            help="nef, camara: where the server is and where the token is.",
        ),
        click.option(
            "--dscp-from-5qi",
            "mapping",
            metavar="NAME|FILE",
            default="",
            help="Mark flows that have a 5QI and no DSCP by this mapping.",
        ),
        click.option(
            "--flow-labels", is_flag=True, help="Give each IPv6 flow a flow label of its own."
        ),
    )

    def add(function: F) -> F:
        for each in reversed(options):
            function = each(function)
        return function

    return add


COMPLETE = "_LIFECYCLE_COMPLETE"
"""Variable by which a shell asks what can come next (click's, by the program's name)."""


def completing(what: str) -> Callable[[click.Context, click.Parameter, str], list[Any]]:
    """Return the shell completion of an argument by words of these kinds, see `_words`."""

    def complete(context: click.Context, _: click.Parameter, incomplete: str) -> list[Any]:
        files = [CompletionItem(incomplete, type="file")] if "manifests" in what else []
        if files and incomplete and not incomplete.isidentifier():
            return files
        words: list[str] = []
        for kind in what.split():
            with contextlib.suppress(Exception):  # what is half written has no completions
                words += _words(kind, context)
        return [CompletionItem(each) for each in words if each.startswith(incomplete)] or files

    return complete


def _systems() -> list[str]:
    from lifecycle.run_directory import run_roots, running

    return [each.name for each in running(*run_roots(os.environ))]


def _words(kind: str, context: click.Context) -> list[str]:
    """Return "manifests" and "systems" here, or what the manifest before has of a kind."""
    if kind == "manifests":
        return sorted(each.name for each in Path().glob("*.lifecycle.yaml"))
    if kind == "systems":
        return _systems()
    import yaml

    target = context.params.get("manifest") or context.params.get("target") or ""
    with Path(str(target)).expanduser().open("rb") as stream:
        document = yaml.load(stream, Loader=yaml.BaseLoader)  # noqa: S506 - builds nothing but text
    return [f"{name}:=" if kind == "arguments" else name for name in document[kind]]
