"""What stands between us and the C libraries: refusals in words, and conversions both ways."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import pytest
from rclpy.context import Context
from rclpy.node import Node
from std_msgs.msg import String

from lifecycle.errors import MiddlewareError
from lifecycle.manifest.qos import Durability, History, Liveliness, QosProfile, Reliability
from lifecycle.middleware import versions
from lifecycle.middleware.fastdds import participant
from lifecycle.middleware.fastdds.nfe import (
    create_subscription,
    get_network_flow_endpoints,
)
from lifecycle.middleware.rcl import abi
from lifecycle.middleware.rcl.conversions import (
    from_rclpy,
    import_interface,
    to_rclpy,
)
from lifecycle.middleware.versions import INSTALL, KNOWN_RCL
from lifecycle.network.nfe import UniqueRequirement

MakeNode = Callable[..., Node]


def ignore(_: String) -> None:
    pass


def test_the_installed_libraries_are_laid_out_as_known() -> None:
    abi.Rcl()


def test_another_major_of_rcl_is_refused_before_anything_is_called(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(abi, "rcl_version", lambda: "11.0.0")
    monkeypatch.setattr(abi, "bind", lambda *_: pytest.fail("a library was loaded"))
    with pytest.raises(MiddlewareError) as refused:
        abi.Rcl()
    assert str(refused.value) == (f"rcl 11.0.0 is not known (known: {KNOWN_RCL}); {INSTALL}")


def test_a_node_is_made_by_an_rclpy_with_another_constructor(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    (other,) = {True, False} - {versions.installed().node_takes_rosout}
    wrong = SimpleNamespace(node_takes_rosout=other)
    monkeypatch.setattr(participant, "installed", lambda: wrong)
    node = participant.bare_node(context)
    assert node.pointer
    node.destroy_when_not_in_use()


@pytest.fixture
def unknown(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """An rcl whose layouts nobody wrote down."""
    monkeypatch.setattr(abi, "rcl_version", lambda: "11.0.0")
    abi.load.cache_clear()
    yield
    abi.load.cache_clear()


@pytest.mark.usefixtures("unknown")
def test_with_an_unknown_rcl_only_what_strictly_requires_a_unique_flow_is_refused(
    make_node: MakeNode,
) -> None:
    node = make_node("node")
    optionally = UniqueRequirement.OPTIONALLY_REQUIRED
    create_subscription(node, String, "/a", ignore, QosProfile(), unique=optionally)
    assert node.count_subscribers("/a") == 1
    strictly = UniqueRequirement.STRICTLY_REQUIRED
    with pytest.raises(MiddlewareError) as refused:
        create_subscription(node, String, "/b", ignore, QosProfile(), unique=strictly)
    assert str(refused.value) == (
        "cannot create subscription '/b' with network flow endpoints strictly_required: rcl 11.0.0 "
        f"is not known (known: {KNOWN_RCL}); ask for optionally_required, or {INSTALL}"
    )
    assert node.count_subscribers("/b") == 0


def test_a_struct_that_is_laid_out_otherwise_is_refused() -> None:
    rcl = abi.Rcl()
    shifted = rcl.call["rcl_subscription_get_default_options"]()
    shifted.options.qos.depth = 0
    rcl.call["rcl_subscription_get_default_options"] = lambda: shifted
    with pytest.raises(MiddlewareError) as refused:
        rcl._check_layout("9.9.9")
    assert str(refused.value) == (
        "rcl 9.9.9 was built otherwise: its rcl_subscription_options_t is not laid out as that of "
        f"{KNOWN_RCL}; {INSTALL}"
    )


@pytest.fixture
def other_rmw(monkeypatch: pytest.MonkeyPatch) -> None:
    """An RMW without network flow endpoints that ignores the creation option, as Cyclone's."""
    rcl = abi.load()
    for kind in ("publisher", "subscription"):
        name = f"rcl_{kind}_get_network_flow_endpoints"
        monkeypatch.setitem(rcl.call, name, lambda *_: abi.RCL_RET_UNSUPPORTED)
    monkeypatch.setattr(rcl, "take_error", lambda: "not supported by rmw_other")


@pytest.mark.usefixtures("other_rmw")
def test_an_rmw_without_network_flow_endpoints_says_so_in_its_own_words(
    make_node: MakeNode,
) -> None:
    publisher = make_node("node").create_publisher(String, "/a", 10)
    with pytest.raises(MiddlewareError) as refused:
        get_network_flow_endpoints(publisher)
    assert str(refused.value) == (
        "cannot read the network flow endpoints of a publisher: not supported by rmw_other; set "
        "RMW_IMPLEMENTATION=rmw_fastrtps_cpp"
    )


@pytest.mark.usefixtures("other_rmw")
def test_an_rmw_that_only_pretends_to_be_strict_is_refused(make_node: MakeNode) -> None:
    node = make_node("node")
    strictly = UniqueRequirement.STRICTLY_REQUIRED
    with pytest.raises(MiddlewareError) as refused:
        create_subscription(node, String, "/a", ignore, QosProfile(), unique=strictly)
    assert str(refused.value) == (
        "cannot create subscription '/a' with network flow endpoints strictly_required: not "
        "supported by rmw_other; ask for optionally_required, or set "
        "RMW_IMPLEMENTATION=rmw_fastrtps_cpp"
    )
    assert list(node.subscriptions) == []
    assert node.count_subscribers("/a") == 0


def test_an_endpoint_that_listens_nowhere_is_refused(
    make_node: MakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = "rcl_subscription_get_network_flow_endpoints"
    monkeypatch.setitem(abi.load().call, name, lambda *_: abi.RCL_RET_OK)
    strictly = UniqueRequirement.STRICTLY_REQUIRED
    with pytest.raises(MiddlewareError) as refused:
        create_subscription(make_node("n"), String, "/a", ignore, QosProfile(), unique=strictly)
    assert "strictly_required: the RMW lists no network flow endpoint for it;" in str(refused.value)


def test_every_policy_survives_the_way_there_and_back() -> None:
    policies = itertools.product(
        History, Reliability, Durability, Liveliness, (None, 1, 2**62, 2**63 - 2)
    )
    for history, reliability, durability, liveliness, duration_ns in policies:
        qos = QosProfile(
            history=history,
            depth=7,
            reliability=reliability,
            durability=durability,
            deadline_ns=duration_ns,
            lifespan_ns=duration_ns,
            liveliness=liveliness,
            liveliness_lease_duration_ns=duration_ns,
        )
        assert from_rclpy(to_rclpy(qos)) == qos


def test_infinite_reads_as_none_however_rmw_spells_it() -> None:
    profile = to_rclpy(QosProfile())
    assert profile.deadline.nanoseconds == 0
    profile.deadline = type(profile.deadline)(nanoseconds=2**63 - 1)
    assert from_rclpy(profile).deadline_ns is None


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "std_msgs/msg/Strin",
            (
                "cannot find interface type 'std_msgs/msg/Strin': package 'std_msgs' has no msg "
                "'Strin'; did you mean std_msgs/msg/String?"
            ),
        ),
        (
            "my_robot/msg/Arm",
            (
                "cannot find interface type 'my_robot/msg/Arm': no package 'my_robot' with msg "
                "interfaces is installed; install my_robot, or source the workspace that has it"
            ),
        ),
        (
            "os/msg/../../System",
            (
                "cannot read interface type 'os/msg/../../System': write package/msg/Type, "
                "package/srv/Type or package/action/Type"
            ),
        ),
    ],
)
def test_an_interface_that_cannot_be_had_says_why(name: str, message: str) -> None:
    with pytest.raises(MiddlewareError) as refused:
        import_interface(name)
    assert str(refused.value) == message


def test_a_package_that_fails_to_import_is_not_said_to_be_missing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def import_module(_: str) -> object:
        raise ModuleNotFoundError("No module named 'numpy'", name="numpy")

    monkeypatch.setattr(
        "lifecycle.middleware.rcl.conversions.importlib",
        SimpleNamespace(import_module=import_module),
    )
    with pytest.raises(ModuleNotFoundError, match="numpy"):
        import_interface("std_msgs/msg/String")
