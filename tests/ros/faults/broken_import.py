"""A module that cannot be imported because something that it needs is missing."""

import no_such_driver  # noqa: F401

from tests.ros.faults.nodes import Talker  # noqa: F401
