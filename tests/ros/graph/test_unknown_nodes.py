"""A node may be in the graph before its name is; it must not pass for nothing."""

from __future__ import annotations

import pytest

from lifecycle.manifest.model import EndpointKind
from lifecycle.middleware.graph import GraphObserver

pytestmark = pytest.mark.ros


class _Info:
    node_name = "_NODE_NAME_UNKNOWN_"
    node_namespace = "_NODE_NAMESPACE_UNKNOWN_"
    topic_type = "rcl_interfaces/msg/Log"
    endpoint_gid = (1,) * 16


def test_a_log_publisher_of_an_unknown_node_is_shown(
    fresh_domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    with GraphObserver(fresh_domain) as observer:
        info = _Info()
        monkeypatch.setattr(info, "qos_profile", observer.node.get_clock, raising=False)
        monkeypatch.setattr("lifecycle.middleware.graph.from_rclpy", lambda _: None)
        monkeypatch.setattr(observer.node, "get_topic_names_and_types", lambda: [("/rosout", [])])
        monkeypatch.setattr(observer.node, "get_publishers_info_by_topic", lambda _: [info])
        monkeypatch.setattr(observer.node, "get_subscriptions_info_by_topic", lambda _: [])
        _, endpoints = observer.snapshot()
    assert [(each.kind, each.node, each.name) for each in endpoints] == [
        (EndpointKind.PUBLISHER, "", "/rosout")
    ]
