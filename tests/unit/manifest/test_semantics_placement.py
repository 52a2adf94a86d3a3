"""Checks of machines, processes and ports."""

from __future__ import annotations

from collections.abc import Callable

import pytest

Findings = Callable[..., list[str]]


def many(count: int, *, flows: str = "", kind: str = "publishers") -> str:
    """Return one node with `count` endpoints that all have the same flow need."""
    names = [f"e{index}" for index in range(count)]
    lines = ["machines: {robot: {address: 10.0.0.1}}", "policy: {unheard: ignore,"]
    lines += ["  unpublished: ignore}", "nodes:", "  n:", '    run: {python: "demo:N"}']
    lines += ["    machine: robot", "    interface:", f"      {kind}:"]
    lines += [f"        - {{name: {name}, type: std_msgs/msg/Empty}}" for name in names]
    lines += ["    flows:", f"      {kind}:"]
    lines += [f"        {name}: {flows}" for name in names]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("count", "flows", "domain", "participants"),
    [
        # One more for the process, and one for the supervisor that observes.
        (118, "{unique: strictly_required}", 0, None),
        (119, "{unique: strictly_required}", 0, 121),
        (61, "{unique: optionally_required}", 232, None),
        (62, "{unique: optionally_required}", 232, 64),
        (200, "{dscp: EF}", 0, None),  # one participant carries them all
    ],
)
def test_participants_that_own_flows_count_against_the_ports(
    findings: Findings, count: int, flows: str, domain: int, participants: int | None
) -> None:
    found = findings(f"discovery: {{domain_id: {domain}}}\n" + many(count, flows=flows))
    fit, limit = (120, "the ports of domain 1, from 7650") if domain == 0 else (63, "")
    expected = (
        f"check.ports 3:1: discovery: cannot run {participants} participants in domain "
        f"{domain} on 'robot': {fit} fit before {limit or 'the highest port, 65535'}; "
    )
    assert [each.startswith(expected) for each in found] == [True] * bool(participants)


LOCALHOST = "ROS_AUTOMATIC_DISCOVERY_RANGE"
ELSEWHERE = f"environment: {{{LOCALHOST}: SUBNET}}"


@pytest.mark.parametrize(
    ("discovery", "first", "found"),
    [
        ("range: localhost", 'python: "demo:N"', True),
        ("range: localhost, transport: udpv4", 'python: "demo:N"', True),
        ("mode: dynamic", 'python: "demo:N"', True),
        ("range: localhost, transport: shm", 'python: "demo:N"', False),
        ("range: subnet", 'python: "demo:N"', False),
        ("mode: static", 'python: "demo:N"', False),
        ("range: localhost", "attach: true", False),
        ("range: localhost", f'python: "demo:N", {ELSEWHERE}', False),
        (
            "range: localhost",
            'python: "demo:N", environment: {RMW_IMPLEMENTATION: rmw_cyclonedds_cpp}',
            False,
        ),
    ],
)
def test_two_participants_beyond_those_that_localhost_looks_for_never_find_each_other(
    findings: Findings,
    monkeypatch: pytest.MonkeyPatch,
    discovery: str,
    first: str,
    found: bool,
) -> None:
    monkeypatch.setenv(LOCALHOST, "LOCALHOST")
    nodes = [f"  n0: {{run: {{{first}}}}}\n"]
    nodes += [f'  n{index}: {{run: {{python: "demo:N"}}}}\n' for index in range(1, 33)]
    text = f"discovery: {{{discovery}}}\nnodes:\n"
    rule = "check.localhost"
    assert [each for each in findings(text + "".join(nodes[:-1])) if rule in each] == []
    message = (
        "check.localhost 3:1: discovery: cannot run 34 participants with range localhost on "
        "'local': at most 33 all find each other, because each looks for participants 0 to 31 of "
        "its host only; use 'range: subnet', or give several nodes one 'process:'"
    )
    assert [each for each in findings(text + "".join(nodes)) if rule in each] == [message] * found


def test_machines_of_one_address_are_one_host(findings: Findings) -> None:
    nodes = "".join(
        f'  n{index}: {{run: {{python: "demo:N"}}, machine: {"ab"[index % 2]}}}\n'
        for index in range(54)
    )
    found = findings(
        f"discovery: {{domain_id: 101}}\nmachines: {{a: {{}}, b: {{}}}}\nnodes:\n{nodes}"
    )
    assert found == [
        (
            "check.ports 3:1: note: discovery: cannot run 55 participants in domain 101 on "
            "'a' and 'b': 54 fit before the ephemeral ports 32768–60999; use a domain of "
            "0–101, 215–232, fewer processes, or fewer unique publishers"
        )
    ]


@pytest.mark.parametrize(("domain", "sure"), [(101, True), (102, False), (214, False), (215, True)])
def test_domains_in_the_ephemeral_range_are_doubtful(
    findings: Findings, domain: int, sure: bool
) -> None:
    found = findings(f"""
        discovery: {{domain_id: {domain}}}
        nodes: {{n: {{run: {{python: "demo:N"}}}}}}
    """)
    assert [each.split(":")[0] for each in found] == ["check.ports 3"] * (not sure)


def test_processes_that_fit_together_are_silent(findings: Findings) -> None:
    assert not findings("""
        nodes:
          a: {run: {python: "demo:A", environment: {X: "1"}}, process: p}
          b: {run: {python: "demo:B", environment: {X: "1"}}, process: p}
          p: {run: {python: "demo:P", environment: {X: "1"}}, process: p}
    """)
