"""`lifecycle init`, `lifecycle schema`, and what every user meets first: verbs and annotations."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
import yaml

from lifecycle.ci_formats import Problem, github
from lifecycle.cli import main
from lifecycle.cli.verbs.init import package_files, schema_reference


def test_a_new_package_has_what_pip_pytest_colcon_and_ci_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["init", "my_robot"]) == 0
    assert "lifecycle up manifests/my_robot.lifecycle.yaml" in capsys.readouterr().out
    root = tmp_path / "my_robot"
    made = {str(each.relative_to(root)) for each in root.rglob("*") if each.is_file()}
    assert made == {*package_files("my_robot")}
    assert made >= {
        "pyproject.toml",
        "package.xml",
        "setup.cfg",
        "resource/my_robot",
        "my_robot/nodes.py",
        "manifests/my_robot.lifecycle.yaml",
        "tests/test_system.py",
        ".github/workflows/ci.yml",
    }
    assert not [each for each in root.rglob("*") if "@NAME@" in each.name]
    assert not [each for each in made if "@NAME@" in (root / each).read_text()]
    assert ET.parse(root / "package.xml").findtext("name") == "my_robot"
    steps = yaml.safe_load((root / ".github/workflows/ci.yml").read_text())["jobs"]["test"]["steps"]
    monkeypatch.chdir(root)
    monkeypatch.syspath_prepend(str(root))
    checks = [each["run"] for each in steps if each.get("run", "").startswith("lifecycle ")]
    assert checks == ["lifecycle check manifests/my_robot.lifecycle.yaml --strict --format github"]
    assert main(checks[0].split()[1:]) == 0


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("Robot", "write lower-case letters, digits and single underscores, a letter first"),
        ("my__robot", "write lower-case letters, digits and single underscores, a letter first"),
        ("json", "Python has a module or a keyword of that name"),
        ("tests", "it would hide a package that its own tests import"),
    ],
)
def test_a_name_that_is_no_package_s_is_refused(
    name: str, why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["init", name]) == 2
    assert capsys.readouterr().err == f"cannot make a package {name!r}: {why}\n"


def test_nothing_that_is_there_is_written_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm").mkdir()
    (tmp_path / "arm/pyproject.toml").write_text("mine")
    assert main(["init", "arm"]) == 2
    assert "'arm/pyproject.toml' is there already" in capsys.readouterr().err
    assert [each.name for each in (tmp_path / "arm").iterdir()] == ["pyproject.toml"]


def test_schemas_are_printed_and_installed_for_editors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.chdir(tmp_path)
    assert main(["schema"]) == 0
    assert "manifest_version" in json.loads(capsys.readouterr().out)["properties"]
    assert main(["schema", "verdict"]) == 0
    assert "findings" in json.loads(capsys.readouterr().out)["properties"]
    assert main(["schema", "--install"]) == 0
    url = capsys.readouterr().out.strip().rpartition("$schema=")[2]
    assert json.loads(Path(url.removeprefix("file://")).read_text())["properties"]
    assert main(["schema", "--install", "here"]) == 0
    assert (tmp_path / "here/manifest.v1.schema.json").exists()
    assert main(["schema", "manifst"]) == 2
    assert capsys.readouterr().err.startswith("cannot find schema 'manifst'; there are: ")


def test_a_verb_that_is_misspelt_is_named_with_the_one_that_is_meant(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["chekc", "x"]) == 2
    assert capsys.readouterr().err == "cannot find the verb 'chekc'; did you mean 'check'?\n"
    assert main(["zzz"]) == 2
    assert "lifecycle --help lists the verbs" in capsys.readouterr().err


def test_an_annotation_is_one_line_whatever_is_in_it() -> None:
    text = github(
        Problem(rule="a:b", level="error", message="100% wrong\nfix it", at="dir,x/a.yaml:3:7")
    )
    assert text == "::error file=dir%2Cx/a.yaml,line=3,col=7,title=a%3Ab::100%25 wrong%0Afix it"
    assert github(Problem(rule="r", level="warning", message="m")) == "::warning title=r::m"


def test_a_captured_manifest_names_the_schema_that_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    (tmp_path / "alone").mkdir()
    assert main(["schema", "--install"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[1] == f"# yaml-language-server: $schema={schema_reference(tmp_path / 'alone')}"
    assert main(["init", "arm", "--directory", str(tmp_path / "arm")]) == 0
    assert schema_reference(tmp_path / "arm/manifests") == "../schemas/manifest.v1.schema.json"
