"""Hardware in the loop with every process for real: boards on a pseudo-terminal and on UDP, agents, station."""

import json
import subprocess
import sys
from pathlib import Path
from socket import SOCK_DGRAM

import pytest

from robot_agent.host.params import set_one
from sim_bridge.sil.commands import Program, RunOptions, programs
from sim_bridge.sil.ports import free_base_port, free_port
from sim_bridge.sil.processes import Children
from tests.sim_bridge.boards import board
from tests.waiting import wait_for_line
from wire.config.experiment import NO_CAMERA, dump_experiment, load_experiment

pytestmark = [pytest.mark.real_time, pytest.mark.timeout(200)]


def in_hil(started: list[Program], boards: dict[int, str]) -> list[Program]:
    """The programs of a run, with `hil` around these boards in the place of `pool`."""
    real = [part for robot, where in boards.items() for part in ("--board", f"{robot}={where}")]
    return [Program(p.name, p.module, ("hil", *p.arguments[1:], *real)) if p.name == "sim-bridge" else p for p in started]


def test_a_formation_of_boards_in_hil_mode_flies_within_its_limits_in_real_time(tmp_path: Path) -> None:
    experiment = load_experiment("pool", ["duration_s=26", NO_CAMERA])
    run, udp = tmp_path / "run", free_port(SOCK_DGRAM)
    run.mkdir()
    (run / "experiment.toml").write_text(dump_experiment(experiment), encoding="utf-8")
    boards = {1: f"serial:{tmp_path}/plug", 2: f"udp:127.0.0.1:{udp}"}
    address = f"tcp/127.0.0.1:{free_port()}"
    started = programs((1, 2), RunOptions(poses=True), run, address, free_base_port((1, 2)))
    children = Children(run / "logs")
    with board(f"pty:{tmp_path}/plug", tmp_path / "kept", 1), board(f"udp:127.0.0.1:{udp}", tmp_path / "kept", 2):
        for where in boards.values():
            set_one("HIL_MODE", 1.0, where)
        try:
            for program in in_hil(started, boards):
                children.start(program.name, program.module, program.arguments)
                if program.name == "groundstation":
                    wait_for_line(run / "logs" / "groundstation.log", "waiting for the fleet", 60.0)
            assert children.all[0].process.wait(120) == 0, children.all[0].explain()
        finally:
            children.stop()
    report = subprocess.run(
        [sys.executable, "-m", "groundstation", "log", "report", str(run)], capture_output=True, text=True, check=False
    )
    result = json.loads((run / "result.json").read_text())
    assert (report.returncode, result["passed"]) == (0, True), result["checks"]
