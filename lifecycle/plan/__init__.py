"""Manifest → Plan: the computational and the data layer graph of a system, ready to run. Pure."""

from __future__ import annotations

from lifecycle.public import names

__getattr__ = names(
    __name__,
    build="build_plan",
    model="Plan",
)
