"""What becomes of a running system's nodes with another plan."""

from __future__ import annotations

from typing import Any

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import (
    Condition,
    Consequence,
    EndpointKind,
    EndpointPolicy,
    Interface,
    Node,
    ParameterDeclaration,
    Policy,
    Quantity,
    Reaction,
    Restart,
    Run,
    RunKind,
    Supervision,
    TargetState,
)
from lifecycle.manifest.qos import QosProfile
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.plan.comparison import GivenParameters, PlanChange, change_between
from tests.builders import at, link, need, node, planned, publisher, subscription

COMMAND = Run(kind=RunKind.COMMAND, command=("arm", "--fast"))
ATTACH = Run(kind=RunKind.ATTACH)
TALKER = node("talker", publisher("chatter"))
LISTENER = node("listener", subscription("chatter"))


def _change(old: tuple[Node, ...], new: tuple[Node, ...], **rest: Any) -> PlanChange:
    return change_between(planned(*old), planned(*new, **rest))


def _talker(**changes: Any) -> tuple[Node, ...]:
    return (replace(TALKER, **changes), LISTENER)


BEFORE = (TALKER, LISTENER)
DELAY = Quantity(name="max_delay_ms", value=5.0, at=at(1))


def test_nodes_of_one_manifest_alone_come_and_go_and_all_else_stays() -> None:
    change = _change(BEFORE, (LISTENER, node("arm")))
    assert (change.added, change.removed, change.restarted) == (("arm",), ("talker",), ())
    assert _change(BEFORE, (LISTENER, TALKER)) == PlanChange(differences=())


@pytest.mark.parametrize(
    "changes",
    [
        {"run": Run(kind=RunKind.PYTHON, python="robot:Other")},
        {"run": replace(TALKER.run, environment={"RATE": "1"})},
        {"run": COMMAND},
        {"run": ATTACH},
        {"remap": (("chatter", "noise"),)},
        {"namespace": "/left"},
        {"name": "speaker"},
        {"log_level": "debug"},
        {"process": "shared"},
        {"state": TargetState.UNCONFIGURED},
        {"interface": Interface(endpoints=(publisher("chatter", qos=QosProfile(depth=3)),))},
        {"interface": Interface(endpoints=(publisher("chatter"), publisher("more")))},
        {"flows": (need(EndpointKind.PUBLISHER, "chatter", dscp=46),)},
        {"flows": (need(EndpointKind.PUBLISHER, "chatter", UniqueRequirement.STRICTLY_REQUIRED),)},
        {
            "interface": Interface(
                endpoints=TALKER.interface.endpoints,
                parameters=(ParameterDeclaration(name="rate", type="int", default=1, at=at(1)),),
            )
        },
    ],
    ids="-".join,
)
def test_what_reaches_a_process_restarts_it_alone(changes: dict[str, Any]) -> None:
    change = _change(BEFORE, _talker(**changes))
    assert (change.added, change.removed, change.restarted) == ((), (), ("talker",))
    assert not change.parameters
    assert change.differences


@pytest.mark.parametrize(
    "changes",
    [
        {"at": at(99), "interface": Interface(endpoints=(publisher("chatter", line=98),))},
        {"supervision": Supervision(restart=Restart.ALWAYS)},
        {"on_violation": (Reaction(rule="flow", what=Consequence.STOP),)},
        {"may_end": True},
        {"state": TargetState.INACTIVE},
        {"flows": (need(EndpointKind.PUBLISHER, "chatter", quantities=(DELAY,)),)},
    ],
    ids="-".join,
)
def test_what_is_only_judged_by_touches_no_node(changes: dict[str, Any]) -> None:
    change = _change(BEFORE, _talker(**changes))
    assert not change.parameters
    assert bool(change.differences) is ("at" not in changes)


def test_another_treatment_of_a_flow_by_the_network_touches_no_node() -> None:
    asked = [Quantity(name="five_qi", value=each, at=at(1)) for each in (85, 82)]
    qi = [
        (need(EndpointKind.PUBLISHER, "chatter", five_qi=int(each.value), quantities=(each,)),)
        for each in asked
    ]
    change = _change(_talker(flows=qi[0]), _talker(flows=qi[1]))
    assert change.differences


def test_neither_do_rules_of_the_system_and_who_waits_for_whom() -> None:
    rules = {
        "policy": Policy(undeclared_nodes=EndpointPolicy.OPEN),
        "links": [link("/chatter", "talker", "listener", max_delay_ms=5.0)],
    }
    waiting = node("listener", subscription("chatter"), after=[("talker", Condition.ACTIVE)])
    change = _change(BEFORE, (TALKER, waiting), **rules)
    assert len(change.differences) == 3


def _with(run: Run | None = None, **values: Any) -> tuple[Node, ...]:
    declared = (
        ParameterDeclaration(name="rate", type="double", default=1.0, at=at(5)),
        ParameterDeclaration(name="id", type="int", default=1, read_only=True, at=at(5)),
        ParameterDeclaration(name="label", type="string", at=at(5)),
    )
    arm = node("arm", run=run or COMMAND, parameters=tuple(values.items()))
    return (replace(arm, interface=Interface(parameters=declared)), LISTENER)


def test_values_of_parameters_are_set_while_the_node_runs() -> None:
    for run in (COMMAND, None, Run(kind=RunKind.PYTHON, python="robot:Arm")):
        change = _change(_with(run), _with(run, rate=2.0))
        given = GivenParameters(before={"rate": 1.0}, now={"rate": 2.0}, types={"rate": "double"})
        assert change.parameters == {"arm": given}
    change = _change(_with(label="a", rate=3.0), _with(label="b"))
    given = change.parameters["arm"]
    assert (given.before, given.now) == ({"rate": 3.0, "label": "a"}, {"rate": 1.0, "label": "b"})


@pytest.mark.parametrize(
    ("before", "now"),
    [({}, {"id": 2}), ({}, {"label": "a"}), ({"label": "a"}, {}), ({}, {"other": 1})],
)
def test_parameters_that_cannot_be_set_restart_their_node(
    before: dict[str, Any], now: dict[str, Any]
) -> None:
    change = _change(_with(**before), _with(**now))
    assert (change.restarted, change.parameters) == (("arm",), {})


def test_a_process_is_restarted_as_a_whole_and_so_is_who_moves_into_it() -> None:
    pair = tuple(replace(each, process="both") for each in BEFORE)
    louder = (replace(pair[0], log_level="debug"), pair[1], node("arm"))
    change = _change((*pair, node("arm")), louder)
    assert change.restarted == ("talker", "listener")
    more = replace(node("arm"), process="both")
    assert _change((*pair,), (*pair, more)).restarted == ("talker", "listener")
    assert _change((*pair, node("arm")), (*pair, more)).restarted == ("talker", "listener", "arm")
    assert _change((*pair, more), pair).restarted == ("talker", "listener")


def test_a_component_goes_with_its_container() -> None:
    loaded = Run(kind=RunKind.ATTACH, component="demo/Arm", container="box")
    box = node("box", run=COMMAND)
    other = node("box", run=replace(COMMAND, command=("arm", "--slow")))
    arm = node("arm", run=loaded)
    assert _change((box, arm), (other, arm)).restarted == ("box", "arm")
    moved = replace(arm, remap=(("a", "b"),))
    assert _change((box, arm), (box, moved)).restarted == ("arm",)


def test_what_others_run_is_only_judged_by() -> None:
    attached = node("arm", publisher("a"), run=ATTACH)
    changed = node("arm", publisher("a", qos=QosProfile(depth=3)), run=ATTACH)
    change = _change((attached,), (changed,))
    assert change.differences
