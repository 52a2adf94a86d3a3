"""The gate: who gets a permit, and what it takes to send an activate request."""

from __future__ import annotations

import pytest

from lifecycle.errors import BringUpError, ExitCode
from lifecycle.supervisor.gate import Gate, Permit, VerificationError
from lifecycle.verify.verdict import Outcome
from tests.unit.supervisor.fakes import verdict_of


def test_an_ok_verdict_opens_the_gate() -> None:
    gate = Gate(strict=True)
    permit = gate.judge(verdict_of(Outcome.OK))
    permit.check()


def test_a_violated_verdict_closes_it_with_exit_code_4_and_every_finding() -> None:
    verdict = verdict_of(Outcome.VIOLATED, "graph.missing-node", "graph.qos-differs")
    with pytest.raises(VerificationError) as caught:
        Gate(strict=False).judge(verdict)
    assert caught.value.exit_code is ExitCode.VIOLATED
    assert str(caught.value) == (
        "cannot activate: the verdict is violated\n"
        "  graph.missing-node: graph.missing-node on /camera\n"
        "  graph.qos-differs: graph.qos-differs on /camera"
    )


def test_unverifiable_passes_unless_the_policy_or_strict_says_that_it_blocks() -> None:
    lenient = verdict_of(Outcome.UNVERIFIABLE, "state.unverifiable")
    Gate(strict=False).judge(lenient).check()
    for gate, verdict in (
        (Gate(strict=True), lenient),
        (
            Gate(strict=False),
            verdict_of(Outcome.UNVERIFIABLE, "state.unverifiable", blocking=True),
        ),
    ):
        with pytest.raises(VerificationError) as caught:
            gate.judge(verdict)
        assert caught.value.exit_code is ExitCode.UNVERIFIABLE


def test_a_permit_dies_with_the_gate() -> None:
    gate = Gate(strict=False)
    permit = gate.judge(verdict_of(Outcome.OK))
    gate.close()
    with pytest.raises(BringUpError, match="the gate was closed again before this request"):
        permit.check()


def test_a_newer_verdict_replaces_the_permit_of_an_older_one() -> None:
    gate = Gate(strict=False)
    old = gate.judge(verdict_of(Outcome.OK))
    with pytest.raises(VerificationError):
        gate.judge(verdict_of(Outcome.VIOLATED, "graph.missing-node"))
    with pytest.raises(BringUpError):
        old.check()


def test_a_permit_made_past_the_gate_is_worth_nothing() -> None:
    gate = Gate(strict=False)
    forged = Permit(gate, verdict_of(Outcome.OK))
    with pytest.raises(BringUpError):
        forged.check()
    with pytest.raises(BringUpError):
        Permit(gate, verdict_of(Outcome.VIOLATED, "graph.missing-node"))
