"""Rules about simulated time: who publishes /clock for nodes with `use_sim_time`. Pure."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from lifecycle.manifest.model import SIM_TIME, EndpointKind
from lifecycle.plan.model import PlannedNode, uses_sim_time
from lifecycle.verify.observation import ObservedEndpoint
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.catalogue import Heals, Rule
from lifecycle.verify.tool_filter import CLOCK
from lifecycle.verify.verdict import Finding, Stage
from lifecycle.verify.view import View

NO_CLOCK = Rule(
    id="time.no-clock",
    meaning="nodes use simulated time, and nobody publishes /clock",
    fix="start the simulator or the bag (`ros2 bag play --clock`), or set use_sim_time: false",
    heals=Heals.WITH_TIME,
    absence="publisher of simulated time",
)
SEVERAL_CLOCKS = Rule(
    id="time.several-clocks",
    meaning="nodes use simulated time, and /clock has more than one publisher",
    fix="stop all but one: each makes time jump to its own",
)
UNDECLARED_CLOCK = Rule(
    id="time.undeclared-clock",
    meaning="nodes use simulated time, and who publishes /clock is not declared to",
    outcomes=(Outcome.UNVERIFIABLE,),
    fix="declare the publisher of /clock, rosgraph_msgs/msg/Clock, in the node that has it",
)
SILENT_CLOCK = Rule(
    id="time.silent-clock",
    meaning="nodes use simulated time, and the publisher of /clock has not sent any yet",
    outcomes=(Outcome.UNVERIFIABLE,),
    fix="see whether the simulator runs, or is paused before its first step",
    heals=Heals.WITH_TIME,
)
RULES = (NO_CLOCK, SEVERAL_CLOCKS, UNDECLARED_CLOCK, SILENT_CLOCK)


def check(view: View) -> Iterator[Finding]:
    """Judge where the time of nodes with `use_sim_time` comes from."""
    users = [node for node in view.plan.nodes if _uses(view, node)]
    if not users:
        return
    topic, type_ = CLOCK
    publishers = [
        each
        for group in view.groups.values()
        for each in group
        if (each.kind, each.name, each.type) == (EndpointKind.PUBLISHER, topic, type_)
    ]
    if len(publishers) > 1:
        owners = ", ".join(sorted(each.node or "an unknown node" for each in publishers))
        yield SEVERAL_CLOCKS.finding(
            **_place(users),
            expected="one publisher",
            observed=f"{len(publishers)} publishers",
            message=f"several nodes give {_named(users)} their time: {owners} publish {topic}",
        )
    elif not publishers:
        # Of a declared one that is missing, or cannot be seen from here, there is a finding.
        if not any(_publishes(node) for node in view.plan.nodes):
            yield NO_CLOCK.finding(
                **_place(users),
                expected=f"publisher of {type_}",
                observed="no publisher",
                message=f"there is no simulated time for {_named(users)}:"
                f" nothing publishes {topic}",
            )
    else:
        yield from _of_one(view, users, publishers[0])


def _of_one(view: View, users: list[PlannedNode], publisher: ObservedEndpoint) -> Iterator[Finding]:
    who = publisher.node or "an unknown node"
    if (publisher.node, publisher.kind, publisher.name) not in view.names.ends:
        yield UNDECLARED_CLOCK.finding(
            **_place(users),
            expected="declared publisher",
            observed=f"publisher of {who}",
            message=f"{who} gives {_named(users)} their time on {publisher.name},"
            " and the manifest does not declare it",
        )
    # A managed publisher sends once it is active.
    if publisher.silent and view.stage is Stage.ACTIVE:
        yield SILENT_CLOCK.finding(
            **_place(users),
            expected="time",
            observed="no message",
            message=f"there is no time yet for {_named(users)}:"
            f" {who} has not sent any on {publisher.name}",
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


def _named(users: list[PlannedNode]) -> str:
    names = [each.full_name for each in users]
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more


_NAMED = 4


def _place(users: list[PlannedNode]) -> dict[str, Any]:
    """Return what findings are about, and where the first of the nodes is given its time."""
    given = next(
        (each.at for node in users for each in node.expected_parameters if each.name == SIM_TIME),
        users[0].at,
    )
    return {"subject": CLOCK[0], "at": given, "endpoint": EndpointKind.PUBLISHER}
