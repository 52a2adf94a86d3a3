"""What is released: wheel and sdist are complete, and serve a clean environment without ROS."""

from __future__ import annotations

import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.thorough

ROOT = Path(__file__).parents[2]


def _run(*command: str | Path, cwd: Path) -> str:
    result = subprocess.run(
        command, cwd=cwd, capture_output=True, text=True, check=False, timeout=100
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def released(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build sdist and wheel of what git has."""
    folder = tmp_path_factory.mktemp("release")
    sources = folder / "sources"
    sources.mkdir()
    files = _run("git", "ls-files", cwd=ROOT).splitlines()
    for name in files:
        target = sources / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if (ROOT / name).is_symlink():
            target.symlink_to((ROOT / name).readlink())
        elif (ROOT / name).is_file():
            target.write_bytes((ROOT / name).read_bytes())
    _run(sys.executable, "-m", "build", "--outdir", folder / "dist", cwd=sources)
    return folder / "dist"


def test_the_index_would_take_them(released: Path) -> None:
    _run(sys.executable, "-m", "twine", "check", "--strict", *released.iterdir(), cwd=released)


def test_they_have_what_verbs_read(released: Path) -> None:
    (wheel,) = released.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    for each in ("_schemas/manifest.v1.schema.json", "network/data/five_qi.json", "py.typed"):
        assert f"lifecycle/{each}" in names
    assert any(each.startswith("lifecycle/cli/template/") for each in names)
    assert not any(each.startswith(("tests/", "benchmarks/")) for each in names)
    (sdist,) = released.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        assert any(each.endswith("/lifecycle/cli/__init__.py") for each in archive.getnames())


def test_a_clean_environment_without_ros_checks_and_plans(released: Path, tmp_path: Path) -> None:
    (wheel,) = released.glob("*.whl")
    _run(sys.executable, "-m", "venv", tmp_path / "venv", cwd=tmp_path)
    python = tmp_path / "venv/bin/python"
    _run(python, "-m", "pip", "install", "--quiet", wheel, cwd=tmp_path)
    program = tmp_path / "venv/bin/lifecycle"
    version = wheel.name.split("-")[1]
    assert version in _run(program, "--version", cwd=tmp_path)
    _run(program, "init", "my_robot", cwd=tmp_path)
    manifest = "manifests/my_robot.lifecycle.yaml"
    assert "ok" in _run(program, "check", manifest, cwd=tmp_path / "my_robot")
    assert "/talker" in _run(program, "plan", manifest, cwd=tmp_path / "my_robot")


def test_pipx_runs_it_without_installing_anything(released: Path, tmp_path: Path) -> None:
    (wheel,) = released.glob("*.whl")
    _run(sys.executable, "-m", "venv", tmp_path / "venv", cwd=tmp_path)
    python = tmp_path / "venv/bin/python"
    _run(python, "-m", "pip", "install", "--quiet", "pipx", cwd=tmp_path)
    homes = {each: str(tmp_path / each.lower()) for each in ("PIPX_HOME", "PIPX_BIN_DIR")}
    pipx = ("env", *(f"{name}={path}" for name, path in homes.items()), python, "-m", "pipx")
    ran = _run(*pipx, "run", "--spec", wheel, "lifecycle", "--version", cwd=tmp_path)
    assert wheel.name.split("-")[1] in ran
