"""Which changes of a node configuration make a reader read it again."""

from __future__ import annotations

import dataclasses

import pytest

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
    return dataclasses.replace(CAMERA, endpoints=(endpoint,), connections=(connection,))


def test_a_checksum_is_sixteen_hex_digits() -> None:
    assert len(checksum(CAMERA)) == 16
    assert int(checksum(CAMERA), 16) >= 0


@pytest.mark.parametrize(
    "changed",
    [
        dataclasses.replace(CAMERA, state="inactive"),
        dataclasses.replace(CAMERA, connected=False),
        dataclasses.replace(CAMERA, checksum="0123456789abcdef"),
        _with(endpoint=dataclasses.replace(VIDEO, matched=2)),
        _with(endpoint=dataclasses.replace(VIDEO, matched=None)),
        _with(endpoint=dataclasses.replace(VIDEO, server_matched=True)),
        _with(connection=dataclasses.replace(NET, established=False)),
    ],
    ids=["state", "connected", "checksum", "matched", "not counted", "server", "established"],
)
def test_what_events_tell_makes_nobody_read_again(changed: NodeConfiguration) -> None:
    assert changed != CAMERA
    assert checksum(changed) == checksum(CAMERA)


@pytest.mark.parametrize(
    "changed",
    [
        dataclasses.replace(CAMERA, identity=dataclasses.replace(CAMERA.identity, process_id=2)),
        dataclasses.replace(CAMERA, transports=("shm", "udpv4")),
        _with(endpoint=dataclasses.replace(VIDEO, mapped=False)),
        _with(endpoint=dataclasses.replace(VIDEO, connection="")),
        _with(endpoint=dataclasses.replace(VIDEO, error="cannot make it")),
        _with(connection=dataclasses.replace(NET, urls=("shm://",))),
        _with(connection=dataclasses.replace(NET, error="cannot open it")),
        _with(connection=dataclasses.replace(NET, mappings=())),
        dataclasses.replace(CAMERA, connections=()),
        dataclasses.replace(CAMERA, endpoints=()),
    ],
    ids=[
        "process",
        "transports",
        "mapped",
        "connection of an endpoint",
        "error of an endpoint",
        "urls",
        "error of a connection",
        "mappings",
        "connections",
        "endpoints",
    ],
)
def test_whatever_else_changes_is_to_be_read_again(changed: NodeConfiguration) -> None:
    assert checksum(changed) != checksum(CAMERA)
