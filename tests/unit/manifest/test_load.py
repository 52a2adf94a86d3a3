"""Loading: every key of the language becomes the field it is meant for."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from lifecycle.manifest.diagnostics import Position
from lifecycle.manifest.loading import load
from lifecycle.manifest.model import (
    Condition,
    DiscoveryMode,
    DiscoveryRange,
    EndpointKind,
    EndpointPolicy,
    Limits,
    Machine,
    Manifest,
    Node,
    OnFailure,
    Resources,
    Restart,
    Run,
    RunKind,
    Supervision,
    Timeouts,
    UniqueHow,
)
from lifecycle.manifest.qos import (
    POLICIES,
    PRESETS,
    Durability,
    History,
    Liveliness,
    QosProfile,
    Reliability,
)
from lifecycle.network.nfe import UniqueRequirement

VALID = Path(__file__).parents[2] / "corpus" / "valid"


def _corpus(name: str, monkeypatch: pytest.MonkeyPatch, **arguments: str) -> Manifest:
    monkeypatch.chdir(VALID)
    monkeypatch.setenv("CORPUS_ROBOT", "r2")
    return load(f"{name}.lifecycle.yaml", arguments).manifest


def _node(manifest: Manifest, key: str) -> Node:
    return next(node for node in manifest.nodes if node.key == key)


@pytest.fixture
def every_key(monkeypatch: pytest.MonkeyPatch) -> Manifest:
    return _corpus("every_key", monkeypatch)


def test_the_system(every_key: Manifest) -> None:
    assert every_key.path == "every_key.lifecycle.yaml"
    assert every_key.system == "every_key"
    assert every_key.description == "every key that the language has"
    assert every_key.arguments == (("rate", "10"),)
    assert [node.key for node in every_key.nodes] == [
        "talker",
        "orders",
        "recorder",
        "driver",
        "far/listener",
        "group/idle",
        "group/idler",
    ]


def test_discovery_and_policy(every_key: Manifest) -> None:
    discovery, policy = every_key.discovery, every_key.policy
    assert discovery.domain_id == 0
    assert discovery.mode is DiscoveryMode.DYNAMIC
    assert discovery.range is DiscoveryRange.LOCALHOST
    assert policy.undeclared_nodes is EndpointPolicy.OPEN
    assert policy.unverifiable_blocks
    assert (policy.unpublished, policy.unheard) == ("warning", "ignore")
    assert policy.tolerated_nodes == ("rviz*", "/tools/*")


@pytest.mark.parametrize("machine", ["", "    machine: far\n"])
def test_supervisors_of_one_machine_and_of_several_may_be_read_in_ros(
    tmp_path: Path, machine: str
) -> None:
    path = tmp_path / "pair.lifecycle.yaml"
    path.write_text(
        "manifest_version: 1\nsystem: pair\nmachines: {far: {address: 192.0.2.1}}\n"
        f"nodes:\n  a:\n    run: {{command: [a]}}\n  b:\n    run: {{command: [b]}}\n{machine}"
    )
    assert load(path).manifest.policy.access.value == "read_only"


def test_machines_with_this_host_added_for_nodes_that_name_none(every_key: Manifest) -> None:
    assert [(each.name, each.address) for each in every_key.machines] == [
        ("here", ""),
        ("there", "fd00::2"),
        ("local", ""),
    ]
    assert [node.machine for node in every_key.nodes] == [
        "here",
        "there",
        "local",
        "local",
        "local",
        "here",
        "here",
    ]


def test_resources_in_the_words_of_systemd(every_key: Manifest) -> None:
    resources = _node(every_key, "talker").run.resources
    assert resources is not None
    assert (Path(resources.at.file).name, resources.at.line, resources.at.column) == (
        "every_key.lifecycle.yaml",
        36,
        7,
    )
    assert resources.properties() == (
        "MemoryMax=512M",
        "MemoryHigh=384M",
        "CPUQuota=150%",
        "CPUWeight=200",
        "TasksMax=64",
    )
    bare = Resources(at=resources.at)
    assert bare.properties() == ()


def test_ways_to_run(every_key: Manifest) -> None:
    assert _node(every_key, "talker").run == Run(
        kind=RunKind.PYTHON,
        python="demo.nodes:Talker",
        environment={"LANG": "C", "LEVEL": "3", "VERSION": "1.10"},
        working_directory=str(VALID),
        no_new_privileges=True,
        limits=Limits(as_mib=4096, cpu_sec=3600, nofile=1024, nproc=4096),
        resources=Resources(
            at=Position(file="", line=0, column=0),  # not compared
            memory_max_mib=512,
            memory_high_mib=384,
            cpu_quota_percent=150,
            cpu_weight=200,
            tasks_max=64,
        ),
    )
    assert _node(every_key, "orders").run == Run(
        kind=RunKind.COMMAND, command=("orders_node", "--fast", "3")
    )
    assert _node(every_key, "recorder").run == Run(
        kind=RunKind.COMMAND, package="rosbag2_transport", executable="recorder"
    )
    assert _node(every_key, "driver").run == Run(kind=RunKind.ATTACH)


def test_the_fields_of_a_node(every_key: Manifest) -> None:
    talker = _node(every_key, "talker")
    assert (talker.name, talker.namespace, talker.process) == ("speaker", "/robot", "main")
    assert talker.managed
    assert talker.parameters == (
        ("use_sim_time", False),
        ("rate", 10),
        ("pid.p", 1.5),
        ("pid.limits", (0.0, 1.0)),
        ("names", ("a", "b")),
        ("verbose", False),
    )
    assert talker.parameter_files == (str(VALID / "parts" / "speaker.params.yaml"),)
    assert talker.remap == (("words", "/chatter"), ("unused", "/nowhere"))
    assert talker.timeouts == Timeouts(
        start_s=20.0,
        configure_s=1.5,
        connect_s=5.0,
        activate_s=5.0,
        deactivate_s=1.0,
        cleanup_s=1.0,
        shutdown_s=1.0,
        silent_s=2.0,
    )
    assert talker.endpoints is EndpointPolicy.OPEN
    assert talker.log_level == "debug"
    assert (talker.at.line, talker.at.column, talker.at.path) == (29, 3, "nodes.talker")


def test_what_a_node_is_when_nothing_is_said(every_key: Manifest) -> None:
    driver = _node(every_key, "driver")
    assert (driver.name, driver.namespace, driver.process) == ("driver", "/", "")
    assert driver.managed
    assert driver.parameter_files == driver.after == ()
    assert driver.timeouts == Timeouts()
    assert driver.endpoints is EndpointPolicy.DECLARED
    assert driver.log_level == ""


def test_what_many_nodes_share_reaches_those_that_have_nothing_nearer(every_key: Manifest) -> None:
    talker, driver = _node(every_key, "talker"), _node(every_key, "driver")
    # Its interface declares parameters, and none of that name.
    assert "shared" not in dict(talker.parameters)
    assert driver.parameters == (("shared", 1), ("use_sim_time", False))
    assert driver.remap == (("unused", "/nowhere"),)
    assert driver.where("parameters.shared").path == "parameters.shared"
    idler = _node(every_key, "group/idler")
    assert (idler.namespace, idler.machine) == ("/group", "here")
    assert idler.parameters == (("shared", 2), ("use_sim_time", True))
    assert idler.remap == (("unused", "/somewhere"),)
    assert idler.at.path == "groups[0].groups[0].nodes.idler"


def test_after(every_key: Manifest) -> None:
    (only,) = _node(every_key, "recorder").after
    assert (only.node, only.condition) == ("talker", Condition.CONNECTED)
    assert only.at.path == "nodes.recorder.after.talker"


def test_endpoints(every_key: Manifest) -> None:
    interface = _node(every_key, "talker").interface
    assert [(each.kind, each.name, each.type) for each in interface.endpoints] == [
        (EndpointKind.PUBLISHER, "words", "std_msgs/msg/String"),
        (EndpointKind.SUBSCRIPTION, "~/orders", "std_msgs/msg/String"),
        (EndpointKind.SERVICE_SERVER, "~/mute", "std_srvs/srv/SetBool"),
        (EndpointKind.SERVICE_CLIENT, "/other/reset", "std_srvs/srv/Trigger"),
    ]
    assert [each.qos for each in interface.endpoints[1:]] == [
        PRESETS["default"],
        PRESETS["services_default"],
        PRESETS["services_default"],
    ]
    assert interface.endpoints[0].qos == QosProfile(
        history=History.KEEP_LAST,
        depth=3,
        reliability=Reliability.RELIABLE,
        durability=Durability.TRANSIENT_LOCAL,
        deadline_ns=500_000_000,
        lifespan_ns=1_000_000_000,
        liveliness=Liveliness.MANUAL_BY_TOPIC,
        liveliness_lease_duration_ns=1_000_000_000,
    )


def test_parameter_declarations(every_key: Manifest) -> None:
    declared = _node(every_key, "talker").interface.parameters
    assert [(each.name, each.type, each.default, each.read_only) for each in declared] == [
        ("rate", "int", 10, True),
        ("pid.p", "double", 1.0, False),
        ("pid.limits", "double_array", None, False),
        ("names", "string_array", ("a",), False),
        ("verbose", "bool", False, False),
        ("raw", "byte_array", (0, 255), False),
    ]
    assert isinstance(declared[1].default, float)
    assert declared[0].description == "messages per second"


def test_flows_and_links(every_key: Manifest) -> None:
    words, orders = _node(every_key, "talker").flows
    assert (words.kind, words.name) == (EndpointKind.PUBLISHER, "words")
    assert words.unique is UniqueRequirement.OPTIONALLY_REQUIRED
    assert (words.dscp, words.enforce, words.five_qi) == (46, False, 3)
    assert (orders.kind, orders.name) == (EndpointKind.SUBSCRIPTION, "~/orders")
    assert orders.unique is UniqueRequirement.SYSTEM_DEFAULT
    assert (orders.dscp, orders.enforce, orders.five_qi) == (None, True, None)
    (link,) = every_key.links
    assert (link.topic, link.from_node, link.to_node) == (
        "/robot/speaker/orders",
        "orders",
        "talker",
    )
    assert link.unique is UniqueHow.WEAKLY
    assert link.max_delay_ms is None


def test_code_points_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    manifest = _corpus("teleop", monkeypatch)
    assert [need.dscp for need in _node(manifest, "camera").flows] == [46, None]
    assert manifest.links[0].max_delay_ms == 5.0


def test_qos_presets_and_overrides(monkeypatch: pytest.MonkeyPatch) -> None:
    endpoints = _corpus("qos", monkeypatch).nodes[0].interface.endpoints
    qos = {each.name: each.qos for each in endpoints}
    sensor_data = PRESETS["sensor_data"]
    assert qos["none_given"] == PRESETS["default"]
    assert qos["by_name"] == sensor_data
    assert qos["overridden"] is not None
    assert (qos["overridden"].depth, qos["overridden"].reliability) == (1, sensor_data.reliability)
    assert qos["keep_all"] is not None
    assert (qos["keep_all"].history, qos["keep_all"].depth) == (History.KEEP_ALL, 0)
    assert qos["zero_is_none"] == PRESETS["default"]
    assert qos["latched"] is not None
    assert qos["latched"].durability is Durability.TRANSIENT_LOCAL
    assert qos["latched"].depth == 2


def test_what_of_a_qos_profile_is_not_written_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    endpoints = _corpus("qos", monkeypatch).nodes[0].interface.endpoints
    defaults = {each.name: each.qos_defaults for each in endpoints}
    assert defaults["none_given"] == POLICIES
    assert (defaults["by_name"], defaults["overridden"], defaults["whatever"]) == ((), (), ())
    assert set(POLICIES) - set(defaults["keep_all"]) == {"history"}
    assert set(POLICIES) - set(defaults["zero_is_none"]) == {"deadline_ns"}
    assert set(POLICIES) - set(defaults["latched"]) == {"history", "depth", "durability"}


def test_each_number_of_a_flow_is_kept_with_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    manifest = _corpus("flows_every_key", monkeypatch)
    found = [
        (str(each), each.at.path)
        for node in manifest.nodes
        for need in node.flows
        for each in need.quantities
    ]
    assert ("rate_hz 50", "nodes.camera.flows.publishers.pose.rate_hz") in found
    assert not [text for text, _ in found if "auto" in text]
    (delay,) = _corpus("teleop", monkeypatch).links[0].quantities
    assert (str(delay), delay.at.path) == ("max_delay_ms 5", "links[0].max_delay_ms")


def test_substitutions_take_the_type_that_the_place_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    manifest = _corpus("substitutions", monkeypatch, domain="42", side="left", managed="false")
    camera = manifest.nodes[0]
    assert manifest.system == "r2"
    assert manifest.discovery.domain_id == 42
    assert camera.namespace == "/r2/left"
    assert not camera.managed
    assert camera.run.command == ("sh", "-c", "exec camera --left $(date)")
    assert camera.run.environment == {"SIDE": "left", "EMPTY": ""}
    assert dict(camera.parameters) == {
        "number": 42,
        "text": "42",
        "both": "left-42",
        "list": (42, 1),
    }


def test_an_included_system_moves_with_its_names_keys_and_links(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    manifest = _corpus("include_twice", monkeypatch)
    assert [(node.key, node.namespace, node.process) for node in manifest.nodes] == [
        ("watch", "/", ""),
        ("left/motor", "/left/arm", "left/main"),
        ("left/control", "/left/arm", "left/main"),
        ("right/motor", "/right/arm", "right/main"),
        ("right/control", "/right/arm", "right/main"),
    ]
    assert [(each.topic, each.from_node, each.to_node) for each in manifest.links] == [
        ("/left/arm/angle", "left/motor", "watch"),
        ("/left/arm/angle", "left/motor", "left/control"),
        ("/right/arm/angle", "right/motor", "right/control"),
    ]
    assert [each.node for each in _node(manifest, "right/control").after] == ["right/motor"]
    assert [each.name for each in manifest.machines] == ["operator", "robot"]
    assert _node(manifest, "left/motor").at == Position(
        file="parts/arm.lifecycle.yaml", line=8, column=3, path="nodes.motor"
    )


def test_an_absolute_topic_of_an_included_system_stays_and_so_does_its_link(
    tmp_path: Path,
) -> None:
    (tmp_path / "inner.lifecycle.yaml").write_text(
        """
manifest_version: 1
system: inner
nodes:
  a: {attach: true, interface: {publishers: [{name: /tf, type: std_msgs/msg/String}]}}
  b: {attach: true, interface: {subscriptions: [{name: /tf, type: std_msgs/msg/String}]}}
links: [{topic: /tf, from: a, to: b}]
"""
    )
    outer = tmp_path / "outer.lifecycle.yaml"
    outer.write_text(
        "manifest_version: 1\nsystem: outer\n"
        "include: [{manifest: inner.lifecycle.yaml, namespace: /n}]\n"
    )
    (link,) = load(outer).manifest.links
    assert link.topic == "/tf"


def test_discovery_and_policy_are_those_of_the_outermost_manifest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    manifest = _corpus("include_only", monkeypatch)
    assert manifest.discovery.domain_id == 3
    assert manifest.policy.unheard == "warning"
    assert [node.key for node in manifest.nodes] == ["talker", "inner/one/listener"]


def test_yaml_1_2_scalars_reach_parameters_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    manifest = _corpus("yaml_features", monkeypatch)
    assert manifest.discovery.range is DiscoveryRange.OFF
    assert manifest.description == "Several lines, ümlauts and 日本語,\none value.\n"
    assert dict(_node(manifest, "side").parameters) == {
        "on": "017",
        "octal": 15,
        "hexadecimal": 255,
        "time": "1:30",
        "version": "1.10",
        "exponent": 1000.0,
        "empty": "",
    }
    front, rear = _node(manifest, "front"), _node(manifest, "rear")
    assert [each.name for each in rear.interface.endpoints] == [
        each.name for each in front.interface.endpoints
    ]


def test_an_interface_by_reference_is_that_of_the_document(monkeypatch: pytest.MonkeyPatch) -> None:
    (talker,) = _corpus("interface_by_reference", monkeypatch).nodes
    assert [each.name for each in talker.interface.endpoints] == ["chatter"]
    assert [each.name for each in talker.interface.parameters] == ["rate"]


def test_paths_do_not_depend_on_the_folder_that_the_process_is_in(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    manifest = load(VALID / "every_key.lifecycle.yaml").manifest
    assert _node(manifest, "talker").parameter_files == (
        str(VALID / "parts" / "speaker.params.yaml"),
    )


def test_attach_may_stand_in_run(monkeypatch: pytest.MonkeyPatch) -> None:
    (talker,) = _corpus("attach_in_run", monkeypatch).nodes
    assert talker.run == Run(kind=RunKind.ATTACH)
    assert _corpus("attach_in_run", monkeypatch).machines == (Machine(name="local", at=talker.at),)


def test_the_environment_may_be_handed_in(tmp_path: Path) -> None:
    path = tmp_path / "e.lifecycle.yaml"
    path.write_text("manifest_version: 1\nsystem: $(env NAME)\nnodes: {talker: {attach: true}}\n")
    assert load(path, environment={"NAME": "given"}).manifest.system == "given"


def test_includes_end_at_a_depth_and_a_number(tmp_path: Path) -> None:
    head = "manifest_version: 1\nsystem: s\ninclude:\n"
    for index in range(20):
        text = f"{head}  - {{manifest: {index + 1}.lifecycle.yaml}}\n"
        (tmp_path / f"{index}.lifecycle.yaml").write_text(text)
    with pytest.raises(Exception, match=r"at most 16 manifests in a row$"):
        load(tmp_path / "0.lifecycle.yaml")
    (tmp_path / "leaf.lifecycle.yaml").write_text(
        "manifest_version: 1\nsystem: s\nnodes: {a: {attach: true}}\n"
    )
    fan = "  - {manifest: FILE.lifecycle.yaml, prefix: PREFIX}\n"
    for name, inner in (("twig", "leaf"), ("branch", "twig"), ("tree", "branch")):
        lines = [fan.replace("FILE", inner).replace("PREFIX", f"p{index}") for index in range(20)]
        (tmp_path / f"{name}.lifecycle.yaml").write_text(head + "".join(lines))
    with pytest.raises(Exception, match="cannot include more than 256 manifests"):
        load(tmp_path / "tree.lifecycle.yaml")


def test_no_module_takes_the_place_of_yaml_until_that_is_loaded() -> None:
    # Python forgets an error, an interrupt too, that loads such a one when others import it.
    program = (
        "import sys, lifecycle.manifest.yaml.document as document; "
        "print('yaml' in sys.modules, document.resolve('0x10', ()))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout == "False 16\n"


def test_what_is_done_when_a_process_fails_is_its_nodes_or_nearest_to_it_or_any_of_its_nodes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    manifest = _corpus("restart", monkeypatch)
    found = {node.key: node.supervision for node in manifest.nodes}
    assert found["camera"] == Supervision(
        restart=Restart.ALWAYS,
        restart_sec=1.0,
        restart_steps=4,
        restart_max_delay_sec=16.0,
        start_limit_burst=3,
        start_limit_interval_sec=60.0,
        on_failure=OnFailure.DEPENDENTS,
        watchdog_sec=2.0,
    )
    arms = Supervision(restart=Restart.ON_FAILURE, restart_sec=0.2, on_failure=OnFailure.ALL)
    assert found["left"] == found["right"] == arms
    assert found["viewer"] == found["logger"] == Supervision(restart_sec=0.5)
    assert found["others"] == Supervision()


def test_an_address_is_one_address_however_it_is_spelled(tmp_path: Path) -> None:
    path = tmp_path / "s.lifecycle.yaml"
    path.write_text(
        "manifest_version: 1\nsystem: s\nnodes: {a: {attach: true, machine: one}}\n"
        "machines: {one: {address: fd00::1}, two: {address: 'FD00:0:0::1'}}\n",
        encoding="utf-8",
    )
    machines = load(path).manifest.machines
    assert [each.address for each in machines] == ["fd00::1", "fd00::1"]
