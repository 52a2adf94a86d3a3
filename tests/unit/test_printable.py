"""Nothing that others wrote commands a terminal, begins a line or leaves JSON unreadable."""

from __future__ import annotations

import json
import re

from hypothesis import given
from hypothesis import strategies as st

from lifecycle.printable import columns, json_text, lines, log_line, one_line, sentence

ANY = st.text(st.characters())


def test_what_is_printable_stays_as_it_is():
    assert one_line("/robot/vidéo → [red]\\x1b") == "/robot/vidéo → [red]\\x1b"


def test_what_is_not_is_written_as_python_escapes_it():
    assert one_line("\x1b[2J\n\r\t\x9b\u202e\ud800") == r"\x1b[2J\n\r\t\x9b\u202e\ud800"


def test_only_a_newline_ends_a_line():
    assert lines("a\nb\u2028c\x85d\re") == "a\nb\\u2028c\\x85d\\re"


def test_several_lines_become_one_sentence():
    text = (
        "nef: 0 unchanged\n  left out: a\ncannot make 1 of 2 changes to nef:\n  POST: no answer\x1b"
    )
    assert sentence(text) == (
        "nef: 0 unchanged; left out: a; cannot make 1 of 2 changes to nef: POST: no answer\\x1b"
    )


def test_the_colours_of_a_log_line_are_left_out_and_its_commands_are_shown():
    assert log_line("\x1b[31m[ERROR]\x1b[0m\tgone\x1b[2J") == "[ERROR]    gone\\x1b[2J"


@given(ANY)
def test_any_text_becomes_one_line(text):
    assert one_line(text).isprintable()
    assert log_line(text).isprintable()
    one_line(text).encode()


@given(st.dictionaries(ANY, ANY), st.sampled_from([None, 2]))
def test_json_reads_back_the_same_and_is_printable(value, indent):
    text = json_text(json.dumps(value, ensure_ascii=False, indent=indent))
    assert json.loads(text) == value
    assert text.replace("\n", "").isprintable()


def test_a_table_aligns_wraps_its_last_cell_and_drops_empty_columns():
    rows = [("a", "", "one two three four five six"), ("long", "", "x")]
    assert columns(rows, indent=2, width=34) == [
        "  a     one two three four five",
        "        six",
        "  long  x",
    ]
    assert columns([]) == []


@given(st.lists(st.lists(st.text("ab →", max_size=9), min_size=3, max_size=3), min_size=1))
def test_coloured_cells_are_aligned_as_those_without_colours_are(rows):
    coloured = [[f"\x1b[31m{first}\x1b[0m", second, last] for first, second, last in rows]
    for width in (0, 30):
        plain = [re.sub("\x1b\\[\\d+m", "", line) for line in columns(coloured, width=width)]
        assert [line.rstrip() for line in plain] == columns(rows, width=width)
