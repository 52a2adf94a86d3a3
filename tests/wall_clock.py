"""A wall clock that processes started with it share, and that can be set while they run.

Owns: `WallClock`. The machine's clock, and all others of its processes, stay as they are.
"""

from __future__ import annotations

import shutil
import struct
import subprocess
from pathlib import Path

LACKS = "" if shutil.which("gcc") else "needs gcc: a wall clock of our own is compiled"
_SOURCE = Path(__file__).with_suffix(".c")


class WallClock:
    """Compiles what processes preload.

    Args:
        directory: for what is compiled, and for the file that says what the clock says.

    Attributes:
        variables: of the environment of the processes whose clock it is.
    """

    def __init__(self, directory: Path) -> None:
        self._file = directory / "wall_clock"
        self.set(0.0)
        library = directory / "wall_clock.so"
        words = ["gcc", "-shared", "-fPIC", "-O1", "-Wall", "-Werror", "-o", str(library)]
        subprocess.run([*words, str(_SOURCE), "-ldl"], check=True, timeout=60)
        self.variables = {"LD_PRELOAD": str(library), "WALL_CLOCK": str(self._file)}

    def set(self, ahead_s: float) -> None:
        """Let the clock be so many seconds ahead of the machine's; negative: behind."""
        with self._file.open("r+b" if self._file.exists() else "wb") as file:
            file.write(struct.pack("=q", round(ahead_s * 1e9)))
