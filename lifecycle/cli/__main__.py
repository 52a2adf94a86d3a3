"""`python -m lifecycle.cli`."""

import sys

from lifecycle.cli import program

sys.exit(program())
