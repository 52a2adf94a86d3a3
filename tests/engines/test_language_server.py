"""What an editor makes of the manifest's schema: a real language server completes and checks it.

The server is installed by npm; without npm, or without its registry, this is skipped.
"""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
SERVER = "yaml-language-server@2.0.0"
pytestmark = [
    pytest.mark.thorough,
    pytest.mark.timeout(200),
    pytest.mark.skipif(shutil.which("npm") is None, reason="needs npm"),
]


class Editor:
    """The client's side of the Language Server Protocol, as far as it takes here."""

    def __init__(self, server: subprocess.Popen[bytes]) -> None:
        assert server.stdin is not None
        assert server.stdout is not None
        self._in, self._out = server.stdin, server.stdout
        self._diagnosed: dict[str, list[Any]] = {}
        self._number = 0
        folder = {"uri": ROOT.as_uri(), "name": "root"}
        start = {"processId": None, "rootUri": ROOT.as_uri(), "workspaceFolders": [folder]}
        self.ask("initialize", {**start, "capabilities": {}})
        self._send({"method": "initialized", "params": {}})

    def ask(self, method: str, params: dict[str, Any]) -> Any:
        """Return what the server answers."""
        self._number += 1
        number = self._number
        self._send({"id": number, "method": method, "params": params})
        while (message := self._receive()).get("id") != number or "method" in message:
            self._take(message)
        return message["result"]

    def problems(self, path: Path, text: str) -> list[str]:
        """Open a file of this text, and return what is wrong with it."""
        document = {"uri": path.as_uri(), "languageId": "yaml", "version": 1, "text": text}
        self._send({"method": "textDocument/didOpen", "params": {"textDocument": document}})
        while path.as_uri() not in self._diagnosed:
            self._take(self._receive())
        return [each["message"] for each in self._diagnosed.pop(path.as_uri())]

    def at(self, what: str, path: Path, line: int, character: int) -> Any:
        """Return "hover" or "completion" at a place of an open file, counted from 0."""
        place = {"line": line, "character": character}
        return self.ask(
            f"textDocument/{what}", {"textDocument": {"uri": path.as_uri()}, "position": place}
        )

    def _take(self, message: dict[str, Any]) -> None:
        params = message.get("params")
        if message.get("method") == "textDocument/publishDiagnostics":
            self._diagnosed[params["uri"]] = params["diagnostics"]
        elif "id" in message:  # it asks us: the settings of each section, or nothing that matters
            asked = (params or {}).get("items") or []
            self._send({"id": message["id"], "result": [None for _ in asked] or None})

    def _send(self, message: dict[str, Any]) -> None:
        body = json.dumps({"jsonrpc": "2.0", **message}).encode()
        self._in.write(b"Content-Length: %d\r\n\r\n%b" % (len(body), body))
        self._in.flush()

    def _receive(self) -> dict[str, Any]:
        length = 0
        while line := self._out.readline().strip():
            name, _, value = line.partition(b":")
            if name.lower() == b"content-length":
                length = int(value)
        assert length, "the language server has ended"
        message: dict[str, Any] = json.loads(self._out.read(length))
        return message


@pytest.fixture(scope="module")
def editor(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Editor]:
    """Start a language server."""
    folder = tmp_path_factory.mktemp("server")
    install = ("npm", "install", "--no-audit", "--no-fund", "--prefix", folder, SERVER)
    done = subprocess.run(install, capture_output=True, text=True, check=False, timeout=150)
    if done.returncode:
        pytest.skip(f"cannot install {SERVER}: {done.stderr.strip()[-200:]}")
    with subprocess.Popen(
        [folder / "node_modules/.bin/yaml-language-server", "--stdio"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as server:
        yield Editor(server)
        server.kill()


@pytest.mark.parametrize("path", sorted((ROOT / "manifests").glob("*.yaml")), ids=lambda p: p.name)
def test_nothing_is_wrong_with_any_manifest(editor: Editor, path: Path) -> None:
    assert editor.problems(path, path.read_text()) == []


def test_keys_are_completed_and_explained_and_wrong_ones_marked(editor: Editor) -> None:
    path = ROOT / "manifests/new.lifecycle.yaml"
    lines = [
        "# yaml-language-server: $schema=../schemas/manifest.v1.schema.json",
        "manifest_version: 1",
        "system: new",
        "nodes:",
        "  talker:",
        "    run: {python: a:B}",
        "    intrface: {}",
        "    restart: on-failure",
        "    ",
    ]
    (problem,) = editor.problems(path, "\n".join(lines))
    assert "intrface" in problem
    completed = editor.at("completion", path, 8, 4)
    labels = {each["label"] for each in completed["items"]}
    assert {"interface", "parameters", "after"} <= labels
    assert "run" not in labels  # it is there already
    explained = json.dumps(editor.at("hover", path, 7, 6))
    assert "restart" in explained.lower()
    assert len(explained) > 80
