"""Which transports the participant of an observer has."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.thorough

_OBSERVES = """
import sys
from lifecycle.middleware.rcl.graph import GraphObserver
from lifecycle.middleware.process.shared_memory import own_segments

with GraphObserver(int(sys.argv[1])):
    print(bool(own_segments()))
"""

_SHARED_MEMORY_ONLY = """
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"><profiles>
  <transport_descriptors><transport_descriptor>
    <transport_id>mine</transport_id><type>SHM</type>
  </transport_descriptor></transport_descriptors>
  <participant profile_name="mine" is_default_profile="true"><rtps>
    <userTransports><transport_id>mine</transport_id></userTransports>
    <useBuiltinTransports>false</useBuiltinTransports>
  </rtps></participant>
</profiles></dds>
"""


def _has_shared_memory(domain_id: int) -> bool:
    done = subprocess.run(
        [sys.executable, "-c", _OBSERVES, str(domain_id)],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    return {"True": True, "False": False}[done.stdout.split()[-1]]


@pytest.mark.parametrize("range_", ["SUBNET", "LOCALHOST"])
def test_an_observer_has_no_shared_memory(
    fresh_domain: int, range_: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", range_)
    monkeypatch.delenv("FASTDDS_BUILTIN_TRANSPORTS", raising=False)
    assert not _has_shared_memory(fresh_domain)


def test_transports_that_the_environment_chooses_are_kept(
    fresh_domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", "DEFAULT")
    assert _has_shared_memory(fresh_domain)


def test_transports_that_a_profile_chooses_are_kept(
    fresh_domain: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    file = tmp_path / "mine.xml"
    file.write_text(_SHARED_MEMORY_ONLY)
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(file))
    assert _has_shared_memory(fresh_domain)
