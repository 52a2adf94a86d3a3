"""Domains of tests: one for each of those that run at once, none in which processes are left."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from lifecycle.pytest_plugin import claimed_domain


@pytest.fixture(autouse=True)
def pool(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Claim of three domains that no other test chooses from."""
    domains = [208, 209, 210]
    monkeypatch.setenv("LIFECYCLE_TEST_DOMAINS", f"{domains[0]}-{domains[-1]}")
    return domains


def test_each_claim_is_another_domain_until_it_is_given_back(pool: list[int]) -> None:
    with claimed_domain() as one, claimed_domain() as two, claimed_domain() as three:
        assert sorted([one, two, three]) == pool
        with pytest.raises(pytest.fail.Exception, match="taken by other tests"), claimed_domain():
            pass
    with claimed_domain() as again:
        assert again in pool


def test_a_domain_in_which_processes_were_left_is_the_last_choice(pool: list[int]) -> None:
    """Of a test that was killed itself, say."""
    waits = [sys.executable, "-c", "print('runs', flush=True); input()"]
    with subprocess.Popen(
        waits,
        env={**os.environ, "ROS_DOMAIN_ID": str(pool[0])},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    ) as left:
        assert left.stdout is not None
        left.stdout.readline()
        with claimed_domain() as one, claimed_domain() as two, claimed_domain() as three:
            assert {one, two} == set(pool[1:])
            assert three == pool[0]
