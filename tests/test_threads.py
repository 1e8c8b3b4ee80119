"""A thread that nobody ends does not keep its program from ending, read from the source."""

import ast
from collections.abc import Iterator

from tests.source_tree import nodes, sources, tree_of

# Threads that are no daemons: name -> why the program may wait for them
WAITED_FOR = {
    "priority": "it ends at once, and is joined",
    "name": "of guarded_thread: what calls it decides, and ends it by its `Stop`",
}


def _threads() -> Iterator[tuple[str, bool]]:
    """Name and place of each thread that is made, and whether it is a daemon."""
    for file in sources("shoal", "groundstation", "robot_agent", "localizer", "sim_bridge"):
        for node in nodes(tree_of(file)):
            if isinstance(node, ast.Call) and ast.unparse(node.func) in {"threading.Thread", "Thread", "threading.Timer"}:
                given = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
                yield given["name"].strip("'"), given.get("daemon") == "True"


def test_threads_end_with_their_program() -> None:
    threads = list(_threads())
    assert len(threads) > 15
    assert {name for name, is_daemon in threads if not is_daemon} == WAITED_FOR.keys()
