"""The catalogue: one module for each kind, each with a table `CASES`."""

from __future__ import annotations

import importlib
import pkgutil

from tests.outside.case import Case

BY_MODULE: dict[str, tuple[Case, ...]] = {
    module: tuple(importlib.import_module(f"{__name__}.{module}").CASES)
    for module in sorted(each.name for each in pkgutil.iter_modules(__path__))
}
"""By module."""

CASES: tuple[Case, ...] = tuple(case for cases in BY_MODULE.values() for case in cases)
