"""What is judged of data that have arrived, and what is named because nothing measures it."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import (
    EndpointKind,
    Executor,
    Machine,
    Quantity,
    Run,
    RunKind,
    TargetState,
)
from lifecycle.measure.sample import Delays, Measured, Sample, Slot, buckets_of
from lifecycle.plan.model import Plan
from lifecycle.verify.judge import without_measured
from lifecycle.verify.observation import Observation
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.report import render_text
from lifecycle.verify.verdict import Finding, Stage, Verdict
from tests.builders import at, link, need, node, planned, publisher, subscription
from tests.unit.verify.edits import both, change_configuration, change_node
from tests.unit.verify.lines import verify
from tests.unit.verify.perfect import perfect

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
FOREIGN = Run(kind=RunKind.COMMAND, command=("other",))


def number(name: str, value: float, line: int = 22, **rest: float) -> Quantity:
    return Quantity(name=name, value=value, at=at(line), **rest)


def pair(*of_link: Quantity, run: Run | None = None, **ends: tuple[Quantity, ...]) -> Plan:
    """One publishing and one subscribing node, with numbers of the link and of the two ends."""
    needs = {
        kind: [need(kind, "a", quantities=ends[word])] if word in ends else []
        for kind, word in ((PUB, "published"), (SUB, "subscribed"))
    }
    how = {} if run is None else {"run": run}
    return planned(
        node("one", publisher("a"), needs=needs[PUB]),
        node("two", subscription("a"), needs=needs[SUB], **how),
        links=[link("/a", "one", "two", quantities=of_link)],
    )


def arrived(
    messages: int, seconds: float, *, delay_ms: float = 1.0, lost: int = 0, silent_s: float = 0.0
) -> Sample:
    histogram = {buckets_of((round(delay_ms * 1e6),))[0]: messages} if messages else {}
    delays = Delays.of((histogram,), seconds=min(seconds, 5.0))
    slot = Slot(seconds=seconds, messages=messages, lost=lost)
    return Sample(
        seconds=seconds,
        silent_s=silent_s,
        messages=messages,
        lost=lost,
        slots=(slot,),
        used=delays,
        received=delays,
    )


def judged(
    plan: Plan, sample: Sample | None, stage: Stage = Stage.ACTIVE, *, let_s: float = 99.0
) -> Verdict:
    seen: Observation = perfect(plan, stage)
    if sample is not None:
        counted = Measured(active_s=sample.seconds, samples=(("/a", sample),))
        seen = change_configuration("/two", measured=counted)(seen)
        seen = change_configuration("/one", measured=Measured(active_s=let_s))(seen)
    return verify(plan, seen, stage=stage)


def of_data(verdict: Verdict) -> list[Finding]:
    rules = ("delay", "rate", "loss", "silent", "not-measured", "nothing-arrived")
    return [each for each in verdict.findings if each.rule in {f"flow.{word}" for word in rules}]


@pytest.mark.parametrize(
    ("quantity", "kept", "broken", "rule"),
    [
        (number("max_delay_ms", 5), arrived(300, 10), arrived(300, 10, delay_ms=8), "flow.delay"),
        (number("rate_hz", 15, slack=0.05), arrived(145, 10), arrived(135, 10), "flow.rate"),
        (number("rate_hz", 0, most=20), arrived(190, 10), arrived(220, 10), "flow.rate"),
        (number("rate_hz", 15, most=20), arrived(180, 10), arrived(130, 10), "flow.rate"),
        (number("loss", 0.01), arrived(2000, 20, lost=2), arrived(1950, 20, lost=50), "flow.loss"),
        (number("max_silence_s", 2), arrived(9, 10), arrived(9, 10, silent_s=2.5), "flow.silent"),
        (number("five_qi", 85), arrived(300, 10), arrived(300, 10, delay_ms=8), "flow.delay"),
    ],
    ids=lambda each: str(each) if isinstance(each, Quantity) else None,
)
@pytest.mark.parametrize("where", ["link", "published", "subscribed"])
def test_a_declared_number_is_ok_or_violated_with_numbers_wherever_it_is_declared(
    quantity: Quantity, kept: Sample, broken: Sample, rule: str, where: str
) -> None:
    plan = pair(quantity) if where == "link" else pair(**{where: (quantity,)})
    good = judged(plan, kept)
    assert good.verdict is Outcome.OK
    assert {each.outcome for each in good.measured[0].bounds} <= {"ok", "measuring"}
    bad = judged(plan, broken)
    assert bad.verdict is Outcome.VIOLATED
    assert [(each.rule, each.subject) for each in of_data(bad)] == [(rule, "/a: /one → /two")]
    assert of_data(bad)[0].expected == str(quantity)
    assert of_data(bad)[0].at == "robot.lifecycle.yaml:22:1"
    gated = without_measured(bad, plan.policy)
    assert (gated.verdict, gated.blocking, of_data(gated), gated.measured) == (
        *(Outcome.OK, False, [], ()),
    )


def test_a_violated_delay_is_said_with_quantile_value_and_bound() -> None:
    plan = pair(number("max_delay_ms", 5, quantile=0.9))
    found = of_data(judged(plan, arrived(300, 10, delay_ms=8)))[0]
    assert found.message == "the flow /one → /two on /a: delay p90 8 ms > 5 ms"
    assert found.expected == "max_delay_ms 5 for 0.9"


def test_what_cannot_be_decided_yet_is_shown_and_counts_for_nothing() -> None:
    verdict = judged(pair(number("max_delay_ms", 5)), arrived(20, 1, delay_ms=8))
    assert verdict.verdict is Outcome.OK
    bound = verdict.measured[0].bounds[0]
    assert (bound.outcome, bound.text) == ("measuring", "delay p99 8 ms, measuring ≤ 5 ms")
    assert (bound.decides_in_s, bound.share) == (4.0, pytest.approx(1.6, rel=0.02))


def test_what_has_arrived_of_a_flow_is_shown_in_numbers() -> None:
    (of_1, of_5, of_9) = (buckets_of((each * 1_000_000,))[0] for each in (1, 5, 9))
    used = Delays.of(({of_1: 985, of_5: 10, of_9: 5},), seconds=5.0)
    sample = replace(arrived(1000, 10, lost=3), used=used)
    plan = pair(number("max_delay_ms", 5), number("loss", 0.001))
    (flow,) = judged(plan, sample).measured
    assert (flow.messages, flow.lost, flow.rate_hz) == (1000, 3, 100.0)
    assert (flow.p50_ms, flow.p99_ms) == (pytest.approx(1, rel=0.02), pytest.approx(5, rel=0.02))
    assert flow.describe().endswith("ms ≤ 5 ms, 3 of 1003 lost, measuring ≤ 0.001, 100.0 Hz")
    (silent,) = judged(plan, Sample(seconds=1.0)).measured
    assert (silent.messages, silent.p50_ms, silent.p99_ms) == (0, None, None)
    assert [each.text for each in silent.bounds] == ["≤ 5 ms", "≤ 0.001"]
    text = render_text(judged(plan, sample), flows=False)
    assert text == f"verdict: ok (1 flow)\n\nmeasured\n  {flow.describe()}\n"


@pytest.mark.parametrize(
    ("name", "state", "judged_"),
    [("/one", "", 1), ("/one", "activating", 0), ("/two", "inactive", 0), ("/two", "active", 1)],
)
def test_nothing_is_judged_while_an_end_says_that_it_is_not_active(
    name: str, state: str, judged_: int
) -> None:
    plan = pair(number("rate_hz", 15))
    assert judged(plan, arrived(50, 10), let_s=3.0).findings == ()  # its publisher only began
    counted = change_configuration(
        "/two", measured=Measured(active_s=9, samples=(("/a", arrived(50, 10)),))
    )
    publishes = change_configuration("/one", measured=Measured(active_s=99))
    edit = both(counted, publishes, change_configuration(name, state=state))
    seen = edit(perfect(plan, Stage.ACTIVE))
    verdict = verify(plan, seen, stage=Stage.ACTIVE)
    assert len(verdict.measured) == len(of_data(verdict)) == judged_


def test_before_activation_nothing_is_measured_and_nothing_is_unverifiable() -> None:
    verdict = judged(pair(number("max_delay_ms", 5)), None, Stage.CONNECTED)
    assert (verdict.verdict, verdict.measured) == (Outcome.OK, ())


def test_a_number_of_which_nothing_arrives_is_unverifiable_after_the_probation() -> None:
    plan = pair(number("max_delay_ms", 5))
    assert judged(plan, arrived(0, 10, silent_s=9)).verdict is Outcome.OK
    found = of_data(judged(plan, arrived(0, 11, silent_s=11)))
    assert [(each.rule, each.outcome) for each in found] == [
        ("flow.nothing-arrived", Outcome.UNVERIFIABLE)
    ]


@pytest.mark.parametrize("stage", Stage)
@pytest.mark.parametrize("where", ["link", "published", "subscribed"])
def test_a_number_of_a_subscription_that_is_not_ours_is_unverifiable_by_name(
    stage: Stage, where: str
) -> None:
    numbers = (number("max_delay_ms", 0.0001), number("rate_hz", 500, slack=0.05))
    plan = pair(*numbers, run=FOREIGN) if where == "link" else pair(run=FOREIGN, **{where: numbers})
    found = of_data(judged(plan, None, stage))
    assert [(each.outcome, each.expected, each.at) for each in found] == [
        (Outcome.UNVERIFIABLE, "max_delay_ms 0.0001", "robot.lifecycle.yaml:22:1"),
        (Outcome.UNVERIFIABLE, "rate_hz 500", "robot.lifecycle.yaml:22:1"),
    ]
    assert "/two does not run in our host" in found[0].message


@pytest.mark.parametrize(
    ("quantity", "why"),
    [
        (number("max_message_size", 1500), "a callback does not show the size of a message"),
        (number("five_qi", 200), "128 to 254 are an operator's own classes"),
    ],
)
def test_a_number_that_nothing_can_measure_says_why(quantity: Quantity, why: str) -> None:
    found = of_data(judged(pair(published=(quantity,)), arrived(300, 10)))
    assert [each.message for each in found] == [
        f"{quantity} of the publisher of /a in /one is not measured: {why}"
    ]


def test_of_several_publishers_only_what_is_of_the_topic_is_measured() -> None:
    rate, loss = number("rate_hz", 15, slack=0.05), number("loss", 0.01)
    topic_rate = number("rate_hz", 15, 30, slack=0.05)
    plan = pair(rate, subscribed=(topic_rate, loss, number("max_delay_ms", 5)))
    sample = arrived(300, 10)
    seen = perfect(plan, Stage.ACTIVE)
    (own,) = (each for each in seen.endpoints if (each.kind, each.name) == (PUB, "/a"))
    seen = replace(seen, endpoints=(*seen.endpoints, replace(own, node="/other", gid="0f")))
    counted = Measured(active_s=10, samples=(("/a", sample),))
    edit = both(
        change_configuration("/one", measured=Measured(active_s=99)),
        change_configuration("/two", measured=counted),
    )
    verdict = verify(plan, edit(seen), stage=Stage.ACTIVE)
    named = [(each.subject, each.expected) for each in of_data(verdict)]
    assert named == [("/a", "loss 0.01"), ("/a: /one → /two", "rate_hz 15")]
    assert [each.name for each in verdict.measured[0].bounds] == ["rate_hz", "max_delay_ms"]
    shown = "30.0 Hz ≥ 15 Hz - 5%, delay p99 0.999 ms ≤ 5 ms"
    assert verdict.measured[0].describe() == f"/a /one → /two: {shown}"


def test_a_rate_of_a_publisher_is_proven_at_one_subscription_and_its_delay_at_each() -> None:
    numbers = (number("rate_hz", 15, slack=0.05), number("max_delay_ms", 5))
    plan = planned(
        node("one", publisher("a"), needs=[need(PUB, "a", quantities=numbers)]),
        node("two", subscription("a")),
        node("three", subscription("a"), run=FOREIGN),
    )
    found = of_data(judged(plan, arrived(300, 10)))
    assert [(each.subject, each.expected) for each in found] == [("/a", "max_delay_ms 5")]


def test_nothing_is_said_of_a_number_whose_endpoint_is_missing() -> None:
    plan = pair(number("max_delay_ms", 5), run=FOREIGN)
    seen = perfect(plan, Stage.ACTIVE)
    gone = replace(seen, endpoints=tuple(each for each in seen.endpoints if each.kind is not SUB))
    assert of_data(verify(plan, gone, stage=Stage.ACTIVE)) == []


def test_a_subscription_of_ours_measures_where_the_manifest_asks_for_it() -> None:
    plan = planned(
        node("one", publisher("a")),
        node("two", subscription("a"), run=FOREIGN),
        links=[link("/a", "one", "two", quantities=(number("rate_hz", 15),), measure=True)],
    )
    publishes = change_configuration("/one", measured=Measured(active_s=99))
    seen = publishes(perfect(plan, Stage.ACTIVE))
    slow = Measured(active_s=0, samples=(("/a", arrived(50, 10)),))
    verdict = verify(plan, replace(seen, measured=slow), stage=Stage.ACTIVE)
    assert [each.rule for each in of_data(verdict)] == ["flow.rate"]
    assert of_data(verify(plan, seen, stage=Stage.CONNECTED)) == []
    asks_of_an_end = planned(
        node("one", publisher("a"), needs=[need(PUB, "a", measure=True)]),
        node("two", subscription("a"), run=FOREIGN),
        node("three", subscription("a")),
    )
    measured = {each.subscription: each.measure for each in asks_of_an_end.flows}
    assert measured == {"two": True, "three": False}


def test_a_subscription_of_ours_is_judged_by_the_supervisor_of_the_node_that_subscribes() -> None:
    plan = planned(
        node("one", publisher("a"), machine="near"),
        node("two", subscription("a"), run=FOREIGN, machine="far"),
        links=[link("/a", "one", "two", quantities=(number("rate_hz", 15),), measure=True)],
        machines=tuple(Machine(name=each, at=at(2)) for each in ("near", "far")),
    )
    slow = Measured(active_s=0, samples=(("/a", arrived(50, 10)),))
    seen = replace(perfect(plan, Stage.ACTIVE), measured=slow, active_s=(("/one", 99),))
    found = {
        machine: [
            each.rule
            for each in of_data(
                verify(plan, seen, stage=Stage.ACTIVE, machines=frozenset({machine}))
            )
        ]
        for machine in ("near", "far")
    }
    assert found == {"near": [], "far": ["flow.rate"]}


def test_a_node_whose_executor_gives_no_message_info_is_named() -> None:
    events = Run(kind=RunKind.PYTHON, python="robot:Node", executor=Executor.EVENTS)
    found = of_data(judged(pair(number("rate_hz", 5), run=events), arrived(300, 10)))
    assert [each.rule for each in found] == ["flow.not-measured"]
    assert found[0].message.endswith("executor: events gives callbacks no message info")


def test_a_number_of_a_topic_is_judged_while_one_of_its_publishers_is_active() -> None:
    silence = number("max_silence_s", 2)
    plan = planned(
        node("one", publisher("a"), state=TargetState.INACTIVE),
        node("other", publisher("a")),
        node("two", subscription("a"), needs=[need(SUB, "a", quantities=(silence,))]),
    )
    silent = Measured(active_s=9, samples=(("/a", arrived(9, 10, silent_s=2.5)),))
    seen = perfect(plan, Stage.ACTIVE)

    def found(other_s: float) -> list[str]:
        edit = both(
            change_configuration("/two", measured=silent),
            change_configuration("/other", measured=Measured(active_s=other_s)),
        )
        return [each.rule for each in of_data(verify(plan, edit(seen), stage=Stage.ACTIVE))]

    assert found(99.0) == ["flow.silent"]
    assert found(1.5) == []


@pytest.mark.parametrize(("active_s", "rules"), [(1.0, []), (19.0, ["flow.rate"])])
def test_what_a_node_of_others_did_not_send_before_it_was_there_is_no_fault(
    active_s: float, rules: list[str]
) -> None:
    plan = planned(
        node("one", publisher("a"), run=FOREIGN),
        node("two", subscription("a")),
        links=[link("/a", "one", "two", quantities=(number("rate_hz", 15),))],
    )
    slow = Measured(active_s=9, samples=(("/a", arrived(50, 10)),))
    seen = change_configuration("/two", measured=slow)(perfect(plan, Stage.ACTIVE))
    seen = replace(seen, active_s=(("/one", active_s),))
    assert [each.rule for each in of_data(verify(plan, seen, stage=Stage.ACTIVE))] == rules


def test_nothing_is_judged_while_a_node_of_others_is_not_active() -> None:
    plan = planned(
        node("one", publisher("a"), run=FOREIGN),
        node("two", subscription("a")),
        links=[link("/a", "one", "two", quantities=(number("rate_hz", 15),))],
    )
    slow = Measured(active_s=9, samples=(("/a", arrived(50, 10)),))
    edit = both(change_node("/one", state="inactive"), change_configuration("/two", measured=slow))
    seen = edit(perfect(plan, Stage.ACTIVE))
    assert of_data(verify(plan, seen, stage=Stage.ACTIVE)) == []


@pytest.mark.parametrize("slow", [number("max_silence_s", 30), number("rate_hz", 0.04)], ids=str)
def test_a_message_is_not_missed_before_what_is_declared_lets_it_be_late(slow: Quantity) -> None:
    plan = pair(number("max_delay_ms", 5), slow)
    assert of_data(judged(plan, arrived(0, 20, silent_s=20))) == []
    (found, *_) = of_data(judged(plan, arrived(0, 31, silent_s=29)))
    assert (found.rule, found.expected) == ("flow.nothing-arrived", "max_delay_ms 5")


def test_a_node_of_ours_that_was_started_again_is_not_silent_before_it_says_how_long_it_runs() -> (
    None
):
    plan = pair(number("max_silence_s", 1), number("rate_hz", 15))
    late = Measured(active_s=9, samples=(("/a", arrived(90, 9, silent_s=4)),))
    seen = change_configuration("/two", measured=late)(perfect(plan, Stage.ACTIVE))
    again = change_configuration("/one", measured=None)(seen)
    assert of_data(verify(plan, again, stage=Stage.ACTIVE)) == []
