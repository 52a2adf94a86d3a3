"""What files outside the manifest's folder hold is in no message: root checks strangers' files."""

from __future__ import annotations

from pathlib import Path

import pytest

from lifecycle.manifest import ManifestError, load

SHADOW = "hunter2:$6$abc:19000:0:99999:7:::\nhunter3: [hunter4]\n"
PARAMETERS = "/hunter2:\n  ros__parameters:\n    hunter3: hunter4\n"


@pytest.mark.parametrize("via_link", [False, True])
@pytest.mark.parametrize("text", [SHADOW, PARAMETERS, "hunter2", "a: [hunter2", "- hunter2"])
@pytest.mark.parametrize(
    "use",
    [
        "include: [{{manifest: '{0}'}}]\nnodes: {{n: {{run: {{python: 'x:Y'}}}}}}\n",
        "nodes: {{n: {{run: {{python: 'x:Y'}}, interface: 'local://{0}'}}}}\n",
        "nodes: {{n: {{run: {{python: 'x:Y'}}, parameter_files: ['{0}'], parameters: 7}}}}\n",
        "nodes: {{n: {{run: {{python: 'x:Y'}}, parameter_files: ['{0}']}}}}\n",
    ],
)
def test_no_text_of_a_file_outside_the_folder_is_quoted(
    use: str, text: str, via_link: bool, tmp_path: Path
) -> None:
    folder = tmp_path / "robot"
    folder.mkdir()
    (tmp_path / "secret.yaml").write_text(text)
    (folder / "link.yaml").symlink_to("../secret.yaml")
    manifest = folder / "robot.lifecycle.yaml"
    name = "link.yaml" if via_link else "../secret.yaml"
    manifest.write_text("manifest_version: 1\nsystem: robot\n" + use.format(name))

    try:
        said = [str(each) for each in load(manifest).warnings]
    except ManifestError as error:
        said = [str(error)]

    assert said
    assert "hunter" not in "\n".join(said)


def test_text_of_a_file_in_the_folder_is_quoted(tmp_path: Path) -> None:
    (tmp_path / "a.lifecycle.yaml").write_text("manifest_version: 1\nsystem: a\nwrong: 1\n")
    manifest = tmp_path / "robot.lifecycle.yaml"
    manifest.write_text(
        "manifest_version: 1\nsystem: robot\ninclude: [{manifest: a.lifecycle.yaml}]\n"
    )
    with pytest.raises(ManifestError, match="unknown key 'wrong'"):
        load(manifest)
