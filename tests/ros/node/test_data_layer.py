"""What connect makes: unique flows, participants, and what the node says of them."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
from hearing import Hearing
from lifecycle_driver import Driver
from msgspec.structs import replace
from planning import publisher, server, subscription
from std_msgs.msg import String
from std_srvs.srv import Trigger

from lifecycle import LifecycleNode, codec, on_message, on_service
from lifecycle.middleware.fastdds.nfe import get_network_flow_endpoints
from lifecycle.network.nfe import TransportProtocol, UniqueRequirement
from lifecycle.plan.model import PlannedParticipant
from lifecycle.verify.observation import NodeConfiguration

Active = Callable[..., Any]
STRICT = UniqueRequirement.STRICTLY_REQUIRED
FLOW = PlannedParticipant(name="_it_flow_0", dscp=46, reason="unique publisher video")


class It(LifecycleNode):
    """Receives on `in`, if that is declared."""


def configuration(driver: Driver) -> NodeConfiguration:
    return codec.from_json(driver.configuration("/it"), NodeConfiguration)


def ports(nfes: Any) -> set[int]:
    return {nfe.transport_port for nfe in nfes if nfe.transport_protocol is TransportProtocol.UDP}


def test_a_strict_requirement_that_the_rmw_refuses_fails_connect_and_leaves_nothing(
    driver: Driver, active: Active
) -> None:
    node = active(It, publisher("first"), publisher("video", unique=STRICT), to="configure")
    error = driver.run(node.lifecycle.change, "connect").error
    assert error.startswith("cannot connect publisher 'video' of /it: publisher 'video' must ")
    assert "(strictly_required), and would share one" in error
    assert driver.state("/it") == (2, "inactive")
    assert [driver.node.count_publishers(name) for name in ("/first", "/video")] == [0, 0]
    first, video = configuration(driver).endpoints
    assert (first.error, first.gid, video.gid) == ("", "", "")
    assert "would share one" in video.error


def test_a_strict_requirement_is_met_by_a_participant_of_its_own_with_its_dscp(
    driver: Driver, active: Active
) -> None:
    received: list[str] = []
    driver.node.create_subscription(String, "/video", lambda m: received.append(m.data), 10)
    node = active(
        It,
        publisher("video", unique=STRICT, participant=FLOW.name, dscp=46),
        publisher("battery"),
        participants=(FLOW,),
        to="connect",
    )
    video, battery = configuration(driver).endpoints
    assert (video.participant, video.dscp, battery.dscp) == (FLOW.name, 46, None)
    assert video.nfes is not None
    assert battery.nfes is not None
    assert ports(video.nfes)
    assert not ports(video.nfes) & ports(battery.nfes)
    assert video.gid[:24] != battery.gid[:24]
    driver.spin_until(lambda: node.publisher("video").get_subscription_count() == 1)
    node.publisher("video").publish(String(data="inactive"))
    assert driver.set("/it", "activate")
    node.publisher("video").publish(String(data="active"))
    driver.spin_until(lambda: received)
    assert received == ["active"]
    assert driver.set("/it", "deactivate")
    assert driver.set("/it", "disconnect")
    driver.spin_until(lambda: FLOW.name not in driver.node.get_node_names())


def test_a_unique_subscription_listens_on_a_port_of_its_own(driver: Driver, active: Active) -> None:
    sender = driver.node.create_publisher(String, "/in", 10)
    other = driver.node.create_subscription(String, "/else", lambda m: None, 10)
    node = active(Hearing, subscription("in", unique=STRICT), to="connect")
    (report,) = configuration(driver).endpoints
    assert report.unique is STRICT
    assert ports(report.nfes)
    assert not ports(report.nfes) & ports(get_network_flow_endpoints(other))
    driver.spin_until(lambda: sender.get_subscription_count() == 1)
    sender.publish(String(data="early"))
    driver.settle()
    assert driver.set("/it", "activate")
    sender.publish(String(data="now"))
    driver.spin_until(lambda: node.heard)
    assert node.heard == ["now"]


@pytest.mark.parametrize("unique", UniqueRequirement)
def test_every_requirement_of_a_subscription_connects_with_fast_dds(
    driver: Driver, active: Active, unique: UniqueRequirement
) -> None:
    active(Hearing, subscription("in", unique=unique), to="connect")
    (report,) = configuration(driver).endpoints
    assert (report.unique, report.error) == (unique, "")


def test_connect_and_disconnect_again_and_again(driver: Driver, active: Active) -> None:
    node = active(Hearing, subscription("in"), publisher("in"), to="configure")
    for turn in range(5):
        assert driver.set("/it", "connect")
        assert driver.set("/it", "activate")
        driver.spin_until(lambda: node.publisher("in").get_subscription_count() == 1)
        node.publisher("in").publish(String(data=str(turn)))
        driver.spin_until(lambda: node.heard)
        assert node.heard.pop() == str(turn)
        assert driver.set("/it", "deactivate")
        assert driver.set("/it", "disconnect")


class Reporting(LifecycleNode):
    @on_message("in")
    def receive(self, message: String) -> None: ...

    @on_service("reset")
    def reset(self, request: Trigger.Request, response: Trigger.Response) -> None: ...


def test_the_configuration_tells_each_endpoint_as_it_is(driver: Driver, active: Active) -> None:
    qos = replace(publisher("x").qos, depth=3)  # type: ignore[type-var]
    active(Reporting, publisher("out", qos=qos), subscription("in"), server("reset"), to="")
    document = json.loads(driver.configuration("/it"))
    assert (document["name"], document["state"], document["connected"]) == (
        "/it",
        "unconfigured",
        False,
    )
    assert document["endpoints"] == []
    assert driver.set("/it", "configure")
    declared = configuration(driver)
    assert [each.resolved for each in declared.endpoints] == ["/out", "/in", "/reset"]
    assert [each.gid for each in declared.endpoints] == ["", "", ""]
    assert driver.set("/it", "connect")
    connected = configuration(driver)
    out, in_, reset = connected.endpoints
    assert connected.connected
    assert out.qos == qos
    assert (out.matched, in_.matched, reset.matched) == (0, 0, None)
    assert connected.identity.node_id == f"/it@{out.gid[:24]}"
    assert len(out.gid) == len(in_.gid) == 32
    (info,) = driver.node.get_publishers_info_by_topic("/out")
    assert bytes(info.endpoint_gid).hex() == out.gid
    assert "udpv4" in connected.transports


def test_a_node_that_cannot_be_described_says_so_and_lives(
    driver: Driver, active: Active, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken() -> str:
        raise OSError("no such file")

    monkeypatch.setattr("lifecycle.node.configuration.machine_id", broken)
    active(It, to="")
    answer = driver.call(Trigger, "/it/get_configuration", Trigger.Request())
    assert (answer.success, answer.message) == (
        False,
        "cannot describe this node: OSError('no such file')",
    )
    assert driver.set("/it", "configure")


def test_the_checksum_changes_exactly_when_a_reader_must_read_again(
    driver: Driver, active: Active
) -> None:
    active(Reporting, publisher("out"), subscription("in"), server("reset"), to="")
    seen = [configuration(driver).checksum]
    assert driver.set("/it", "configure")
    seen.append(configuration(driver).checksum)
    assert driver.set("/it", "connect")
    seen.append(configuration(driver).checksum)
    assert len(set(seen)) == 3
    assert driver.set("/it", "activate")
    driver.node.create_subscription(String, "/out", lambda m: None, 10)
    driver.spin_until(lambda: configuration(driver).endpoints[0].matched == 1)
    assert configuration(driver).checksum == seen[-1]
