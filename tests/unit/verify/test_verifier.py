"""A judge that keeps what has not changed says what one says that looks for the first time."""

from __future__ import annotations

import copy
import dataclasses
import functools
import random
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from lifecycle.manifest import load
from lifecycle.manifest.model import EndpointKind, EndpointPolicy, Policy
from lifecycle.manifest.qos import PRESETS, Reliability
from lifecycle.plan import Plan, build_plan
from lifecycle.verify import (
    EndpointReport,
    NodeConfiguration,
    Observation,
    ObservedEndpoint,
    ObservedNode,
    Stage,
    Verdict,
    Verifier,
    verify,
)
from lifecycle.verify.observation import ConnectionReport, NodeParameters, ParameterReport
from tests.unit.verify.perfect import perfect
from tests.unit.verify.test_verify_properties import TYPES, systems

_ROOT = Path(__file__).parents[3]
_MANIFESTS = (
    *sorted(str(each) for each in (_ROOT / "manifests").glob("*.lifecycle.yaml")),
    *(
        str(_ROOT / f"tests/corpus/valid/{each}.lifecycle.yaml")
        for each in (
            "attach_in_run",
            "check_open_systems_only_warn",
            "connections_of_every_transport",
            "data_layer_negotiated",
            "discovery_static_endpoints",
            "flows_every_key",
            "groups",
            "qos",
        )
    ),
)
"""Connections, shared memory alone, static discovery, links, parameters, machines, open nodes."""

_NOBODY = ("", "_NODE_NAME_UNKNOWN_", "/_ros2cli_1", "/rviz", "/stranger", "/_stranger_flow_0")
_HASHES = (None, "", "RIHS01_a", "RIHS01_b")
_STATES = (None, "", "unconfigured", "inactive", "activating", "active", "finalized")


@functools.cache
def _loaded(path: str) -> Plan:
    return build_plan(load(path).manifest, environment={})


@st.composite
def plans(draw: st.DrawFn) -> Plan:
    """A system made up or one of the manifests, with a policy of its own and installed types."""
    plan = draw(st.sampled_from(_MANIFESTS).map(_loaded) | systems())
    policies = st.sampled_from(EndpointPolicy)
    hashes = st.sampled_from(["", "RIHS01_a"])
    policy = Policy(
        undeclared_nodes=draw(policies),
        tolerated_nodes=draw(st.sampled_from([Policy().tolerated_nodes, (), ("/stran*", "rviz")])),
        unverifiable_blocks=draw(st.booleans()),
    )
    open_, type_hash = draw(policies), draw(hashes)
    nodes = tuple(
        dataclasses.replace(
            node,
            endpoint_policy=open_,
            endpoints=tuple(
                dataclasses.replace(each, type_hash=type_hash) for each in node.endpoints
            ),
        )
        for node in plan.nodes
    )
    return dataclasses.replace(plan, policy=policy, nodes=nodes)


class Moments:
    """What is seen of one system, moment after moment."""

    def __init__(self, plan: Plan, chance: random.Random) -> None:
        self.names = [each.full_name for each in plan.nodes]
        self.chance = chance
        self.first = self.seen = perfect(plan, chance.choice(tuple(Stage)))

    def step(self) -> None:
        """Have one thing change: discovery, a report, a process, or nothing but the order."""
        self.chance.choice(
            (
                *(functools.partial(self._part, field) for field in _PARTS),
                functools.partial(self._part, "endpoints"),
                functools.partial(self._part, "configurations"),
                self._process,
                self._order,
                self._same_again,
            )
        )()

    def _put(self, field: str, parts: Sequence[Any]) -> None:
        self.seen = dataclasses.replace(self.seen, **{field: tuple(parts)})

    def _part(self, field: str) -> None:
        parts = list(getattr(self.seen, field))
        how = self.chance.choice(("gone", "new", "twice", "other", "other", "other", "back"))
        place = self.chance.randrange(len(parts)) if parts else 0
        if how == "new":
            parts.insert(place, _NEW[field](self))
        elif how == "back" or not parts:
            parts = list(getattr(self.first, field))
        elif how == "gone":
            del parts[place]
        elif how == "twice":
            parts.append(parts[place])
        else:
            fields = _PARTS[field](self, parts[place])
            name = self.chance.choice(sorted(fields))
            parts[place] = dataclasses.replace(parts[place], **{name: fields[name]})
        self._put(field, parts)

    def _process(self) -> None:
        """All of a node goes, or comes back."""
        name = self.chance.choice(self.names)
        there = any(each.full_name == name for each in self.seen.nodes)
        for field, key in _OWNERS.items():
            now, first = getattr(self.seen, field), getattr(self.first, field)
            others = [each for each in now if getattr(each, key) != name]
            back = [] if there else [each for each in first if getattr(each, key) == name]
            self._put(field, [*others, *back])

    def _order(self) -> None:
        field = self.chance.choice(tuple(_PARTS))
        parts = list(getattr(self.seen, field))
        self.chance.shuffle(parts)
        self._put(field, parts)

    def _same_again(self) -> None:
        """Everything is read anew, and equal."""
        for field in _PARTS:
            self._put(field, [copy.deepcopy(each) for each in getattr(self.seen, field)])

    # -- parts, and what else they may be

    def node_name(self) -> str:
        return self.chance.choice((*self.names, *_NOBODY))

    def endpoint_name(self) -> str:
        names = sorted({each.name for each in self.first.endpoints})
        return self.chance.choice(
            (*names, "/another", "/n0/get_parameters", "/rosout", "/dock/_action/feedback")
        )

    def type_name(self) -> str:
        types = sorted({each.type for each in self.first.endpoints})
        return self.chance.choice((*TYPES.values(), *types, ""))

    def gid(self) -> str:
        gids = [each.gid for each in self.first.endpoints if each.gid]
        return self.chance.choice((*gids, "", f"010f{self.chance.randrange(4):028x}"))

    def qos(self) -> Any:
        return self.chance.choice(
            (
                None,
                *(PRESETS[name] for name in ("default", "sensor_data")),
                dataclasses.replace(PRESETS["default"], reliability=Reliability.UNKNOWN),
            )
        )

    def other_node(self, _: ObservedNode) -> dict[str, object]:
        return {
            "count": self.chance.choice((1, 1, 2)),
            "state": self.chance.choice(_STATES),
            "managed": self.chance.choice((None, False, True)),
            "full_name": self.node_name() or "/stranger",
        }

    def other_endpoint(self, part: ObservedEndpoint) -> dict[str, object]:
        return {
            "type": self.type_name(),
            "type_hash": self.chance.choice(_HASHES),
            "node": self.node_name(),
            "name": self.endpoint_name(),
            "kind": self.chance.choice(tuple(EndpointKind)),
            "qos": self.qos() if part.kind.is_topic else None,
            "gid": self.gid(),
            "address": self.chance.choice(("", "10.0.0.1")),
        }

    def other_configuration(self, part: NodeConfiguration) -> dict[str, object]:
        identity = part.identity
        reports = list(part.endpoints)
        if reports:
            place = self.chance.randrange(len(reports))
            how = self.chance.choice(("gone", "twice", "other", "other", "other", "other"))
            if how == "gone":
                del reports[place]
            elif how == "twice":
                reports.append(reports[place])
            else:
                fields = self._other_report(reports[place])
                name = self.chance.choice(sorted(fields))
                reports[place] = dataclasses.replace(reports[place], **{name: fields[name]})
        changed = {
            "identity": dataclasses.replace(
                identity,
                machine_id=self.chance.choice((identity.machine_id, "machine-other")),
                process_id=self.chance.choice((identity.process_id, 1)),
            ),
            "state": self.chance.choice(_STATES[1:]),
            "connected": not part.connected,
            "name": self.node_name() or "/stranger",
            "connections": self._connections(part),
            "parameters": self._parameters(),
        }
        # What a node has of endpoints is most of what is judged of it.
        return {**changed, **({} if self.chance.random() < 0.3 else {"endpoints": tuple(reports)})}

    def _other_report(self, report: EndpointReport) -> dict[str, object]:
        nfes = report.nfes or ()
        port = self.chance.choice((0, 7411, 7413, 40000))
        return {
            "matched": self.chance.choice((None, 0, 1, 2)),
            "peers": self.chance.choice((None, (), (self.gid(),), (self.gid(), self.gid()))),
            "server_matched": self.chance.choice((None, False, True)),
            "error": self.chance.choice(("", "refused")),
            "mapped": not report.mapped,
            "resolved": self.chance.choice((report.resolved, "/elsewhere")),
            "aliases": self.chance.choice(((), ("/alias",), (report.resolved,))),
            "type": self.type_name(),
            "type_hash": self.chance.choice(_HASHES),
            "gid": self.gid(),
            "qos": self.qos(),
            "dscp": self.chance.choice((None, 0, 46)),
            "connection": self.chance.choice(("", "radio")),
            "nfes": self.chance.choice(
                (None, (), tuple(dataclasses.replace(each, transport_port=port) for each in nfes))
            ),
        }

    def _connections(self, part: NodeConfiguration) -> tuple[ConnectionReport, ...]:
        return tuple(
            dataclasses.replace(
                each,
                urls=self.chance.choice((each.urls, (), ("udpv4:10.0.0.9:9999",))),
                established=self.chance.choice((True, False)),
                error=self.chance.choice(("", "no route")),
            )
            for each in part.connections
            if self.chance.random() < 0.9
        )

    def _parameters(self) -> tuple[ParameterReport, ...] | None:
        known = sorted(
            {each.name for one in self.first.configurations for each in one.parameters or ()}
        )
        values = tuple(
            ParameterReport(name=each, type="integer", value=self.chance.choice((0, 1)))
            for each in known
            if self.chance.random() < 0.9
        )
        return self.chance.choice((None, values))

    def other_parameters(self, _: NodeParameters) -> dict[str, object]:
        return {
            "node": self.chance.choice(self.names),
            "parameters": self._parameters(),
            "error": self.chance.choice(("", "no answer")),
        }

    def new_node(self) -> ObservedNode:
        return ObservedNode(full_name=self.node_name() or "/stranger")

    def new_endpoint(self) -> ObservedEndpoint:
        kind = self.chance.choice(tuple(EndpointKind))
        return ObservedEndpoint(
            kind=kind,
            node=self.node_name(),
            name=self.endpoint_name(),
            type=self.chance.choice((TYPES[kind], self.type_name())),
            gid=self.gid(),
        )

    def new_configuration(self) -> NodeConfiguration:
        known = self.first.configurations
        if not known:
            return perfect(_loaded(_MANIFESTS[0])).configurations[0]
        each = self.chance.choice(known)
        return dataclasses.replace(each, identity=dataclasses.replace(each.identity, process_id=7))

    def new_parameters(self) -> NodeParameters:
        return NodeParameters(node=self.chance.choice(self.names), parameters=self._parameters())


_PARTS: dict[str, Callable[[Moments, Any], dict[str, object]]] = {
    "nodes": Moments.other_node,
    "endpoints": Moments.other_endpoint,
    "configurations": Moments.other_configuration,
    "parameters": Moments.other_parameters,
}
_NEW: dict[str, Callable[[Moments], object]] = {
    "nodes": Moments.new_node,
    "endpoints": Moments.new_endpoint,
    "configurations": Moments.new_configuration,
    "parameters": Moments.new_parameters,
}
_OWNERS = {"nodes": "full_name", "endpoints": "node", "configurations": "name"}


class Terms:
    """What a system is judged against, which changes now and then."""

    def __init__(self, plan: Plan, chance: random.Random) -> None:
        self.plan = plan
        self.chance = chance
        self.names = [each.full_name for each in plan.nodes]
        self.change()

    def change(self) -> None:
        choice = self.chance.choice
        machines = sorted({each.machine for each in self.plan.nodes})
        self.rest: dict[str, Any] = {
            "stage": choice(tuple(Stage)),
            "machines": choice((None, None, frozenset(), frozenset(machines[:1]))),
            "ahead": choice((frozenset(), frozenset({choice(self.names)}))),
            "over": choice(({}, {choice(self.names): "exit code 0"})),
        }

    def judged(self, judge: Callable[..., Verdict], seen: Observation) -> Verdict:
        return judge(self.plan, seen, **self.rest)


def anew(seen: Observation) -> Observation:
    """Return the same facts, no object of which was ever judged."""
    return Observation(
        **{name: tuple(copy.deepcopy(each) for each in getattr(seen, name)) for name in _PARTS}
    )


@settings(max_examples=120, deadline=None)
@given(st.lists(plans(), min_size=1, max_size=2), st.randoms(use_true_random=False))
def test_what_is_judged_again_and_again_is_judged_as_at_first_sight(
    several: list[Plan], chance: random.Random
):
    """The same findings in the same order, whatever changed in between and was kept of it."""
    verifier = Verifier()
    systems_ = [(Terms(plan, chance), Moments(plan, chance)) for plan in several]
    for _ in range(chance.randint(2, 10)):
        terms, moments = chance.choice(systems_)
        assert terms.judged(verifier.verify, moments.seen) == terms.judged(
            verify, anew(moments.seen)
        )
        for _ in range(chance.randint(0, 3)):
            moments.step()
        if chance.random() < 0.15:
            terms.change()
