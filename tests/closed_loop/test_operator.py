"""A person at the station: the programs started one by one, as in a lab, and orders from another terminal.

The simulated pool tells poses itself: on a slow machine camera and localizer would not keep up with the wall clock."""

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from sim_bridge.ports import free_base_port, free_port
from sim_bridge.processes import Children


class Lab:
    """Station, simulated pool and two agents, by the wall clock."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.children = folder, Children(folder / "logs")
        self.station = f"tcp/127.0.0.1:{free_port()}"
        ports = free_base_port((1, 2))
        self.start("agent-1", "robot_agent", "run", "pool", "--robot", "1", "--link", f"udp:127.0.0.1:{ports + 1}")  # first
        self.start("sim-bridge", "sim_bridge", "pool", "pool", "--poses", "--ports", str(ports))
        self.children.start(
            "groundstation",
            "groundstation",
            ["run", "pool", "--no-web", "--listen", self.station, "--run-dir", str(folder / "run")],
        )
        self.start("agent-2", "robot_agent", "run", "pool", "--robot", "2", "--link", f"udp:127.0.0.1:{ports + 2}")

    def start(self, name: str, module: str, *arguments: str) -> None:
        self.children.start(name, module, [*arguments, "--station", self.station])

    def order(self, *what: str) -> tuple[int, str]:
        command = [sys.executable, "-m", "groundstation", *what, "--station", self.station]
        answer = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
        return answer.returncode, answer.stdout + answer.stderr

    def set_off(self, patience_s: float = 60.0) -> None:
        """Order the start, again while the station finds robots unfit: a loaded machine loses some messages now and then."""
        deadline = time.monotonic() + patience_s
        while (answer := self.order("order", "start")) != (0, "start: under way\n"):
            assert answer[0] == 1 and time.monotonic() < deadline, answer
            time.sleep(0.5)

    def says(self, name: str, text: str, times: int = 1, timeout_s: float = 30.0) -> None:
        log = self.folder / "logs" / f"{name}.log"
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            if log.read_text().count(text) >= times:
                return
            time.sleep(0.05)
        raise AssertionError(f"{name} never said {text!r} {times} times:\n{log.read_text()}")


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    found = Lab(tmp_path)
    try:
        yield found
    finally:
        found.children.stop()


def test_a_mission_by_hand(lab: Lab) -> None:
    lab.says("groundstation", "mission: waiting for the fleet\n")  # every robot is fit
    refused, why = lab.order("order", "hold")
    assert (refused, "HOLD is not possible when WAITING" in why) == (1, True)
    lab.set_off()
    for robot in (1, 2):
        lab.says(f"agent-{robot}", "INFO tracking")
    assert lab.order("order", "hold")[0] == 0
    for robot in (1, 2):
        lab.says(f"agent-{robot}", "INFO holding")
    assert lab.order("order", "resume")[0] == 0
    for robot in (1, 2):
        lab.says(f"agent-{robot}", "INFO tracking", times=2)
    lab.says("groundstation", "mission: running", times=2)

    assert lab.order("stop")[0] == 0
    for robot in (1, 2):
        lab.says(f"agent-{robot}", "stopped: emergency stop")
        lab.says("sim-bridge", f"board of robot {robot}: neutral")
    refused, why = lab.order("order", "start")
    assert refused == 1
    assert "STOPPED" in why
    assert lab.order("order", "clear-stop")[0] == 0
    for robot in (1, 2):
        lab.says(f"agent-{robot}", "INFO disarmed")
    lab.says("groundstation", "mission: waiting for the fleet", times=2)
    assert lab.order("order", "nonsense")[0] == 2


def test_the_log_of_a_mission_by_hand_gives_a_report(lab: Lab) -> None:
    lab.set_off()
    lab.says("agent-1", "INFO tracking")
    time.sleep(2.0)
    lab.children.stop()
    run = lab.folder / "run"
    report = subprocess.run(
        [sys.executable, "-m", "groundstation", "report", str(run)], check=False, capture_output=True, text=True
    )
    assert report.returncode == 0, report.stderr
    result = json.loads((run / "result.json").read_text())
    assert (result["scene"], result["mode"], result["passed"]) == ("pool", "real-time", False)
    assert 1.0 < result["duration_s"] < 20.0
    assert (run / "report.html").stat().st_size > 10_000
