"""Read the tables of network facts that ship inside the package.

Owns: where they are and how they become typed. The files under `lifecycle/network/data/` are
transcribed facts with their sources; nothing is computed into them.
"""

from __future__ import annotations

from importlib import resources
from typing import TypeVar

from lifecycle.codec import from_json

T = TypeVar("T")


def read_table(name: str, type_: type[T]) -> T:
    """Read `data/<name>.json` of this package as `type_`.

    Raises:
        FileNotFoundError: no such table.
        ValueError: the file does not fit `type_`.
    """
    file = resources.files("lifecycle.network").joinpath("data").joinpath(f"{name}.json")
    return from_json(file.read_bytes(), type_)
