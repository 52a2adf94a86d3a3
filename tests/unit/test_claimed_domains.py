"""Domains of tests: one for each of those that run at once."""

from __future__ import annotations

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
