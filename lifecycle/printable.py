r"""Escape control characters and bidi overrides in text from elsewhere before a terminal shows it.

Owns: which characters reach a terminal, a log or a report as they are. Names in a graph, texts of
other nodes and lines of processes are chosen by others: ESC moves a cursor, a newline begins a line
that looks like ours, U+202E turns a line around (CVE-2021-42574), a lone surrogate cannot be
written at all. What `str.isprintable` calls no printable character is written as Python would,
`\x1b`, `\n`, `\u202e`. Also how cells are aligned in columns. Imports nothing of the package.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence

_COLOUR = re.compile("\x1b\\[[0-9;:]*m")
"""SGR (ECMA-48 §8.3.117): it changes how text looks, and nothing else."""

_BREAK = re.compile(r"([:;,.]?)\n\s*")


def one_line(text: str) -> str:
    """Return a text that is one line of printable characters."""
    return text if text.isprintable() else "".join(map(_escaped, text))


def sentence(text: str) -> str:
    """Return a text that may have several lines as one, of printable characters."""
    return one_line(_BREAK.sub(lambda found: f"{found[1] or ';'} ", text))


def lines(text: str) -> str:
    """Return a text of printable lines, which nothing but U+000A ends."""
    return "\n".join(map(one_line, text.split("\n")))


def log_line(text: str) -> str:
    """Return a line that a process wrote, without the colours that it gave it."""
    return one_line(_COLOUR.sub("", text).replace("\t", "    "))


def json_text(text: str) -> str:
    """Return a JSON document with what is not printable in its strings escaped (`u202e`).

    Outside of strings JSON has no such character but newlines (RFC 8259 §2).
    """
    if text.isprintable():
        return text
    return "".join(each if each == "\n" else _json_escaped(each) for each in text)


def count(number: int, noun: str) -> str:
    """Return a number and its noun: `1 node`, `2 nodes`, `3 processes`."""
    ending = "" if number == 1 else "es" if noun.endswith("s") else "s"
    return f"{number} {noun}{ending}"


def listed(names: Sequence[str], most: int) -> str:
    """Return names in one line, at most so many of them: `/a, /b and 3 more`."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


_GAP = "  "
_LEAST = 24
"""Columns that the last cell keeps even when the others are wide."""


def columns(rows: Sequence[Sequence[str]], *, indent: int = 0, width: int = 0) -> list[str]:
    """Align the cells of rows in columns; the last cell of a row wraps under itself.

    Args:
        rows: all of one length; cells may be coloured.
        indent: spaces before each line.
        width: columns that a line should not pass, where words that are longer than what is left
            stay whole; 0 never wraps, so that each row is one line.

    Returns:
        Lines without trailing blanks; columns that are empty in every row take no space.
    """
    sizes = [max(map(shown_length, column)) for column in zip(*rows, strict=True)]
    *fixed, last = [column for column, size in enumerate(sizes) if size] or [0]
    text: list[str] = []
    for row in rows:
        cells = (row[each] + " " * (sizes[each] - shown_length(row[each])) + _GAP for each in fixed)
        first = " " * indent + "".join(cells)
        if not width:
            text.append(first + row[last])
            continue
        under = " " * shown_length(first)
        wrapped = textwrap.wrap(
            row[last],
            max(width - len(under), _LEAST),
            break_long_words=False,
            break_on_hyphens=False,
        )
        text += [first + "".join(wrapped[:1]), *(under + each for each in wrapped[1:])]
    return [line.rstrip() for line in text]


def shown_length(text: str) -> int:
    """Return how many characters of a text are shown: its colours are not."""
    return len(_COLOUR.sub("", text))


def _escaped(character: str) -> str:
    if character.isprintable():
        return character
    return character.encode("unicode_escape", "surrogatepass").decode("ascii")


def _json_escaped(character: str) -> str:
    if character.isprintable():
        return character
    units = character.encode("utf-16-be", "surrogatepass").hex()
    return "".join(f"\\u{units[at : at + 4]}" for at in range(0, len(units), 4))
