"""What every test shares: how property tests look for examples, and that programs can be ended.

A busy machine says nothing about a property, so no example has a deadline. CI takes the same
examples each time, so that a change is refused for what it changed; everywhere else new ones are
looked for at each run.

A shell starts what runs in its background with SIGINT ignored, and programs inherit that; tests end
programs by SIGINT.
"""

from __future__ import annotations

import os
import signal

from hypothesis import HealthCheck, settings

settings.register_profile(
    "lifecycle",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    derandomize="CI" in os.environ,
)
settings.load_profile("lifecycle")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
