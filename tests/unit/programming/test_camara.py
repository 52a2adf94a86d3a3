"""CAMARA QualityOnDemand against a stateful server that the interface's own document checks."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from msgspec.structs import replace

from lifecycle.programming.ledger import Ledger
from lifecycle.programming.target import (
    FlowChange,
    Means,
    PartlyError,
    TargetChanges,
    read_targets,
)
from tests.unit.programming.fakes import Waited
from tests.unit.programming.samples import camara_settings, ledger_in, rule, settings_file
from tests.unit.programming.servers import TOKEN, Answer, Asked, CamaraServer, Clock


@dataclasses.dataclass
class Bench:
    """A target maker, its server and what lies between them."""

    make: Callable[..., Waited]
    server: CamaraServer
    ledger: Ledger
    clock: Clock

    @property
    def session(self) -> dict[str, object]:
        (only,) = self.server.sessions.values()
        return only


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    """A QualityOnDemand interface without sessions."""
    clock = Clock(monkeypatch)
    with CamaraServer(clock) as server:
        ledger = ledger_in(tmp_path)
        targets = Means(ledger)

        def make(**settings: object) -> Waited:
            file = settings_file(tmp_path, camara=camara_settings(server.url, **settings))
            return Waited(read_targets(["camara"], {"config": file})[0].open(targets))

        yield Bench(make, server, ledger, clock)


def only(changes: TargetChanges) -> FlowChange:
    (change,) = changes.changes
    return change


def test_a_flow_becomes_a_session_and_a_second_apply_changes_nothing(bench: Bench) -> None:
    target = bench.make()

    first, second = target.apply([rule()]), target.apply([rule()])

    assert (only(first).kind.value, only(second).kind.value) == ("create", "keep")
    assert bench.server.methods() == ["POST"]
    asked = {"device", "applicationServer", "devicePorts", "applicationServerPorts", "qosProfile"}
    assert {key: bench.session[key] for key in asked} == {
        "device": {"ipv4Address": {"publicAddress": "10.45.0.3", "privateAddress": "10.45.0.3"}},
        "applicationServer": {"ipv4Address": "198.51.100.7"},
        "devicePorts": {"ports": [17900]},
        "applicationServerPorts": {"ports": [17910]},
        "qosProfile": "QOS_E",
    }


def test_ipv6_devices_and_servers_are_asked_for_as_such(bench: Bench) -> None:
    target = bench.make(devices=["2001:db8:45::/48"])

    target.apply([rule(source="2001:db8:45::3", destination="2001:db8:99::7")])

    assert bench.session["device"] == {"ipv6Address": "2001:db8:45::3"}
    assert bench.session["applicationServer"] == {"ipv6Address": "2001:db8:99::7"}


def test_a_port_that_changed_ends_the_old_session_before_the_new_one(bench: Bench) -> None:
    target = bench.make()
    target.apply([rule(port=17900)])

    assert only(target.apply([rule(port=18000)])).kind.value == "update"
    assert bench.server.methods() == ["POST", "DELETE", "POST"]
    assert bench.session["devicePorts"] == {"ports": [18000]}


def test_a_session_that_is_only_requested_is_waited_for(bench: Bench) -> None:
    bench.server.asks_until_available = 3

    change = only(bench.make().apply([rule()]))

    assert change.detail == ""
    assert bench.server.methods() == ["POST", "GET", "GET", "GET"]
    assert bench.clock.slept == [0.25, 0.5, 1.0]


def test_a_session_that_stays_requested_is_told_after_a_bounded_wait(bench: Bench) -> None:
    bench.server.asks_until_available = 1000

    change = only(bench.make().apply([rule()]))

    assert change.detail == "requested, not yet available"
    assert 9.0 <= sum(bench.clock.slept) <= 10.0


def test_a_session_that_the_network_cannot_provide_is_deleted_and_an_error(bench: Bench) -> None:
    bench.server.asks_until_available = 1000
    session = {"qosStatus": "UNAVAILABLE", "statusInfo": "NETWORK_TERMINATED", "sessionId": "x"}
    bench.server.failures = [("GET", Answer(200, session))]

    with pytest.raises(PartlyError, match=r"made session \S+ unavailable \(NETWORK_TERMINATED\)"):
        bench.make().apply([rule()])

    assert bench.server.sessions == {}
    assert bench.ledger.read().targets == ()


def test_a_shorter_duration_than_asked_for_is_told(bench: Bench) -> None:
    bench.server.longest_s = 600

    change = only(bench.make().apply([rule()]))

    assert change.detail == "granted for 600 s instead of 3600 s"


def test_a_session_is_extended_before_it_expires_and_not_sooner(bench: Bench) -> None:
    target = bench.make(duration_s=1000)
    target.apply([rule()])

    assert target.renew() == 800.0
    bench.clock.now += 801
    assert target.renew() == 999.0
    assert bench.server.asked[-1].path.endswith("/extend")
    assert bench.server.asked[-1].body == {"requestedAdditionalDuration": 1000}
    assert bench.session["duration"] == 2000


def test_a_clock_that_is_set_back_makes_no_session_last_longer(bench: Bench) -> None:
    target = bench.make(duration_s=1000)
    target.apply([rule()])
    assert target.renew() == 800.0
    bench.clock.is_set_s = -3600.0
    assert target.renew() == 800.0
    bench.clock.now += 801
    target.renew()
    assert bench.server.asked[-1].path.endswith("/extend")


def test_a_session_at_its_longest_is_replaced_instead_of_left_to_expire(bench: Bench) -> None:
    bench.server.longest_s = 1000
    target = bench.make(duration_s=1000)
    target.apply([rule()])
    (old,) = bench.server.sessions
    bench.clock.now += 801

    assert target.renew() == 800.0
    (new,) = bench.server.sessions
    assert new != old
    assert only(target.apply([rule()])).kind.value == "keep"


def test_a_session_that_cannot_be_extended_any_more_is_made_anew(bench: Bench) -> None:
    target = bench.make(duration_s=1000)
    target.apply([rule()])
    (old,) = bench.server.sessions
    bench.clock.now += 900
    bench.server.expire(old)

    assert target.renew() == 800.0
    assert bench.session["qosStatus"] == "AVAILABLE"
    assert old not in bench.server.sessions


def test_a_session_that_nobody_prolonged_is_made_anew_by_the_next_apply(bench: Bench) -> None:
    target = bench.make(duration_s=1000)
    target.apply([rule()])
    (old,) = bench.server.sessions
    bench.clock.now += 1000
    bench.server.expire(old)

    change = only(target.apply([rule()]))

    assert (change.kind.value, change.detail) == ("update", "it has expired")
    assert bench.session["qosStatus"] == "AVAILABLE"


def test_a_token_that_the_server_quotes_in_its_refusal_is_not_repeated(bench: Bench) -> None:
    quoted = f"cannot accept 'Bearer {TOKEN}'"
    refusal = Answer(401, {"status": 401, "code": "UNAUTHENTICATED", "message": quoted})
    bench.server.failures = [("POST", refusal)]

    with pytest.raises(PartlyError) as caught:
        bench.make().apply([rule()])

    assert TOKEN not in str(caught.value)
    assert "401 Unauthorized: UNAUTHENTICATED: cannot accept 'Bearer ***'" in str(caught.value)


def test_a_renewal_that_fails_says_which_flow_will_lose_its_session(bench: Bench) -> None:
    target = bench.make(duration_s=1000)
    target.apply([rule()])
    bench.clock.now += 801
    refusal = Answer(403, {"status": 403, "code": "PERMISSION_DENIED", "message": "no"})
    bench.server.failures = [("POST", refusal)]

    with pytest.raises(PartlyError, match=r"/video /camera → /viewer .*403 Forbidden"):
        target.renew()


def test_somebody_elses_session_for_the_same_flow_is_an_error_and_stays(bench: Bench) -> None:
    target = bench.make()
    target.apply([rule()])
    bench.ledger.put(replace(bench.ledger.read().targets[0], entries=()))

    with pytest.raises(PartlyError, match="409 Conflict: CONFLICT: no: conflict"):
        target.apply([rule()])

    assert len(bench.server.sessions) == 1
    assert bench.ledger.read().targets == ()


def test_what_came_of_a_lost_answer_is_looked_up_by_device(bench: Bench) -> None:
    bench.server.lose_answers = True
    target = bench.make()
    with pytest.raises(PartlyError):
        target.apply([rule()])

    target.apply([rule()])

    assert [each.path.rpartition("/")[2] for each in bench.server.asked][:2] == [
        "sessions",
        "retrieve-sessions",
    ]
    assert len(bench.server.sessions) == 1
    assert only(target.apply([rule()])).kind.value == "keep"


def test_the_document_that_checks_these_requests_does_refuse_wrong_ones(bench: Bench) -> None:
    server = {"ipv4Address": "198.51.100.7"}
    wrong = {"applicationServer": server, "qosProfile": "x", "duration": 0}
    headers = {"content-type": "application/json", "authorization": "Bearer x"}
    path = "/quality-on-demand/v1/sessions"

    bench.server.answer(Asked("POST", path, headers, wrong))
    bench.server.answer(Asked("POST", path, {"content-type": "application/json"}, wrong))

    kinds = [each.split(": ")[1].split("(")[0] for each in bench.server.complaints]
    bench.server.complaints.clear()
    assert kinds == ["InvalidRequestBody", "InvalidData", "SecurityValidationError"]
