"""The stop's command line: whatever is left of it after what cannot be used was left out can be parsed."""

from typing import Any

import typer
from hypothesis import given
from hypothesis import strategies as st

from groundstation.__main__ import cli
from groundstation.cli.stop import CHECKS, FLAGS, NAME, usable_arguments

VALUES = st.one_of(
    st.floats().map(str),
    st.integers(-10, 10**6).map(str),
    st.sampled_from(["", "86400", "86401", "tcp/127.0.0.1:1", "shoal", "a/b", "keys", "1_0"]),
    st.text(max_size=8),
)
WORDS = st.one_of(
    st.sampled_from([name for name in FLAGS if name != "--help"]).map(lambda name: [name]),
    st.tuples(st.sampled_from(sorted(CHECKS)), VALUES).map(list),
    st.tuples(st.sampled_from(sorted(CHECKS)), VALUES).map(lambda pair: ["=".join(pair)]),
    VALUES.map(lambda value: [value]),
)


@given(st.lists(WORDS, max_size=4))
def test_no_line_keeps_a_stop_from_being_sent(words: list[list[str]]) -> None:
    arguments = [word for group in words for word in group]
    group: Any = typer.main.get_command(cli)
    group.commands[NAME].make_context(NAME, arguments)
    kept, complaints = usable_arguments(arguments)
    assert len(kept) + len(complaints) <= 2 * len(arguments)
