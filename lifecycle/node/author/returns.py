"""What a transition callback returns: SUCCESS, FAILURE, ERROR.

Owns: short names for rclpy's TransitionCallbackReturn.
"""

from __future__ import annotations

from rclpy.lifecycle import TransitionCallbackReturn

SUCCESS = TransitionCallbackReturn.SUCCESS
FAILURE = TransitionCallbackReturn.FAILURE
ERROR = TransitionCallbackReturn.ERROR

__all__ = ["ERROR", "FAILURE", "SUCCESS", "TransitionCallbackReturn"]
