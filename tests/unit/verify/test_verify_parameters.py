"""Parameters: what is expected, what the node has, and exactly the findings that follow."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.diagnostics import Diagnostic, Position, Severity
from lifecycle.manifest.model import ParameterValue, Run, RunKind
from lifecycle.plan.model import ExpectedParameter, Plan
from lifecycle.verify.observation import (
    LONGEST_VALUE,
    NodeConfiguration,
    NodeParameters,
    Observation,
    ParameterReport,
)
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.parameters import spell
from lifecycle.verify.verdict import Finding, Stage
from tests.builders import at, node, planned
from tests.unit.verify.lines import lines, verify
from tests.unit.verify.perfect import perfect

ATTACH = Run(kind=RunKind.ATTACH)
NAN = float("nan")
LONG = tuple(float(each) for each in range(LONGEST_VALUE))
ABSENT = None


def expected(
    value: ParameterValue | None = 1.5, type_: str = "double", **rest: object
) -> ExpectedParameter:
    source = "" if value is None else "parameters"
    fields = {"name": "gain", "type": type_, "value": value, "source": source, "at": at(60, 7)}
    return ExpectedParameter(**{**fields, **rest})


def has(value: ParameterValue | None, type_: str = "double", *, read_only: bool = False):
    return ParameterReport.of("gain", type_, value, read_only=read_only)


def plan_of(*parameters: ExpectedParameter, run: Run = ATTACH, **rest: object) -> Plan:
    plan = planned(node("arm", run=run, managed=run is not ATTACH))
    (only,) = plan.nodes
    only = replace(only, expected_parameters=parameters, **rest)
    return replace(plan, nodes=(only,))


def served(plan: Plan, *reports: ParameterReport) -> Observation:
    """What is seen of a foreign node that answers."""
    seen = perfect(plan, Stage.ACTIVE)
    return replace(seen, parameters=(NodeParameters(node="/arm", parameters=reports),))


def judged(plan: Plan, seen: Observation) -> tuple[Finding, ...]:
    return verify(plan, seen, stage=Stage.ACTIVE).findings


CASES: dict[str, tuple[ExpectedParameter, ParameterReport | None, list[str]]] = {
    "as given": (expected(), has(1.5), []),
    "another value": (expected(), has(99.0), ["param.value-differs"]),
    "an integer where a double is meant": (expected(2.0), has(2, "int"), ["param.type-differs"]),
    "a double where an integer is meant": (
        expected(2, "int"),
        has(2.0),
        ["param.type-differs"],
    ),
    "one is not true": (expected(True, "bool"), has(1, "int"), ["param.type-differs"]),
    "it is not there": (expected(), ABSENT, ["param.missing"]),
    "only a section for many gives it, and it is otherwise": (
        expected(optional=True),
        has(2.0),
        ["param.value-differs"],
    ),
    "a declared type, whatever the value": (expected(None), has(7.0), []),
    "a declared type without a value": (expected(None), has(None), []),
    "a declared value that is not set": (expected(), has(None), ["param.value-differs"]),
    "not set, of any type": (expected(None), has(None, ""), ["param.type-differs"]),
    "not a number": (expected(".nan"), has(NAN), []),
    "a number where there must be none": (expected(".nan"), has(0.0), ["param.value-differs"]),
    "text that looks like no number": (expected(".nan", "string"), has(".nan", "string"), []),
    "the other infinity": (expected("-.inf"), has(float("inf")), ["param.value-differs"]),
    "both zeros": (expected(0.0), has(-0.0), []),
    "an equal array": (
        expected((1.0, 2.0), "double_array"),
        has((1.0, 2.0), "double_array"),
        [],
    ),
    "a longer array": (
        expected((1, 2), "int_array"),
        has((1, 2, 3), "int_array"),
        ["param.value-differs"],
    ),
    "an empty array of any type": (expected((), "array"), has((), "string_array"), []),
    "not even an array": (expected((), "array"), has("", "string"), ["param.type-differs"]),
    "a value too long to be passed on": (
        expected(LONG, "double_array"),
        has(LONG, "double_array"),
        [],
    ),
    "another value too long to be passed on": (
        expected(LONG, "double_array"),
        has((*LONG[:-1], 0.0), "double_array"),
        ["param.value-differs"],
    ),
    "read_only as declared": (expected(read_only=True), has(1.5, read_only=True), []),
    "declared read_only, and can be set": (
        expected(read_only=True),
        has(1.5),
        ["param.read-only-differs"],
    ),
    "read_only, which nobody forbids": (expected(), has(1.5, read_only=True), []),
    "what the command gives is not there": (
        expected((1, 2), "int_array", source="command"),
        ABSENT,
        ["param.missing"],
    ),
    "another type, too long to show": (
        expected(2.0),
        has("x" * LONGEST_VALUE, "string"),
        ["param.type-differs"],
    ),
    "an array of another type": (
        expected(None, "string"),
        has((True, False), "bool_array"),
        ["param.type-differs"],
    ),
    "two things wrong at once": (
        expected(read_only=True),
        has(3.0),
        ["param.value-differs", "param.read-only-differs"],
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_a_parameter_is_judged(case: str):
    wanted, actual, rules = CASES[case]
    plan = plan_of(wanted)
    found = judged(plan, served(plan, *(() if actual is None else (actual,))))
    assert [(each.rule, each.outcome) for each in found] == [
        (rule, Outcome.VIOLATED) for rule in rules
    ]
    assert {each.subject for each in found} <= {"/arm: gain"}
    assert {each.at for each in found} <= {"robot.lifecycle.yaml:60:7"}


def test_a_value_for_many_nodes_that_none_has_reached_none():
    plan = plan_of(expected(optional=True))
    (found,) = judged(plan, served(plan))
    assert (found.rule, found.outcome) == ("param.reached-none", Outcome.UNVERIFIABLE)
    assert (found.subject, found.at) == ("gain", "robot.lifecycle.yaml:60:7")


def test_a_warning_of_check_is_a_finding_unless_the_graph_settles_it():
    at = Position(file="p.yaml", line=2, column=3, path="/**")
    warnings = [
        Diagnostic(rule=rule, severity=Severity.WARNING, at=at, message="cannot")
        for rule in ("check.parameter-file-unmatched", "check.remap-unused", "check.qos-doubtful")
    ]
    plan = replace(plan_of(), unproven=tuple(warnings))
    found = judged(plan, served(plan))
    assert [each.rule for each in found] == ["param.reached-none", "declaration.unproven"]
    assert {(each.outcome, each.at) for each in found} == {(Outcome.UNVERIFIABLE, "p.yaml:2:3")}


def test_a_finding_names_both_values_and_where_the_demand_comes_from():
    plan = plan_of(
        expected(),
        expected(name="limits", source="default_value"),
        expected(None, "int", name="bogus"),
        expected(".nan", name="unset", source="cfg/arm.yaml"),
    )
    seen = served(
        plan,
        has(99.0),
        replace(has(2.0), name="limits"),
        replace(has(float("inf")), name="unset"),
    )
    messages = "\n".join(each.message for each in judged(plan, seen))
    assert messages == (
        "parameter gain of node /arm is 99.0, and must be double 1.5 as given "
        "under `parameters`\n"
        "parameter limits of node /arm is 2.0, and must be double 1.5 as declared in "
        "its interface, where nothing else is given\n"
        "parameter bogus of node /arm must be int as declared in its interface, and there is no "
        "such parameter\n"
        "parameter unset of node /arm is .inf, and must be double .nan as given in "
        "cfg/arm.yaml"
    )


@pytest.mark.parametrize(
    ("error", "why"),
    [
        ("serves no parameters", "it serves no parameters"),
        ("did not answer", "it did not answer"),
    ],
)
def test_what_a_node_does_not_tell_is_one_unverifiable_finding(error: str, why: str):
    plan = plan_of(*(expected(name=f"p{number}") for number in range(10)))
    seen = replace(
        perfect(plan, Stage.ACTIVE), parameters=(NodeParameters(node="/arm", error=error),)
    )
    (finding,) = judged(plan, seen)
    assert (finding.rule, finding.outcome) == ("param.unverifiable", Outcome.UNVERIFIABLE)
    assert finding.message == (
        "nothing shows parameters p0, p1, p2, p3, p4, p5, p6, p7 and 2 more of node /arm: " + why
    )


def test_a_node_that_nobody_asked_is_unverifiable_and_one_that_is_not_there_is_only_missing():
    plan = plan_of(expected())
    seen = perfect(plan, Stage.ACTIVE)
    assert [each.rule for each in judged(plan, seen)] == ["param.unverifiable"]
    gone = replace(seen, nodes=())
    assert [each.rule for each in judged(plan, gone)] == ["graph.missing-node"]


def reporting(plan: Plan, parameters: tuple[ParameterReport, ...] | None) -> Observation:
    seen = perfect(plan, Stage.ACTIVE)

    def changed(each: NodeConfiguration) -> NodeConfiguration:
        return replace(each, parameters=parameters)

    return replace(seen, configurations=tuple(changed(each) for each in seen.configurations))


def test_nodes_of_ours_are_judged_by_their_report():
    plan = plan_of(expected(), run=Run(kind=RunKind.PYTHON, python="robot:Arm"))
    assert judged(plan, perfect(plan, Stage.ACTIVE)) == ()
    assert [each.rule for each in judged(plan, reporting(plan, (has(2.0),)))] == [
        "param.value-differs"
    ]
    assert [each.rule for each in judged(plan, reporting(plan, ()))] == ["param.missing"]
    # One of another version reports none, and its services are asked.
    assert [each.rule for each in judged(plan, reporting(plan, None))] == ["param.unverifiable"]


def test_a_node_of_ours_without_a_report_has_no_second_finding():
    plan = plan_of(expected(), run=Run(kind=RunKind.PYTHON, python="robot:Arm"))
    seen = replace(perfect(plan, Stage.ACTIVE), configurations=())
    assert [each.rule for each in judged(plan, seen)] == ["config.missing-report"]


@pytest.mark.parametrize(
    ("value", "type_", "text"),
    [
        ("\x1b[31mred\x9b\u202e", "string", r"'\x1b[31mred\x9b\u202e'"),
        ("x" * 100, "string", "'" + "x" * 57 + "…'"),
        ("x" * 58, "string", "'" + "x" * 58 + "'"),
        ("x" * 59, "string", "'" + "x" * 57 + "…'"),
        (tuple(range(20)), "int_array", "[0, 1, 2, 3, 4, 5, 6, 7, … 20 items]"),
        (tuple(range(8)), "int_array", "[0, 1, 2, 3, 4, 5, 6, 7]"),
        (tuple(range(9)), "int_array", "[0, 1, 2, 3, 4, 5, 6, 7, … 9 items]"),
        ((".nan", 1.0, "-.inf"), "double_array", "[.nan, 1.0, -.inf]"),
        ((".nan", "a"), "string_array", "['.nan', 'a']"),
        (True, "bool", "true"),
        (False, "bool", "false"),
        (1.0, "double", "1.0"),
        (".nan", "string", "'.nan'"),
    ],
)
def test_what_a_node_says_is_shown_short_and_without_control_characters(
    value: ParameterValue, type_: str, text: str
):
    assert spell(value, type_) == text


def test_what_cannot_be_read_is_unverifiable():
    plan = plan_of(expected(), unread_parameter_files=("arm.yaml",))
    assert lines(judged(plan, perfect(plan, Stage.ACTIVE))) == [
        "unverifiable param.unverifiable: /arm: arm.yaml, /arm at 3:3",
        "unverifiable param.unverifiable: /arm, /arm at 3:3",
    ]


@pytest.mark.parametrize(
    ("count", "listed"),
    [
        (2, "p0, p1"),
        (8, "p0, p1, p2, p3, p4, p5, p6, p7"),
        (9, "p0, p1, p2, p3, p4, p5, p6, p7 and 1 more"),
    ],
)
def test_at_most_eight_parameters_are_named(count: int, listed: str):
    plan = plan_of(*(expected(name=f"p{number}") for number in range(count)))
    (finding,) = judged(plan, perfect(plan, Stage.ACTIVE))
    assert finding.message == (
        f"nothing shows parameters {listed} of node /arm: they were not read"
    )


OURS = Run(kind=RunKind.PYTHON, python="robot:Arm")


def asked(seen: Observation, **answer: object) -> Observation:
    """What the parameter services say, beside what is in the report."""
    return replace(seen, parameters=(NodeParameters(node="/arm", **answer),))


def test_the_services_of_a_node_of_ours_are_believed_only_where_its_report_has_no_parameters():
    plan = plan_of(expected(), run=OURS)
    assert judged(plan, asked(reporting(plan, (has(1.5),)), parameters=(has(2.0),))) == ()
    (finding,) = judged(plan, asked(reporting(plan, None), parameters=(has(2.0),)))
    assert finding.rule == "param.value-differs"


def test_a_node_of_ours_that_neither_reports_nor_answers_says_why():
    plan = plan_of(expected(), run=OURS)
    seen = replace(perfect(plan, Stage.ACTIVE), configurations=())
    found = judged(plan, asked(seen, error="did not answer"))
    assert [
        (each.rule, each.message) for each in found if each.rule != "config.missing-report"
    ] == [
        (
            "param.unverifiable",
            "nothing shows parameters gain of node /arm: it did not answer",
        )
    ]
