"""The board's service: a unit that systemd accepts, a watchdog that only the loop feeds, what real time asks of the system."""

import os
import re
import resource
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from robot_agent.commands import UNIT_NAME, unit_text
from robot_agent.host import realtime
from robot_agent.host.config import RealtimeConfig
from robot_agent.host.sd_notify import TIMES_A_WATCH, ServiceNotifier
from shoal.bus.endpoint import Endpoint
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.errors import ConfigError
from sim_bridge.sil.ports import free_port

pytestmark = pytest.mark.real_time

SYSTEMD = shutil.which("systemd-analyze")


@pytest.mark.skipif(SYSTEMD is None, reason="systemd-analyze is not installed")
def test_systemd_accepts_the_unit_and_finds_it_shut_in(tmp_path: Path) -> None:
    program = tmp_path / "venv" / "bin" / "robot-agent"
    program.parent.mkdir(parents=True)
    program.symlink_to(sys.executable)
    file = tmp_path / UNIT_NAME
    file.write_text(unit_text(str(tmp_path), "root"), encoding="utf-8")
    assert SYSTEMD is not None
    verified = subprocess.run([SYSTEMD, "verify", str(file)], capture_output=True, text=True, check=False)
    assert (verified.returncode, verified.stderr) == (0, "")
    file.write_text(unit_text("/opt/shoal", "shoal"), encoding="utf-8")  # `verify` wants a program and a user that are there
    rated = subprocess.run(
        [SYSTEMD, "security", "--offline=true", "--threshold=30", str(file)], capture_output=True, text=True, check=False
    )
    assert rated.returncode == 0, rated.stdout[-300:]  # exposure at most 3.0 of 10
    figure = re.search(r"exposure level for .*: ([0-9.]+)", rated.stdout)
    sentence = re.search(r"of systemd (\d+)\s+rates it ([0-9.]+) of 10", Path("docs/deploy.md").read_text(encoding="utf-8"))
    version = subprocess.run([SYSTEMD, "--version"], capture_output=True, text=True, check=True).stdout.split()[1]
    assert figure is not None and sentence is not None
    assert version != sentence[1] or figure[1] == sentence[2]  # another systemd counts otherwise


def test_the_unit_says_what_was_decided() -> None:
    lines = unit_text("/opt/shoal/", "pi").splitlines()
    for line in (
        "Type=notify",
        "WatchdogSec=2",
        "Restart=always",
        "User=pi",
        "StateDirectory=shoal-agent",
        "RuntimeDirectory=shoal-agent",
        "Environment=NUMBA_CACHE_DIR=/var/lib/shoal-agent/kernels",
        "ExecStart=/opt/shoal/venv/bin/robot-agent run --config /opt/shoal/agent.toml",
    ):
        assert line in lines
    assert "@" not in "".join(line for line in lines if not line.startswith(("#", "SystemCallFilter=")))


@pytest.mark.parametrize(
    ("home", "user"), [("shoal", "pi"), ("/opt/sh oal", "pi"), ("/opt/$X", "pi"), ("/opt", "pi\nUser=root")]
)
def test_value_that_systemd_would_misread_is_refused(home: str, user: str) -> None:
    with pytest.raises(ConfigError):
        unit_text(home, user)


def ear(path: Path) -> socket.socket:
    """The service manager's end of $NOTIFY_SOCKET."""
    manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    manager.bind(str(path))
    manager.settimeout(30.0)
    return manager


@pytest.mark.parametrize("name", ["notify", "robot@pool"])
def test_the_watchdog_is_fed_as_often_as_asked_and_never_by_itself(tmp_path: Path, name: str) -> None:
    with ear(tmp_path / name) as manager:
        watchdog = ServiceNotifier({"NOTIFY_SOCKET": str(tmp_path / name), "WATCHDOG_USEC": "2000000"})
        watchdog.ready("flying")
        watchdog.mode("FAULT", "no pose")
        for now_ns in range(0, 2_000_000_000, 50_000_000):  # a watchdog period of control steps
            watchdog.alive(now_ns)
        watchdog.stopping()
        watchdog.close()
        manager.setblocking(False)
        texts = []
        while (text := _next(manager)) is not None:
            texts.append(text)
    assert texts == ["READY=1\nSTATUS=flying", "STATUS=fault: no pose", *["WATCHDOG=1"] * TIMES_A_WATCH, "STOPPING=1"]


def _next(manager: socket.socket) -> str | None:
    try:
        return manager.recv(1000).decode()
    except BlockingIOError:
        return None


@pytest.mark.parametrize(
    "environment",
    [
        {},
        {"NOTIFY_SOCKET": "/nowhere/notify", "WATCHDOG_USEC": "1"},
        {"NOTIFY_SOCKET": "/nowhere/notify", "WATCHDOG_USEC": "x", "WATCHDOG_PID": "1"},
    ],
)
def test_without_a_service_manager_nothing_happens(environment: dict[str, str]) -> None:
    watchdog = ServiceNotifier(environment)
    watchdog.ready("flying")
    watchdog.alive(1)
    watchdog.stopping()
    watchdog.close()


def test_mode_stands_in_a_file_until_the_agent_ends(tmp_path: Path) -> None:
    watchdog = ServiceNotifier({"RUNTIME_DIRECTORY": str(tmp_path)})
    watchdog.mode("DISARMED")
    watchdog.mode("TRACKING")
    assert (tmp_path / "status").read_text() == f"TRACKING {os.getpid()}\n"
    assert [file.name for file in tmp_path.iterdir()] == ["status"]
    watchdog.stopping()
    assert not list(tmp_path.iterdir())
    lost = ServiceNotifier({"RUNTIME_DIRECTORY": str(tmp_path / "gone")})
    lost.mode("TRACKING")
    lost.stopping()


def test_a_mode_that_cannot_be_written_leaves_no_older_one_behind(tmp_path: Path) -> None:
    """`groundstation deploy` restarts a robot that the file calls disarmed."""
    watchdog = ServiceNotifier({"RUNTIME_DIRECTORY": str(tmp_path)})
    watchdog.mode("DISARMED")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))  # a full disk, but for the error's number
    try:
        watchdog.mode("TRACKING")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)
    assert not (tmp_path / "status").exists()


def test_a_core_of_any_number_is_refused_in_words() -> None:
    (refused,) = realtime.apply(RealtimeConfig(cores=(10**12,)))
    assert refused.startswith("cores [1000000000000]: CPU number too large (there are")


def test_a_real_agent_tells_systemd_when_it_is_ready_and_that_its_loop_goes_round(tmp_path: Path) -> None:
    address = f"tcp/127.0.0.1:{free_port()}"
    environment = {**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "400000"}
    environment["RUNTIME_DIRECTORY"] = str(tmp_path)
    command = ["run", "pool", "--robot", "1", "--link", "udp:127.0.0.1:9", "--station", address]
    with ear(tmp_path / "notify") as manager:
        agent = subprocess.Popen([sys.executable, "-m", "robot_agent", *command], env=environment, stderr=subprocess.DEVNULL)
        router = None
        try:
            manager.settimeout(3.0)
            with pytest.raises(TimeoutError):  # no station yet: not ready, and nothing to vouch for
                manager.recv(1000)
            router = ZenohTransport(Endpoint(address, router=True))
            manager.settimeout(30.0)
            assert manager.recv(1000) == b"READY=1\nSTATUS=robot 1, experiment pool"
            assert manager.recv(1000) == b"STATUS=disarmed"
            assert (tmp_path / "status").read_text() == f"DISARMED {agent.pid}\n"  # `groundstation deploy` reads it
            assert [manager.recv(1000) for _ in range(5)] == [b"WATCHDOG=1"] * 5
            agent.terminate()
            text = b""
            while text != b"STOPPING=1":
                text = manager.recv(1000)
            assert agent.wait(20.0) == 0
        finally:
            agent.kill()
            agent.wait()
            if router is not None:
                router.close()


def in_a_child(wanted: RealtimeConfig) -> str:
    """Refusals of `apply` in a child process: the tests themselves must not run with a real-time priority."""
    imports = "from robot_agent.host import realtime; from robot_agent.host.config import RealtimeConfig"
    script = f"{imports}; print(realtime.apply({wanted!r}))"
    limit = (resource.RLIMIT_RTPRIO, (0, 0))
    done = subprocess.run(
        [sys.executable, "-c", f"import resource; resource.setrlimit(*{limit}); {script}"],
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.strip()


@pytest.mark.skipif(sys.platform != "linux", reason="real-time options are Linux's")
def test_refusal_of_the_system_is_told_and_not_fatal() -> None:
    assert realtime.apply(RealtimeConfig()) == []
    assert "cores [4000]" in in_a_child(RealtimeConfig(cores=(4000,)))
    assert in_a_child(RealtimeConfig(cores=tuple(os.sched_getaffinity(0)))) == "[]"
    assert "SCHED_FIFO priority" in realtime.permitted()


@pytest.mark.skipif(sys.platform != "linux" or os.geteuid() != 0, reason="needs root to give up a capability")
def test_permissions_are_tried_and_not_read_from_limits() -> None:
    """Root without CAP_SYS_NICE, as in many containers."""
    script = """
import ctypes, os, sys
if len(sys.argv) == 1:  # the capability is lost at the next program
    ctypes.CDLL(None).prctl(24, 23, 0, 0, 0)
    os.execv(sys.executable, [sys.executable, "-c", sys.stdin.read(), "again"])
from robot_agent.host import realtime
from robot_agent.host.config import RealtimeConfig
print(realtime.permitted().split(";")[0], realtime.apply(RealtimeConfig(priority=5)))
"""
    done = subprocess.run([sys.executable, "-c", script], input=script, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("SCHED_FIFO priority: none (Operation not permitted) ['priority 5: ")


@pytest.mark.skipif(sys.platform != "linux" or os.geteuid() != 0, reason="needs root to be allowed everything")
def test_realtime_settings_hold_for_this_thread_only() -> None:
    script = """
import os, threading
from robot_agent.host import realtime
from robot_agent.host.config import RealtimeConfig
refused = realtime.apply(RealtimeConfig(priority=5, lock_memory=True))
here = (os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK, os.sched_getparam(0).sched_priority)
there = []
thread = threading.Thread(target=lambda: there.append(os.sched_getscheduler(0)))
thread.start(); thread.join()
print(refused, here == (os.SCHED_FIFO, 5), there == [os.SCHED_OTHER])
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    output = done.stdout.strip()
    if "priority" in output:
        pytest.skip(f"this container allows no real-time priority: {output}")
    assert output == "[] True True"


@pytest.mark.skipif(sys.platform != "linux", reason="threads are pinned on Linux")
def test_every_thread_is_pinned_those_from_before_and_those_to_come() -> None:
    script = """
import os, threading
from robot_agent.host import realtime
from robot_agent.host.config import RealtimeConfig
core, found, go = min(os.sched_getaffinity(0)), [], threading.Event()
def look():
    go.wait()
    found.append(os.sched_getaffinity(0))
before = threading.Thread(target=look)
before.start()
print(realtime.apply(RealtimeConfig(cores=(core,))))
go.set(); before.join()
after = threading.Thread(target=look)
after.start(); after.join()
print(found == [{core}, {core}])
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["[]", "True"]


def test_the_collector_leaves_alone_what_there_was_when_the_program_began() -> None:
    script = """
import gc
from robot_agent.host import realtime
from robot_agent.agent import Agent
from shoal.config.experiment import load_experiment
agent = Agent(load_experiment("pool"), 1)
before = len(gc.get_objects())
realtime.settle()
print(before > 50_000 and len(gc.get_objects()) < before // 20)
"""
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.strip() == "True"


@pytest.mark.skipif(sys.platform != "linux" or os.geteuid() != 0, reason="needs root to be allowed everything")
def test_locked_memory_is_what_is_used_and_no_more() -> None:
    script = """
import mmap, pathlib
from robot_agent.host import realtime
from robot_agent.host.config import RealtimeConfig
before = mmap.mmap(-1, 1 << 29)
refused = realtime.apply(RealtimeConfig(lock_memory=True))
after = mmap.mmap(-1, 1 << 29)
said = dict(line.split(":", 1) for line in pathlib.Path("/proc/self/status").read_text().splitlines() if ":" in line)
print(refused, int(said["VmLck"].split()[0]) > 2**20, int(said["VmRSS"].split()[0]) < 2**19)
"""
    output = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.strip()
    if "lock_memory" in output:
        pytest.skip(f"this container locks no memory: {output}")
    assert output == "[] True True"
