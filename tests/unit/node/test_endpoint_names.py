"""How endpoints are called in requests."""

from __future__ import annotations

import pytest

from lifecycle.manifest.model import EndpointKind
from lifecycle.node.endpoint import UnknownEndpointError, find_endpoint

VIDEO = (EndpointKind.PUBLISHER, "video")
COMMAND = (EndpointKind.SUBSCRIPTION, "/robot/command")
ECHO_OUT = (EndpointKind.PUBLISHER, "echo")
ECHO_IN = (EndpointKind.SUBSCRIPTION, "echo")
DECLARED = (VIDEO, COMMAND, ECHO_OUT, ECHO_IN)


@pytest.mark.parametrize("key", DECLARED)
def test_kind_and_name_are_never_ambiguous(key: tuple[EndpointKind, str]) -> None:
    assert find_endpoint(key[0].spell(key[1]), DECLARED, node="/camera") == key


@pytest.mark.parametrize("key", [VIDEO, COMMAND])
def test_a_name_that_one_kind_has_is_enough(key: tuple[EndpointKind, str]) -> None:
    assert find_endpoint(key[1], DECLARED, node="/camera") == key


def test_a_topic_that_is_called_like_a_spelling_is_found_by_it() -> None:
    odd = (EndpointKind.SUBSCRIPTION, "publishers/map")
    assert find_endpoint("publishers/map", (VIDEO, odd), node="/camera") == odd


@pytest.mark.parametrize(
    ("spelling", "declared", "message"),
    [
        (
            "echo",
            DECLARED,
            (
                "cannot tell which 'echo' of /camera is meant; "
                "write 'publishers/echo' or 'subscriptions/echo'"
            ),
        ),
        (
            "vidoe",
            DECLARED,
            (
                "cannot find endpoint 'vidoe' of /camera; "
                "declared: 'publishers/video', 'subscriptions//robot/command', 'publishers/echo', "
                "'subscriptions/echo'"
            ),
        ),
        (
            "video",
            (),
            (
                "cannot find endpoint 'video' of /camera; "
                "endpoints are declared at configure; ask from on_configure on"
            ),
        ),
    ],
)
def test_what_is_not_declared_is_answered_with_what_is(
    spelling: str, declared: tuple[tuple[EndpointKind, str], ...], message: str
) -> None:
    with pytest.raises(UnknownEndpointError) as error:
        find_endpoint(spelling, declared, node="/camera")
    assert str(error.value) == message
