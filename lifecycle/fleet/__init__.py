"""Starts, watches and ends the supervisors of several hosts from one place, over ssh.

Owns: `lifecycle up --hosts`: the coordinator, its transports, and the agent on each host. Public:
what the command line uses of them.
"""

from lifecycle.doors import open_door

__getattr__, __dir__, __all__ = open_door(__name__, __file__)
