"""Nothing but what a verb prints comes out on standard output."""

from __future__ import annotations

import subprocess
import sys

_PROGRAM = """
import os
from lifecycle.cli.own_stdout import keep_stdout
print("before")
keep_stdout()
os.write(1, b"a library\\n")
os.system("echo a child")
print("ours", flush=True)
os.write(1, b"again\\n")
"""


def test_what_libraries_and_children_print_goes_to_standard_error() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM], capture_output=True, text=True, check=True
    )
    assert done.stdout == "before\nours\n"
    assert done.stderr == "a library\na child\nagain\n"


def test_a_closed_standard_output_is_left_alone() -> None:
    program = "import os\nos.close(1)\nfrom lifecycle.cli.own_stdout import keep_stdout\n"
    done = subprocess.run(
        [sys.executable, "-c", program + "keep_stdout()\n"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    assert "Traceback" not in done.stderr
