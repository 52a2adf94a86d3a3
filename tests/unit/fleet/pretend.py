"""A `lifecycle` of which only what `up --hosts` needs is there: `host-agent`, `up` and `down`.

Its `up` has a run directory like a real one, and does what files beside the manifest say: it is
active once there is `go`, fails upon `fail`, writes the lines of `talk`. It ends upon SIGTERM.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from pathlib import Path

from lifecycle.fleet import serve
from lifecycle.run_directory import RunDirectory, new_run_id, runtime_root

COMMAND = (sys.executable, __file__)


def say(**record: object) -> None:
    print(json.dumps(record), flush=True)


def up(words: list[str]) -> int:
    machine = words[words.index("--machine") + 1]
    manifest = Path(words[words.index("--") + 1])
    control = Path(manifest.read_text().strip())
    asked: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: asked.append(number))
    directory = RunDirectory.acquire(runtime_root(os.environ), f"patrol@7.{machine}", new_run_id())
    print(f"warning of {machine}", file=sys.stderr, flush=True)
    say(event="run", system="patrol", words=words)
    is_active, code, end = False, 0, time.monotonic() + 30
    while not asked and time.monotonic() < end:
        if (control / "fail").exists():
            code = 6
            break
        if (control / "go").exists() and not is_active:
            is_active = True
            say(event="system", reached="active", elapsed_s=1.0)
        time.sleep(0.01)
    directory.release()
    code = code or (0 if is_active else 143)
    say(event="stopped", exit_code=code)
    say(verdict="ok", run={"exit_code": code})
    return code


def main(words: list[str]) -> int:
    if words[0] == "host-agent":
        serve(0, 1, command=COMMAND, silent_s=float(os.environ.get("SILENT_S", "20")))
        return 0
    if words[0] == "up":
        return up(words[1:])
    print(f"pretends no {words}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
