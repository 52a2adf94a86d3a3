"""The catalogue: one module for each kind, each with a table `CASES`."""

from __future__ import annotations

import importlib
import pkgutil

from tests.outside.case import Case

CASES: tuple[Case, ...] = tuple(
    case
    for module in sorted(each.name for each in pkgutil.iter_modules(__path__))
    for case in importlib.import_module(f"{__name__}.{module}").CASES
)
