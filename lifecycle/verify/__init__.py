"""Verifies Plan × Observation → Verdict, and reports it. Pure: no ROS, no files, no clock."""

from lifecycle.doors import open_door

__getattr__, __dir__, __all__ = open_door(__name__, __file__)
