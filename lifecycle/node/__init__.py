"""LifecycleNode: the class to derive from, its state machine, and how it is run.

Owns: the node's side of everything.
"""
