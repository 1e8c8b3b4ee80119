"""The stop's command line: whatever is left of it after what cannot be used was left out can be parsed."""

import errno
import os
import re
import signal
import socket
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from groundstation.__main__ import cli
from groundstation.cli.stop import CHECKS, FLAGS, NAME, StationStop, usable_arguments
from groundstation.deploy import key_ring
from groundstation.station import discovery
from groundstation.station.discovery import RunningStation
from tests.forked import ended

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


@pytest.mark.parametrize(
    "words",
    [
        ["stop"],
        ["mission", "stop"],
        ["--fleet", "lab", "mission", "stop"],
        ["mission", "--fleet", "lab", "stop"],
        ["mission", "--wait=0", "--json", "stop"],
        ["--fleet", "run", "stop"],
        ["order", "--insecure", "stop"],
    ],
    ids=" ".join,
)
def test_a_stop_is_one_wherever_its_options_stand(words: list[str]) -> None:
    code, output, errors = ended("groundstation", *words, "--station", "tcp/127.0.0.1:1", "--wait", "0")
    assert code == 1 and "NOT HEARD" in output and "Usage" not in errors


def test_a_stop_that_nobody_hears_names_the_address_that_was_called(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With keys that is another one than a station has without."""
    key_ring.init(tmp_path / "keys", ["127.0.0.1"], "shoal", datetime.now(UTC))
    monkeypatch.setenv("SHOAL_RUNTIME_DIR", str(tmp_path))  # nothing runs there
    for words in ([], ["--station", "tcp/127.0.0.1:1"]):
        code, output, _ = ended("groundstation", "stop", *words, "--keys", str(tmp_path / "keys"), "--wait", "0")
        assert code == 1 and len(re.findall("tls/127.0.0.1", output)) == 2 and "tcp/" not in output


def test_a_reader_who_goes_away_leaves_no_station_without_its_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    """As `groundstation stop | head -1` does after the first station's line."""
    stations = [RunningStation(f"tcp/127.0.0.1:{port}", "shoal", name, port) for port, name in ((1, "a"), (2, "b"))]
    awaited: list[str] = []

    def closed(stop: StationStop, as_json: bool) -> None:
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")

    monkeypatch.setattr(discovery, "running", lambda: stations)
    monkeypatch.setattr(StationStop, "begin", lambda stop: None)
    monkeypatch.setattr(StationStop, "await_end", lambda stop: awaited.append(stop.station.endpoint))
    monkeypatch.setattr(StationStop, "print", closed)
    assert CliRunner().invoke(cli, ["stop"]).exit_code == 1
    assert awaited == [station.endpoint for station in stations]


@pytest.mark.real_time
@pytest.mark.parametrize("words", [["stop"], ["mission", "hold"]], ids=["stop", "hold"])
def test_a_person_who_waits_no_longer_is_told_that_nobody_has_heard(tmp_path: Path, words: list[str]) -> None:
    """Something listens at the station's address, and says nothing."""
    tmp_path.chmod(0o700)
    private = {"SHOAL_RUNTIME_DIR": str(tmp_path)}  # another station of this machine is none of this terminal's
    with socket.create_server(("127.0.0.1", 0)) as silent:
        silent.settimeout(120.0)
        address = f"tcp/127.0.0.1:{silent.getsockname()[1]}"
        command = [sys.executable, "-P", "-m", "groundstation", *words, "--station", address, "--wait", "60"]
        terminal = subprocess.Popen(
            command, stderr=subprocess.PIPE, text=True, env=os.environ | private,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a shell's background job ignores it
        )  # fmt: skip
        try:
            with silent.accept()[0]:  # it tries to reach the station
                terminal.send_signal(signal.SIGINT)
                _, errors = terminal.communicate(timeout=60.0)
        finally:
            terminal.kill()
            terminal.wait()
    assert terminal.returncode == 130 and "NOT HEARD" in errors and "goes on with it" not in errors
