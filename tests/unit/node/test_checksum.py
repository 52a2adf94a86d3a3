"""Which changes of a node configuration make a reader read it again."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind
from lifecycle.node.configuration import checksum
from lifecycle.verify.observation import EndpointReport, NodeConfiguration
from lifecycle.verify.outcome import ConnectionReport
from tests.builders import configuration

VIDEO = EndpointReport(
    kind=EndpointKind.PUBLISHER,
    name="video",
    resolved="/video",
    type="std_msgs/msg/String",
    mapped=True,
    connection="net",
    matched=1,
)
NET = ConnectionReport(
    name="net",
    urls=("udpv4://10.77.0.1:7911",),
    node_name="_camera_net",
    established=True,
    mappings=("publishers/video",),
)
CAMERA = configuration("/camera", VIDEO, state="active", connections=(NET,))


def _with(
    endpoint: EndpointReport = VIDEO, connection: ConnectionReport = NET
) -> NodeConfiguration:
    return replace(CAMERA, endpoints=(endpoint,), connections=(connection,))


def test_a_checksum_is_sixteen_hex_digits() -> None:
    assert len(checksum(CAMERA)) == 16
    assert int(checksum(CAMERA), 16) >= 0


SAME = {
    "state": replace(CAMERA, state="inactive"),
    "connected": replace(CAMERA, connected=False),
    "checksum": replace(CAMERA, checksum="0123456789abcdef"),
    "matched": _with(endpoint=replace(VIDEO, matched=2)),
    "not counted": _with(endpoint=replace(VIDEO, matched=None)),
    "server": _with(endpoint=replace(VIDEO, server_matched=True)),
    "established": _with(connection=replace(NET, established=False)),
}
OTHERS = {
    "process": replace(CAMERA, identity=replace(CAMERA.identity, process_id=2)),
    "transports": replace(CAMERA, transports=("shm", "udpv4")),
    "mapped": _with(endpoint=replace(VIDEO, mapped=False)),
    "connection of an endpoint": _with(endpoint=replace(VIDEO, connection="")),
    "error of an endpoint": _with(endpoint=replace(VIDEO, error="cannot make it")),
    "urls": _with(connection=replace(NET, urls=("shm://",))),
    "error of a connection": _with(connection=replace(NET, error="cannot open it")),
    "mappings": _with(connection=replace(NET, mappings=())),
    "connections": replace(CAMERA, connections=()),
    "endpoints": replace(CAMERA, endpoints=()),
}


@pytest.mark.parametrize("changed", SAME.values(), ids=SAME)
def test_what_events_tell_makes_nobody_read_again(changed: NodeConfiguration) -> None:
    assert changed != CAMERA
    assert checksum(changed) == checksum(CAMERA)


@pytest.mark.parametrize("changed", OTHERS.values(), ids=OTHERS)
def test_whatever_else_changes_is_to_be_read_again(changed: NodeConfiguration) -> None:
    assert checksum(changed) != checksum(CAMERA)
