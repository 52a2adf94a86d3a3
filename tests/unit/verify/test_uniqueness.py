"""Which endpoints are unique among all that nodes report."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lifecycle.manifest.model import EndpointKind, UniqueHow
from lifecycle.network.nfe import (
    NetworkFlowEndpoint,
    TransportProtocol,
    dissimilar,
    is_ip,
    located,
)
from lifecycle.plan.model import Plan
from lifecycle.verify.matcher import lay_out
from lifecycle.verify.observation import Identity
from lifecycle.verify.uniqueness import Uniqueness, meets
from lifecycle.verify.verdict import Stage
from lifecycle.verify.view import Actual
from tests import builders
from tests.builders import (
    configuration,
    endpoint,
    node,
    planned,
    publisher,
    reported,
    subscription,
)
from tests.unit.verify.edits import (
    Edit,
    both,
    change_configuration,
    change_report,
    drop_report,
)
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
    if addresses is None:
        return Uniqueness(view.reported), ends
    return Uniqueness(view.reported, addresses), ends


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


@pytest.mark.parametrize("kind", [PUB, SUB])
def test_unknown_sockets_make_an_answer_unknown_only_inside_their_process(kind):
    edit = lists(kind, a=(nfe(1),), b=None)
    assert unique(plan_of(kind, processes=1), edit) == {"/a": None, "/b": None}
    assert unique(plan_of(kind), edit) == {"/a": True, "/b": None}


@pytest.mark.parametrize(
    ("machines", "processes", "expected"),
    [
        (("m", "m"), (7, 7), None),
        (("m", "m"), (7, 8), True),
        (("m", "n"), (7, 7), True),
    ],
)
def test_a_process_is_known_by_its_machine_and_its_number(machines, processes, expected):
    edit = both(on_machines(*machines, processes=processes), lists(SUB, a=(nfe(1),), b=None))
    assert unique(plan_of(SUB), edit)["/a"] is expected


def test_a_shared_socket_is_no_doubt_whatever_else_is_not_known():
    make = publisher
    plan = planned(node("one", make("a"), make("b"), make("c")))
    edit = lists(PUB, a=(nfe(1),), b=(nfe(1),), c=None)
    assert unique(plan, edit) == {"/a": False, "/b": False, "/c": None}


def test_several_unknown_endpoints_of_a_process_leave_it_unknown():
    plan = planned(node("one", *(publisher(name) for name in ("a", "b", "c"))))
    assert unique(plan, lists(PUB, a=(nfe(1),), b=None, c=None))["/a"] is None


def test_publishers_are_compared_with_publishers_and_subscriptions_with_subscriptions():
    plan = planned(node("one", publisher("a"), subscription("b")))
    same = both(lists(PUB, a=(nfe(1),)), lists(SUB, b=(nfe(1),)))
    assert unique(plan, same) == {"/a": True, "/b": True}
    assert unique(plan, both(lists(PUB, a=(nfe(1),)), lists(SUB, b=None)))["/a"] is True
    assert unique(plan, both(lists(PUB, a=None), lists(SUB, b=(nfe(1),))))["/b"] is True


def test_an_endpoint_that_was_not_made_shares_nothing():
    refused = change_report(PUB, "/b", error="refused")
    for nfes in ((nfe(1),), None):
        edit = both(lists(PUB, a=(nfe(1),), b=nfes), refused)
        assert unique(plan_of(PUB, processes=1), edit) == {"/a": True, "/b": None}


def test_what_is_no_topic_is_not_compared():
    service = endpoint(EndpointKind.SERVICE_SERVER, "ask", "std_srvs/srv/Trigger")
    plan = planned(node("one", service, publisher("a")))
    assert unique(plan, lists(PUB, a=(nfe(1),))) == {"/ask": None, "/a": True}


def test_an_endpoint_that_nobody_reports_is_unknown_and_has_no_sockets():
    edit = both(lists(PUB, a=(nfe(1),)), drop_report("/two"))
    uniqueness, ends = laid_out(plan_of(PUB), edit)
    assert uniqueness.is_unique(ends["/b"]) is None
    assert uniqueness.nfes((ends["/b"], ends["/a"])) == (nfe(1),)


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
    plan = planned(node("one", publisher("a"), publisher("b"), subscription("c")))
    edit = both(
        change_report(PUB, "/a", nfes=(SHM, nfe(1)), dscp=46),
        change_report(PUB, "/b", nfes=(nfe(1), nfe(2)), dscp=46),
        change_report(SUB, "/c", nfes=(nfe(3),), dscp=46),
    )
    uniqueness, ends = laid_out(plan, edit)
    marked = uniqueness.nfes((ends["/a"], ends["/b"]))
    assert [(each.transport_port, each.dscp) for each in marked] == [(1, 46), (1, 46), (2, 46)]
    assert uniqueness.nfes((ends["/c"],)) == (nfe(3),)
    assert uniqueness.nfes(()) == ()


@pytest.mark.parametrize(
    ("nfes", "expected"),
    [
        ({"a": (nfe(1),), "b": (nfe(2),)}, True),
        ({"a": (nfe(1),), "b": (nfe(9),)}, False),
        ({"a": (nfe(1),), "b": None}, None),
        ({"a": None, "b": (nfe(9),)}, False),
    ],
)
def test_several_endpoints_are_unique_if_each_is_and_not_if_one_is_not(nfes, expected):
    plan = planned(
        node("one", publisher("a")), node("two", publisher("b")), node("three", publisher("c"))
    )
    edit = both(
        *(
            change_configuration(
                name, identity=Identity(machine_id="m", process_id=number, node_id=name)
            )
            for number, name in enumerate(("/one", "/two", "/three"))
        ),
        lists(PUB, c=(nfe(9),), **nfes),
    )
    uniqueness, ends = laid_out(plan, edit)
    assert uniqueness.all_unique((ends["/a"], ends["/b"])) is expected
    assert uniqueness.all_unique((ends["/b"], ends["/a"])) is expected
    assert uniqueness.all_unique(()) is None


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


def test_a_wildcard_counts_beside_the_declared_address_of_a_machine():
    edit = both(
        on_machines("m", "m"),
        lists(SUB, a=(nfe(2), nfe(1, "0.0.0.0")), b=(nfe(3), nfe(1, "0.0.0.0"))),
    )
    here = {"/one": "10.0.0.1", "/two": "10.0.0.1"}
    assert unique(plan_of(SUB), edit, here) == {"/a": False, "/b": False}


def test_what_does_not_count_is_named_all_the_same():
    edit = both(on_machines("m", "n"), lists(SUB, a=(nfe(1), BRIDGE), b=(BRIDGE,)))
    uniqueness, ends = laid_out(plan_of(SUB), edit, DECLARED)
    assert uniqueness.nfes((ends["/a"],)) == (nfe(1), BRIDGE)


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
    known = [each for other in others for each in other or () if is_ip(each)]
    own = [each for each in nfes if is_ip(each)]
    if not own or not all(dissimilar(one, other) for one in own for other in known):
        return False
    return None if None in others else True


@given(st.lists(ENDS, max_size=8))
def test_answers_are_those_of_comparing_every_endpoint_with_every_other(ends):
    reports = [reported(kind, f"e{i}", nfes=nfes) for i, (kind, _, nfes) in enumerate(ends)]
    uniqueness = Uniqueness(
        configuration(
            f"/n{index}", each, identity=Identity(machine_id=host, process_id=pid, node_id="")
        )
        for index, (each, (_, (host, pid), _)) in enumerate(zip(reports, ends, strict=True))
    )
    for index, (kind, process, nfes) in enumerate(ends):
        others = [
            located(each, place[0])
            for other, (side, place, each) in enumerate(ends)
            # What is not known hides no equal one but in its own process.
            if other != index and side is kind and (each is not None or place == process)
        ]
        end = dataclasses.replace(END, report=reports[index])
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
