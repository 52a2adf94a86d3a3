"""Which distribution of ROS 2 a version of rcl belongs to, and how another one is refused."""

from __future__ import annotations

import pytest

from lifecycle.errors import MiddlewareError
from lifecycle.middleware import versions
from lifecycle.middleware.versions import (
    INSTALL,
    JAZZY,
    KILTED,
    KNOWN_RCL,
    Distribution,
    of_rcl,
    private,
)


@pytest.mark.parametrize(
    ("version", "distribution"),
    [("9.2.5", JAZZY), ("10.1.3", KILTED), ("", JAZZY), ("1.0", None), ("11.0.0", None)],
)
def test_the_major_version_of_rcl_tells_the_distribution(
    version: str, distribution: Distribution | None
) -> None:
    assert of_rcl(version) is distribution


def test_an_rclpy_without_a_private_name_is_refused_by_its_version(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(versions, "rcl_version", lambda: "11.0.0")
    assert private("text", "upper", "shout")() == "TEXT"
    with pytest.raises(MiddlewareError) as refused:
        private("text", "_loud", "shout")
    assert str(refused.value) == (
        f"cannot shout: rclpy of rcl 11.0.0 has no _loud; known: {KNOWN_RCL}; {INSTALL}"
    )
