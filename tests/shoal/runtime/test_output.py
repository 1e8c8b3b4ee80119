"""Logging and progress while nothing takes them: a real process with a stuck pipe, a full disk, a reader that is gone."""

import ast
import io
import os
import subprocess
import sys
from pathlib import Path

import pytest
from rich.table import Table

from shoal.runtime.output import MOST_WAITING, terminal
from shoal.runtime.runtime import log, log_handler
from tests.source_tree import nodes, sources, tree_of

pytestmark = pytest.mark.real_time

LINES = MOST_WAITING + 3000  # more than the queue and a pipe hold
LOGGING = f"""
import sys
from shoal.runtime.runtime import log, start_log
start_log("test")
for number in range({LINES}):
    log.info("line %06d: %s", number, "x" * 40)
print("done", flush=True)
for line in sys.stdin:
    log.info(line.strip())
    print("done", flush=True)
"""


PACKAGES = ("shoal", "groundstation", "robot_agent", "localizer", "sim_bridge", "benchmarks")


@pytest.mark.parametrize("text", ["[/b]", "lab[red]/run", "a [bold b", ":dash: and :x:", "\\[a]"])
def test_a_terminal_prints_what_people_write_as_it_is(text: str) -> None:
    console = terminal(io.StringIO())
    console.print(text, style="red")
    table = Table(text, title=text)
    table.add_row(text)
    console.print(table)
    assert isinstance(console.file, io.StringIO)
    assert console.file.getvalue().count(text) == 4


@pytest.mark.parametrize("package", PACKAGES)
def test_no_program_prints_with_markup(package: str) -> None:
    """Use `terminal`: a bracket in a path or a title must not end a program."""
    for source in sources(package):
        for node in nodes(tree_of(source)):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Console":
                off = [key.arg for key in node.keywords if isinstance(key.value, ast.Constant) and key.value.value is False]
                assert "markup" in off, f"{source}: line {node.lineno}"


def process(script: str, stderr: int) -> "subprocess.Popen[str]":
    words = [sys.executable, "-c", script]
    return subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stderr, text=True)


def test_a_pipe_that_nobody_reads_stops_nothing_and_what_was_lost_is_counted() -> None:
    with process(LOGGING, subprocess.PIPE) as child:
        assert child.stdin is not None and child.stdout is not None and child.stderr is not None
        assert child.stdout.readline() == "done\n"
        first = child.stderr.readline()
        assert first.endswith("test INFO line 000000: " + "x" * 40 + "\n")
        lines = [first]
        while len(lines) < MOST_WAITING:
            lines.append(child.stderr.readline())
        child.stdin.write("flows again\n")
        child.stdin.close()
        lines += child.stderr.readlines()
        assert child.wait() == 0
    assert lines[-1].endswith("flows again\n")
    # More than one gap where the writer's thread comes to run between two lines that find no room.
    gaps = [line for line in lines if "outputs are missing here" in line]
    assert gaps and sum(int(gap.removeprefix("[").split()[0]) for gap in gaps) + len(lines) - len(gaps) - 1 == LINES


def test_a_process_ends_although_nobody_reads_its_output() -> None:
    reading, writing = os.pipe()
    with process(LOGGING, writing) as child:
        os.close(writing)
        assert child.stdin is not None
        child.stdin.close()
        assert child.wait(timeout=60) == 0
    os.close(reading)


def test_a_program_that_ends_with_an_error_ends() -> None:
    """The error's frames hold the console until the interpreter has no threads any more."""
    script = """
import sys
from sim_bridge.in_process import run
def broken(*_):
    raise ValueError("on purpose")
run.prepared = broken
sys.argv = ["sim-bridge", "numeric", "numeric"]
from sim_bridge.__main__ import app
app()
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1 and "ValueError: on purpose" in done.stderr


def test_a_reader_that_is_gone_stops_nothing() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with process(LOGGING, writing) as child:
        os.close(writing)
        assert child.stdin is not None and child.stdout is not None
        assert child.stdout.readline() == "done\n"
        child.stdin.close()
        assert child.wait() == 0


def test_a_full_disk_stops_nothing_and_is_said_when_there_is_room_again(tmp_path: Path) -> None:
    script = """
import resource
from shoal.runtime import output
from shoal.runtime.runtime import log, start_log
start_log("test")
log.info("whole")
output.flush()
_, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
for _ in range(5):
    log.info("no room")
output.flush()
resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
log.info("room again")
"""
    file = tmp_path / "log"
    with file.open("w") as stderr:
        subprocess.run([sys.executable, "-c", script], stderr=stderr, check=True)
    lines = file.read_text().splitlines()
    assert [line.rpartition("INFO ")[2] for line in (lines[0], lines[2])] == ["whole", "room again"]
    assert lines[1].startswith("[5 outputs are missing here")


def test_everything_is_written_before_the_log_is_closed(tmp_path: Path) -> None:
    with (tmp_path / "log").open("w") as stream:
        handler = log_handler("test", stream)
        for number in range(1000):
            handler.handle(log.makeRecord("shoal", 20, "", 0, "%d", (number,), None))
        handler.close()
        assert (tmp_path / "log").read_text().count("\n") == 1000
