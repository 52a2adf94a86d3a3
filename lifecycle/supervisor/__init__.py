"""Brings a system up behind the gate, watches it, and takes it down: processes, order, rollback.

Owns: everything between a plan and a running system. Public: `up` and what it takes and gives,
`status` and `down` of a running one, `judge_running` for a system that others run.
"""
