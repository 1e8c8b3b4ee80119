"""Cost of a robot's program on its board: time from start to ready, memory, and CPU while it flies at 20 Hz.

All processes of the pool experiment run for real, in real time, with keys, as over a network; the simulator stands for camera
and localizer. One of the two agents is watched from outside. The requirement: 2 s, 250 MB, 10 % of a core.
"""

import tempfile
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

import psutil

from benchmarks.harness import Row
from groundstation.deploy import key_ring
from shoal.config.experiment import load_experiment
from sim_bridge.sil.ports import free_base_port, free_port
from sim_bridge.sil.processes import Child, Children

STARTS = 5
FLIGHT_S = 20
WITHIN_S = 60.0


def _until(condition: Callable[[], bool], what: str) -> float:
    """Seconds until something is so."""
    began_s = time.monotonic()
    while not condition():
        if time.monotonic() - began_s > WITHIN_S:
            raise TimeoutError(f"{what}: not within {WITHIN_S:g} s")
        time.sleep(0.005)
    return time.monotonic() - began_s


def _said(child: Child, what: str) -> bool:
    if child.exit_code is not None:
        raise RuntimeError(child.explain())
    return what in child.log.read_text(encoding="utf-8", errors="replace")


def _agent(children: Children, robot: int, ports: int, common: list[str], name: str = "") -> Child:
    link = f"udp:127.0.0.1:{ports + robot}"
    command = ["run", "pool", "--robot", str(robot), "--link", link, *common]
    return children.start(name or f"agent-{robot}", "robot_agent", command)


def run() -> Iterator[Row]:
    """Start robot 1's agent some times, then fly both and watch it."""
    address, ports = f"tls/127.0.0.1:{free_port()}", free_base_port(load_experiment("pool").robot_ids)
    with tempfile.TemporaryDirectory() as folder:
        children, ring = Children(Path(folder) / "logs"), Path(folder) / "keys"
        key_ring.init(ring, [], "shoal", datetime.now(UTC))
        for robot in (1, 2):
            key_ring.add(ring, "robot", robot, datetime.now(UTC))
        common = ["--station", address, "--keys", str(ring)]
        try:
            command = [
                "run",
                "pool",
                "--no-web",
                "--no-report",
                "--auto",
                "--listen",
                address,
                "--keys",
                str(ring),
                "--run-dir",
                f"{folder}/run",
            ]
            station = children.start("groundstation", "groundstation", command)
            _until(lambda: _said(station, "mission: waiting"), "station")
            children.start("sim-bridge", "sim_bridge", ["pool", "pool", "--poses", "--ports", str(ports), *common])
            starts = []
            for i in range(STARTS):
                agent = _agent(children, 1, ports, common, f"start-{i}")
                starts.append(_until(lambda agent=agent: _said(agent, "ready"), "agent"))  # type: ignore[misc]
                if i < STARTS - 1:
                    agent.process.kill()
                    agent.process.wait()
            yield Row.of("agent", "start to ready", "ours", "s", starts, "2")
            _agent(children, 2, ports, common)
            _until(lambda: _said(station, "mission: running"), "mission")
            watched = psutil.Process(agent.process.pid)
            yield from _watch(watched)
        finally:
            children.stop()


def _watch(process: psutil.Process) -> Iterator[Row]:
    memory_mb, shares = [], []
    spent, at_s = process.cpu_times(), time.monotonic()
    for _ in range(FLIGHT_S):
        time.sleep(1.0)
        now, now_s = process.cpu_times(), time.monotonic()
        shares.append(100.0 * (now.user + now.system - spent.user - spent.system) / (now_s - at_s))
        spent, at_s = now, now_s
        memory_mb.append(process.memory_info().rss / 1e6)
    yield Row.of("agent", "memory, resident", "ours", "MB", memory_mb, "250")
    yield Row.of("agent", "CPU at 20 Hz", "ours", "% of a core", shares, "10")
    yield Row.of("agent", "threads", "ours", "", [float(process.num_threads())])
