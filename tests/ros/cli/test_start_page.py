"""The page "Start here", followed step by step as a new user would; real DDS."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.ros, pytest.mark.thorough]

PAGE = (Path(__file__).parents[3] / "docs/start.md").read_text(encoding="utf-8")
STEP = re.compile(
    r"<!-- (append to|insert before links: in|replace in) (\S+) -->\n```\w+\n(.*?)```"
    r"|```(console)\n(.*?)```",
    re.DOTALL,
)
REPLACED = "    def on_configure(self):\n        self.count = 0\n"


def _edit(root: Path, how: str, name: str, block: str) -> None:
    file = root / name
    text = file.read_text(encoding="utf-8")
    if how == "append to":
        text += f"\n\n{block}"
    elif how == "replace in":
        assert text.count(REPLACED) == 1
        text = text.replace(REPLACED, block)
    else:
        text = text.replace("links:\n", f"{block}links:\n")
    file.write_text(text, encoding="utf-8")


def test_each_step_of_the_page_does_what_it_says(tmp_path: Path, fresh_domain: int) -> None:
    root, ran = tmp_path / "my_robot", []
    environment = {**os.environ, "ROS_DOMAIN_ID": str(fresh_domain), "ROS_LOG_DIR": str(tmp_path)}
    for how, name, block, console, lines in STEP.findall(PAGE):
        if not console:
            _edit(root, how, name, block)
            continue
        for command, shown in re.findall(r"^\$ (.*)\n((?:(?!\$ ).+\n)*)", lines, re.MULTILINE):
            program, *options = shlex.split(command)
            if program != "lifecycle":
                continue
            result = subprocess.run(
                [sys.executable, "-m", "lifecycle", *options],
                cwd=tmp_path if options[0] == "init" else root,
                env=environment,
                capture_output=True,
                text=True,
                timeout=60,
                check=False,
            )
            said = result.stdout + result.stderr
            assert result.returncode == (4 if "violated" in shown else 0), said
            assert all(each in said for each in shown.splitlines()), said
            ran.append(options[0])
    assert ran == ["init", "up", "check", "plan", "up", "up"]
