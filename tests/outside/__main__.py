"""`python -m tests.outside [WORD]`: print the catalogue as a table; rows with WORD only."""

from __future__ import annotations

import shlex
import sys

from tests.outside.case import Case
from tests.outside.cases import BY_MODULE

HEAD = ("kind", "attack", "command", "verdict", "exit", "activated")


def row(module: str, case: Case) -> tuple[str, ...]:
    """Return the cells of one case."""
    strangers = "".join(f"{shlex.join(each)} & " for each in case.strangers)
    verb, *options = case.verb
    activated = "any" if case.activated is None else ", ".join(sorted(case.activated)) or "nobody"
    return (
        module,
        case.attack,
        f"{strangers}lifecycle {shlex.join([verb, 'SYSTEM', *options])}"
        + (" (and a story)" if case.story else ""),
        case.verdict or "any",
        " or ".join(map(str, case.exit_codes)),
        activated,
    )


def main(word: str = "") -> None:
    """Print a table in Markdown."""
    rows = [HEAD, ("---",) * len(HEAD)]
    rows += [row(module, case) for module, cases in BY_MODULE.items() for case in cases]
    for index, cells in enumerate(rows):
        if index < 2 or word in " ".join(cells):
            print(
                "|", " | ".join(" ".join(each.replace("|", "\\|").split()) for each in cells), "|"
            )


if __name__ == "__main__":
    main(*sys.argv[1:])
