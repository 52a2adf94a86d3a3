"""A judge that keeps what has not changed says what one says that looks for the first time."""

from __future__ import annotations

import copy
import dataclasses
import functools
import random
from collections.abc import Callable, Iterator, Sequence
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
from lifecycle.verify.tool_filter import NODE_SERVICES, OUR_SERVICES
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
_BESIDE = "_radio"
"""A hidden node that a node may report as its own."""
_MADE = (
    (EndpointKind.SERVICE_SERVER, "get_configuration", OUR_SERVICES["get_configuration"]),
    (EndpointKind.SERVICE_SERVER, "get_parameters", NODE_SERVICES["get_parameters"]),
    (EndpointKind.SERVICE_SERVER, "get_parameters", "robot/srv/Other"),
    (EndpointKind.PUBLISHER, "transition_event", "lifecycle_msgs/msg/TransitionEvent"),
)
_HASHES = (None, "", "RIHS01_a", "RIHS01_b")
_STATES = (None, "", "unconfigured", "inactive", "activating", "active", "finalized")


@functools.cache
def _loaded(path: str) -> Plan:
    return build_plan(load(path).manifest, environment={})


@st.composite
def plans(draw: st.DrawFn) -> Plan:
    """A system made up or one of the manifests, with a policy of its own and installed types."""
    made = st.sampled_from(_MANIFESTS).map(_loaded)
    plan = draw(made | made | systems())
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
    """What is seen of one system, moment after moment; each part of it is an object of its own."""

    def __init__(self, plan: Plan, chance: random.Random) -> None:
        self.names = [each.full_name for each in plan.nodes]
        self.chance = chance
        self.first = perfect(plan, chance.choice(tuple(Stage)))
        if chance.random() < 0.5:
            self.first = _counting(self.first)
        self.reports = [one for each in self.first.configurations for one in each.endpoints]
        if chance.random() < 0.3:
            self.first = _asked_for_parameters(self.first)
        self.seen = self.first

    def step(self) -> None:
        """Have one thing change: discovery, a report, a process, or nothing but the order."""
        part = functools.partial
        self.chance.choice(
            (
                *(part(self._part, field) for field in (*_PARTS, "endpoints", "configurations")),
                *(self._process, self._outsider, self._outsider, self._shared_socket),
                *(self._made, self._beside),
                *(self._order, self._same_again),
            )
        )()

    def _put(self, field: str, parts: Sequence[Any]) -> None:
        self.seen = dataclasses.replace(self.seen, **{field: tuple(parts)})

    def _part(self, field: str) -> None:
        parts = list(getattr(self.seen, field))
        how = self.chance.choice(("gone", "new", "twice", "other", "other", "other", "back"))
        place = self.chance.randrange(len(parts)) if parts else 0
        if how == "new":
            parts.insert(place, copy.deepcopy(_NEW[field](self)))
        elif how == "back" or not parts:
            parts = list(getattr(self.first, field))
        elif how == "gone":
            del parts[place]
        elif how == "twice":
            parts.append(copy.deepcopy(parts[place]))
        else:
            fields = _PARTS[field](self, parts[place])
            name = self.chance.choice(sorted(fields))
            parts[place] = copy.deepcopy(dataclasses.replace(parts[place], **{name: fields[name]}))
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

    def _outsider(self) -> None:
        """Somebody else has what a declared endpoint has, and whom it is matched with counts it."""
        topical = [each for each in self.first.endpoints if each.kind.is_topic]
        if not topical:
            return
        known = self.chance.choice(topical)
        gid = f"010f{self.chance.randrange(1 << 16):028x}"
        other = dataclasses.replace(known, node=self.chance.choice(_NOBODY), gid=gid)
        self._put("endpoints", (*self.seen.endpoints, other))
        if self.chance.random() < 0.5:
            self._change_reports(
                lambda each: each.resolved == known.name and each.kind is not known.kind,
                lambda each: {"matched": (each.matched or 0) + 1, "peers": None},
            )

    def _made(self) -> None:
        """A node has an endpoint that client libraries make, or ours."""
        name = self.chance.choice(self.names)
        kind, base, type_ = self.chance.choice(_MADE)
        made = ObservedEndpoint(kind=kind, node=name, name=f"{name}/{base}", type=type_)
        self._put("endpoints", (*self.seen.endpoints, made))

    def _beside(self) -> None:
        """A participant that a node connected, or is said to have connected, has an endpoint."""
        space = self.chance.choice(self.names).rpartition("/")[0]
        other = dataclasses.replace(self.new_endpoint(), node=f"{space}/{_BESIDE}")
        self._put("endpoints", (*self.seen.endpoints, other))

    def _shared_socket(self) -> None:
        """An endpoint has the sockets of another one, maybe in another process."""
        if not self.reports:
            return
        taken, by = self.chance.choice(self.reports), self.chance.choice(self.reports)
        self._change_reports(
            lambda each: (each.kind, each.gid) == (by.kind, by.gid), lambda _: {"nfes": taken.nfes}
        )

    def _change_reports(
        self,
        which: Callable[[EndpointReport], bool],
        how: Callable[[EndpointReport], dict[str, object]],
    ) -> None:
        self._put(
            "configurations",
            [
                copy.deepcopy(
                    dataclasses.replace(
                        one,
                        endpoints=tuple(
                            dataclasses.replace(each, **how(each)) if which(each) else each
                            for each in one.endpoints
                        ),
                    )
                )
                if any(map(which, one.endpoints))
                else one
                for one in self.seen.configurations
            ],
        )

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
        own = self.chance.choice(self.names)
        made = [f"{own}/{each}" for each in ("get_parameters", "change_state", "transition_event")]
        return self.chance.choice(
            (*names, *made, "/another", "/rosout", "/dock/_action/feedback", "/a/_service_event")
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
        another = ConnectionReport(name="radio", node_name=_BESIDE, established=True)
        known = (another,) if self.chance.random() < 0.5 else ()
        return known + tuple(
            dataclasses.replace(
                each,
                urls=self.chance.choice((each.urls, (), ("udpv4:10.0.0.9:9999",))),
                established=self.chance.choice((True, False)),
                error=self.chance.choice(("", "no route")),
            )
            for each in part.connections
            if each.name != another.name and self.chance.random() < 0.9
        )

    def _parameters(self) -> tuple[ParameterReport, ...] | None:
        known = sorted({each.name for each in _parameters_of(self.first)})
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
        kind, name = self.chance.choice(tuple(EndpointKind)), self.endpoint_name()
        return ObservedEndpoint(
            kind=kind,
            node=self.chance.choice((self.node_name(), name.rpartition("/")[0])),
            name=name,
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


def _parameters_of(seen: Observation) -> Iterator[ParameterReport]:
    for one in (*seen.configurations, *seen.parameters):
        yield from one.parameters or ()


def _counting(seen: Observation) -> Observation:
    """Return what is seen of nodes that say how many they are matched with, and not with whom."""
    return dataclasses.replace(
        seen,
        configurations=tuple(
            dataclasses.replace(
                one,
                endpoints=tuple(dataclasses.replace(each, peers=None) for each in one.endpoints),
            )
            for one in seen.configurations
        ),
    )


def _asked_for_parameters(seen: Observation) -> Observation:
    """Return what is seen of nodes that do not report their parameters, and were asked."""
    return dataclasses.replace(
        seen,
        configurations=tuple(
            dataclasses.replace(each, parameters=None) for each in seen.configurations
        ),
        parameters=tuple(
            NodeParameters(node=each.name, parameters=each.parameters)
            for each in seen.configurations
        ),
    )


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
        self.rest = self._drawn()

    def _drawn(self) -> dict[str, Any]:
        choice, names = self.chance.choice, [each.full_name for each in self.plan.nodes]
        machines = sorted({each.machine for each in self.plan.nodes})
        return {
            "stage": choice(tuple(Stage)),
            "machines": choice((None, None, frozenset(), frozenset(machines[:1]))),
            "ahead": choice((frozenset(), frozenset({choice(names)}))),
            "over": choice(({}, {choice(names): "exit code 0"})),
        }

    def change(self) -> None:
        """Change one of them."""
        name = self.chance.choice(sorted(self.rest))
        self.rest = {**self.rest, name: self._drawn()[name]}

    def judged(self, judge: Callable[..., Verdict], seen: Observation) -> Verdict:
        return judge(self.plan, seen, **self.rest)


def anew(seen: Observation) -> Observation:
    """Return the same facts, no object of which was ever judged."""
    return Observation(
        **{name: tuple(copy.deepcopy(each) for each in getattr(seen, name)) for name in _PARTS}
    )


@settings(max_examples=150, deadline=None)
@given(plans(), plans(), st.integers(0, 2**32))
def test_what_is_judged_again_and_again_is_judged_as_at_first_sight(
    one: Plan, other: Plan, seed: int
):
    """The same findings in the same order, whatever changed in between and was kept of it."""
    chance = random.Random(seed)
    verifier = Verifier()
    several = [(Terms(plan, chance), Moments(plan, chance)) for plan in (one, one, one, other)]
    terms, moments = several[0]
    for _ in range(12):
        assert terms.judged(verifier.verify, moments.seen) == terms.judged(
            verify, anew(moments.seen)
        )
        for _ in range(chance.randint(0, 2)):
            moments.step()
        if chance.random() < 0.15:
            terms.change()
        if chance.random() < 0.05:
            terms, moments = chance.choice(several)
