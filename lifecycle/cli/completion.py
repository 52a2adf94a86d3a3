"""What a word of the command line can be, for click's shell completion. Runs nothing of a manifest.

Switched on by click's own scripts: `eval "$(_LIFECYCLE_COMPLETE=bash_source lifecycle)"` in
~/.bashrc, `zsh_source` and `fish_source` likewise.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

COMPLETE = "_LIFECYCLE_COMPLETE"
"""Variable by which a shell asks what can come next (click's, by the program's name)."""

Source = Callable[[click.Context], Iterable[str]]
Completer = Callable[[click.Context, click.Parameter, str], list[Any]]


def completing(what: str) -> Completer:
    """Return the shell completion of an argument: words of these kinds, see `_SOURCES`."""

    def complete(context: click.Context, _: click.Parameter, incomplete: str) -> list[Any]:
        if "manifests" in what and not incomplete.isidentifier() and incomplete:
            return [CompletionItem(incomplete, type="file")]
        words = [word for each in what.split() for word in _words(each, context)]
        found = [CompletionItem(each) for each in words if each.startswith(incomplete)]
        files = [CompletionItem(incomplete, type="file")] if "manifests" in what else []
        return found or files

    return complete


def _words(kind: str, context: click.Context) -> list[str]:
    try:
        return list(_SOURCES[kind](context))
    except Exception:  # noqa: BLE001 - what is half written has no completions
        return []


def _manifests(_: click.Context) -> Iterable[str]:
    return sorted(each.name for each in Path().glob("*.lifecycle.yaml"))


def _systems(_: click.Context) -> Iterable[str]:
    from lifecycle.run_directory import run_roots, running

    return [each.name for each in running(*run_roots(os.environ))]


def _runs(_: click.Context) -> Iterable[str]:
    from lifecycle.supervisor.processes.logs import ros_log_root, runs_of

    return [each.name for each in runs_of(ros_log_root(os.environ), "")]


def _mapping(context: click.Context, key: str) -> dict[str, Any]:
    """Return what is under a key of the manifest that the words before name, as its text has it."""
    import yaml

    target = context.params.get("manifest") or context.params.get("target") or ""
    with Path(str(target)).expanduser().open("rb") as stream:
        document = yaml.load(stream, Loader=yaml.BaseLoader)  # noqa: S506 - builds nothing but text
    return dict(document[key])


_SOURCES: dict[str, Source] = {
    "manifests": _manifests,
    "systems": _systems,
    "nodes": lambda context: _mapping(context, "nodes"),
    "machines": lambda context: _mapping(context, "machines"),
    "arguments": lambda context: (f"{name}:=" for name in _mapping(context, "arguments")),
    "runs": _runs,
}
