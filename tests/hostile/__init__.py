"""Attacks by the hundreds, and what `make hostile` makes of them: see `__main__`."""
