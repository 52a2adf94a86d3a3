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
    managed = "values:" in run and "Plain" not in run
    lines = [
        "manifest_version: 1",
        "system: values",
        "discovery: {range: localhost}",
        "nodes:",
        f"  {name}:",
        f"    run: {run}",
        *([] if managed else ["    managed: false", f"    name: {name}"]),
        *([f"    {given}"] if given else []),
        *([f"    interface: {interface}"] if interface else []),
        *([more] if more else []),
    ]
    return "\n".join(lines) + "\n"


def in_file(values: str, name: str = "/**") -> dict[str, str]:
    return {"values.yaml": f"{name}:\n  ros__parameters: {values}\n"}


EMPTY = ("names=[] STRING_ARRAY", "counts=[] INTEGER_ARRAY")


def has(*wanted: str) -> Callable[[Run], None]:
    """Return a story: the node notes these."""

    def story(run: Run) -> None:
        def noted() -> set[str]:
            return {what.removeprefix("received ") for _, _, what in run.marks(what="received ")}

        run.wait(lambda: set(wanted) <= noted(), f"notes {wanted}")

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
WAYS = (
    ("a node of the host", MANAGED, ".INF", "inf"),
    ("a node of the host that declares its parameters", CODED, ".Inf", "inf"),
    ("a plain node of the host", PLAIN, "-.INF", "-inf"),
    ("a program", COMMAND, ".NAN", "nan"),
)


def _arrives(who: str, run: str, how: str, spelled: str, is_: str, quick: bool) -> Case:
    values = GIVEN % spelled
    return Case(
        attack=f"{spelled}, NaN and empty arrays reach {who}, {how}",
        manifest=system(
            run,
            given=f"parameters: {values}" if how == "inline" else "parameter_files: [values.yaml]",
        ),
        files={} if how == "inline" else in_file(values),
        verb=("up", "--strict", "--stop-after", "1"),
        story=has(f"gain={is_} DOUBLE", SPECIAL, *EMPTY),
        verdict=OK,
        quick=quick,
    )


CASES = (
    *(
        _arrives(who, run, how, spelled, is_, quick=run == MANAGED and how == "in a file")
        for who, run, spelled, is_ in WAYS
        for how in ("inline", "in a file")
    ),
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
        quick=True,
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
