"""Values of parameters: doubles that are not finite, empty arrays, and values that reach nobody."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from tests.outside.case import NOBODY, OK, UNVERIFIABLE, Case

if TYPE_CHECKING:
    from tests.outside.running import Run

PROGRAM = Path(__file__).parents[1] / "programs" / "values.py"
INTERFACE = (
    "{parameters: {gain: {type: double}, gains: {type: double_array}, "
    "names: {type: string_array}, counts: {type: int_array}}}"
)
GIVEN = "{gain: %s, gains: [.NaN, -.Inf, 1.5], names: [], counts: []}"
PLAIN, MANAGED, CODED = (f'{{python: "values:{each}"}}' for each in ("Plain", "Managed", "Coded"))
COMMAND = f'{{command: [python, "{PROGRAM}"]}}'


def system(
    run: str, *, given: str = "", interface: str = INTERFACE, more: str = "", name: str = "values"
) -> str:
    """Return a manifest of one node `values`."""
    return HEAD + node(run, given, interface, name) + (f"{more}\n" if more else "")


HEAD = "manifest_version: 1\nsystem: values\ndiscovery: {range: localhost}\nnodes:\n"


def node(run: str, given: str, interface: str = INTERFACE, name: str = "values") -> str:
    """Return what a manifest says of one node."""
    managed = "values:" in run and "Plain" not in run
    lines = [
        f"  {name}:",
        f"    run: {run}",
        *([] if managed else ["    managed: false", f"    name: {name}"]),
        *([f"    {given}"] if given else []),
        *([f"    interface: {interface}"] if interface else []),
    ]
    return "\n".join(lines) + "\n"


def in_file(values: str, name: str = "/**") -> dict[str, str]:
    return {"values.yaml": f"{name}:\n  ros__parameters: {values}\n"}


EMPTY = ("names=[] STRING_ARRAY", "counts=[] INTEGER_ARRAY")


def has(*wanted: str, node: str = "") -> Callable[[Run], None]:
    """Return a story: the node notes these."""

    def story(run: Run) -> None:
        def noted() -> set[str]:
            marks = run.marks(node, "received ")
            return {what.removeprefix("received ") for _, _, what in marks}

        run.wait(lambda: set(wanted) <= noted(), f"{node} notes {wanted}")

    return story


def in_modes(run: Run) -> None:
    """Enter the other mode and come back; each time the node has the mode's values."""
    run.until_active()
    for mode, values in (
        ("idle", {"names=[] STRING_ARRAY", "gain=inf DOUBLE"}),
        ("busy", {"names=['a'] STRING_ARRAY", "gain=1.0 DOUBLE"}),
    ):
        began = time.time()
        done = run.lifecycle("mode", "values", mode)
        assert done.returncode == 0, done.stdout + done.stderr
        for value in values:
            run.wait(
                lambda value=value, began=began: any(  # type: ignore[misc]
                    at > began and what == f"received {value}" for at, _, what in run.marks()
                ),
                f"{value} in mode {mode}",
            )


def plan_is_json(run: Run) -> None:
    """Planning is JSON that any parser reads: no NaN and no Infinity, which JSON has not."""

    def refuse(word: str) -> object:
        raise AssertionError(f"{word} is no JSON")

    for verb in (("plan", "{}", "--format", "json"), ("check", "{}", "--format", "json")):
        done = run.lifecycle(*verb)
        assert done.returncode == 0, done.stdout + done.stderr
        json.loads(done.stdout, parse_constant=refuse)


SPECIAL = "gains=[nan, -inf, 1.5] DOUBLE_ARRAY"
WAYS = {
    "managed": (MANAGED, ".INF", "inf"),
    "coded": (CODED, ".Inf", "inf"),
    "plain": (PLAIN, "-.INF", "-inf"),
    "program": (COMMAND, ".NAN", "nan"),
}
"""Nodes of the host, of which one declares its parameters in code, and a program."""


def all_have(run: Run) -> None:
    for name, (_, _, is_) in WAYS.items():
        has(f"gain={is_} DOUBLE", SPECIAL, *EMPTY, node=name)(run)


def _arrive(how: str) -> Case:
    given = {name: GIVEN % spelled for name, (_, spelled, _) in WAYS.items()}
    says = {
        name: f"parameters: {values}" if how == "inline" else f"parameter_files: [{name}.yaml]"
        for name, values in given.items()
    }
    files = {f"{name}.yaml": in_file(values)["values.yaml"] for name, values in given.items()}
    return Case(
        attack=f"infinity, NaN and empty arrays reach nodes of the host and a program, {how}",
        manifest=HEAD + "".join(node(WAYS[name][0], says[name], name=name) for name in WAYS),
        files={} if how == "inline" else files,
        verb=("up", "--strict", "--stop-after", "1"),
        story=all_have,
        verdict=OK,
    )


CASES = (
    _arrive("inline"),
    _arrive("in a file"),
    Case(
        attack="values behind -p: infinity and an empty array",
        manifest=system(
            f'{{command: [python, "{PROGRAM}", --ros-args, -p, "gain:=-.Inf", -p, "names:=[]", '
            '-p, "counts:=[ ]"]}'
        ),
        verb=("up", "--strict", "--stop-after", "1"),
        story=has("gain=-inf DOUBLE", *EMPTY),
        verdict=OK,
    ),
    Case(
        attack="a file of the command line itself: NaN and an empty array",
        manifest=system(
            f'{{command: [python, "{PROGRAM}", --ros-args, --params-file, values.yaml]}}'
        ),
        files=in_file("{gain: .nan, names: []}", "values"),
        verb=("up", "--strict", "--stop-after", "1"),
        story=has("gain=nan DOUBLE", "names=[] STRING_ARRAY"),
        verdict=OK,
    ),
    Case(
        attack="an empty array whose type nothing declares gets that of the node",
        manifest=system(COMMAND, given="parameters: {names: []}", interface=""),
        verb=("up", "--strict", "--stop-after", "1"),
        story=has("names=[] STRING_ARRAY"),
        verdict=OK,
        says=("cannot tell the type of 'names'",),
    ),
    Case(
        attack="check says that nothing declares the type of an empty array",
        manifest=system(COMMAND, given="parameters: {names: []}", interface=""),
        verb=("check", "--strict"),
        exit_code=5,
        says=("cannot tell the type of 'names'",),
    ),
    Case(
        attack="NaN in the first mode is what the node has, and equals itself",
        manifest=system(
            MANAGED,
            given="parameters: {gain: 1.0}",
            more="modes: {a: {parameters: {values: {gain: .NaN}}}, b: {}}",
        ),
        verb=("up", "--strict", "--stop-after", "1"),
        story=has("gain=nan DOUBLE"),
        verdict=OK,
    ),
    Case(
        attack="empty arrays and infinities in modes",
        manifest=system(
            MANAGED,
            given="parameters: {gain: 1.0, names: [a]}",
            more="modes:\n  busy: {}\n  idle: {parameters: {values: {gain: .inf, names: []}}}",
        ),
        verb=("up", "--strict", "--stop-after", "4"),
        story=in_modes,
        verdict=OK,
    ),
    Case(
        attack="a plan with values that JSON has no numbers for",
        manifest=system(MANAGED, given=f"parameters: {GIVEN % '-.inf'}"),
        verb=("plan",),
        story=plan_is_json,
    ),
    Case(
        attack="a number that must be finite is not",
        manifest=system(MANAGED, more="    timeouts: {start_s: .inf}"),
        verb=("check",),
        exit_code=3,
        says=("a number must be finite",),
    ),
    Case(
        attack="an integer that does not fit into 64 bits",
        manifest=system(MANAGED, given="parameters: {counts: [99999999999999999999]}"),
        verb=("check",),
        exit_code=3,
        says=("an integer must fit into 64 bits",),
    ),
    Case(
        attack="what rcl reads as a string is no double",
        manifest=system(MANAGED, given="parameter_files: [values.yaml]"),
        files=in_file("{gain: .Nan}"),
        verb=("check",),
        exit_code=3,
        says=("it is a string, declared is double",),
    ),
    Case(
        attack="a section of a parameter file for a node that is not there",
        manifest=system(MANAGED, given="parameter_files: [values.yaml]"),
        files={
            "values.yaml": "/values:\n  ros__parameters: {gain: 2.0}\n"
            "/valeus:\n  ros__parameters: {gain: 3.0}\n"
        },
        verb=("up", "--strict", "--stop-after", "1", "--timeout", "3"),
        exit_code=5,
        verdict=UNVERIFIABLE,
        findings=("param.reached-none",),
        activated=NOBODY,
    ),
    Case(
        attack="the gate opens on a value that reached nobody, and says so",
        manifest=system(MANAGED, given="parameter_files: [values.yaml]"),
        files=in_file("{gain: 2.0}", "/valeus"),
        verb=("up", "--stop-after", "1"),
        verdict=UNVERIFIABLE,
        findings=("param.reached-none",),
        activated=frozenset({"values"}),
        says=("trusted", "param.reached-none"),
    ),
    Case(
        attack="a misspelt parameter below /** of a node without declared parameters",
        manifest=system(COMMAND, given="parameter_files: [values.yaml]", interface=""),
        files=in_file("{gain: 2.0, gian: 3.0}"),
        verb=("up", "--strict", "--stop-after", "1", "--timeout", "4"),
        exit_code=5,
        verdict=UNVERIFIABLE,
        findings=("param.reached-none",),
    ),
    Case(
        attack="a misspelt parameter that all nodes share",
        manifest="parameters: {gian: 3.0}\n" + system(MANAGED, given="parameters: {gain: 2.0}"),
        verb=("up", "--strict", "--stop-after", "1", "--timeout", "3"),
        exit_code=5,
        verdict=UNVERIFIABLE,
        findings=("param.reached-none",),
        activated=NOBODY,
    ),
    Case(
        attack="-p for a node that its process does not have",
        manifest=system(f'{{command: [python, "{PROGRAM}", --ros-args, -p, "valeus:gain:=2.0"]}}'),
        verb=("up", "--strict", "--stop-after", "1", "--timeout", "3"),
        exit_code=5,
        verdict=UNVERIFIABLE,
        findings=("param.reached-none",),
    ),
    Case(
        attack="check refuses under --strict what up refuses: a value that reaches nobody",
        manifest=system(MANAGED, given="parameter_files: [values.yaml]"),
        files=in_file("{gain: 2.0}", "/valeus"),
        verb=("check", "--strict"),
        exit_code=5,
        says=("cannot find node '/values'",),
    ),
    Case(
        attack="advice of check is no reason to refuse",
        manifest=system(
            MANAGED,
            given="parameters: {gain: 2.0}",
            more="    restart: always\n    start_limit_burst: 5\n    start_limit_interval_sec: 1\n"
            "    restart_sec: 1",
        ),
        verb=("up", "--strict", "--stop-after", "1"),
        verdict=OK,
        says=("note: ", "never given up"),
        activated=frozenset({"values"}),
    ),
    Case(
        attack="check finds advice, and is content under --strict",
        manifest=system(
            MANAGED,
            more="    restart: always\n    start_limit_burst: 5\n    start_limit_interval_sec: 1\n"
            "    restart_sec: 1",
        ),
        verb=("check", "--strict"),
        says=("note: ", "(1 note)"),
    ),
    Case(
        attack="a value below /** that one of two nodes has reached somebody",
        manifest=system(COMMAND, given="parameter_files: [values.yaml]", interface="")
        + '  other:\n    run: {python: "nodes:Marked"}\n    parameter_files: [values.yaml]\n',
        files=in_file("{gain: 2.0}"),
        verb=("up", "--strict", "--stop-after", "1"),
        story=has("gain=2.0 DOUBLE"),
        verdict=OK,
    ),
)
