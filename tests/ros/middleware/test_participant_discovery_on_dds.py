"""A participant that nobody knows until it is announced."""

from __future__ import annotations

import contextlib
import ctypes
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import rclpy
from rclpy.node import Node

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds import participant_discovery
from lifecycle.middleware.fastdds.participant_discovery import Unannounced, can_be_unannounced
from lifecycle.middleware.fastdds.participant_profile import ParticipantSettings
from lifecycle.middleware.fastdds.settings import participant_settings

_CAN_BE = """
import rclpy
from lifecycle.middleware.fastdds.participant_discovery import can_be_unannounced

rclpy.init()
node = rclpy.create_node("asked")
with node.handle:
    print(can_be_unannounced(node.handle.pointer))
"""

_IGNORES = """
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"><profiles>
  <participant profile_name="mine" is_default_profile="true"><rtps><builtin><discovery_config>
    <ignoreParticipantFlags>FILTER_DIFFERENT_HOST</ignoreParticipantFlags>
  </discovery_config></builtin></rtps></participant>
</profiles></dds>
"""


@contextlib.contextmanager
def _node(name: str, domain_id: int, *, unannounced: bool) -> Iterator[Node]:
    context = rclpy.Context()
    context.init(args=[], domain_id=domain_id)
    try:
        with participant_settings(context, ParticipantSettings(unannounced=unannounced)):
            node = rclpy.create_node(name, context=context)
        yield node
        node.destroy_node()
    finally:
        context.try_shutdown()


def _held(node: Node) -> Unannounced:
    with node.handle:
        found = Unannounced.of(node.handle.pointer)
    assert found is not None
    return found


def test_two_that_were_unannounced_meet_each_other_and_one_that_was_there(
    fresh_domain: int, wait_until: Callable[..., None]
) -> None:
    with (
        _node("early", fresh_domain, unannounced=False) as early,
        _node("one", fresh_domain, unannounced=True) as one,
        _node("other", fresh_domain, unannounced=True) as other,
    ):
        held = [_held(one), _held(other)]
        nodes = (early, one, other)
        with _node("late", fresh_domain, unannounced=False) as late:
            # Two that hide nothing know each other: whom they could know, they do.
            wait_until(lambda: set(late.get_node_names()) == {"early", "late"})
            wait_until(lambda: set(early.get_node_names()) == {"early", "late"})
        wait_until(lambda: early.get_node_names() == ["early"])
        assert one.get_node_names() == ["one"]
        assert other.get_node_names() == ["other"]
        held[0].announce()
        wait_until(lambda: set(early.get_node_names()) == {"early", "one"})
        wait_until(lambda: set(one.get_node_names()) == {"early", "one"})
        assert other.get_node_names() == ["other"]
        held[1].announce()
        for node in nodes:
            wait_until(lambda node=node: set(node.get_node_names()) == {"early", "one", "other"})


def test_one_that_was_not_made_so_goes_on(
    fresh_domain: int, wait_until: Callable[..., None]
) -> None:
    with _node("one", fresh_domain, unannounced=False) as one:
        with one.handle:
            assert Unannounced.of(one.handle.pointer) is None
        with _node("other", fresh_domain, unannounced=False) as other:
            wait_until(lambda: set(other.get_node_names()) == {"one", "other"})


@pytest.mark.parametrize("field", ["protocol", "static_edp", "announcement_period", "sync_period"])
def test_what_is_laid_out_otherwise_is_not_touched(
    fresh_domain: int, monkeypatch: pytest.MonkeyPatch, field: str
) -> None:
    """Fields in another order stand for another version."""
    fields = list(participant_discovery._Pdp._fields_)
    index = [name for name, _ in fields].index(field)
    fields[index], fields[index + 1] = fields[index + 1], fields[index]
    other = type("_Pdp", (ctypes.Structure,), {"_fields_": tuple(fields)})
    with _node("one", fresh_domain, unannounced=False) as one, one.handle:
        assert can_be_unannounced(one.handle.pointer)
        monkeypatch.setattr(participant_discovery, "_Pdp", other)
        assert not can_be_unannounced(one.handle.pointer)
        with pytest.raises(MiddlewareError, match="cannot have a participant discover others"):
            Unannounced.of(one.handle.pointer)


def test_one_that_is_unannounced_says_that_others_cannot_be(fresh_domain: int) -> None:
    for unannounced in (False, True):
        with _node("one", fresh_domain, unannounced=unannounced) as one, one.handle:
            assert can_be_unannounced(one.handle.pointer) is not unannounced


@pytest.mark.parametrize("chosen", ["nothing", "server", "ignored"])
def test_what_chooses_discovery_otherwise_is_left_alone(
    fresh_domain: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, chosen: str
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(fresh_domain))
    if chosen == "server":
        monkeypatch.setenv("ROS_DISCOVERY_SERVER", "127.0.0.1:11999")
    if chosen == "ignored":
        file = tmp_path / "mine.xml"
        file.write_text(_IGNORES)
        monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(file))
    done = subprocess.run(
        [sys.executable, "-c", _CAN_BE], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.split()[-1] == str(chosen == "nothing")
