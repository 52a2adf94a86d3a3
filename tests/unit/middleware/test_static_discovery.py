"""The table of endpoints that are not announced, and how an endpoint finds its line."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.profiles import (
    check_endpoint,
)
from lifecycle.plan.model import StaticEndpoint

_STRING = "std_msgs::msg::dds_::String_"


def line(topic: str, user_id: int, *, writer: bool = True, **changes: bool) -> StaticEndpoint:
    return StaticEndpoint(
        writer=writer,
        topic=f"rt{topic}",
        type=_STRING,
        profile=topic,
        user_id=user_id,
        **changes,
    )


def test_an_endpoint_is_found_by_direction_name_and_type_together() -> None:
    lines = [
        line("/x", 1, writer=False),
        replace(line("/x", 2), type="std_msgs::msg::dds_::Int32_"),
        line("/y", 3),
        line("/x", 4),
    ]
    check_endpoint(lines, writer=True, profile="/x", type_name=_STRING)
    with pytest.raises(MiddlewareError):
        check_endpoint(lines[:3], writer=True, profile="/x", type_name=_STRING)


@pytest.mark.parametrize(
    ("lines", "listed"),
    [((line("/x", 1), line("/y", 2, writer=False)), f"/x ({_STRING})"), ((), "none")],
)
def test_an_endpoint_that_nobody_would_find_is_refused(
    lines: tuple[StaticEndpoint, ...], listed: str
) -> None:
    with pytest.raises(MiddlewareError) as refused:
        check_endpoint(lines, writer=True, profile="/y", type_name=_STRING)
    assert str(refused.value) == (
        f"cannot make a writer of '/y' ({_STRING}): the table of static discovery has only these "
        f"writers for this participant: {listed}; declare the endpoint, and check or plan again"
    )
