"""NEF AsSessionWithQoS against a stateful server on loopback."""

from __future__ import annotations

import dataclasses
import logging
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from msgspec.structs import replace

from lifecycle.programming.ledger import Ledger
from lifecycle.programming.rules import RuleSet
from lifecycle.programming.target import (
    Means,
    PartlyError,
    TargetChanges,
    read_targets,
)
from tests.unit.programming.fakes import Waited
from tests.unit.programming.samples import ledger_in, nef_settings, rule, settings_file
from tests.unit.programming.servers import TOKEN, Answer, Clock, NefServer

PROBLEM = "application/problem+json"
SHOWN = "udp 10.45.0.3:17900 → 198.51.100.7:17910, EF = DSCP 46 = TOS 184 (0xb8), 5QI 85"


@dataclasses.dataclass
class Bench:
    """A target, its server and what lies between them."""

    target: Waited
    server: NefServer
    ledger: Ledger
    clock: Clock
    again: Callable[[], Waited]


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    """A NEF without subscriptions."""
    with NefServer() as server:
        yield made(tmp_path, server, Clock(monkeypatch))


def made(tmp_path: Path, server: NefServer, clock: Clock) -> Bench:
    ledger = ledger_in(tmp_path)
    file = settings_file(tmp_path, nef=nef_settings(server.url))
    targets = Means(ledger)

    def make() -> Waited:
        return Waited(read_targets(["nef"], {"config": file})[0].open(targets))

    return Bench(make(), server, ledger, clock, make)


def kinds(changes: TargetChanges) -> list[str]:
    return [each.kind.value for each in changes.changes]


def test_each_flow_becomes_one_subscription_and_a_second_apply_changes_nothing(
    bench: Bench,
) -> None:
    rules = [rule(), rule("/lidar", 17901)]

    first = bench.target.apply(rules)
    bench.server.asked.clear()
    second = bench.again().apply(rules)

    assert kinds(first) == ["create", "create"]
    assert kinds(second) == ["keep", "keep"]
    assert bench.server.methods() == []
    assert [each["flowInfo"] for each in bench.server.subscriptions.values()] == [
        [
            {
                "flowId": 1,
                "flowDescriptions": [f"permit in 17 from 10.45.0.3 {port} to 198.51.100.7 17910"],
            }
        ]
        for port in (17900, 17901)
    ]


def test_a_plan_says_what_would_be_done_and_does_none_of_it(bench: Bench) -> None:
    changes = bench.target.plan([rule(), rule("/map", five_qi=9)])

    assert changes.render() == (
        f"nef at {bench.server.url}/3gpp-as-session-with-qos/v1/robots: 1 to create, 0 unchanged\n"
        f"  + /video /camera → /viewer udp 198.51.100.7 from device: {SHOWN}\n"
        "  left out: /map /camera → /viewer: the operator's name for 5QI 9 is not known; "
        "add it to qos_references"
    )
    assert bench.server.asked == []


def test_a_port_that_changed_ends_the_old_subscription_before_the_new_one(bench: Bench) -> None:
    bench.target.apply([rule(port=17900)])

    changes = bench.target.apply([rule(port=18000)])

    assert kinds(changes) == ["update"]
    assert bench.server.methods() == ["POST", "DELETE", "POST"]
    (subscription,) = bench.server.subscriptions.values()
    (flow,) = subscription["flowInfo"]
    assert flow["flowDescriptions"] == ["permit in 17 from 10.45.0.3 18000 to 198.51.100.7 17910"]


def test_removal_deletes_ours_and_nothing_else(bench: Bench) -> None:
    bench.server.subscriptions["theirs"] = {"self": "/x/theirs"}
    bench.target.apply([rule(), rule("/lidar", 17901)])

    changes = bench.target.remove()

    assert kinds(changes) == ["delete", "delete"]
    assert list(bench.server.subscriptions) == ["theirs"]
    assert bench.ledger.read().targets == ()


def test_a_flow_that_is_gone_loses_its_subscription(bench: Bench) -> None:
    bench.target.apply([rule(), rule("/lidar", 17901)])

    changes = bench.target.apply([rule("/lidar", 17901)])

    assert kinds(changes) == ["delete", "keep"]
    assert list(bench.server.subscriptions) == ["sub-2"]


def test_a_delete_that_is_answered_with_200_or_404_is_a_delete(bench: Bench) -> None:
    bench.server.deletes_with_200 = True
    bench.target.apply([rule(), rule("/lidar", 17901)])
    del bench.server.subscriptions["sub-2"]

    bench.target.remove()

    assert bench.server.subscriptions == {}
    assert bench.ledger.read().targets == ()


def test_only_the_id_is_taken_of_a_location_so_that_no_token_goes_elsewhere(bench: Bench) -> None:
    bench.server.absolute_locations = True
    bench.target.apply([rule()])

    bench.target.remove()
    assert bench.server.asked[-1].path.endswith("/robots/subscriptions/sub-1")


@pytest.mark.parametrize("status", [429, 503])
def test_retry_after_is_waited_for(bench: Bench, status: int) -> None:
    bench.server.failures = [("POST", Answer(status, None, {"retry-after": "7"}))]

    bench.target.apply([rule()])

    assert bench.clock.slept == [7.0]
    assert bench.server.methods() == ["POST", "POST"]


def test_a_retry_after_beyond_all_patience_is_an_error_that_says_so(bench: Bench) -> None:
    answer = Answer(429, {"cause": "QUOTA"}, {"retry-after": "3600"}, PROBLEM)
    bench.server.failures = [("POST", answer)]

    with pytest.raises(PartlyError) as caught:
        bench.target.apply([rule()])

    url = f"{bench.server.url}/3gpp-as-session-with-qos/v1/robots"
    assert str(caught.value) == (
        f"cannot make 1 of 1 changes to nef at {url}:\n"
        "  /video /camera → /viewer udp 198.51.100.7 from device: "
        f"cannot POST {url}/subscriptions: 429 Too Many Requests: QUOTA; "
        "it is to be asked again in 3600 s, not within 60 s"
    )
    assert bench.clock.slept == []


def test_a_conflict_is_tried_again_with_growing_pauses_and_then_given_up(bench: Bench) -> None:
    bench.server.failures = [("POST", Answer(409, {"cause": "BUSY"}, type=PROBLEM))] * 5

    with pytest.raises(PartlyError, match="409 Conflict: BUSY"):
        bench.target.apply([rule()])

    assert bench.clock.slept == [0.5, 1.0, 2.0, 4.0]
    assert bench.ledger.read().targets == ()


def test_one_flow_that_is_refused_does_not_keep_others_from_being_made(bench: Bench) -> None:
    refusal = Answer(403, {"cause": "QOS_NOT_ALLOWED", "detail": "not yours"}, type=PROBLEM)
    bench.server.failures = [("POST", refusal)]

    with pytest.raises(PartlyError) as caught:
        bench.target.apply([rule(), rule("/lidar", 17901)])

    assert "cannot make 1 of 2 changes" in str(caught.value)
    assert "403 Forbidden: QOS_NOT_ALLOWED: not yours; check the token" in str(caught.value)
    assert list(bench.server.subscriptions) == ["sub-1"]


def test_what_came_of_a_lost_answer_is_looked_up_and_deleted_before_it_is_asked_for_again(
    bench: Bench,
) -> None:
    bench.server.lose_answers = True
    with pytest.raises(PartlyError, match="Server disconnected"):
        bench.target.apply([rule()])
    (flow,) = bench.server.subscriptions["sub-1"]["flowInfo"]
    flow["flowDescriptions"] = ["permit  in udp from 10.45.0.3 17900 to 198.51.100.7 17910"]

    bench.target.apply([rule()])

    assert bench.server.methods() == ["POST", "GET", "DELETE", "POST"]
    assert list(bench.server.subscriptions) == ["sub-2"]
    assert kinds(bench.target.apply([rule()])) == ["keep"]


def test_a_server_error_leaves_a_pending_entry_that_the_next_apply_settles(bench: Bench) -> None:
    bench.server.failures = [("POST", Answer(500, None))]

    with pytest.raises(PartlyError, match="500 Internal Server Error"):
        bench.target.apply([rule()])

    (record,) = bench.ledger.read().targets
    assert [each.id for each in record.entries] == [""]
    (change,) = bench.target.apply([rule()]).changes
    assert change.detail == "asked for before, and not answered"
    assert list(bench.server.subscriptions) == ["sub-1"]


def test_a_run_that_died_before_the_answer_is_found_and_removed_by_the_next(bench: Bench) -> None:
    bench.target.apply([rule()])
    (record,) = bench.ledger.read().targets
    died = replace(record.entries[0], id="")
    bench.ledger.put(replace(record, entries=(died,)))

    bench.again().remove()

    assert bench.server.subscriptions == {}
    assert bench.ledger.read().targets == ()


def test_nobody_at_the_address_is_one_clear_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with NefServer() as server:
        pass
    bench = made(tmp_path, server, Clock(monkeypatch))
    with pytest.raises(PartlyError, match=r"cannot POST .*: .*Connection refused"):
        bench.target.apply([rule()])
    assert bench.ledger.read().targets == ()


def test_a_redirect_is_not_followed_with_our_token(bench: Bench) -> None:
    bench.server.failures = [("POST", Answer(307, None, {"location": "http://127.0.0.1:1/x"}))]

    with pytest.raises(PartlyError, match="307 Temporary Redirect"):
        bench.target.apply([rule()])


def test_the_token_is_in_requests_and_nowhere_else(
    bench: Bench, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    caplog.set_level(logging.DEBUG)
    bench.target.apply([rule()])
    bench.server.failures = [("DELETE", Answer(401, None))]

    with pytest.raises(PartlyError) as caught:
        bench.target.apply([rule(port=18000)])

    assert bench.server.asked[0].headers["authorization"] == f"Bearer {TOKEN}"
    trace = "".join(
        traceback.TracebackException.from_exception(caught.value, capture_locals=True).format()
    )
    files = [each.read_text() for each in tmp_path.rglob("*") if each.is_file()]
    dump = bench.target.export(RuleSet(rules=(rule(),)))
    for text in (caplog.text, trace, dump, repr(vars(bench.target.real)), *files):
        assert TOKEN not in text
