"""Text from others cannot steer a terminal that shows it."""

import io
import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shoal.runtime.runtime import log, log_handler
from shoal.system.printable import printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        (
            "Fahrt \N{LATIN SMALL LETTER U WITH DIAERESIS}ber 3 m\n\ttief",
            "Fahrt \N{LATIN SMALL LETTER U WITH DIAERESIS}ber 3 m\\n\\ttief",
        ),
        ("\x1b]0;title\x07", "\\x1b]0;title\\x07"),
        ("a\rb\x00\x7f\x9b31m", "a\\rb\\x00\\x7f\\x9b31m"),
        ("robot \u202e1", "robot \\u202e1"),
    ],
)
def test_control_characters_are_shown_as_escapes(text: str, shown: str) -> None:
    assert printable(text) == shown


@given(st.text())
def test_no_control_character_is_left(text: str) -> None:
    for sign in printable(text):
        assert unicodedata.category(sign) != "Cc"
        assert unicodedata.bidirectional(sign) not in ("LRE", "RLE", "PDF", "LRO", "RLO", "LRI", "RLI", "FSI", "PDI")


def test_a_log_line_cannot_steer_the_terminal() -> None:
    stream = io.StringIO()
    log_handler("test", stream).handle(log.makeRecord("shoal", 20, "", 0, "robot \x1b[2J", (), None))
    assert stream.getvalue().endswith("test INFO robot \\x1b[2J\n")
