"""`python -m lifecycle`: the command line."""

import sys

from lifecycle.cli import program

sys.exit(program())
