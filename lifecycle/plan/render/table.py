"""Aligned text tables that fit a width. Owns: the one layout that plans are printed in. Pure."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

_GAP = "  "
_LEAST = 24
"""Columns that the last cell keeps even when the others are wide."""


def table(rows: Sequence[Sequence[str]], *, indent: int = 2, width: int = 100) -> list[str]:
    """Align the columns of `rows`; the last cell of a row wraps under itself.

    Args:
        rows: all of one length.
        indent: spaces before each line.
        width: columns that a line should not pass. Words longer than what is left stay whole.

    Returns:
        Lines without trailing blanks; columns that are empty in every row take no space.
    """
    if not rows:
        return []
    sizes = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    used = [column for column, size in enumerate(sizes) if size]
    lines: list[str] = []
    for row in rows:
        fixed = "".join(row[column].ljust(sizes[column]) + _GAP for column in used[:-1])
        first = " " * indent + fixed
        last = row[used[-1]] if used else ""
        lines += textwrap.wrap(
            last,
            max(width, len(first) + _LEAST),
            initial_indent=first,
            subsequent_indent=" " * len(first),
            break_long_words=False,
            break_on_hyphens=False,
        ) or [first]
    return [line.rstrip() for line in lines]
