"""What a node's class or function is called with: `arguments:`, and a name where it needs one."""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import Any

import pytest
from host_process import hosted

from lifecycle.node.host.foreign import keywords


def _wrapped(function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def call(*args: Any, **named: Any) -> Any:
        return function(*args, **named)

    return call


class _Needs:
    def __init__(self, node_name: str, depth: int = 1) -> None: ...


class _Has:
    def __init__(self, depth: int, node_name: str = "mine") -> None: ...


class _NeedsByName:
    def __init__(self, *args: Any, depth: int = 1, node_name: str, **named: Any) -> None: ...


class _HasByName:
    def __init__(self, *, node_name: str = "mine") -> None: ...


class _Takes:
    def __init__(self, *node_name: str, **named: Any) -> None: ...


class _Uses:
    def __init__(self) -> None:
        node_name = "mine"
        del node_name


class _Inherits(_Needs):
    pass


class _Decorated:
    @_wrapped
    def __init__(self, node_name: str) -> None: ...


class _MadeOtherwise:
    def __new__(cls, node_name: str) -> _MadeOtherwise:  # noqa: PYI034 - not in Python 3.10
        return super().__new__(cls)


class _Meta(type):
    def __call__(cls, depth: int) -> object:
        return object()


class _CalledOtherwise(metaclass=_Meta):
    def __init__(self, node_name: str) -> None: ...


class _Says:
    __signature__ = inspect.Signature()

    def __init__(self, node_name: str) -> None: ...


class _Plain:
    pass


class _Callable:
    def __call__(self, node_name: str) -> object:
        return object()


def _function(node_name: str) -> object:
    return object()


async def _coroutine(*, node_name: str) -> object:
    return object()


@pytest.mark.parametrize(
    ("what", "needs"),
    [
        (_Needs, True),
        (_Has, False),
        (_NeedsByName, True),
        (_HasByName, False),
        (_Takes, False),
        (_Uses, False),
        (_Inherits, True),
        (_Decorated, True),
        (_MadeOtherwise, True),
        (_CalledOtherwise, False),
        (_Says, False),
        (_Plain, False),
        (_Callable(), True),
        (_function, True),
        (_wrapped(_function), True),
        (_coroutine, True),
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
    run = dataclasses.replace(planned.run, arguments=(("node_name", "mine"), ("sizes", (1, 2))))
    planned = dataclasses.replace(planned, run=run)
    assert keywords(planned, _function) == {"node_name": "mine", "sizes": [1, 2]}
