"""What each host of a system gets from `lifecycle up --hosts`: files, options, and when it ends.

Owns: `parts_of`, from a manifest and its plan. Pure but for reading files. Must not import rclpy.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from lifecycle import dataclasses
from lifecycle.codec import to_json
from lifecycle.errors import UsageError
from lifecycle.fleet.protocol import Part, SentFile
from lifecycle.manifest import THIS_HOST, is_outside
from lifecycle.run_directory import run_name

if TYPE_CHECKING:
    from lifecycle.plan import Plan

LARGEST = 16 * 2**20
"""Bytes of all files that are sent to a host."""


def parts_of(
    plan: Plan,
    files: Mapping[str, bytes],
    *,
    arguments: tuple[str, ...] = (),
    options: tuple[str, ...] = (),
    environment: Mapping[str, str] | None = None,
) -> tuple[tuple[Part, ...], tuple[str, ...]]:
    """Return the part of each machine that has nodes, and the files that are not sent.

    Args:
        plan: of the system.
        files: all that was read for it: contents by absolute path.
        arguments: `name:=value` of the manifest.
        options: of `lifecycle up`, for each.
        environment: for AMENT_PREFIX_PATH; None takes this process's own.

    Returns:
        What is in the folder of the manifest is sent. What is neither there nor in an installed
        package is listed: it must be there under the same path.

    Raises:
        UsageError: there is nothing to run, or too much to send.
    """
    manifest = os.path.abspath(plan.manifest_path)  # noqa: PTH100 - links are kept
    folder = Path(manifest).parent
    variables = os.environ if environment is None else environment
    if sum(map(len, files.values())) > LARGEST:
        raise UsageError(f"cannot send a manifest of more than {LARGEST} bytes to other hosts")
    sent, unsent = [], []
    for path, data in sorted(files.items()):
        if path == manifest or (
            Path(path).is_relative_to(folder) and not is_outside(path, manifest, {})
        ):
            sent.append(SentFile(path=str(Path(path).relative_to(folder)), data=data))
        elif is_outside(path, manifest, variables):
            unsent.append(path)
    used = {each.machine for each in plan.processes}
    machines = [each.name for each in plan.machines if each.name in used]
    if not machines:
        raise UsageError(f"cannot find a node of {plan.system!r} that runs on any machine")
    digest = hashlib.sha256(to_json((sent, arguments, plan.domain_id))).hexdigest()
    return tuple(
        Part(
            name=run_name(plan, machine),
            machine=machine,
            manifest=Path(manifest).name,
            files=tuple(sent),
            arguments=arguments,
            options=options,
            digest=digest,
            whole=run_name(plan),
        )
        for machine in machines
    ), tuple(unsent)


def in_place(part: Part, manifest: str) -> Part:
    """Return the part of this host, where the manifest lies with all that is beside it.

    Args:
        part: as it would be sent.
        manifest: the file.
    """
    path = os.path.abspath(manifest)  # noqa: PTH100 - links are kept
    return dataclasses.replace(part, manifest=path, files=())


def ranks(plan: Plan) -> dict[str, int]:
    """Return by machine when its nodes come at the latest: what comes last is ended first."""
    level_of = {key: level for level, keys in enumerate(plan.levels) for key in keys}
    found: dict[str, int] = {}
    for node in plan.nodes:
        found[node.machine] = max(found.get(node.machine, 0), level_of.get(node.key, 0))
    return found


def destinations(
    plan: Plan, chosen: Mapping[str, str], is_local: Callable[[str], bool]
) -> dict[str, str]:
    """Return by machine where ssh finds it; empty for this host.

    Args:
        plan: of the system.
        chosen: by machine, in the place of the manifest's address.
        is_local: whether a machine is this host by its address.

    Raises:
        UsageError: a machine is chosen that the manifest does not declare.
    """
    known = {each.name: each for each in plan.machines}
    for name in chosen:
        if name not in known:
            raise UsageError(
                f"cannot use --host {name}=…: the manifest declares no such machine; declared: "
                f"{', '.join(sorted(known)) or 'none'}"
            )
    return {
        name: chosen[name]
        if name in chosen
        else ""
        if (is_local(name) if each.address else name == THIS_HOST)
        else each.address or name
        for name, each in known.items()
    }
