"""A node may be in the graph before its name is; it must not pass for nothing."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable

import pytest

from lifecycle.manifest.model import EndpointKind
from lifecycle.middleware.rcl.graph import GraphObserver
from tests.ros.faults.system import BARE_DDS

pytestmark = pytest.mark.ros


def test_a_log_publisher_of_an_unknown_node_is_shown(
    fresh_domain: int, wait_until: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(fresh_domain))
    writer = (sys.executable, BARE_DDS, "--write", "rt/rosout:rcl_interfaces::msg::dds_::Log_")
    expected = [(EndpointKind.PUBLISHER, "", "/rosout")]
    with GraphObserver(fresh_domain) as observer, subprocess.Popen(writer) as process:
        wait_until(
            lambda: (
                [(each.kind, each.node, each.name) for each in observer.snapshot()[1]] == expected
            )
        )
        process.terminate()
