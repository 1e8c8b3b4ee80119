"""Process faults stop, continue and kill real processes, set their clocks and fill the disk of the log."""

import errno
import os
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import load_experiment
from shoal.messages import topics
from shoal.messages.codec import decode
from shoal.messages.messages import Event
from sim_bridge.sil.fault_injector import ProcessFaultInjector
from sim_bridge.sil.processes import Child, Children


def test_injector_stops_continues_and_kills_a_process(tmp_path: Path) -> None:
    lines = ["t=0.1 for=0.3 process agent-1 stopped", "t=0.2 process agent-2 killed"]
    children = Children(tmp_path)
    try:
        one, two = (children.start(f"agent-{i}", "http.server", ["0"]) for i in (1, 2))
        with Bus(MemoryTransport(MemoryHub())) as bus:
            injector = ProcessFaultInjector(load_experiment("pool", faults=lines), children, bus)
            injector.act(0, None)
            # that nothing waits yet is known to the injector alone: the robots have not started
            assert not injector._waiting
            until_s, was_stopped = time.monotonic() + 20.0, False
            # how many faults last is known to the injector alone
            while time.monotonic() < until_s and (not was_stopped or len(injector._broken) != 1 or two.exit_code is None):
                injector.act(1, 0.01)
                was_stopped |= psutil.Process(one.process.pid).status() == psutil.STATUS_STOPPED
                time.sleep(0.01)
            assert was_stopped and two.exit_code == -9
            assert psutil.Process(one.process.pid).status() != psutil.STATUS_STOPPED
            assert injector.killed == {"agent-2"}
    finally:
        children.stop()


def test_longer_fault_outlives_a_shorter_one_of_the_same_program(tmp_path: Path) -> None:
    """Stopped for good, and once more for a moment; a clock an hour off, and a minute for a moment."""
    lasting = ["t=0.1 process agent-1 stopped", "t=0.1 clock agent-2 step 3600"]
    passing = ["t=0.2 for=0.2 process agent-1 stopped", "t=0.2 for=0.2 clock agent-2 step 60"]
    children = Children(tmp_path)
    try:
        one, _ = (children.start(f"agent-{i}", "http.server", ["0"]) for i in (1, 2))
        with Bus(MemoryTransport(MemoryHub())) as bus:
            injector = ProcessFaultInjector(load_experiment("pool", faults=lasting + passing), children, bus)
            begin_s, most = time.monotonic(), 0
            # how many faults last is known to the injector alone
            while time.monotonic() - begin_s < 20.0 and not (most == 4 and len(injector._broken) == 2):
                injector.act(1, 0.01)
                # how many faults last is known to the injector alone
                most = max(most, len(injector._broken))
                time.sleep(0.01)
        assert psutil.Process(one.process.pid).status() == psutil.STATUS_STOPPED
        assert float(children.clock_file("agent-2").read_text()) == 3600.0
    finally:
        children.stop()


def test_a_second_flight_has_the_timeline_from_its_own_start_on(tmp_path: Path) -> None:
    """A program that was killed in the first stays dead; what a fault without an end broke is whole until its time."""
    children = Children(tmp_path)
    try:
        children.start("agent-2", "http.server", ["0"])
        events, hub = list[str](), MemoryHub()
        with Bus(MemoryTransport(hub)) as bus, Bus(MemoryTransport(hub)) as person:
            person.subscribe(topics.EVENT, None, lambda _, key, __, data: events.append(decode(Event, data, key, "").message))
            lines = ["t=10 clock agent-1 step 60", "t=20 process agent-2 killed"]
            injector = ProcessFaultInjector(load_experiment("pool", faults=lines), children, bus)
            for began_ns, time_s in ((1, 5.0), (1, 6.0), (2, 11.0), (2, 12.0), (3, 25.0), (4, -0.4), (4, 0.1), (5, 30.0)):
                injector.act(began_ns, time_s)
                events.append(f"{began_ns} {time_s}")
    finally:
        children.stop()
    clock, killed = "fault: clock agent-1 step 60", "fault: process agent-2 killed"
    assert events == [
        "1 5.0", "1 6.0", clock, "2 11.0", "2 12.0", killed, "3 25.0",
        "fault over: " + clock[7:], "4 -0.4", "4 0.1", clock, "5 30.0"
    ]  # fmt: skip


CLOCK_TELLER = """
import time
at_s = time.time() - time.monotonic()
while True:
    off_s = time.time() - time.monotonic() - at_s
    with open("{out}", "w") as file:
        file.write(str(off_s))
    time.sleep(0.02)
"""


def test_a_clock_is_set_and_set_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "off"
    (tmp_path / "clock_teller.py").write_text(CLOCK_TELLER.format(out=out))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
    offsets: set[int | str] = set()
    children = Children(tmp_path / "logs", frozenset({"agent-1"}))
    try:
        children.start("agent-1", "clock_teller", [])
        with Bus(MemoryTransport(MemoryHub())) as bus:
            injector = ProcessFaultInjector(
                load_experiment("pool", faults=["t=0.5 for=0.5 clock agent-1 step 3600"]), children, bus
            )
            deadline = time.monotonic() + 20.0
            while time.monotonic() < deadline and offsets != {0, 3600, "back"}:
                text = out.read_text() if out.exists() else ""
                if text:
                    injector.act(1, 0.01)
                    hour = round(float(text))
                    offsets.add("back" if hour == 0 and 3600 in offsets else hour)
                time.sleep(0.02)
    finally:
        children.stop()
    assert offsets == {0, 3600, "back"}


def test_a_full_disk_stops_the_log_and_an_emptied_one_takes_more(tmp_path: Path) -> None:
    """Against a real process that writes as the station does."""
    log = tmp_path / "run.mcap"
    (tmp_path / "logs").mkdir()
    log.write_bytes(bytes(1000))
    writer = subprocess.Popen([sys.executable, "-c", WRITER.format(log=log)], stdout=subprocess.PIPE, text=True)
    assert writer.stdout is not None and writer.stdout.readline() == "0\n"
    children = Children(tmp_path / "logs", all=[Child("groundstation", writer, tmp_path / "logs" / "groundstation.log")])  # type: ignore[arg-type]
    try:
        with Bus(MemoryTransport(MemoryHub())) as bus:
            injector = ProcessFaultInjector(load_experiment("pool", faults=["t=0.01 for=0.5 disk full"]), children, bus)
            errors: list[int] = []
            while (len(errors) < 400 and errors[-3:] != [0, 0, 0]) or errno.EFBIG not in errors:
                injector.act(1, 0.02)
                errors.append(int(writer.stdout.readline()))
    finally:
        writer.kill()
        writer.wait()
    assert errors[-3:] == [0, 0, 0] and set(errors) == {0, errno.EFBIG}


WRITER = """
import os, time
fd = os.open("{log}", os.O_WRONLY | os.O_APPEND)
while True:
    try:
        os.write(fd, bytes(100))
        print(0, flush=True)
    except OSError as error:
        print(error.errno, flush=True)
    time.sleep(0.02)
"""
