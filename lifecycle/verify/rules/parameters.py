"""Rules about nodes' parameters, about warnings of the manifest, and about simulated time. Pure.

Of what `lifecycle check` warns only that is repeated here which no observation can settle.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from lifecycle.manifest.diagnostics import Diagnostic, Position
from lifecycle.manifest.model import SIM_TIME, EndpointKind, ParameterValue
from lifecycle.manifest.parameter_values import NOT_FINITE, is_implicit
from lifecycle.plan.model import ExpectedParameter, PlannedNode, uses_sim_time
from lifecycle.plan.parameters import COMMAND, DEFAULT, GIVEN
from lifecycle.printable import listed
from lifecycle.verify.observation import SERVES_NONE, ParameterReport
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.catalogue import Heals, Rule
from lifecycle.verify.tool_filter import CLOCK
from lifecycle.verify.verdict import Finding, Stage
from lifecycle.verify.view import NodeFacts, SeenEndpoint, View, Whose

MISSING = Rule(
    id="param.missing",
    meaning="a node does not have a parameter that is declared or given",
    says="{who} must be {expected}, and there is {observed}",
    fix="correct the name, or have the node declare it",
    heals=Heals.WITH_TIME,
)
TYPE_DIFFERS = Rule(
    id="param.type-differs",
    meaning="a parameter has another type than is declared or given",
    fix="correct the declaration, or the node; ROS converts nothing, 1 is no double",
)
VALUE_DIFFERS = Rule(
    id="param.value-differs",
    meaning="a parameter has another value than the manifest gives or declares as its default",
    fix="give the value that is meant, in the manifest or with `ros2 param set`",
)
READ_ONLY_DIFFERS = Rule(
    id="param.read-only-differs",
    meaning="a parameter that is declared read_only can be set while the node runs",
    fix="have the node declare it read-only, or remove read_only from the interface",
)
UNDECLARED = Rule(
    id="param.undeclared",
    meaning="a declared node has parameters that its interface does not declare",
    says="the interface of {who} does not declare {observed}",
    fix="declare them in the node's interface, remove them, or set `endpoints: open` on the node",
)
UNVERIFIABLE = Rule(
    id="param.unverifiable",
    meaning="parameters of a node could not be read, or not what they must be",
    outcomes=(Outcome.UNVERIFIABLE,),
    unproven="nothing shows {expected} of {who}: {observed}",
    fix="see whether `ros2 param list` shows the node's parameters; look at its log",
)
REACHED_NONE = Rule(
    id="param.reached-none",
    meaning="a value that is given for nodes by a name or a pattern is a parameter of none",
    outcomes=(Outcome.UNVERIFIABLE,),
    unproven="no node has parameter {who}, {expected}",
    fix="correct the name of the node or of the parameter, or remove the value",
    heals=Heals.WITH_TIME,
)
_NAMED = 8
_SHOWN_ITEMS = 8
_SHOWN_TEXT = 60


def check(view: View) -> Iterator[Finding]:
    """Judge the parameters of every node, repeat warnings, judge where simulated time is from."""
    for facts in view.nodes.values():
        yield from _judge_node(facts)
    yield from _reached_none(view)
    yield from _warnings(view)
    yield from _time(view)


def _judge_node(facts: NodeFacts) -> Iterator[Finding]:
    node = facts.node
    if facts.absent:
        return
    for file in node.unread_parameter_files:
        yield _unread(node, file)
    if not node.expected_parameters and not node.has_all_parameters:
        return
    known = _known(facts)
    if not isinstance(known, str):
        for expected in node.expected_parameters:
            yield from _judge(node, expected, known.get(expected.name))
        if node.has_all_parameters:
            yield from _undeclared(node, known)
    elif not node.expected_parameters and known == f"it {SERVES_NONE}":
        return  # it has none that anybody could know of, and none are declared
    elif known or facts.configuration is not None or not facts.is_ours:
        # Of a node of ours without a report config.missing-report says it all.
        yield _unknown(node, known or "they were not read")


def _reached_none(view: View) -> Iterator[Finding]:
    """Find values for several nodes, as below `/**`, that none of those has as a parameter."""
    settled = {each.at for each in view.plan.unproven}
    found: dict[Position, tuple[ExpectedParameter, list[str]]] = {}
    for facts in view.nodes.values():
        known = _known(facts)
        for each in facts.node.expected_parameters:
            if not each.optional or each.at in settled:
                continue
            if facts.absent or isinstance(known, str) or each.name in known:
                settled.add(each.at)  # it did, or it is not known, which has its own finding
                found.pop(each.at, None)
            else:
                found.setdefault(each.at, (each, []))[1].append(facts.name)
    for at, (each, nodes) in found.items():
        yield REACHED_NONE.finding(
            subject=each.name,
            expected=f"{_wanted(each)} for {', '.join(nodes[:_NAMED])}",
            observed="no such parameter",
            at=at,
        )


def _known(facts: NodeFacts) -> dict[str, ParameterReport] | str:
    """Return a node's parameters by name; why not if they are not known, empty if not asked."""
    report, read = facts.configuration, facts.parameters
    if report is not None and report.parameters is not None:
        return {each.name: each for each in report.parameters}
    if read is None:
        return ""
    if read.parameters is None:
        return f"it {read.error}"
    return {each.name: each for each in read.parameters}


def _judge(
    node: PlannedNode, expected: ExpectedParameter, actual: ParameterReport | None
) -> Iterator[Finding]:
    place: dict[str, Any] = {
        "subject": f"{node.full_name}: {expected.name}",
        "who": f"parameter {expected.name} of node {node.full_name}",
        "at": expected.at,
        "node": node.full_name,
    }
    wanted = _wanted(expected)
    if actual is None:
        if not expected.optional:
            yield MISSING.finding(**place, expected=wanted, observed="no such parameter")
        return
    if not _is_of_type(actual, expected.type):
        yield TYPE_DIFFERS.finding(**place, expected=wanted, observed=_with_type(actual))
    elif expected.value is not None and not actual.has(expected.value):
        yield VALUE_DIFFERS.finding(
            **place,
            expected=wanted,
            observed=_value_of(actual),
            hint="give the value that is meant under `parameters`, or correct the default"
            if expected.source == DEFAULT
            else "",
        )
    if expected.read_only and not actual.read_only:
        yield READ_ONLY_DIFFERS.finding(
            **place, expected="read_only, as its interface declares it", observed="not read_only"
        )


def _undeclared(node: PlannedNode, known: Mapping[str, ParameterReport]) -> Iterator[Finding]:
    declared = {each.name for each in node.expected_parameters}
    # One that has never been set has a name and nothing else to declare.
    names = sorted(
        name
        for name, each in known.items()
        if name not in declared and not is_implicit(name) and each.type
    )
    if names:
        yield UNDECLARED.on(
            node,
            expected="no such parameter",
            observed=listed([f"{name} ({known[name].type})" for name in names], _NAMED),
        )


def _unknown(node: PlannedNode, why: str) -> Finding:
    names = [each.name for each in node.expected_parameters]
    return UNVERIFIABLE.on(
        node,
        expected=f"parameters {listed(names, _NAMED)}" if names else "that there are no parameters",
        observed=why,
    )


def _unread(node: PlannedNode, file: str) -> Finding:
    return UNVERIFIABLE.on(
        node,
        subject=f"{node.full_name}: {file}",
        expected=f"the parameters that {file} gives",
        observed="it could not be read",
        hint="lifecycle check says what keeps it from being read",
    )


def _origin(expected: ExpectedParameter) -> str:
    """Return where the demand comes from."""
    if not expected.source:
        return "declared in its interface"
    if expected.source == DEFAULT:
        return "declared in its interface, where nothing else is given"
    if expected.source == COMMAND:
        return "given in its `command`"
    if expected.source == GIVEN:
        return "given under `parameters`"
    return f"given in {expected.source}"


def _wanted(expected: ExpectedParameter) -> str:
    """Return what is demanded, and by whom."""
    value = "" if expected.value is None else f" {spell(expected.value, expected.type)}"
    return f"{expected.type}{value} as {_origin(expected)}"


def _is_of_type(actual: ParameterReport, type_: str) -> bool:
    if type_ == "array":
        return actual.type.endswith("_array")
    return actual.type == type_


def _with_type(actual: ParameterReport) -> str:
    if not actual.type:
        return "not set"
    article = "an" if actual.type[0] in "ai" else "a"
    return f"{article} {actual.type}, {_value_of(actual)}"


def _value_of(actual: ParameterReport) -> str:
    if actual.digest:
        return f"too long to show (SHA-256 {actual.digest[:16]!r}…)"
    return "not set" if actual.value is None else spell(actual.value, actual.type)


def spell(value: ParameterValue, type_: str) -> str:
    """Return a value for people, short and without a character that a terminal would obey."""
    if isinstance(value, tuple):
        shown = ", ".join(spell(each, type_) for each in value[:_SHOWN_ITEMS])
        more = f", … {len(value)} items" if len(value) > _SHOWN_ITEMS else ""
        return f"[{shown}{more}]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if value in NOT_FINITE and type_.startswith("double"):
        return str(value)
    spelled = repr(value)
    if len(spelled) > _SHOWN_TEXT:
        return f"{spelled[: _SHOWN_TEXT - 2]}…{spelled[-1]}"
    return spelled


UNPROVEN = Rule(
    id="declaration.unproven",
    meaning="`lifecycle check` warns of something that is declared and that nothing can prove",
    outcomes=(Outcome.UNVERIFIABLE,),
    fix="see what `lifecycle check` says of it",
)


_NO_NODE = frozenset(
    (
        "check.parameter-file-unmatched",
        "check.parameter-undeclared",
        "check.parameter-for-no-node",
    )
)
_JUDGED = frozenset(
    (
        *("check.qos-doubtful", "check.type-not-installed", "check.parameter-empty-array"),
        *("check.flow-foreign", "check.flow-transport"),
        "yaml.tag",
    )
)
"""Rules of `check` whose matter is judged where the system runs, by the rule that is about it."""


def _warnings(view: View) -> Iterator[Finding]:
    """Repeat the warnings that stay true whatever is seen."""
    for each in view.plan.unproven:
        if each.rule not in _JUDGED:
            yield _of_warning(each)


def _of_warning(warning: Diagnostic) -> Finding:
    rule = REACHED_NONE if warning.rule in _NO_NODE else UNPROVEN
    return rule.finding(
        subject=warning.at.path or warning.at.file,
        expected="no warning",
        observed=warning.rule,
        message=warning.message,
        at=warning.at,
        hint=warning.hint,
    )


NO_CLOCK = Rule(
    id="time.no-clock",
    meaning="nodes use simulated time, and nobody publishes /clock",
    says="there is no time for {who}: {observed}",
    fix="start the simulator or the bag (`ros2 bag play --clock`), or set use_sim_time: false",
    heals=Heals.WITH_TIME,
)
SEVERAL_CLOCKS = Rule(
    id="time.several-clocks",
    meaning="nodes use simulated time, and /clock has more than one publisher",
    says="{who} must have {expected} of their time, and have {observed}",
    fix="stop all but one: each makes time jump to its own",
)
UNDECLARED_CLOCK = Rule(
    id="time.undeclared-clock",
    meaning="nodes use simulated time, and who publishes /clock is not declared to",
    outcomes=(Outcome.UNVERIFIABLE,),
    unproven="{who} have their time from {observed}, which is no {expected}",
    fix="declare the publisher of /clock, rosgraph_msgs/msg/Clock, in the node that has it",
)
SILENT_CLOCK = Rule(
    id="time.silent-clock",
    meaning="nodes use simulated time, and the publisher of /clock has not sent any yet",
    outcomes=(Outcome.UNVERIFIABLE,),
    unproven="there is no time yet for {who}: {observed}",
    fix="see whether the simulator runs, or is paused before its first step",
    heals=Heals.WITH_TIME,
)
RULES = (
    *(MISSING, UNDECLARED, TYPE_DIFFERS, VALUE_DIFFERS, READ_ONLY_DIFFERS),
    *(UNVERIFIABLE, REACHED_NONE),
    UNPROVEN,
    *(NO_CLOCK, SEVERAL_CLOCKS, UNDECLARED_CLOCK, SILENT_CLOCK),
)


def _time(view: View) -> Iterator[Finding]:
    """Judge where the time of nodes with `use_sim_time` comes from."""
    users = [node for node in view.plan.nodes if _uses(view, node)]
    if not users:
        return
    topic, type_ = CLOCK
    ends, _ = view.topics.get(topic, ((), ()))
    publishers = [
        each
        for each in ends
        if each.type == type_ and each.is_shown and each.whose is not Whose.DEPARTED
    ]
    if len(publishers) > 1:
        owners = ", ".join(sorted(each.node or "an unknown node" for each in publishers))
        yield SEVERAL_CLOCKS.finding(
            **_place(users),
            expected="one publisher",
            observed=f"{len(publishers)} publishers of {topic}: {owners}",
        )
    elif not publishers:
        # Of a declared one that is missing, or cannot be seen from here, there is a finding.
        if not any(_publishes(node) for node in view.plan.nodes):
            yield NO_CLOCK.finding(
                **_place(users),
                expected=f"publisher of {type_}",
                observed=f"nothing publishes {topic}",
            )
    else:
        yield from _of_one(view, users, publishers[0])


def _of_one(view: View, users: list[PlannedNode], publisher: SeenEndpoint) -> Iterator[Finding]:
    who = publisher.node or "an unknown node"
    if publisher.planned is None:
        yield UNDECLARED_CLOCK.finding(
            **_place(users),
            expected="declared publisher",
            observed=f"the publisher of {publisher.name} in {who}",
        )
    # A managed publisher sends once it is active.
    seen = publisher.observed
    if seen is not None and seen.silent and view.stage is Stage.ACTIVE:
        yield SILENT_CLOCK.finding(
            **_place(users),
            expected="time",
            observed=f"{who} has not sent any on {publisher.name}",
        )


def _uses(view: View, node: PlannedNode) -> bool:
    configuration = view.configurations.get(node.full_name)
    reported = (configuration.parameters if configuration is not None else None) or ()
    return uses_sim_time(node) or any(
        each.name == SIM_TIME and each.value is True for each in reported
    )


def _publishes(node: PlannedNode) -> bool:
    return any(
        (each.kind, each.resolved, each.type) == (EndpointKind.PUBLISHER, *CLOCK)
        for each in node.endpoints
    )


def _place(users: list[PlannedNode]) -> dict[str, Any]:
    """Return what findings are about, and where the first of the nodes is given its time."""
    given = next(
        (each.at for node in users for each in node.expected_parameters if each.name == SIM_TIME),
        users[0].at,
    )
    who = listed([each.full_name for each in users], 4)
    return {"subject": CLOCK[0], "who": who, "at": given, "endpoint": EndpointKind.PUBLISHER}
