"""Verifies Plan × Observation → Verdict, and reports it. Pure: no ROS, no files, no clock."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
