"""Nodes and a program that note what their parameters are: `values.py [--ros-args …]`.

As nodes of the system (`values:Plain`, `values:Managed`), or as a program whose node is `/values`.
A note is `gain=-inf`, `names=[] STRING_ARRAY`; NaN is `nan`.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.parameter import Parameter

sys.path.insert(0, str(Path(__file__).parent))

import contextlib

from nodes import Marked, mark

from lifecycle import on_timer

NAMES = ("gain", "gains", "names", "counts")


def note(node: Node) -> None:
    """Mark each parameter as it is now."""
    for name in NAMES:
        if node.has_parameter(name):
            found = node.get_parameter_or(name, Parameter(name))
            value = list(found.value) if found.type_.name.endswith("_ARRAY") else found.value
            mark(node.get_name(), f"received {name}={value} {found.type_.name}")


def declare(node: Node) -> None:
    """Declare them with defaults that no row gives."""
    node.declare_parameter("gain", 1.0)
    node.declare_parameter("gains", [1.0])
    node.declare_parameter("names", ["default"])
    node.declare_parameter("counts", Parameter.Type.INTEGER_ARRAY)


class Managed(Marked):
    """Has what its interface declares, and notes it five times a second."""

    @on_timer(period_s=0.2)
    def look(self) -> None:
        note(self)


class Coded(Managed):
    """Declares its parameters in code."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        declare(self)


class Plain(Node):
    """Declares them, and notes them at once: before anything else can set them."""

    def __init__(self) -> None:
        super().__init__("values")
        declare(self)
        note(self)


def main() -> None:
    """Run a plain node until it is interrupted; it notes its parameters each 0.2 s."""
    rclpy.init()
    node = Node("values")
    declare(node)
    node.create_timer(0.2, lambda: note(node))
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == "__main__":
    main()
