"""What tests of running systems share: asking their nodes as any program may."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters

from lifecycle.middleware.rcl.graph import GraphObserver
from lifecycle.middleware.services.service_calls import ServiceCalls
from tests.ros.supervisor.running import BOUND_S


@pytest.fixture
def set_parameter(fresh_domain: int) -> Iterator[Callable[..., None]]:
    """Set a parameter of a node as `ros2 param set` does."""
    with GraphObserver(fresh_domain) as observer:
        calls = ServiceCalls(observer)

        def set_it(node: str, name: str, **value: Any) -> None:
            service = f"{node}/set_parameters"
            given = [Parameter(name=name, value=ParameterValue(**value))]
            answer = asyncio.run(calls.call(service, SetParameters, BOUND_S, parameters=given))
            assert [each.successful for each in answer.results] == [True], answer

        try:
            yield set_it
        finally:
            calls.destroy()
