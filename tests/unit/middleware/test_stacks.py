"""What is shown of where the threads of a process stand."""

from __future__ import annotations

import os
import sysconfig
import time
from pathlib import Path

import lifecycle
from lifecycle.middleware.process import busy_sign
from lifecycle.middleware.process.busy_sign import BusySign

OURS = str(Path(lifecycle.__file__).parent)
STDLIB = sysconfig.get_path("stdlib")


def thread(*frames: tuple[str, int, str]) -> str:
    lines = [f'  File "{file}", line {line} in {name}' for file, line, name in frames]
    return "\n".join(["Thread 0x00007f649a02a4c0 (most recent call first):", *lines, ""])


EXECUTOR = (f"{OURS}/middleware/rcl/rclpy_nodes.py", 347, "_run_timer")
HOST = (f"{OURS}/node/host/host.py", 250, "serve")


def test_the_callback_and_what_it_called_last_are_shown() -> None:
    frames = [("/robot/deep.py", 9 - depth, f"f{depth}") for depth in range(5)]
    found = busy_sign.brief(thread((f"{STDLIB}/socket.py", 1, "recv"), *frames, EXECUTOR, HOST))
    assert found == "f4 (/robot/deep.py:5) > f1 (/robot/deep.py:8) > f0 (/robot/deep.py:9)"


def test_what_a_host_was_forked_from_is_no_callback() -> None:
    command = ("/venv/lib/python3.11/site-packages/click/core.py", 911, "invoke")
    ours = (f"{OURS}/cli/__init__.py", 201, "program")
    assert busy_sign.brief(thread(EXECUTOR, HOST, command, ours)) == ""


def test_a_thread_of_the_users_is_no_callback() -> None:
    worker = thread(("/robot/camera.py", 5, "grab"), (f"{STDLIB}/threading.py", 982, "run"))
    callback = thread(
        ("/robot/camera.py", 20, "show"),
        ("/opt/ros/jazzy/lib/python3.12/site-packages/rclpy/task.py", 239, "__call__"),
        (f"{STDLIB}/concurrent/futures/thread.py", 58, "run"),
    )
    assert busy_sign.brief(f"{worker}\n{callback}") == "show (/robot/camera.py:20)"


def test_an_installed_package_of_the_users_is_shown() -> None:
    file = f"{STDLIB}/site-packages/robot/node.py"
    assert busy_sign.brief(thread((file, 3, "tick"), EXECUTOR, HOST)) == f"tick ({file}:3)"


def test_nothing_is_shown_of_nothing() -> None:
    assert busy_sign.brief("") == ""


def test_another_process_shows_where_it_stands_and_what_it_does() -> None:
    sign = BusySign.make(0.1)
    child = os.fork()
    if not child:
        try:
            sign.show_stacks()
            busy_sign.show_stacks_here()
            sign.begin(what="of the service /reset")
            time.sleep(30)
        finally:
            os._exit(0)
    try:
        deadline = time.monotonic() + 10
        while not sign.what and time.monotonic() < deadline:
            time.sleep(0.01)
        assert "test_stacks.py" in sign.where(child)
        assert sign.where(child).count("test_another_process") == 1  # each time what is now
        assert sign.what == "of the service /reset"
    finally:
        os.kill(child, 9)
        os.waitpid(child, 0)
        sign.close()


def test_who_does_not_answer_is_sent_nothing() -> None:
    sign = BusySign.make(0.1)
    try:
        assert sign.where(os.getpid()) == ""
    finally:
        sign.close()
