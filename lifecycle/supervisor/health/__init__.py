"""Liveliness of the processes, nodes and other supervisors of a system."""
