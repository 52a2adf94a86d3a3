"""What a node's class or function is called with: `arguments:`, and a name where it needs one."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import pytest
from host_process import hosted
from msgspec.structs import replace

from lifecycle.node.host.adoption import keywords


class _Needs:
    def __init__(self, node_name: str, depth: int = 1) -> None: ...


class _Has:
    def __init__(self, depth: int, node_name: str = "mine") -> None: ...


class _NeedsByName:
    def __init__(self, *args: Any, depth: int = 1, node_name: str, **named: Any) -> None: ...


class _Takes:
    def __init__(self, *node_name: str, **named: Any) -> None: ...


class _Inherits(_Needs):
    pass


class _MadeOtherwise:
    def __new__(cls, node_name: str) -> _MadeOtherwise:  # noqa: PYI034 - not in Python 3.10
        return super().__new__(cls)


class _Plain:
    pass


def _function(node_name: str) -> object:
    return object()


@functools.wraps(_function)
def _wrapped(*args: Any, **named: Any) -> Any:
    return _function(*args, **named)


@pytest.mark.parametrize(
    ("what", "needs"),
    [
        (_Needs, True),
        (_Has, False),
        (_NeedsByName, True),
        (_Takes, False),
        (_Inherits, True),
        (_MadeOtherwise, True),
        (_Plain, False),
        (_function, True),
        (_wrapped, True),
        (functools.partial(_function, node_name="given"), False),
        (functools.partial(_function), True),
        (lambda: None, False),
    ],
)
def test_a_name_is_given_to_what_needs_one(what: Callable[..., Any], needs: bool) -> None:
    planned = hosted("camera", "Good")
    assert keywords(planned, what) == ({"node_name": "camera"} if needs else {})


def test_a_name_that_the_manifest_gives_stays() -> None:
    planned = hosted("camera", "Good")
    run = replace(planned.run, arguments={"node_name": "mine", "sizes": (1, 2)})
    planned = replace(planned, run=run)
    assert keywords(planned, _function) == {"node_name": "mine", "sizes": [1, 2]}
