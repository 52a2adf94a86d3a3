"""The promise, tried from outside: the real command on real DDS, what it says and what it allows.

`make outside` runs all of it, also against another installation: `LIFECYCLE=path/to/lifecycle make
outside`. The tables are in `cases/`, one module for each kind of attack; `case.py` says what a row
is, `running.py` runs one. Nothing here imports the package: only its public names are used, and
only by the programs of a system (`programs/`).
"""
