"""A delay between two hosts: judged by what is known of their clocks, or named."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import Machine, Policy, Quantity
from lifecycle.measure.bounds import CLOCKS_S
from lifecycle.measure.clock import ClockOffset
from lifecycle.measure.delays import Delays, signed_buckets_of
from lifecycle.measure.sample import Measured, Sample
from lifecycle.plan.model import Plan
from lifecycle.verify.judge import apart_from_numbers, verify
from lifecycle.verify.observation import Identity
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.measured import compares_clocks
from lifecycle.verify.verdict import Stage, Verdict
from tests.builders import at, link, node, planned, publisher, subscription
from tests.unit.verify.edits import both, change_configuration
from tests.unit.verify.perfect import perfect

MS = 1_000_000
SHIFT_NS = -511 * MS
"""Of delays that seem to be negative: the robot's clock is ahead."""


def system(
    *more: str, max_delay_ms: float = 2.0, name: str = "max_delay_ms", viewer: str = "station"
) -> Plan:
    """A camera on the robot whose video must be at the viewer in time; more of them elsewhere."""
    numbers = (Quantity(name=name, value=max_delay_ms, at=at(40, 7)),)
    nodes = [node("camera", publisher("/video"), machine="robot")]
    nodes += [node(f"camera_{each}", publisher("/video"), machine=each) for each in more]
    return planned(
        *nodes,
        node("viewer", subscription("/video"), machine=viewer),
        links=[link("/video", "camera", "viewer", quantities=numbers)],
        machines=tuple(Machine(name=each, at=at(2)) for each in ("robot", "station", "arm")),
        policy=Policy(),
    )


def judged(
    plan: Plan,
    *clocks: tuple[str, ClockOffset],
    delay_ms: float = 1.0,
    seconds: float = 10.0,
    own: str = "station",
    shift_ns: int | None = SHIFT_NS,
    is_up: bool = True,
) -> Verdict:
    """Judge as the supervisor of a machine does; delays are those of the robot at +512 ms."""
    raw_ns = round(delay_ms * MS) - 512 * MS - SHIFT_NS
    used = Delays(seconds=5.0, buckets=((signed_buckets_of((raw_ns,))[0], 300),), shift_ns=shift_ns)
    measured = Measured(
        active_s=seconds,
        samples=(("/video", Sample(seconds=seconds, messages=300, used=used, received=used)),),
    )
    seen = perfect(plan, Stage.ACTIVE)
    reports = tuple(
        replace(each, measured=measured) if each.name == "/viewer" else each
        for each in seen.configurations
    )
    seen = replace(seen, configurations=reports, clocks=clocks if is_up else None)
    return verify(plan, seen, stage=Stage.ACTIVE, machines=frozenset({own}))


def robot(uncertainty_ms: float) -> tuple[str, ClockOffset]:
    return "robot", ClockOffset(offset_ms=512, uncertainty_ms=uncertainty_ms)


def test_the_offset_is_subtracted_and_said_with_its_uncertainty() -> None:
    verdict = judged(system(), robot(0.25))
    assert verdict.verdict is Outcome.OK
    (flow,) = verdict.measured
    assert flow.clock == robot(0.25)[1]
    assert (flow.p50_ms, flow.p99_ms) == (pytest.approx(1.0), pytest.approx(1.0))
    assert flow.describe() == (
        "/video /camera → /viewer: delay p99 1 ms ± 0.25 ms ≤ 2 ms, 0.0 Hz, 0 of 0 lost, "
        "clocks 512 ms ± 0.25 ms apart"
    )


def test_a_delay_that_is_too_long_whatever_the_clocks_are_is_violated() -> None:
    (found,) = judged(system(), robot(3.1), delay_ms=50).findings
    assert (found.rule, found.outcome) == ("flow.delay", Outcome.VIOLATED)
    assert found.message.endswith("delay p99 49.8 ms ± 3.86 ms > 2 ms")


CLOCKS = "the clocks of robot and station"
WHERE = "max_delay_ms 2 of the flow /camera → /viewer on /video is not measured:"


P99 = "delay p99 1.89 ms ± 0.314 ms"


@pytest.mark.parametrize(
    ("delay_ms", "clocks", "why"),
    [
        (1.0, [robot(3.1)], "{} differ by 512 ms ± 3.1 ms, which is more than max_delay_ms 2"),
        (1.9, [robot(0.3)], f"{P99} may be more than 2 ms, or not: {{}} differ by 512 ms ± 0.3 ms"),
        (1.0, [], "{} are not compared yet, or one was set a moment ago"),
    ],
)
def test_what_the_clocks_do_not_let_decide_is_unverifiable_by_name_after_a_while(
    delay_ms: float, clocks: list[tuple[str, ClockOffset]], why: str
) -> None:
    early = judged(system(), *clocks, delay_ms=delay_ms, seconds=CLOCKS_S - 1)
    assert early.verdict is Outcome.OK
    assert early.is_measuring(within_s=1.5)
    assert [each.outcome for each in early.measured[0].bounds] == ["measuring"]
    late = judged(system(), *clocks, delay_ms=delay_ms)
    (found,) = late.findings
    assert (found.rule, found.outcome) == ("flow.not-measured", Outcome.UNVERIFIABLE)
    assert found.message == f"{WHERE} {why.format(CLOCKS)}"
    assert [each.outcome for each in late.measured[0].bounds] == ["unverifiable"]
    other = judged(system(), *clocks, delay_ms=delay_ms + 0.01)
    assert apart_from_numbers(other) == apart_from_numbers(late)
    assert [each.rule for each in apart_from_numbers(late).findings] == ["flow.not-measured"]


def test_a_5qi_is_named_with_its_budget() -> None:
    verdict = judged(system(name="five_qi", max_delay_ms=82), robot(30.0))  # its budget is 10 ms
    messages = [each.message for each in verdict.findings if "clocks" in each.message]
    assert len(messages) == 1
    assert messages[0].endswith("± 30 ms, which is more than the 10 ms of five_qi 82")


def test_nothing_is_said_of_clocks_before_the_system_is_up() -> None:
    assert judged(system(), is_up=False).findings == ()


def test_only_the_supervisor_of_the_subscription_judges() -> None:
    verdict = judged(system(), own="robot")
    assert (verdict.findings, verdict.measured) == ((), ())


def test_one_host_has_one_clock_whatever_its_machines_are_called() -> None:
    plan = system(viewer="robot")
    used = Delays(seconds=5.0, buckets=((signed_buckets_of((MS,))[0], 300),))
    verdict = judged(plan, own="robot", shift_ns=None)
    assert verdict.measured[0].clock is None
    assert used.quantile_ms(0.99) is not None
    assert verdict.verdict is Outcome.OK


def test_messages_of_several_hosts_are_judged_by_all_of_their_clocks() -> None:
    arm = "arm", ClockOffset(offset_ms=511, uncertainty_ms=0.1)
    verdict = judged(system("arm"), robot(0.1), arm)
    clock = verdict.measured[0].clock
    assert clock is not None
    assert (clock.offset_ms, clock.uncertainty_ms) == (511.5, pytest.approx(0.6))
    assert judged(system("arm"), robot(0.1)).measured[0].clock is None  # one is not known
    (found,) = judged(system("station"), robot(0.1)).findings
    assert f"{CLOCKS} differ by 256 ms ± 256 ms" in found.message


def test_what_was_counted_as_of_one_host_is_not_compared() -> None:
    (found,) = judged(system(), robot(0.1), shift_ns=None).findings
    assert "not compared yet" in found.message


def test_a_host_without_a_supervisor_of_its_own_is_named_from_the_first_gate_on() -> None:
    plan = system()
    verdict = verify(plan, perfect(plan), stage=Stage.CONNECTED)
    (found,) = verdict.findings
    assert found.message == f"{WHERE} the clocks of the two hosts are not compared"
    both_here = [
        change_configuration(name, identity=Identity(machine_id="m", process_id=1, node_id=""))
        for name in ("/camera", "/viewer")
    ]
    assert verify(plan, both(*both_here)(perfect(plan)), stage=Stage.CONNECTED).findings == ()


def test_clocks_are_compared_where_a_delay_is_declared_and_data_pass_between_machines() -> None:
    assert compares_clocks(system())
    assert compares_clocks(system(name="five_qi", max_delay_ms=82))
    assert not compares_clocks(system(name="rate_hz"))
    assert not compares_clocks(system(viewer="robot"))
