"""Brings a system up behind the gate, watches it, and takes it down: processes, order, rollback.

Owns: everything between a plan and a running system. Public: `up` and what it takes and gives,
`status` and `down` of a running one, `judge_running` for a system that others run. Names
load on first use: the fork server, which is of this room, must start without the rest of it.
"""

from lifecycle.doors import open_door

__getattr__, __dir__, __all__ = open_door(__name__, __file__)
