"""One message of Fast DDS's that is kept from standard output."""

from __future__ import annotations

import subprocess
import sys

_WRITES = """
import os, sys
import rclpy
from lifecycle.middleware.fastdds.log import without_message
from lifecycle.middleware.fastdds.participant_profile import ParticipantSettings
from lifecycle.middleware.fastdds.settings import (
    fast_dds_function,
    load_profile,
    participant_settings,
)
from lifecycle.errors import MiddlewareError

rclpy.init(domain_id=int(sys.argv[1]))
print("before")
with without_message("unique_network_request"):
    print("buffered")
    sys.stdout.flush()
    with participant_settings(rclpy.get_default_context(), ParticipantSettings(names_by_udp=True)):
        node = rclpy.create_node("one")
    os.write(1, b"written\\n")
    try:
        load_profile("broken", "<dds><profiles><participant/></profiles></dds>")
    except MiddlewareError:
        # Its thread writes a line in pieces; ours would be in the middle of one.
        fast_dds_function("_ZN8eprosima7fastdds3dds3Log5FlushEv", None)()
        print("refused")
print("after")
sys.stdout.flush()
with participant_settings(rclpy.get_default_context(), ParticipantSettings(names_by_udp=True)):
    pass
"""


def test_all_other_lines_are_written_in_their_order(fresh_domain: int) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _WRITES, str(fresh_domain)],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    lines = done.stdout.splitlines()
    assert "unique_network_request" not in done.stdout
    ours = [each for each in lines if each in {"before", "buffered", "written", "refused", "after"}]
    assert ours == ["before", "buffered", "written", "refused", "after"]
    # What else it says is there: why it refuses a profile.
    assert [each for each in lines if "XMLPARSER" in each], done.stdout


def test_it_would_be_there_otherwise(fresh_domain: int) -> None:
    program = _WRITES.replace("unique_network_request", "nothing of the kind")
    done = subprocess.run(
        [sys.executable, "-c", program, str(fresh_domain)],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert "unique_network_request" in done.stdout
