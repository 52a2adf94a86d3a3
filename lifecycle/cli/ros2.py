"""`ros2 manifest VERB`: this package's verbs as a command of ros2cli; found by its entry point."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from ros2cli.command import CommandExtension


class ManifestCommand(CommandExtension):  # type: ignore[misc]
    """Declare a ROS 2 system in a manifest, verify it, and only then activate it."""

    def add_arguments(self, parser: argparse.ArgumentParser, _cli_name: str) -> None:
        """Take everything: the verbs read their own arguments."""
        parser.add_argument(
            "arguments",
            nargs=argparse.REMAINDER,
            metavar="VERB …",
            help="as of lifecycle; lifecycle -h lists the verbs",
        )

    def main(self, *, parser: argparse.ArgumentParser, args: Any) -> int:  # noqa: ARG002
        """Do what `lifecycle` does, in this process."""
        from lifecycle.cli import program

        sys.argv = ["lifecycle", *(args.arguments or ["-h"])]
        return program()
