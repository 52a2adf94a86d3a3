"""Which distribution of ROS 2 a version of rcl belongs to."""

from __future__ import annotations

import pytest

from lifecycle.middleware.versions import JAZZY, KILTED, Distribution, of_rcl


@pytest.mark.parametrize(
    ("version", "distribution"),
    [("9.2.5", JAZZY), ("10.1.3", KILTED), ("", JAZZY), ("1.0", None), ("11.0.0", None)],
)
def test_the_major_version_of_rcl_tells_the_distribution(
    version: str, distribution: Distribution | None
) -> None:
    assert of_rcl(version) is distribution
