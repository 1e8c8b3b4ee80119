"""A person at the station: the programs started one by one, as in a lab, and orders from another terminal.

The simulated pool tells poses itself: on a slow machine camera and localizer would not keep up with the wall clock."""

import json
import re
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
        answer = subprocess.run(command, capture_output=True, text=True, timeout=90, check=False)
        return answer.returncode, answer.stdout + answer.stderr

    def set_off(self, patience_s: float = 60.0) -> None:
        """Order the start, again while the station finds robots unfit: a loaded machine loses some messages now and then."""
        deadline = time.monotonic() + patience_s
        while (answer := self.order("order", "start"))[0] != 0:
            assert answer[0] == 1 and "refused" in answer[1] and time.monotonic() < deadline, answer
            time.sleep(0.5)

    def told(self, name: str, text: str) -> None:
        """Both robots' programs have said so by now: nobody waits for it."""
        for robot in (1, 2):
            assert text in (self.folder / "logs" / f"{name}-{robot}.log").read_text()

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
    lab.set_off()  # each command returns when the robots have done it
    lab.told("agent", "INFO tracking")
    code, said = lab.order("order", "hold")
    assert (code, said.splitlines()[-1]) == (0, "hold: done"), said
    lab.told("agent", "INFO holding")
    assert lab.order("order", "resume")[0] == 0
    assert lab.order("go", "0.5", "-0.3")[0] == 1  # on a circle there is nowhere to go

    code, said = lab.order("stop")
    assert code == 0
    assert said.splitlines()[1:] == ["  robot 1: confirmed", "  robot 2: confirmed", "stop: done"]
    lab.told("agent", "stopped: emergency stop")
    for robot in (1, 2):
        lab.says("sim-bridge", f"board of robot {robot}: neutral")
    refused, why = lab.order("order", "start")
    assert refused == 1
    assert "STOPPED" in why
    assert lab.order("order", "clear-stop")[0] == 0
    lab.told("agent", "INFO disarmed")
    assert lab.order("order", "nonsense")[0] == 2

    lab.children.all[0].process.kill()  # agent 1
    lab.says("groundstation", "robot 1: not heard for")
    code, said = lab.order("stop")
    assert code == 1
    assert re.search(r"robot 1: NOT confirmed: not heard for [\d.]+ s", said), said
    assert "  robot 2: confirmed" in said
    assert lab.order("end")[0] == 0
    lab.says("groundstation", "the run is ended")
    station = lab.children.all[2].process
    assert station.wait(30) == 1  # it did not fly to its end


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
