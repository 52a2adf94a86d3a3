"""Node classes whose process says when it asks for sender sockets."""

from __future__ import annotations

import functools
import sys
from typing import Any

from hosted import Good, Plain, Theirs
from rclpy.publisher import Publisher

from lifecycle.middleware.fastdds import nfe

__all__ = ["Good", "Plain", "Theirs"]


def _saying(function: Any) -> Any:
    @functools.wraps(function)
    def call(*arguments: Any) -> Any:
        if isinstance(arguments[0], Publisher):
            print("asked", file=sys.stderr, flush=True)
        return function(*arguments)

    return call


nfe.get_network_flow_endpoints = _saying(nfe.get_network_flow_endpoints)
