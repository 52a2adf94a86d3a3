"""`lifecycle init` and `lifecycle schema`: a package of one's own, and what editors read.

The files of a package are in cli/template/, where `@NAME@` stands for its name. Needs no ROS.
"""

from __future__ import annotations

import keyword
import os
import re
import shlex
import sys
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

import click

from lifecycle.cli.common import write_text
from lifecycle.errors import ExitCode, UsageError

if TYPE_CHECKING:
    from importlib.abc import Traversable

_PLACEHOLDER = "@NAME@"
_RENAMED = {
    "package": "@NAME@",
    "system.lifecycle.yaml": "@NAME@.lifecycle.yaml",
    "marker": "@NAME@",
}
"""Names in cli/template/ that are others in a package."""

_MANIFEST_SCHEMA = "manifest.v1.schema.json"
_PACKAGE_DEPTH = 3
"""Folders above a manifest that may be its package's."""


@click.command("init")
@click.argument("name", metavar="NAME")
@click.option(
    "--directory",
    type=click.Path(file_okay=False, path_type=Path),
    metavar="DIRECTORY",
    help="Where to make it; default: NAME, here.",
)
def command(name: str, directory: Path | None) -> int:
    """Make a package of one's own, NAME: nodes, their manifest, tests, and a CI workflow.

    It is a Python package with tests that pass, and a colcon package, too (ament_python). NAME has
    lower-case letters, digits and underscores.
    """
    # What both Python and ROS 2 take for a package, REP-144.
    if not re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", name) or len(name) < 2:
        what = "write lower-case letters, digits and single underscores, a letter first"
    elif keyword.iskeyword(name) or name in sys.stdlib_module_names:
        what = "Python has a module or a keyword of that name"
    elif name in ("lifecycle", "tests"):
        what = "it would hide a package that its own tests import"
    else:
        what = ""
    if what:
        raise UsageError(f"cannot make a package {name!r}: {what}")
    root = Path(name) if directory is None else directory
    files = {root / path: text for path, text in package_files(name).items()}
    if there := [str(path) for path in files if os.path.lexists(path)]:
        raise UsageError(
            f"cannot make a package in {str(root)!r}: {there[0]!r} is there already",
            hint="give --directory DIRECTORY",
        )
    for path, text in files.items():
        write_text(path, text)
    where = shlex.quote(str(root))
    click.echo(
        f"made {name!r} in {str(root)!r}: {len(files)} files\n"
        f"  cd {where}\n"
        "  pip install --editable '.[ros,test]'    # beside /opt/ros: '.[test]'\n"
        f"  lifecycle up manifests/{name}.lifecycle.yaml --stop-after 3\n"
        "  pytest"
    )
    return ExitCode.OK


def package_files(name: str) -> dict[str, str]:
    """Return the files of a new package: path in it → text."""
    found = dict(_template(resources.files("lifecycle.cli") / "template", "", name))
    found[f"schemas/{_MANIFEST_SCHEMA}"] = _schema_text(_MANIFEST_SCHEMA)
    return dict(sorted(found.items()))


def _template(folder: Traversable, path: str, name: str) -> Iterator[tuple[str, str]]:
    for each in folder.iterdir():
        plain = each.name.removesuffix(".in")
        renamed = _RENAMED.get(plain, plain).replace(_PLACEHOLDER, name)
        if each.is_dir():
            yield from _template(each, f"{path}{renamed}/", name)
        elif plain != each.name:
            text = each.read_text(encoding="utf-8").replace(_PLACEHOLDER, name)
            yield f"{path}{renamed}", text


def _schema_text(file: str) -> str:
    return (resources.files("lifecycle") / "_schemas" / file).read_text(encoding="utf-8")


def _schemas() -> dict[str, str]:
    """Return the schemas that are shipped: `manifest` → `manifest.v1.schema.json`."""
    folder = resources.files("lifecycle") / "_schemas"
    names = sorted(each.name for each in folder.iterdir() if each.name.endswith(".schema.json"))
    return {each.partition(".")[0]: each for each in names}


@click.command("schema")
@click.argument("name", default="manifest", metavar="[NAME]")
@click.option(
    "--install",
    "to",
    is_flag=False,
    flag_value="",
    type=str,
    metavar="[DIRECTORY]",
    help="Copy all schemas to DIRECTORY (default: the user's data directory).",
)
def schema_command(name: str, *, to: str | None) -> int:
    """Print a JSON Schema: of the manifest, or NAME: check, graph, plan or verdict.

    Editors complete and explain a manifest that begins with the line which --install prints.
    """
    schemas = _schemas()
    if name not in schemas:
        raise UsageError(f"cannot find schema {name!r}; there are: {', '.join(schemas)}")
    if to is None:
        click.echo(_schema_text(schemas[name]).rstrip("\n"))
        return ExitCode.OK
    folder = Path(to) if to else _data_directory()
    for file in schemas.values():
        write_text(folder / file, _schema_text(file))
    manifest = folder / schemas["manifest"]
    reference = f"{folder.as_posix()}/{manifest.name}" if to else manifest.as_uri()
    click.echo(
        f"copied {len(schemas)} schemas to {str(folder)!r}; a manifest begins with\n"
        f"# yaml-language-server: $schema={reference}"
    )
    return ExitCode.OK


def schema_reference(folder: Path) -> str:
    """Return where a manifest in a folder finds its schema, as the first line of it says.

    That is the `schemas/` folder of its package, if there is one, else where `lifecycle schema
    --install` puts it.
    """
    here = folder.absolute()
    for base in (here, *here.parents[:_PACKAGE_DEPTH]):
        if (base / "schemas" / _MANIFEST_SCHEMA).is_file():
            return Path(os.path.relpath(base / "schemas" / _MANIFEST_SCHEMA, here)).as_posix()
    return (_data_directory() / _MANIFEST_SCHEMA).as_uri()


def _data_directory() -> Path:
    """Return where this user's schemas are, XDG Base Directory Specification."""
    data = os.environ.get("XDG_DATA_HOME") or "~/.local/share"
    return Path(data).expanduser().absolute() / "lifecycle" / "schemas"
