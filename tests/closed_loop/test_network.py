"""Agents that were deployed to hosts of their own (network namespaces with SSH servers), with keys and clocks apart."""

import json
import os
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import pytest

from groundstation.deploy import key_ring
from shoal.config.experiment import NO_CAMERA, dump_experiment, load_experiment
from shoal.mavlink.signing_key import new_key
from sim_bridge.sil.ports import free_port
from sim_bridge.sil.processes import Child, Children
from tests.closed_loop.reported import assert_passed
from tests.forked import ended
from tests.ssh_server import WITH_PACKAGES, own_wheel, ssh_command, ssh_server
from tests.waiting import wait_for_line

pytestmark = [pytest.mark.real_time, pytest.mark.slow, pytest.mark.timeout(1200)]

IP = shutil.which("ip", path=f"{os.environ.get('PATH', '')}:/usr/sbin") or "ip"
SUBNET = "10.213.7"  # the bridge is .1, robot N's host .10 + N
APART_S = {1: 0.012, 2: -0.008}  # clock of each robot's host minus the station's: within mission.clock_offset_ms
SSH_PORT, PORTS = 22, 14550
AGENT = "venv/bin/python -m sim_bridge.sil.clock_shim clock robot_agent"  # a namespace has no wall clock of its own
SETTINGS = ["duration_s=26", NO_CAMERA, "limits.exposure_to_pwm_p99_ms=200"]  # three computers' work on one machine
ENDS_WITHIN_S = 300.0  # a flight of 26 s, on a machine that is busy


@dataclass(frozen=True)
class Hosts:
    """The robots' hosts: where ssh finds them, how, and the folder in which each has its own software."""

    names: dict[int, str]
    ssh: str
    home: Path

    def command(self, robot: int, words: str) -> list[str]:
        """Words for the shell of a host, in its home."""
        return [*shlex.split(self.ssh), "-tt", self.names[robot], f"cd {self.home} && {words}"]

    def run(self, robot: int, words: str) -> str:
        done = subprocess.run(
            self.command(robot, words), capture_output=True, text=True, stdin=subprocess.DEVNULL, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout


def ip(*words: str) -> bool:
    """True if `ip` did as it was told."""
    return subprocess.run([IP, *words], capture_output=True, check=False).returncode == 0


@pytest.fixture
def hosts(tmp_path: Path) -> Iterator[Hosts]:
    """Two hosts on a bridge of this machine, each with an SSH server, a home and a clock of its own."""
    spaces = {robot: f"hil-{os.getpid()}-{robot}" for robot in APART_S}
    bridge, home = f"hil{os.getpid()}", tmp_path / "shoal"
    names = {robot: f"{SUBNET}.{10 + robot}" for robot in spaces}
    home.mkdir()
    with ExitStack() as stack:
        if not ip("link", "add", bridge, "type", "bridge"):
            pytest.skip("network namespaces are not permitted here")
        stack.callback(ip, "link", "del", bridge)
        assert ip("addr", "add", f"{SUBNET}.1/24", "dev", bridge) and ip("link", "set", bridge, "up")
        ssh = ssh_command(tmp_path, SSH_PORT)
        for robot, space in spaces.items():
            here, there = f"h{os.getpid()}{robot}", f"t{os.getpid()}{robot}"
            assert ip("netns", "add", space)
            stack.callback(ip, "netns", "del", space)
            stack.callback(end_all_in, space)
            assert ip("link", "add", here, "type", "veth", "peer", "name", there, "netns", space)
            assert ip("link", "set", here, "master", bridge, "up")
            assert ip("-n", space, "addr", "add", f"{names[robot]}/24", "dev", there)
            assert ip("-n", space, "link", "set", there, "up") and ip("-n", space, "link", "set", "lo", "up")
            disk = tmp_path / f"host-{robot}"
            disk.mkdir()
            mounted = f'mount --bind {disk} {home} && exec "$@"'  # `ip netns exec` has a mount namespace of its own
            inside = [IP, "netns", "exec", space, "sh", "-c", mounted, "sh"]
            (disk / "clock").write_text(str(APART_S[robot]))
            environment = {**WITH_PACKAGES, "NUMBA_CACHE_DIR": str(home / "kernels")}
            stack.enter_context(ssh_server(tmp_path, names[robot], SSH_PORT, environment, inside))
        yield Hosts(names, ssh, home)


def end_all_in(space: str) -> None:
    """End the programs that are left in a network namespace."""
    left = subprocess.run([IP, "netns", "pids", space], capture_output=True, text=True, check=False).stdout.split()
    subprocess.run(["kill", "-KILL", *left], capture_output=True, check=False)


def deploy(hosts: Hosts, robot: int, settings: list[str]) -> None:
    """Bring a host up to date as a lab does."""
    command = ["deploy", f"{hosts.names[robot]}={robot}", *settings, "--home", str(hosts.home), "--ssh", hosts.ssh]
    command += ["--link", f"udp:{SUBNET}.1:{PORTS + robot}", "--link-key", "link.key"]
    code, output, errors = ended("groundstation", *command)
    assert code == 0, output + errors


def on_host(children: Children, hosts: Hosts, robot: int, name: str, words: str) -> Child:
    """Start a program on a robot's host."""
    log = children.log_dir / f"{name}.log"
    with log.open("wb") as output:
        process = subprocess.Popen(hosts.command(robot, words), stdin=subprocess.DEVNULL, stdout=output, stderr=output)
    children.all.append(child := Child(name, process, log))
    return child


def test_agents_deployed_to_two_hosts_with_clocks_apart_fly_within_limits(tmp_path: Path, hosts: Hosts) -> None:
    run, ring, boards = tmp_path / "run", tmp_path / "keys", tmp_path / "boards"
    for folder in (run, boards, run / "logs"):
        folder.mkdir()
    file, station = run / "experiment.toml", f"tls/{SUBNET}.1:{free_port()}"
    file.write_text(dump_experiment(load_experiment("pool", SETTINGS)), encoding="utf-8")
    key_ring.init(ring, [f"{SUBNET}.1"], "shoal", datetime.now(UTC))
    key_ring.add(ring, "simulator", 0, datetime.now(UTC))
    wheels = own_wheel(tmp_path / "wheels")
    for robot in hosts.names:
        key_ring.add(ring, "robot", robot, datetime.now(UTC))
        new_key(boards / f"robot-{robot}.key")
        shutil.copy(boards / f"robot-{robot}.key", tmp_path / f"host-{robot}" / "link.key")
        settings = ["--experiment", str(file), "--station", station, "--keys", str(ring), "--wheelhouse", str(wheels)]
        deploy(hosts, robot, settings)
    children, common = Children(run / "logs"), [str(file), "--keys", str(ring)]
    try:
        compiles = [on_host(children, hosts, robot, f"compile-{robot}", f"{AGENT} compile") for robot in hosts.names]
        assert [each.process.wait() for each in compiles] == [0, 0], [each.explain() for each in compiles]
        leads = ["run", *common, "--run-dir", str(run), "--no-report", "--listen", station, "--no-web", "--auto"]
        leader = children.start("groundstation", "groundstation", leads)
        wait_for_line(leader.log, "waiting for the fleet", ENDS_WITHIN_S)
        pool = ["pool", *common, "--station", station, "--poses", "--boards", str(boards), "--host", f"{SUBNET}.1"]
        water = children.start("sim-bridge", "sim_bridge", [*pool, "--ports", str(PORTS)])
        wait_for_line(water.log, "robots are in the water", ENDS_WITHIN_S)
        for robot in hosts.names:
            checked = hosts.run(robot, f"{AGENT} check --json")
            verdicts = {finding["what"]: finding["verdict"] for finding in json.loads(checked[checked.index("[") :])}
            assert "fail" not in verdicts.values(), checked
            assert verdicts["station"] == verdicts["certificate"] == verdicts["thruster board"] == "ok", checked
        for robot in hosts.names:
            on_host(children, hosts, robot, f"agent-{robot}", f"exec {AGENT} run --config agent.toml")
        assert leader.process.wait(ENDS_WITHIN_S) == 0, "\n".join(child.explain() for child in children.all)
    finally:
        children.stop()
    assert_passed(run)
