"""Endpoints made in code after configure: where they may be, and that they are told of."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from lifecycle_driver import Driver
from planning import publisher, subscription
from std_msgs.msg import Empty, String
from std_srvs.srv import Trigger

from lifecycle import LifecycleNode, codec, on_message
from lifecycle.errors import LifecycleError
from lifecycle.manifest.model import Authority, EndpointKind, EndpointPolicy
from lifecycle.plan.model import PlannedParticipant
from lifecycle.verify.observation import EndpointReport, NodeConfiguration

Active = Callable[..., Any]
SCHEMA = Path(__file__).parents[3] / "schemas" / "node_configuration.v1.schema.json"


class It(LifecycleNode):
    """Grows."""


def configuration(driver: Driver) -> NodeConfiguration:
    return codec.from_json(driver.configuration("/it"), NodeConfiguration)


def endpoints(driver: Driver) -> list[tuple[EndpointKind, str, str, bool]]:
    return [
        (each.kind, each.name, each.resolved, each.mapped)
        for each in configuration(driver).endpoints
    ]


def test_an_open_node_declares_more_while_it_is_active(driver: Driver, active: Active) -> None:
    node = active(It, publisher("out"))
    before = configuration(driver).checksum
    heard: list[str] = []
    node.declare_publisher("news", String)
    node.hint("news", lossy=True, size_bytes=200)
    node.declare_subscription("news", String, callback=lambda m: heard.append(m.data))
    node.declare_service("ask", Trigger, callback=answer)
    node.declare_client("ask", Trigger)
    assert endpoints(driver) == [
        (EndpointKind.PUBLISHER, "out", "/out", True),
        (EndpointKind.PUBLISHER, "news", "/news", True),
        (EndpointKind.SUBSCRIPTION, "news", "/news", True),
        (EndpointKind.SERVICE_SERVER, "ask", "/ask", True),
        (EndpointKind.SERVICE_CLIENT, "ask", "/ask", True),
    ]
    after = configuration(driver)
    assert after.checksum != before
    assert (after.endpoints[1].lossy, after.endpoints[1].size_bytes) == (True, 200)
    driver.spin_until(lambda: node.publisher("news").get_subscription_count() == 1)
    node.publisher("news").publish(String(data="hello"))
    driver.spin_until(lambda: heard == ["hello"])
    driver.spin_until(node.client("ask").service_is_ready)
    future = node.client("ask").call_async(Trigger.Request())
    driver.spin_until(future.done)
    assert future.result().message == "answered"
    # They can be mapped, and they go with cleanup: the next configure declares anew.
    driver.spin_until(
        node.map_to("subscriptions/news", node.connect_to("udpv4://127.0.0.1", name="net")).done
    )
    for label in ("deactivate", "cleanup", "configure"):
        assert driver.set("/it", label)
    assert endpoints(driver) == [(EndpointKind.PUBLISHER, "out", "/out", False)]


def answer(request: Trigger.Request, response: Trigger.Response) -> None:
    response.success = True
    response.message = "answered"


def test_what_is_declared_in_on_configure_is_made_by_connect(
    driver: Driver, active: Active
) -> None:
    class Configuring(LifecycleNode):
        def on_configure(self) -> None:
            self.declare_publisher("late", String)

    active(Configuring, to="configure")
    assert endpoints(driver) == [(EndpointKind.PUBLISHER, "late", "/late", False)]
    assert driver.set("/it", "connect")
    assert endpoints(driver) == [(EndpointKind.PUBLISHER, "late", "/late", True)]


def test_under_an_authority_what_is_declared_later_waits_to_be_mapped(
    driver: Driver, active: Active
) -> None:
    node = active(It, authority=Authority.SUPERVISOR)
    node.declare_publisher("news", String)
    assert endpoints(driver) == [(EndpointKind.PUBLISHER, "news", "/news", False)]
    node.map_to("news", "")
    assert endpoints(driver) == [(EndpointKind.PUBLISHER, "news", "/news", True)]


def test_a_node_whose_endpoints_are_declared_refuses_more(driver: Driver, active: Active) -> None:
    node = active(It, publisher("out"), endpoint_policy=EndpointPolicy.DECLARED)
    with pytest.raises(LifecycleError) as error:
        node.declare_publisher("news", String)
    assert str(error.value) == (
        "cannot declare publisher 'news' while /it is 'active': nodes.it.endpoints is 'declared' "
        "in its manifest, which fixes them at configure; write nodes.it.endpoints: open, or "
        "declare it in the manifest"
    )
    node.create_publisher(String, "raw", 10)  # rclpy's own: as ever, and the verifier's to judge
    # On a busy machine discovery may show it only after the gate has opened: the node reports it.
    assert endpoints(driver) == [
        (EndpointKind.PUBLISHER, "out", "/out", True),
        (EndpointKind.PUBLISHER, "", "/raw", True),
    ]


def test_a_subscription_that_is_declared_later_needs_its_callback(active: Active) -> None:
    node = active(It)
    with pytest.raises(LifecycleError) as error:
        node.declare_subscription("news", String)
    assert str(error.value) == (
        "cannot serve subscription 'news' of /it that is declared after configure: it has no "
        "handler; give one, declare_subscription('news', …, callback=…)"
    )
    assert node.mappings == ()


def test_what_is_declared_twice_or_made_impossible_leaves_the_node_as_it_was(
    driver: Driver, active: Active
) -> None:
    node = active(It, publisher("out"))
    node.declare_publisher("news", String)
    node.declare_publisher("news", String)
    with pytest.raises(LifecycleError, match=r"it is declared as std_msgs/msg/String already$"):
        node.declare_publisher("news", Empty)
    with pytest.raises(Exception, match="topic name"):
        node.declare_publisher("no topic", String)
    assert [name for name, _ in node.mappings] == ["publishers/out", "publishers/news"]


def test_after_the_end_nothing_is_declared(driver: Driver, active: Active) -> None:
    node = active(It)
    assert driver.set("/it", "shutdown")
    with pytest.raises(LifecycleError) as error:
        node.declare_publisher("news", String)
    assert str(error.value) == (
        "cannot declare publisher 'news' while /it is 'finalized'; "
        "declare endpoints in __init__, or from on_configure until cleanup"
    )


def test_what_rclpys_factories_make_is_in_the_configuration_of_an_open_node(
    driver: Driver, active: Active
) -> None:
    node = active(It, publisher("out"))
    news = node.create_publisher(String, "news", 7)
    node.create_subscription(String, "news", lambda m: None, 10)
    node.create_service(Trigger, "ask", answer)
    asking = node.create_client(Trigger, "ask")
    assert endpoints(driver) == [
        (EndpointKind.PUBLISHER, "out", "/out", True),
        (EndpointKind.PUBLISHER, "", "/news", True),
        (EndpointKind.SUBSCRIPTION, "", "/news", True),
        (EndpointKind.SERVICE_CLIENT, "", "/ask", True),
        (EndpointKind.SERVICE_SERVER, "", "/ask", True),
    ] or endpoints(driver)[3:] == [
        (EndpointKind.SERVICE_SERVER, "", "/ask", True),
        (EndpointKind.SERVICE_CLIENT, "", "/ask", True),
    ]
    report: EndpointReport = configuration(driver).endpoints[1]
    assert (report.type, report.qos.depth if report.qos else None) == ("std_msgs/msg/String", 7)
    assert report.nfes
    assert len(report.gid) == 32
    node.destroy_publisher(news)
    asking.destroy()  # behind the node's back
    assert [each[:3] for each in endpoints(driver)] == [
        (EndpointKind.PUBLISHER, "out", "/out"),
        (EndpointKind.SUBSCRIPTION, "", "/news"),
        (EndpointKind.SERVICE_SERVER, "", "/ask"),
    ]


def test_hints_of_a_manifests_endpoint_are_reported(driver: Driver, active: Active) -> None:
    class Hinting(LifecycleNode):
        def __init__(self) -> None:
            super().__init__()
            self.hint("publishers/out", lossy=False, size_bytes=70_000)

        @on_message("in")
        def hear(self, message: String) -> None: ...

    active(Hinting, publisher("out"), subscription("in"))
    out, in_ = configuration(driver).endpoints
    assert (out.lossy, out.size_bytes, in_.lossy, in_.size_bytes) == (False, 70_000, None, None)


def test_the_document_fits_its_schema_in_every_state(driver: Driver, active: Active) -> None:
    validator = jsonschema.Draft202012Validator(json.loads(SCHEMA.read_text(encoding="utf-8")))
    flow = PlannedParticipant(name="_it_flow_0", dscp=46, reason="publisher video")
    node = active(
        It,
        publisher("video", participant=flow.name),
        publisher(
            "out",
        ),
        participants=(flow,),
        to="",
    )
    for label in ("configure", "connect", "activate"):
        validator.validate(json.loads(driver.configuration("/it")))
        assert driver.set("/it", label)
    node.create_publisher(String, "raw", 10)
    node.map_to("out", node.connect_to("udpv4://127.0.0.1", "shm://", name="net"))
    with pytest.raises(LifecycleError):
        node.connect_to("udpv4://192.0.2.1", name="failed")
    document = json.loads(driver.configuration("/it"))
    validator.validate(document)
    assert document["paradigms"] == ["publish-subscribe", "request-response"]
    assert document["serializations"] == ["cdr"]
    assert {"shm", "tcpv4", "udpm", "udpv4"} <= set(document["transports"])
    assert sorted(document["identity"]) == ["machine_id", "node_id", "process_id"]
    assert [each["name"] for each in document["connections"]] == ["", "net", "failed"]
    # A publisher that has a flow of its own is on no connection: the participant tells it apart.
    video = document["endpoints"][0]
    assert (video["connection"], video["participant"]) == ("", "_it_flow_0")


class Activating(LifecycleNode):
    """Declares whenever it becomes active."""

    def on_activate(self) -> None:
        self.declare_publisher("news", String)


def test_what_on_activate_declares_is_there_when_it_is_active_again(
    driver: Driver, active: Active
) -> None:
    node = active(Activating, publisher("out"), endpoint_policy=EndpointPolicy.OPEN)
    assert driver.set("/it", "deactivate")
    assert driver.set("/it", "activate")
    assert [name for name, _ in node.mappings] == ["publishers/out", "publishers/news"]
