"""A person at the station: the programs started one by one, as in a lab, and orders from another terminal.

In lockstep: a slow machine is slow, and no robot is late; no faster than real time, so that orders come to an early moment
of the flight. The simulated pool tells poses itself."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from shoal.config.experiment import dump_experiment, load_experiment
from sim_bridge.sil.ports import free_base_port, free_port
from sim_bridge.sil.processes import Children
from tests.forked import ended
from tests.waiting import wait_for_line

pytestmark = pytest.mark.real_time


def run_groundstation(*what: str) -> tuple[int, str]:
    """Exit code and output of a command."""
    code, output, errors = ended("groundstation", *what)
    return code, output + errors


class OperatorLab:
    """Station, simulated pool and two agents."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.children = folder, Children(folder / "logs")
        self.station = f"tcp/127.0.0.1:{free_port()}"
        folder.joinpath("long.toml").write_text(dump_experiment(load_experiment("pool", ["duration_s=900"])))
        self.experiment = str(folder / "long.toml")
        ports = free_base_port((1, 2))
        place = ("--run-dir", str(folder / "run"))
        self.agent(1, ports)  # first
        paced = ("--lockstep", "--poses", "--pace", "1", "--ports", str(ports))
        self.start("sim-bridge", "sim_bridge", "pool", self.experiment, *paced)
        self.children.start(
            "groundstation",
            "sim_bridge.lockstep",
            ["station", self.experiment, "--no-web", "--listen", self.station, *place],
        )
        self.agent(2, ports)

    def agent(self, robot: int, ports: int) -> None:
        link = f"udp:127.0.0.1:{ports + robot}"
        self.start(f"agent-{robot}", "sim_bridge.lockstep", "agent", self.experiment, "--robot", str(robot), "--link", link)

    def start(self, name: str, module: str, *arguments: str) -> None:
        self.children.start(name, module, [*arguments, "--station", self.station])

    def order(self, *what: str) -> tuple[int, str]:
        return run_groundstation(*what, "--station", self.station)

    def ready(self) -> None:
        self.says("groundstation", "mission: fleet ready\n", timeout_s=90.0)  # every robot is fit

    def set_off(self) -> None:
        self.ready()
        code, output = self.order("mission", "start")
        assert (code, output.splitlines()[-1]) == (0, "start: confirmed by 1, 2"), output

    def told(self, name: str, text: str) -> None:
        """Both robots' programs have said so by now: nobody waits for it."""
        for robot in (1, 2):
            assert text in (self.folder / "logs" / f"{name}-{robot}.log").read_text()

    def says(self, name: str, text: str, times: int = 1, timeout_s: float = 30.0) -> None:
        wait_for_line(self.folder / "logs" / f"{name}.log", text, timeout_s, times)


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[OperatorLab]:
    operator_lab = OperatorLab(tmp_path)
    try:
        yield operator_lab
    finally:
        operator_lab.children.stop()


def test_a_mission_by_hand(lab: OperatorLab) -> None:
    lab.ready()
    refused, why = lab.order("mission", "resume")
    assert (refused, "resume is not possible when WAITING" in why) == (1, True)
    lab.set_off()  # each command returns when the robots have done it
    lab.told("agent", "INFO tracking")
    code, output = lab.order("mission", "hold")
    assert (code, output.splitlines()[-1]) == (0, "hold: confirmed by 1, 2"), output
    lab.told("agent", "INFO holding")
    assert lab.order("mission", "resume")[0] == 0
    assert lab.order("mission", "go", "0.5", "-0.3")[0] == 1  # on a circle there is nowhere to go

    code, output = lab.order("stop")
    assert code == 0
    assert output.splitlines()[1:] == ["  robot 1: confirmed", "  robot 2: confirmed", "stop: confirmed by 1, 2"]
    lab.told("agent", "stopped: emergency stop")
    for robot in (1, 2):
        lab.says("sim-bridge", f"board of robot {robot}: neutral")
    refused, why = lab.order("mission", "start")
    assert refused == 1
    assert "STOPPED" in why
    assert lab.order("mission", "clear-stop")[0] == 0
    lab.told("agent", "INFO disarmed")
    assert lab.order("mission", "nonsense")[0] == 2

    assert lab.order("end")[0] == 0
    lab.says("groundstation", "the run is ended")
    assert lab.children.all[2].process.wait(60) == 1  # it did not fly to its end
    code, output = run_groundstation("log", "report", str(lab.folder / "run"))
    assert (code, output.rstrip().endswith("(not judged)")) == (1, True), output
    result = json.loads((lab.folder / "run" / "result.json").read_text())
    assert (result["scene"], result["mode"], result["passed"]) == ("pool", "lockstep", False)
    assert result["cause"]["text"] == "pressed the emergency stop"
    assert 0.0 < result["duration_s"] < 900.0
    assert (lab.folder / "run" / "report.html").stat().st_size > 10_000


def test_a_stop_that_no_robot_hears_is_no_success(tmp_path: Path) -> None:
    children, place = Children(tmp_path / "logs"), f"tcp/127.0.0.1:{free_port()}"
    station = children.start(
        "groundstation",
        "groundstation",
        ["run", "pool", "--no-web", "--no-report", "--listen", place, "--run-dir", str(tmp_path / "run")],
    )
    try:
        wait_for_line(tmp_path / "logs" / "groundstation.log", "waiting for the fleet", 60.0)
        for what, last in (("stop", "stop: not done within 5 s"), ("end", "end: done")):
            code, output = run_groundstation(what, "--station", place)
            unheard = [f"  robot {robot}: NOT confirmed: not heard" for robot in (1, 2)]
            assert (code, output.splitlines()[-3:]) == (1 if what == "stop" else 0, [*unheard, last])
        station.process.wait(30)
    finally:
        children.stop()
