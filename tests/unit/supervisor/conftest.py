"""Async tests of this folder run in a loop whose clock jumps."""

from __future__ import annotations

import asyncio
import inspect

import pytest

from tests.unit.supervisor.fakes import run

BOUND_S = 20.0


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run an `async def` test; in real time where its module says `REAL_TIME = True`."""
    test = pyfuncitem.obj
    if not inspect.iscoroutinefunction(test):
        return None
    given = {name: pyfuncitem.funcargs[name] for name in inspect.signature(test).parameters}
    real = getattr(pyfuncitem.module, "REAL_TIME", False)
    if real:
        asyncio.run(asyncio.wait_for(test(**given), BOUND_S))
    else:
        run(test(**given))
    return True
