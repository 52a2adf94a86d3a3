"""What nodes run, looked for without running it."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from msgspec.structs import replace

from lifecycle.manifest.diagnostics import Severity
from lifecycle.manifest.model import EndpointKind, Position, Run, RunKind
from lifecycle.plan.programs import Resolution, resolve_programs
from tests.builders import endpoint, manifest, node, publisher, subscription

TALKER = """
from lifecycle import LifecycleNode, on_message, on_service, on_action, on_goal, on_timer
raise SystemExit("this was run")
class Talker(LifecycleNode):
    @on_timer(period_s=1)
    def tick(self):
        self.publisher("chatter").publish(1)
    @on_message("orders")
    def take(self, message): ...
"""
COMPLETE = (publisher("chatter"), subscription("orders"))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def write(folder: Path, **modules: str) -> None:
    """Write modules by name."""
    for name, text in modules.items():
        (folder / f"{name}.py").write_text(text)


def python(
    reference: str, *endpoints: object, ours: bool = True, working_directory: str = ""
) -> Resolution:
    """Look for one class; `ours`: its machine is this host."""
    run = Run(kind=RunKind.PYTHON, python=reference, working_directory=working_directory)
    system = manifest(node("talker", *endpoints, run=run, machine="" if ours else "robot"))
    return resolve_programs(system, environment={}, is_ours=lambda name: name != "robot")


def command(*words: str, environment: dict[str, str] | None = None, **rest: object) -> Resolution:
    run = Run(kind=RunKind.COMMAND, command=words, **rest)
    return resolve_programs(manifest(node("talker", run=run)), environment=environment or {})


def said(found: Resolution) -> list[str]:
    """Messages and hints of the diagnostics, then what is unresolved."""
    lines = [f"{each.message}; {each.hint}".removesuffix("; ") for each in found.diagnostics]
    return lines + [f"? {each.subject}: {each.reason}" for each in found.unresolved]


def test_a_class_with_all_its_handlers_is_found_and_nothing_is_run(folder: Path) -> None:
    write(folder, talk=TALKER)
    assert python("talk:Talker", *COMPLETE) == Resolution()
    assert "talk" not in sys.modules


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        (
            "talk:Talkr",
            "cannot find class 'Talkr' in talk (talk.py); it has Talker; did you mean 'Talker'?",
        ),
        (
            "pkg.mod:Plain",
            (
                "cannot use 'Plain' of pkg.mod (pkg/mod.py) as a node: it is no node class; derive "
                "it from lifecycle.LifecycleNode, or from rclpy.node.Node"
            ),
        ),
        ("broken:Talker", "cannot import 'broken': broken.py:1: invalid syntax"),
    ],
)
def test_what_python_would_refuse_is_an_error(folder: Path, reference: str, message: str) -> None:
    write(folder, talk=TALKER, broken="class class")
    (folder / "pkg").mkdir()
    (folder / "pkg" / "__init__.py").write_text("from . import mod\n")
    (folder / "pkg" / "mod.py").write_text("class Plain: ...\n")
    found = [line.replace(f"{folder}/", "") for line in said(python(reference))]
    assert found == [message]


@pytest.mark.parametrize("module", ["nowhere.nodes", "talk.more", "pkg.none"])
def test_a_module_that_is_nowhere_says_where_it_is_looked_for(folder: Path, module: str) -> None:
    write(folder, talk=TALKER)
    (folder / "pkg").mkdir()
    assert said(python(f"{module}:Talker")) == [
        f"cannot find module '{module}'; it is looked for in {folder} and in what is installed"
    ]


@pytest.mark.parametrize(
    "init",
    [
        "from .talker import Talker",
        "from pkg.talker import Talker",
        "from .again import Other as Talker",
        "from . import talker\nclass Talker(talker.Talker): ...",
        "import pkg, pkg.talker as t\nclass Talker(t.Talker): ...",
    ],
)
def test_names_are_followed_through_imports(folder: Path, init: str) -> None:
    (folder / "pkg").mkdir()
    (folder / "pkg" / "__init__.py").write_text(init)
    (folder / "pkg" / "talker.py").write_text(TALKER)
    (folder / "pkg" / "again.py").write_text("from .talker import Talker as Other")
    assert python("pkg:Talker", *COMPLETE) == Resolution()
    assert said(python("pkg:Talker", publisher("chatter"))) == [
        (
            "cannot use handler @on_message('orders') (pkg/talker.py:8): 'talker' declares no "
            "subscription 'orders'; declared: none"
        )
    ]


@pytest.mark.parametrize(
    "text",
    [
        "def __getattr__(name): ...",
        "globals()['Talk' + 'er'] = type",
        "from nodes import *",
        "from . import Talker",
        "import Talker",
        "Talker = make()",
        "Talker = 'orders'",
        "try:\n    from a import Talker\nexcept ImportError:\n    Talker = None",
        "from lifecycle import LifecycleNode\nif LifecycleNode:\n    class Talker: ...",
        "from nowhere_x import Base\nclass Talker(Base): ...",
        "class Talker(make()): ...",
    ],
)
def test_what_only_running_would_tell_is_named(folder: Path, text: str) -> None:
    write(folder, talk=text)
    (line,) = said(python("talk:Talker"))
    assert line.startswith(("? class 'talk:Talker': ", "? node class of class 'talk:Talker': "))


def test_a_compiled_module_is_named(folder: Path) -> None:
    (folder / "fast.abi3.so").write_bytes(b"")
    assert said(python("fast:Talker")) == ["? class 'fast:Talker': fast is not written in Python"]


SLIPS = """
import nosuch.part, os
from gone import thing
from lifecycle import LifecycleNode
try:
    import optional
except ImportError:
    pass
class Talker(LifecycleNode):
    def on_configur(self, state):
        self.declare_parameter("own", 1)
        self.get_parameter("sped"), self.get_parameter("own"), self.get_parameter("use_sim_time")
    def on_activated(self, other): ...
    def on_wave(self): ...
    def on_message(self): ...
"""


def test_what_code_says_and_nothing_answers_to_is_warned_of(folder: Path) -> None:
    write(folder, talk=SLIPS, free=SLIPS.replace('"own", 1', "self.name, 1"))
    found = python("talk:Talker")
    assert {each.severity for each in found.diagnostics} == {Severity.WARNING}
    missing = "it is not installed here; install it where the node runs"
    parameter = (
        "cannot get parameter 'sped' in talk.py:12: 'talker' declares none of that name; "
        "declared: none"
    )
    callback = (
        "cannot tell what Talker.{} (talk.py:{}) is for: nothing calls it; did you mean '{}'?"
    )
    assert said(found) == [
        f"cannot import 'nosuch', as talk.py:2 does: {missing}",
        f"cannot import 'gone', as talk.py:3 does: {missing}",
        callback.format("on_configur", 10, "on_configure"),
        callback.format("on_activated", 13, "on_activate"),
        parameter,
    ]
    # A name that is computed may be any.
    assert parameter.replace("talk.py", "free.py") not in said(python("free:Talker"))
    assert [each for each in said(python("talk:Talker", ours=False)) if "import" in each] == []


def test_handlers_and_endpoints_are_paired_as_at_run_time(folder: Path) -> None:
    text = TALKER.replace("class Talker", "class Base") + (
        "class Talker(Base):\n"
        "    def take(self, message): ...\n"  # inherits what it overrides
        "    @on_service('reset')\n"
        "    def reset(self, request, response): ...\n"
        "    @on_goal('dock')\n"
        "    def may(self, goal): ...\n"
    )
    write(folder, talk=text)
    found = python(
        "talk:Talker",
        publisher("chatter"),
        subscription("order"),
        endpoint(EndpointKind.SERVICE_SERVER, "reset", "std_srvs/srv/Trigger"),
        endpoint(EndpointKind.ACTION_SERVER, "dock", "robot/action/Dock", None),
    )
    assert sorted(said(found)) == [
        (
            "cannot serve action server 'dock': no method of Talker (talk.py) is decorated with "
            "@on_action('dock')"
        ),
        (
            "cannot serve subscription 'order': no method of Talker (talk.py) is decorated with "
            "@on_message('order')"
        ),
        (
            "cannot use handler @on_message('orders') (talk.py:8): 'talker' declares no "
            "subscription 'orders'; did you mean 'order'? declared: 'order'"
        ),
    ]


def test_endpoints_that_code_declares_itself_are_not_guessed(folder: Path) -> None:
    write(folder, talk=TALKER + "    def on_configure(self): self.declare_publisher('x', 1)\n")
    (line,) = said(python("talk:Talker"))
    assert line.startswith("? endpoints of class 'talk:Talker': its code declares endpoints itself")


def test_of_another_machine_only_what_is_here_is_judged(folder: Path) -> None:
    write(folder, talk=TALKER)
    assert said(python("nowhere:Talker", ours=False))[0].startswith(
        "? class 'nowhere:Talker': it is for machine 'robot'; here, there is no module 'nowhere'"
    )
    assert said(python("talk:Talkr", ours=False))[0].startswith("cannot find class 'Talkr'")


def test_a_working_directory_is_looked_in_first(folder: Path) -> None:
    (folder / "work").mkdir()
    write(folder, talk="class Other: ...")
    write(folder / "work", talk=TALKER)
    found = python("talk:Talker", *COMPLETE, working_directory=str(folder / "work"))
    assert found == Resolution()


def test_programs_are_found_as_exec_would_find_them(folder: Path) -> None:
    (folder / "bin").mkdir()
    (folder / "bin" / "talk").write_text("#!/bin/sh\n")
    (folder / "bin" / "listen").write_text("#!/bin/sh\n")
    (folder / "bin" / "talk").chmod(0o755)
    path = {"PATH": "/nowhere"}
    own = {"PATH": f"{folder}/bin"}
    run = Run(kind=RunKind.COMMAND, command=("talk",), environment=own)
    assert resolve_programs(manifest(node("t", run=run)), environment=path) == Resolution()
    assert command("bin/talk") == Resolution()
    assert said(command("talk", environment=path)) == [
        (
            "cannot find program 'talk' on PATH; install it, name its path, or set PATH in "
            "run.environment"
        )
    ]
    assert said(command("bin/talkr")) == [
        f"cannot find program 'talkr' in '{folder}/bin'; did you mean 'talk'?"
    ]
    assert said(command("bin/listen")) == ["cannot run 'bin/listen': it is not executable"]
    assert said(command(sys.executable, "talk.py")) == [
        f"cannot find script 'talk.py' in '{folder}'"
    ]
    assert said(command("bin/talk", working_directory="/nowhere")) == [
        "cannot find the working directory '/nowhere'"
    ]


def test_executables_of_packages_are_looked_for_where_there_are_packages(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "lib" / "demo").mkdir(parents=True)
    (folder / "lib" / "demo" / "talk").write_text("")
    (folder / "lib" / "demo" / "talk").chmod(0o755)

    def package(executable: str, prefix: str) -> list[str]:
        run = Run(kind=RunKind.COMMAND, package="demo", executable=executable)
        variables = {"AMENT_PREFIX_PATH": prefix} if prefix else {}
        return said(resolve_programs(manifest(node("t", run=run)), environment=variables))

    assert package("talk", str(folder)) == []
    assert package("talkr", str(folder)) == [
        "cannot find executable 'talkr' of package 'demo': the package has talk"
    ]
    assert package("talk", "") == [
        (
            "? executable 'talk' of package 'demo': AMENT_PREFIX_PATH is empty; source the setup "
            "file of its workspace"
        )
    ]
    monkeypatch.setattr(sys, "prefix", str(folder))  # where wheels install them
    assert package("talk", "") == []


FOREIGN = """
import rclpy
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
class Plain(Node):
    def __init__(self, device, *, rate=10):
        super().__init__("plain")
class Managed(LifecycleNode): ...
def both(word): return [Plain(word), Managed("m")]
"""


@pytest.mark.parametrize(
    ("name", "managed", "arguments", "message"),
    [
        ("Plain", False, {"device": "/dev/null", "rate": 5}, ""),
        ("Managed", True, {}, ""),
        ("both", True, {"word": "hi"}, ""),
        (
            "Plain",
            True,
            {"device": "/dev/null"},
            (
                "cannot manage 'talker': Plain (them.py) is a plain node; write 'managed: false'; "
                "it is held by its executor until the system is verified"
            ),
        ),
    ],
)
def test_a_class_of_others_is_managed_as_it_can_be(
    folder: Path, name: str, managed: bool, arguments: dict[str, str], message: str
) -> None:
    write(folder, them=FOREIGN)
    run = Run(kind=RunKind.PYTHON, python=f"them:{name}", arguments=arguments)
    found = resolve_programs(manifest(node("talker", run=run, managed=managed)), environment={})
    assert said(found) == ([message] if message else [])


def test_modules_are_found_beside_the_manifest_and_on_pythonpath(folder: Path) -> None:
    (folder / "src").mkdir()
    write(folder / "src", them=FOREIGN)
    environment = {"PYTHONPATH": str(folder / "src")}
    run = Run(kind=RunKind.PYTHON, python="them:Managed")
    assert said(resolve_programs(manifest(node("talker", run=run)), environment={})) != []
    given = replace(run, environment=environment)
    assert said(resolve_programs(manifest(node("talker", run=given)), environment={})) == []
    at = Position(file=str(folder / "src" / "them.lifecycle.yaml"), line=1, column=1)
    beside = replace(node("talker", run=run), at=at)
    assert said(resolve_programs(manifest(beside), environment={})) == []


def test_a_class_is_found_in_nested_folders_without_an_init(folder: Path) -> None:
    (folder / "outer" / "inner").mkdir(parents=True)
    (folder / "outer" / "inner" / "talking.py").write_text(TALKER)
    assert python("outer.inner.talking:Talker", *COMPLETE).diagnostics == ()
