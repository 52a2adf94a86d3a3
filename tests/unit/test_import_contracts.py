"""What modules import and name, where import-linter does not look."""

from __future__ import annotations

import ast
import graphlib
import subprocess
import sys
from pathlib import Path

from lifecycle.network.medium import Medium

ROOT = Path(__file__).parents[2]


def test_networks_are_programmed_without_ros_and_loaded_without_httpx() -> None:
    code = (
        "import sys\n"
        "sys.modules['rclpy'] = sys.modules['httpx'] = None\n"
        "import lifecycle.programming.programmer\n"
        "from lifecycle.programming.target import read_targets\n"
        "assert read_targets(['nft'], {})\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr


def test_the_core_of_a_supervisor_is_loaded_without_a_loop() -> None:
    code = (
        "import sys\n"
        "sys.modules['asyncio'] = sys.modules['rclpy'] = None\n"
        "import lifecycle.supervisor.core.reduce\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr


def test_no_module_imports_itself_by_way_of_others() -> None:
    graphlib.TopologicalSorter(_imports()).prepare()


def _imports() -> dict[str, set[str]]:
    """What each module imports when it is loaded; a class may be named whose module imports it."""
    files = {
        ".".join(each.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): each
        for each in (ROOT / "lifecycle").rglob("*.py")
    }
    found: dict[str, set[str]] = {}
    for name, path in files.items():
        tree = ast.parse(path.read_text())
        late = {
            id(each)
            for block in ast.walk(tree)
            if isinstance(block, ast.FunctionDef | ast.AsyncFunctionDef)
            or (isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING")
            for each in ast.walk(block)
        }
        modules: set[str] = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module and id(node) not in late:
                for each in node.names:
                    inner = f"{node.module}.{each.name}"
                    modules.add(inner if inner in files else node.module)
        # A room loads its public names on first use, and is no part of a circle.
        found[name] = {each for each in modules if each in files and each != name}
    return {
        name: {each for each in modules if files[each].name != "__init__.py"}
        for name, modules in found.items()
    }


def test_those_that_choose_or_name_a_medium_know_it_and_all_others_ask_it() -> None:
    """A new medium is an entry of its table; who asks `is_tcp` of it need not be found."""
    root = ROOT / "lifecycle"
    words = {each.value for each in Medium}
    knowing, spelling = set(), []
    for path in root.rglob("*.py"):
        name = str(path.relative_to(root))
        for each in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(each, ast.Constant) and each.value in words:
                spelling.append(f"{name}:{each.lineno}")
            if isinstance(each, ast.Attribute) and each.attr in Medium.__members__:
                of = each.value
                knowing |= {name} if isinstance(of, ast.Name) and of.id == "Medium" else set()
    assert {each.partition(":")[0] for each in spelling} == {"network/medium.py"}
    assert knowing == {
        "network/medium.py",
        "network/nfe.py",  # shared memory is what shows no address
        "verify/network_flows.py",
        "verify/view.py",
        "programming/rules.py",
        "middleware/fastdds/url_profile.py",  # what Fast DDS calls it
        "plan/media.py",  # which medium two ends get
        "plan/negotiate.py",
    }
