"""Agents on hosts of their own (network namespaces), with keys, clocks apart, and boards in HIL mode beside the station."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from socket import SOCK_DGRAM

import pytest

from groundstation.deploy import key_ring
from robot_agent.host.params import set_one
from sim_bridge.sil.ports import free_port
from sim_bridge.sil.processes import Child, Children
from tests.closed_loop.reported import assert_passed
from tests.sim_bridge.boards import board
from tests.waiting import wait_for_line
from wire.config.experiment import NO_CAMERA, dump_experiment, load_experiment
from wire.mavlink.signing_key import new_key

pytestmark = [pytest.mark.real_time, pytest.mark.slow, pytest.mark.timeout(400)]

IP = shutil.which("ip", path=f"{os.environ.get('PATH', '')}:/usr/sbin")
SUBNET = "10.213.7"  # the bridge is .1, robot N's host .10 + N
APART_S = {1: 0.012, 2: -0.008}  # clock of each robot's host minus the station's: within mission.clock_offset_ms


def ip(*words: str) -> bool:
    """True if `ip` did as it was told."""
    return IP is not None and subprocess.run([IP, *words], capture_output=True, check=False).returncode == 0


@pytest.fixture
def hosts() -> Iterator[dict[int, str]]:
    """Two hosts on a bridge of this machine: the name of each robot's namespace."""
    names = {robot: f"hil-{os.getpid()}-{robot}" for robot in (1, 2)}
    bridge = f"hil{os.getpid()}"
    try:
        if not ip("link", "add", bridge, "type", "bridge"):
            pytest.skip("network namespaces are not permitted here")
        assert ip("addr", "add", f"{SUBNET}.1/24", "dev", bridge) and ip("link", "set", bridge, "up")
        for robot, name in names.items():
            here, there = f"h{os.getpid()}{robot}", f"t{os.getpid()}{robot}"
            assert ip("netns", "add", name)
            assert ip("link", "add", here, "type", "veth", "peer", "name", there, "netns", name)
            assert ip("link", "set", here, "master", bridge, "up")
            assert ip("-n", name, "addr", "add", f"{SUBNET}.{10 + robot}/24", "dev", there)
            assert ip("-n", name, "link", "set", there, "up") and ip("-n", name, "link", "set", "lo", "up")
        yield names
    finally:
        for name in names.values():
            ip("netns", "del", name)
        ip("link", "del", bridge)


def on_host(children: Children, host: str, robot: int, arguments: list[str]) -> Child:
    """Start a robot's agent on its host, with a clock of its own."""
    name = f"agent-{robot}"
    children.clock_file(name).write_text(str(APART_S[robot]))
    shim = ["sim_bridge.sil.clock_shim", str(children.clock_file(name)), "robot_agent", *arguments]
    log = children.log_dir / f"{name}.log"
    with log.open("wb") as output:
        process = subprocess.Popen(
            [IP or "ip", "netns", "exec", host, sys.executable, "-m", *shim], stdout=output, stderr=subprocess.STDOUT
        )
    child = Child(name, process, log)
    children.all.append(child)
    return child


def test_agents_on_two_hosts_with_keys_and_clocks_apart_fly_boards_in_hil_mode(tmp_path: Path, hosts: dict[int, str]) -> None:
    experiment = load_experiment("pool", ["duration_s=26", NO_CAMERA])
    run, ring, kept, udp = tmp_path / "run", tmp_path / "keys", tmp_path / "boards", free_port(SOCK_DGRAM)
    run.mkdir()
    kept.mkdir()
    (run / "experiment.toml").write_text(dump_experiment(experiment), encoding="utf-8")
    key_ring.init(ring, [f"{SUBNET}.1"], "shoal", datetime.now(UTC))
    key_ring.add(ring, "simulator", 0, datetime.now(UTC))
    for robot in hosts:
        key_ring.add(ring, "robot", robot, datetime.now(UTC))
        new_key(kept / f"robot-{robot}.key")
    station, file = f"tls/{SUBNET}.1:{free_port()}", str(run / "experiment.toml")
    common = [file, "--keys", str(ring)]
    boards = {1: f"serial:{tmp_path}/plug", 2: f"udp:127.0.0.1:{udp}"}
    real = [part for robot, where in boards.items() for part in ("--board", f"{robot}={where}")]
    pool = ["hil", *common, "--station", station, "--poses", *real, "--boards", str(kept), "--host", f"{SUBNET}.1"]
    children = Children(run / "logs")
    with board(f"pty:{tmp_path}/plug", kept, 1), board(f"udp:127.0.0.1:{udp}", kept, 2):
        for robot, where in boards.items():
            set_one("HIL_MODE", 1.0, where, key=kept / f"robot-{robot}.key")
        try:
            leads = ["run", *common, "--run-dir", str(run), "--listen", station, "--no-web", "--auto"]
            leader = children.start("groundstation", "groundstation", leads)
            wait_for_line(leader.log, "waiting for the fleet", 60.0)
            children.start("sim-bridge", "sim_bridge", pool)
            for robot, host in hosts.items():
                link = ["--link", f"udp:{SUBNET}.1:{14550 + robot}", "--link-key", str(kept / f"robot-{robot}.key")]
                on_host(children, host, robot, ["run", *common, "--robot", str(robot), "--station", station, *link])
            assert leader.process.wait(200) == 0, "\n".join(child.explain() for child in children.all)
        finally:
            children.stop()
    assert_passed(run)
