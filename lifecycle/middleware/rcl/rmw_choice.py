"""RMW_IMPLEMENTATION: whether the RMW that it names is installed, checked before rcl is loaded.

rcl ends the process with 102 where it is not, which cannot be caught. Must not import rclpy.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path

from lifecycle.errors import UsageError
from lifecycle.network.medium import DEFAULT_RMW

_VARIABLES = ("RMW_IMPLEMENTATION", "RCL_ASSERT_RMW_ID_MATCHES")
"""Both are checked by rcl (rcl/rmw_implementation_identifier_check.c)."""


def check_rmw(environment: Mapping[str, str]) -> None:
    """Refuse an RMW whose library is nowhere that the loader looks.

    Args:
        environment: of this process.

    Raises:
        UsageError: a participant could not be made with it.
    """
    folders = [*environment.get("LD_LIBRARY_PATH", "").split(os.pathsep), f"{sys.prefix}/lib"]
    for variable in _VARIABLES:
        rmw = environment.get(variable) or DEFAULT_RMW
        if rmw != DEFAULT_RMW and not any(
            Path(folder, f"lib{rmw}.so").is_file() for folder in folders
        ):
            raise UsageError(
                f"cannot use {variable}={rmw!r}: this installation of ROS 2 cannot load that RMW",
                hint=f"install it, or unset {variable}: the default is {DEFAULT_RMW}",
            )
