"""Verifies Plan × Observation → Verdict, and reports it. Pure: no ROS, no files, no clock."""

from __future__ import annotations

from lifecycle.public import names

__getattr__ = names(
    __name__,
    judge="verify",
    outcome="Outcome",
    verdict="Finding Verdict",
)
