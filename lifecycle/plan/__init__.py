"""Manifest → Plan: the computational and the data layer graph of a system, ready to run. Pure."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
