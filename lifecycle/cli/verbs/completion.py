"""`lifecycle completion`: shell completion in bash, zsh and fish, and what each argument can be.

Owns: the scripts, which call `lifecycle` again with `_LIFECYCLE_COMPLETE=SHELL`, and the lines that
they read: kind, value and help, separated by tabs. Kinds: `plain`; `open`, which no space follows;
`path`; and `file`, for which the shell's own completion of files is used. Must not import rclpy.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import click
from click.shell_completion import CompletionItem, ShellComplete, split_arg_string

from lifecycle.cli import COMPLETE
from lifecycle.errors import ExitCode

Source = Callable[[click.Context, str], Iterable[CompletionItem[Any]]]

_SUFFIX = ".lifecycle.yaml"
_LOGS_OF = re.compile(r".+-\d+-(?=[A-Za-z])")
"""What comes before the name of the system in the name of a run's log directory."""

_BASH = r"""_lifecycle_completion() {
    local kind value help
    COMPREPLY=()
    while IFS=$'\t' read -r kind value help; do
        case $kind in
            file) compopt -o default; continue ;;
            open) compopt -o nospace ;;
            path) compopt -o filenames ;;
        esac
        COMPREPLY+=("$value")
    done < <(COMP_LINE="${COMP_LINE:0:COMP_POINT}" COMP_BREAKS="$COMP_WORDBREAKS" \
        _LIFECYCLE_COMPLETE=bash "$1" 2>/dev/null)
}
complete -o nosort -F _lifecycle_completion lifecycle
"""
_ZSH = r"""#compdef lifecycle
_lifecycle_completion() {
    local kind value help
    local -a plain described open paths
    while IFS=$'\t' read -r kind value help; do
        case $kind in
            file) _files ;;
            open) open+=("$value") ;;
            path) paths+=("$value") ;;
            *) [[ -n $help ]] && described+=("${value//:/\\:}:$help") || plain+=("$value") ;;
        esac
    done < <(COMP_LINE="${(j: :)words[1,CURRENT]}" \
        _LIFECYCLE_COMPLETE=zsh "${words[1]}" 2>/dev/null)
    (( $#described )) && _describe -V lifecycle described
    (( $#plain )) && compadd -V plain -a plain
    (( $#open )) && compadd -V open -S '' -a open
    (( $#paths )) && compadd -V paths -a paths
}
if [[ $zsh_eval_context[-1] == loadautofunc ]]; then
    _lifecycle_completion "$@"
else
    compdef _lifecycle_completion lifecycle
fi
"""
_FISH = r"""function _lifecycle_completion
    set -l program (commandline -opc)[1]
    for line in (COMP_LINE=(commandline -cp) _LIFECYCLE_COMPLETE=fish $program 2>/dev/null)
        set -l parts (string split \t -- $line)
        switch $parts[1]
            case file
                __fish_complete_path (commandline -ct)
            case '*'
                printf '%s\t%s\n' $parts[2] "$parts[3]"
        end
    end
end
complete --no-files --command lifecycle --arguments '(_lifecycle_completion)'
"""
SCRIPTS = {"bash": _BASH, "zsh": _ZSH, "fish": _FISH}


@click.command("completion")
@click.argument("shell", type=click.Choice(tuple(SCRIPTS)))
def command(shell: str) -> int:
    """Print the script that switches on completion in SHELL.

    bash, in ~/.bashrc: eval "$(lifecycle completion bash)"; zsh, in ~/.zshrc behind compinit:
    eval "$(lifecycle completion zsh)"; fish, in ~/.config/fish/config.fish:
    lifecycle completion fish | source. It completes verbs, options, manifests (`*.lifecycle.yaml`,
    any other file where there is none), the nodes, machines and arguments of the manifest that is
    named before, and the systems that run.
    """
    click.echo(SCRIPTS[shell].rstrip("\n"))
    return ExitCode.OK


def answer(cli: click.Command, environment: Mapping[str, str]) -> int:
    """Print what can come next on the command line; nothing where that cannot be known."""
    shell = environment[COMPLETE]
    if shell not in SCRIPTS:
        return ExitCode.USAGE
    try:
        text = _Completion(cli, shell, environment).complete()
    except Exception:  # noqa: BLE001 - a shell shows what is said in the middle of its line
        return ExitCode.USAGE
    if text:
        click.echo(text)
    return ExitCode.OK


class _Completion(ShellComplete):
    """What click knows of the command line, as lines for the scripts above."""

    name = "lifecycle"
    source_template = ""

    def __init__(self, cli: click.Command, shell: str, environment: Mapping[str, str]) -> None:
        super().__init__(cli, {}, "lifecycle", COMPLETE)
        self._line = environment.get("COMP_LINE", "")
        # bash replaces only what follows the last of these characters.
        self._breaks = environment.get("COMP_BREAKS", "") if shell == "bash" else ""
        self._word = ""

    def get_completion_args(self) -> tuple[list[str], str]:
        """Split the line as a shell does; the last word is the one to complete."""
        words = split_arg_string(self._line)
        ended = not self._line or self._line[-1].isspace()
        self._word = "" if ended or len(words) < 2 else words.pop()
        self.ctx_args["obj"] = tuple(words)
        return words[1:], self._word

    def format_completion(self, item: CompletionItem[Any]) -> str:
        """Return the line of one item, or the shell's own files."""
        kind = {"dir": "file"}.get(item.type, item.type)
        value = str(item.value)
        if kind == "file":
            value = ""
        elif self._word.startswith("--") and "=" in self._word:
            value = f"{self._word.partition('=')[0]}={value}"  # click completes what is behind it
        cut = max((self._word.rfind(each) for each in self._breaks), default=-1) + 1
        help_ = " ".join((item.help or "").split())
        return "\t".join((kind, value[cut:], help_))


def found(what: str, context: click.Context, incomplete: str) -> list[CompletionItem[Any]]:
    """Return what an argument can be; nothing where the manifest or the run cannot be read.

    Args:
        what: kinds, see `_SOURCES`, separated by spaces.
        context: of the words before.
        incomplete: what is there of the word.
    """
    kinds = what.split()
    items = [item for each in kinds for item in _items(_SOURCES[each], context, incomplete)]
    if kinds[0] == "manifests" and not any(item.type != "open" for item in items):
        return [CompletionItem(incomplete, type="file")]
    return items


def _items(
    source: Source, context: click.Context, incomplete: str
) -> tuple[CompletionItem[Any], ...]:
    try:
        return tuple(source(context, incomplete))
    except Exception:  # noqa: BLE001 - what is half written has no completions
        return ()


def _manifests(_: click.Context, incomplete: str) -> Iterator[CompletionItem[Any]]:
    """Yield manifests, and folders that may have some."""
    folder, slash, start = incomplete.rpartition("/")
    place = Path(folder + slash).expanduser() if slash else Path()
    for entry in sorted(os.scandir(place), key=lambda each: each.name):
        if not entry.name.startswith(start) or (entry.name.startswith(".") and not start):
            continue
        if entry.is_dir():
            yield CompletionItem(f"{folder}{slash}{entry.name}/", type="open")
        elif entry.name.endswith(_SUFFIX):
            yield CompletionItem(f"{folder}{slash}{entry.name}", type="path")


def _systems(_: click.Context, incomplete: str) -> Iterator[CompletionItem[Any]]:
    """Yield the runs that supervisors of this user hold."""
    from lifecycle.run_directory import running, runtime_root

    yield from _beginning(running(runtime_root(os.environ)), incomplete)


def _nodes(context: click.Context, incomplete: str) -> Iterator[CompletionItem[Any]]:
    """Yield the keys of nodes, and behind a slash their full names."""
    target = _target(context)
    if Path(target).is_file():
        try:
            nodes = {
                each.key: f"{each.namespace.rstrip('/')}/{each.name}"
                for each in _loaded(target).nodes
            }
        except Exception:  # noqa: BLE001 - it has an error somewhere, its keys are there
            nodes = {
                key: f"{node.get('namespace', '').rstrip('/')}/{node.get('name', key)}"
                for key, node in _mapping(target, "nodes").items()
            }
    else:
        from lifecycle.run_directory import find_run, runtime_root
        from lifecycle.supervisor import status

        nodes = {
            each.node.rpartition("/")[2]: each.node
            for each in status(find_run(runtime_root(os.environ), target)).nodes
        }
    names = nodes.values() if incomplete.startswith("/") else nodes
    yield from _beginning(names, incomplete)


def _logged(context: click.Context, incomplete: str) -> Iterator[CompletionItem[Any]]:
    """Yield the processes of the latest run, which have log files."""
    from lifecycle.supervisor import ros_log_root, runs_of

    runs = runs_of(ros_log_root(os.environ), context.params.get("system") or "")
    yield from _beginning(sorted(each.stem for each in runs[0].glob("*.log")), incomplete)


def _logged_systems(_: click.Context, incomplete: str) -> Iterator[CompletionItem[Any]]:
    """Yield the systems of which there are logs."""
    from lifecycle.supervisor import ros_log_root, runs_of

    runs = runs_of(ros_log_root(os.environ), "")
    systems = {_LOGS_OF.sub("", each.name) for each in runs}
    yield from _beginning(sorted(systems), incomplete)


def _runs(context: click.Context, incomplete: str) -> Iterator[CompletionItem[Any]]:
    """Yield the log directories of runs that have a journal, latest first."""
    from lifecycle.supervisor import ros_log_root, runs_of

    runs = runs_of(ros_log_root(os.environ), context.params.get("system") or "")
    there = (each.name for each in runs if (each / "journal.jsonl").is_file())
    yield from _beginning(there, incomplete)


def _machines(context: click.Context, incomplete: str) -> Iterator[CompletionItem[Any]]:
    yield from _beginning(_mapping(_target(context), "machines"), incomplete)


def _arguments(context: click.Context, incomplete: str) -> Iterator[CompletionItem[Any]]:
    """Yield `name:=` for what is not given yet; behind it the values that are allowed."""
    from lifecycle.manifest import declared_arguments

    given = {
        word.partition(":=")[0]
        for name in ("assignments", "words")
        for word in context.params.get(name) or ()
    }
    for each in declared_arguments(_target(context)):
        name, sign, _ = incomplete.partition(":=")
        if not sign and each.name.startswith(incomplete) and each.name not in given:
            yield CompletionItem(f"{each.name}:=", type="open", help=each.description)
        elif sign and each.name == name:
            values = each.choices or (() if each.default is None else (each.default,))
            yield from _beginning((f"{name}:={value}" for value in values), incomplete)


_SOURCES: dict[str, Source] = {
    "manifests": _manifests,
    "systems": _systems,
    "nodes": _nodes,
    "machines": _machines,
    "arguments": _arguments,
    "logged": _logged,
    "runs": _runs,
    "logged_systems": _logged_systems,
}


def _beginning(names: Iterable[str], incomplete: str) -> Iterator[CompletionItem[Any]]:
    return (CompletionItem(each) for each in names if each.startswith(incomplete))


def _target(context: click.Context) -> str:
    target = context.params.get("manifest") or context.params.get("target") or ""
    if not target:  # click gives up on arguments where an option lacks its value
        target = next((each for each in context.obj if each.endswith(_SUFFIX)), "")
    return os.path.expanduser(str(target))  # noqa: PTH111 - of a text


def _loaded(path: str) -> Any:
    from lifecycle.manifest import load

    return load(path, {}).manifest


def _mapping(path: str, key: str) -> dict[str, Any]:
    """Return what is under a key of a file, as its text has it."""
    import yaml

    with Path(path).open("rb") as stream:
        document = yaml.load(stream, Loader=yaml.BaseLoader)  # noqa: S506 - builds nothing but text
    return cast("dict[str, Any]", document[key])
