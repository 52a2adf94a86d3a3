"""Manifest → Plan: the computational and the data layer graph of a system, ready to run. Pure."""

from lifecycle.doors import open_door

__getattr__, __dir__, __all__ = open_door(__name__, __file__)
