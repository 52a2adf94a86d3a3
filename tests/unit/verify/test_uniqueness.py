"""Which endpoints are unique among all that nodes report."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind, UniqueHow
from lifecycle.network.nfe import NetworkFlowEndpoint, TransportProtocol, dissimilar, is_ip, located
from lifecycle.plan.model import Plan
from lifecycle.verify.matcher import lay_out
from lifecycle.verify.network_flows import Uniqueness, meets
from lifecycle.verify.observation import Identity
from lifecycle.verify.verdict import Stage
from lifecycle.verify.view import Actual
from tests import builders
from tests.builders import configuration, node, planned, publisher, reported, subscription
from tests.unit.verify.edits import Edit, both, change_configuration, change_report
from tests.unit.verify.perfect import perfect

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION


def nfe(port: int, address: str = "10.0.0.1", *how: Any, **rest: Any) -> NetworkFlowEndpoint:
    return builders.nfe(address, port, *how, **rest)


SHM = builders.shared_memory(1)
TCP = TransportProtocol.TCP


def plan_of(kind: EndpointKind, *, processes: int = 2) -> Plan:
    """Endpoints /a and /b of a kind, in two nodes, or in one process."""
    make = publisher if kind is PUB else subscription
    if processes == 1:
        return planned(node("one", make("a"), make("b")))
    return planned(node("one", make("a")), node("two", make("b")))


def laid_out(
    plan: Plan, edit: Edit, addresses: dict[str, str] | None = None
) -> tuple[Uniqueness, dict[str, Actual]]:
    view = lay_out(plan, edit(perfect(plan)), Stage.CONNECTED)
    ends = {each.planned.resolved: each for each in view.actual}
    return Uniqueness(view.reported, addresses or {}), ends


def unique(
    plan: Plan, edit: Edit, addresses: dict[str, str] | None = None
) -> dict[str, bool | None]:
    uniqueness, ends = laid_out(plan, edit, addresses)
    first = {name: uniqueness.is_unique(end) for name, end in ends.items()}
    assert {name: uniqueness.is_unique(end) for name, end in ends.items()} == first
    return first


def lists(kind: EndpointKind, **nfes: tuple[NetworkFlowEndpoint, ...] | None) -> Edit:
    return both(*(change_report(kind, f"/{name}", nfes=each) for name, each in nfes.items()))


def on_machines(one: str, two: str, *, processes: tuple[int, int] = (1, 2)) -> Edit:
    return both(
        *(
            change_configuration(
                name, identity=Identity(machine_id=machine, process_id=process, node_id=name)
            )
            for name, machine, process in zip(("/one", "/two"), (one, two), processes, strict=True)
        )
    )


@pytest.mark.parametrize("kind", [PUB, SUB])
@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        ((nfe(1),), (nfe(1),), (False, False)),
        ((nfe(1),), (nfe(2),), (True, True)),
        ((nfe(1),), (nfe(1, transport=TCP),), (True, True)),
        ((nfe(1, "::"),), (nfe(1, "0.0.0.0"),), (True, True)),
        ((nfe(1),), (nfe(1, "10.0.0.2"),), (True, True)),
        ((nfe(1), nfe(2)), (nfe(2), nfe(3)), (False, False)),
        ((nfe(1), nfe(1)), (nfe(2),), (True, True)),
        ((SHM, nfe(1)), (SHM, nfe(2)), (True, True)),
        ((SHM,), (nfe(2),), (False, True)),
        ((), (nfe(2),), (False, True)),
        (None, (nfe(2),), (None, True)),
    ],
)
def test_an_endpoint_is_unique_if_none_of_its_sockets_is_anothers(kind, a, b, expected):
    found = unique(plan_of(kind), both(on_machines("m", "m"), lists(kind, a=a, b=b)))
    assert (found["/a"], found["/b"]) == expected


@pytest.mark.parametrize(
    ("marks", "expected"),
    [((46, 46), False), ((46, 8), True), ((None, None), False), ((46, None), True)],
)
def test_the_mark_that_was_read_back_tells_publishers_apart(marks, expected):
    edit = both(
        on_machines("m", "m"),
        change_report(PUB, "/a", nfes=(nfe(1),), dscp=marks[0]),
        change_report(PUB, "/b", nfes=(nfe(1),), dscp=marks[1]),
    )
    assert unique(plan_of(PUB), edit) == {"/a": expected, "/b": expected}


def test_the_sockets_of_endpoints_are_each_named_once_with_the_mark_that_was_read_back():
    plan = planned(node("one", publisher("a"), subscription("c")))
    edit = both(
        change_report(PUB, "/a", nfes=(SHM, nfe(1), nfe(1)), dscp=46),
        change_report(SUB, "/c", nfes=(nfe(3),), dscp=46),
    )
    uniqueness, ends = laid_out(plan, edit)
    marked = uniqueness.nfes(ends["/a"])
    assert [(each.transport_port, each.dscp) for each in marked] == [(1, 46), (1, 46)]
    assert uniqueness.nfes(ends["/c"]) == (nfe(3),)
    assert uniqueness.nfes(None) == ()


# --- declared addresses of machines

BRIDGE = nfe(1, "172.17.0.1")
GROUP = nfe(1, "239.255.0.1")
DECLARED = {"/one": "10.0.0.1", "/two": "10.0.0.2"}


@pytest.mark.parametrize(
    ("a", "b", "addresses", "expected"),
    [
        ((nfe(1), BRIDGE), (nfe(1, "10.0.0.2"), BRIDGE), DECLARED, True),
        ((nfe(1), BRIDGE), (nfe(1, "10.0.0.2"), BRIDGE), {}, False),
        ((nfe(1), BRIDGE), (nfe(1, "10.0.0.2"), BRIDGE), None, False),
        ((nfe(1), BRIDGE), (nfe(1, "10.0.0.2"), BRIDGE), {"/one": "10.0.0.1"}, True),
        ((nfe(5, "0.0.0.0"), BRIDGE), (nfe(6, "0.0.0.0"), BRIDGE), {}, False),
        # On no declared address all that they have counts.
        ((BRIDGE,), (BRIDGE,), DECLARED, False),
        # A group is no address of a machine: it counts beside one, and alone it proves nothing.
        ((nfe(1), GROUP), (nfe(1, "10.0.0.2"), GROUP), DECLARED, False),
        ((BRIDGE, GROUP), (BRIDGE, nfe(2, "239.255.0.1")), DECLARED, False),
        # A wildcard is every address of its machine, the declared one too.
        ((nfe(1, "0.0.0.0"), BRIDGE), (nfe(1, "10.0.0.2"), BRIDGE), DECLARED, True),
        ((nfe(2), nfe(1, "0.0.0.0")), (nfe(1, "0.0.0.0"), BRIDGE), DECLARED, True),
        # One address may be written in several ways.
        (
            (nfe(1, "fd00:0::1"), BRIDGE),
            (nfe(1, "fd00::2"), BRIDGE),
            {"/one": "fd00::1", "/two": "fd00:0:0::2"},
            True,
        ),
    ],
)
def test_where_the_manifest_says_a_machines_address_only_that_one_counts(a, b, addresses, expected):
    edit = both(on_machines("m", "n"), lists(SUB, a=a, b=b))
    found = unique(plan_of(SUB), edit, addresses)
    assert found == {"/a": expected, "/b": expected}


NFES = st.one_of(
    st.just(SHM),
    st.builds(
        nfe,
        st.sampled_from((1, 2)),
        st.sampled_from(("10.0.0.1", "0.0.0.0", "127.0.0.1", "239.1.1.1", "::", "fe80::1%a")),
        st.sampled_from((TransportProtocol.UDP, TCP)),
    ),
)
ENDS = st.tuples(
    st.sampled_from((PUB, SUB)),
    st.sampled_from((("m", 1), ("m", 2), ("n", 1))),
    st.none() | st.lists(NFES, max_size=3).map(tuple),
)

ALONE = planned(node("one", publisher("a")))
(END,) = lay_out(ALONE, perfect(ALONE), Stage.CONNECTED).actual


def by_comparing(nfes, others) -> bool | None:
    """Compare each IP NFE with each of the others; None in `others` is what is not known."""
    if nfes is None:
        return None
    known = [each for other in others for each in other or () if is_ip(each.nfe)]
    own = [each for each in nfes if is_ip(each.nfe)]
    if not own or not all(dissimilar(one, other) for one in own for other in known):
        return False
    return None if None in others else True


@given(st.lists(ENDS, max_size=8))
def test_answers_are_those_of_comparing_every_endpoint_with_every_other(ends):
    reports = [reported(kind, f"e{i}", nfes=nfes) for i, (kind, _, nfes) in enumerate(ends)]
    described = [
        configuration(
            f"/n{index}", each, identity=Identity(machine_id=host, process_id=pid, node_id="")
        )
        for index, (each, (_, (host, pid), _)) in enumerate(zip(reports, ends, strict=True))
    ]
    uniqueness = Uniqueness(described, {})
    for index, (kind, process, nfes) in enumerate(ends):
        others = [
            located(each, place[0])
            for other, (side, place, each) in enumerate(ends)
            # What is not known hides no equal one but in its own process.
            if other != index and side is kind and (each is not None or place == process)
        ]
        end = replace(END, node=f"/n{index}", report=reports[index])
        assert uniqueness.is_unique(end) is by_comparing(located(nfes, process[0]), others)


@pytest.mark.parametrize(
    ("publisher", "subscription", "weakly", "strongly"),
    [
        (True, True, True, True),
        (True, False, True, False),
        (False, False, False, False),
        (True, None, True, None),
        (False, None, None, False),
        (None, None, None, None),
    ],
)
def test_a_demand_is_met_not_met_or_cannot_be_told(
    *, publisher: bool | None, subscription: bool | None, weakly: bool | None, strongly: bool | None
) -> None:
    for a, b in ((publisher, subscription), (subscription, publisher)):
        assert meets(UniqueHow.NOT, publisher=a, subscription=b) is True
        assert meets(UniqueHow.WEAKLY, publisher=a, subscription=b) is weakly
        assert meets(UniqueHow.STRONGLY, publisher=a, subscription=b) is strongly
