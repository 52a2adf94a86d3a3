"""RMW_IMPLEMENTATION: whether the RMW that it names can be loaded, checked before rcl is.

Owns: that check. rcl compares the variable with what it was linked to, or what could be loaded,
while it is loaded itself, and ends the process with 102, which cannot be caught. Must not import
rclpy.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping

from lifecycle.errors import UsageError
from lifecycle.network.medium import DEFAULT_RMW

_VARIABLES = ("RMW_IMPLEMENTATION", "RCL_ASSERT_RMW_ID_MATCHES")
"""Both are checked by rcl (rcl/rmw_implementation_identifier_check.c)."""

_ASK = "from rclpy.utilities import get_rmw_implementation_identifier as name; print(name())"
_TIMEOUT_S = 30.0


def check_rmw(environment: Mapping[str, str]) -> None:
    """Refuse an RMW that this installation does not have; costs nothing for the default one.

    Args:
        environment: of this process.

    Raises:
        UsageError: a participant could not be made with it.
    """
    for variable in _VARIABLES:
        rmw = environment.get(variable, "")
        if rmw in ("", DEFAULT_RMW):
            continue
        try:
            done = subprocess.run(
                [sys.executable, "-c", _ASK],
                env=dict(environment),
                capture_output=True,
                text=True,
                timeout=_TIMEOUT_S,
                check=False,
            )
            loaded = done.returncode == 0 and done.stdout.strip() == rmw
        except subprocess.TimeoutExpired:
            loaded = False
        if not loaded:
            raise UsageError(
                f"cannot use {variable}={rmw!r}: this installation of ROS 2 cannot load that RMW",
                hint=f"install it, or unset {variable}: the default is {DEFAULT_RMW}",
            )
