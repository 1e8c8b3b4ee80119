"""The board's configuration, and the look at the board before the water: against a real station and a real simulated board."""

import itertools
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from groundstation.deploy import key_ring
from groundstation.gate.gate import Gate
from robot_agent.__main__ import cli
from robot_agent.host.config import AgentConfig, RealtimeConfig, load_agent_config, merge_config
from robot_agent.preflight import board as check_shell
from robot_agent.preflight import findings, network, thrusters
from robot_agent.preflight.findings import CheckFinding, CheckVerdict
from robot_agent.preflight.rehearsal import rehearse
from robot_agent.preflight.thrusters import judge
from shoal.bus.bus import Bus
from shoal.bus.endpoint import Endpoint
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.bus.network import endpoint
from shoal.bus.transport import Presence
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.config.experiment import Experiment, load_experiment
from shoal.errors import ConfigError
from shoal.frames import Array
from shoal.mavlink import board_address
from shoal.mavlink.board_port import Link
from shoal.messages import topics
from shoal.messages.messages import Mode, Solve, StationHeartbeat, required
from sim_bridge.sil.ports import free_base_port, free_port
from sim_bridge.thruster_board.board_link import Arm
from sim_bridge.thruster_board.sensor_zero import BoardStart
from tests.robot_agent import obedient_board
from tests.robot_agent.autopilot import Autopilot
from tests.robot_agent.host.restarted_board import DEEP, RESTARTED, STILL, RestartedBoard
from tests.shoal.mavlink.resetting_board import ResettingBoard
from tests.waiting import eventually

pytestmark = pytest.mark.real_time

NOW = datetime(2030, 5, 1, tzinfo=UTC)


def invoke(*arguments: str) -> Result:
    return CliRunner().invoke(cli, list(arguments))


# --- configuration


def test_init_writes_what_run_reads(tmp_path: Path) -> None:
    file = tmp_path / "agent.toml"
    wanted = ["--robot", "2", "--station", "tls/192.168.1.10:7447", "--keys", "keys", "--out", str(file)]
    assert invoke("init", *wanted).exit_code == 0
    board = load_agent_config(file)
    assert (board.robot, board.experiment, board.station) == (2, "pool", "tls/192.168.1.10:7447")
    assert board.keys == str(tmp_path / "keys")
    assert board.realtime == RealtimeConfig(priority=20, cores=(), lock_memory=True)
    assert sum(line.lstrip().startswith("#") or "#" in line for line in file.read_text().splitlines()) > 8
    again = invoke("init", *wanted)
    assert isinstance(again.exception, ConfigError)
    assert "is there already" in str(again.exception)


def test_init_refuses_a_robot_that_no_link_can_name(tmp_path: Path) -> None:
    options = ["--station", "tcp/127.0.0.1:7447", "--experiment", "brought-later.toml", "--out", str(tmp_path / "agent.toml")]
    assert invoke("init", "--robot", "49", *options).exit_code == 0
    refused = invoke("init", "--robot", "256", "--force", *options)
    assert refused.exit_code == 2 and "49" in refused.output


def test_init_writes_any_path_so_that_toml_reads_it(tmp_path: Path) -> None:
    file, odd = tmp_path / "agent.toml", 'a "b" \\c.key'
    options = ["--robot", "1", "--station", "tcp/127.0.0.1:7447", "--link-key", odd, "--experiment", "later.toml"]
    assert invoke("init", *options, "--out", str(file)).exit_code == 0
    board = load_agent_config(file)
    assert (board.link_key, board.experiment) == (str(tmp_path / odd), str(tmp_path / "later.toml"))


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--station", "tcp/192.168.1.10:7447"], "other machines could command the robots"),
        (["--station", "tls/192.168.1.10:7447"], "TLS needs --keys FOLDER"),
        (["--station", "192.168.1.10"], "not a place where a station can be (allowed: tcp/HOST:PORT"),
        (["--experiment", "puddle"], "'puddle': no such experiment (allowed: blocked-path"),
        (["--robot", "3"], "robot 3: not in experiment 'pool' (allowed: 1, 2)"),
        (["--link", "usb:1"], "--link 'usb:1': not an address of a thruster board (allowed: udp:HOST:PORT"),
        (["--link", "serial:/dev/ttyACM0:1"], "no baud rate (allowed: 300 to 12000000)"),
        (["--out", "nowhere/agent.toml"], "nowhere/agent.toml: No such file or directory"),
        (["--out", ".", "--force"], ".: Is a directory"),
    ],
)
def test_init_refuses_what_run_would(options: list[str], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    refused = invoke("init", "--robot", "1", "--station", "tcp/127.0.0.1:7447", *options).exception
    assert isinstance(refused, ConfigError) and says in str(refused)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("robot = 0", "robot = 0: "),
        ("robot = 256", "robot = 256: "),
        ('robot = 1\nspeed = "high"', "speed: unknown key (allowed here: experiment, fleet"),
        ("robot = 1\nrealtime.priority = 100", "realtime.priority = 100: "),
        ('robot = 1\nkeys = "k"\ninsecure = true', "agent.toml: insecure = true beside keys: with keys"),
        ('robot = 1\nfleet = "lab/*"', "fleet = 'lab/*': 'lab/*' is no fleet's name (allowed: up to 32 letters"),
        ('robot = 1\nfleet = "replay/lab"', "is a recorded run, which no program can join"),
    ],
)
def test_a_bad_file_says_which_key(tmp_path: Path, text: str, says: str) -> None:
    file = tmp_path / "agent.toml"
    file.write_text(f'experiment = "pool"\nstation = "tcp/127.0.0.1:7447"\n{text}\n')
    with pytest.raises(ConfigError) as refused:
        load_agent_config(file)
    assert says in str(refused.value)
    assert str(file) in str(refused.value)


def test_options_go_before_the_file_and_the_file_before_defaults(tmp_path: Path) -> None:
    file = tmp_path / "agent.toml"
    file.write_text('experiment = "pool"\nstation = "tcp/127.0.0.1:1"\nrobot = 2\nlink = "udp:10.0.0.2:5"\n')
    board = merge_config({"station": "tcp/127.0.0.1:2", "robot": None}, file)
    assert (board.robot, board.station, board.link) == (2, "tcp/127.0.0.1:2", "udp:10.0.0.2:5")
    assert merge_config({"experiment": "pool", "robot": 1}, None) == AgentConfig(
        experiment="pool", robot=1, station="tcp/127.0.0.1:7447"
    )
    with pytest.raises(ConfigError, match="which robot"):
        merge_config({"experiment": "pool"}, None)
    with pytest.raises(ConfigError, match=f"command line and {file}"):
        merge_config({"robot": 0}, file)
    with pytest.raises(ConfigError, match=r"command line(?! and)"):
        merge_config({"experiment": "pool", "robot": 0}, None)


# --- judgement


@pytest.mark.parametrize(
    ("starts", "expires", "verdict"),
    [(-1, 397, CheckVerdict.OK), (-1, 10, CheckVerdict.WARN), (-9, -1, CheckVerdict.FAIL), (1, 397, CheckVerdict.FAIL)],
)
def test_a_certificate_must_be_valid(starts: int, expires: int, verdict: CheckVerdict) -> None:
    days = timedelta(days=1)
    assert findings.certificate("agent-1.0a", NOW + starts * days, NOW + expires * days, NOW).verdict is verdict


def test_clocks_and_times_are_judged_by_their_limits() -> None:
    assert [findings.clock(s).verdict for s in (0.9, -0.9, 1.1, -3600)] == [CheckVerdict.OK] * 2 + [CheckVerdict.WARN] * 2
    codes = [findings.same_code(stations, "1.0 abc") for stations in ("1.0 abc", "1.0 abd", "")]
    assert [finding.verdict for finding in codes] == [CheckVerdict.OK, CheckVerdict.WARN, CheckVerdict.WARN]
    assert "1.0 abc" in codes[1].detail and "1.0 abd" in codes[1].detail
    unknown = findings.same_code("1.0 unknown", "1.0 unknown")
    assert unknown.verdict is CheckVerdict.WARN and "nobody knows" in unknown.detail
    verdicts = [findings.timing(p50, p99, 0.05, 1).verdict for p50, p99 in ((1, 24), (1, 26), (26, 30))]
    assert verdicts == [CheckVerdict.OK, CheckVerdict.WARN, CheckVerdict.FAIL]
    assert findings.exit_code([CheckFinding("a", CheckVerdict.WARN, ""), CheckFinding("b", CheckVerdict.SKIPPED, "")]) == 0
    assert findings.exit_code([CheckFinding("a", CheckVerdict.OK, ""), CheckFinding("b", CheckVerdict.FAIL, "")]) == 1


def test_an_echo_tells_which_thruster_turned() -> None:
    def pulses(**moved: int) -> tuple[int, ...]:
        return tuple(moved.get(f"c{k}", 1500) for k in range(8))

    vehicle, wanted = load_experiment("pool").vehicle, pulses(c1=1540)
    assert judge(vehicle, 1, wanted, [pulses(), pulses(c1=1520), wanted]).verdict is CheckVerdict.OK
    assert judge(vehicle, 1, wanted, [pulses()]).verdict is CheckVerdict.FAIL
    assert judge(vehicle, 1, wanted, [()]).verdict is CheckVerdict.FAIL
    assert "thruster 3 moved as well" in judge(vehicle, 1, wanted, [pulses(c1=1540, c2=1540)]).detail
    assert "ankle 4 moved as well" in judge(vehicle, 4, pulses(c4=1600), [pulses(c4=1600, c7=1600)]).detail
    strays = [wanted, pulses(c1=1530, c2=1540), pulses(c1=1530, c2=1600), wanted]  # not in the echo that is nearest
    assert "thruster 3 moved as well" in judge(vehicle, 1, wanted, strays).detail
    assert judge(vehicle, 1, wanted, strays[:2] + strays[3:]).verdict is CheckVerdict.OK  # one echo may be wrong


def test_the_rehearsal_flies_with_every_neighbour() -> None:
    experiment = load_experiment("fleet-20")
    for agent, inputs, now_ns in itertools.islice(rehearse(experiment, 7), 40):
        outputs = agent.step(inputs, now_ns)
    assert (outputs.state.mode, required(outputs.state.control).solve, len(outputs.state.heard)) == (
        Mode.TRACKING,
        Solve.SOLVED,
        19,
    )


@pytest.mark.parametrize(
    "setting",
    [
        "vehicle.battery={cells=6, full_v=25.2, warn_v=21.6, no_arm_v=21.0, neutral_v=19.8, hysteresis_v=0.3}",
        "controller.period_s=0.1",
        "robots.0.depth_offset_m=1",
    ],
)
def test_the_rehearsal_flies_whatever_the_battery_the_rate_and_the_depths_zero(setting: str) -> None:
    """The time of a step of a robot that lies disarmed says nothing."""
    for agent, inputs, now_ns in itertools.islice(rehearse(load_experiment("pool", [setting]), 1), 40):
        outputs = agent.step(inputs, now_ns)
    assert outputs.state.mode is Mode.TRACKING


def test_a_rehearsal_that_does_not_fly_tells_no_time() -> None:
    """The steps of a robot that lies disarmed are in time on any CPU."""
    finding = check_shell.step_timing(load_experiment("pool", ["pool.size_m=[1.5, 0.9, 1.0]"]), 1)
    assert (finding.what, finding.verdict) == ("control step", CheckVerdict.WARN)
    assert "not timed" in finding.detail and "LOAD is refused: trajectory.eta leaves the pool" in finding.detail
    assert "p50" not in finding.detail


@pytest.mark.parametrize(
    ("system", "says"),
    [
        (1, "udp:127.0.0.1:9: autopilot 3 (ARDUPILOTMEGA), no thruster board: it takes pulses for a pilot's sticks"),
        (2, "what comes is not of this robot's board (system 1, component 1), but of 2, 1"),
    ],
)
def test_an_autopilot_and_another_robots_board_fail_by_name(system: int, says: str, monkeypatch: pytest.MonkeyPatch) -> None:
    there = Autopilot(system)
    monkeypatch.setattr(check_shell, "open_board_link", lambda board: (there, None))
    monkeypatch.setattr(check_shell, "BOARD_WITHIN_S", 0.05)
    monkeypatch.setattr(check_shell, "PARAMETERS_WITHIN_S", 0.05)
    monkeypatch.setattr(check_shell, "REHEARSED", check_shell.WARM_UP + 1)
    board = AgentConfig(robot=1, experiment="pool", station=f"tcp/127.0.0.1:{free_port()}", link="udp:127.0.0.1:9")
    findings = {finding.what: finding for finding in check_shell.run_preflight(board, None)}
    assert findings["thruster board"].verdict is CheckVerdict.FAIL and says in findings["thruster board"].detail


@pytest.mark.parametrize(
    ("start", "eta", "says", "verdict"),
    [
        (RESTARTED, DEEP, "depth 0.50 m, on for 1 s after brown-out, with the zeros kept from before, DEPTH ZERO IN QUESTION: "
         "it will not arm before `robot-agent confirm-zero`, disarmed", CheckVerdict.WARN),
        (replace(RESTARTED, causes=8), STILL, "s after watchdog, with the zeros kept from before, disarmed", CheckVerdict.OK),
        (BoardStart(1, True, None), STILL, "s after power-on, disarmed", CheckVerdict.OK),
    ],
    ids=["under water", "in air", "switched on"],
)  # fmt: skip
def test_check_shows_a_restart_and_a_zero_in_question_once_the_board_has_judged_it(
    start: BoardStart, eta: Array, says: str, verdict: CheckVerdict, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A board's first heartbeat says in question, before it has measured the pressure: opening the port may have reset it."""
    monkeypatch.setattr(check_shell, "open_board_link", lambda board: (RestartedBoard(start, eta), None))
    monkeypatch.setattr(check_shell, "REHEARSED", check_shell.WARM_UP + 1)
    board = AgentConfig(robot=1, experiment="pool", station=f"tcp/127.0.0.1:{free_port()}", link="udp:127.0.0.1:9")
    board_line = {finding.what: finding for finding in check_shell.run_preflight(board, None)}["thruster board"]
    assert says in board_line.detail and board_line.verdict is verdict, board_line.detail


class Broken:
    """A law of one's own that cannot be made."""

    def __init__(self, *given: object) -> None:
        raise ValueError("no gains")


@pytest.mark.parametrize(
    ("law", "says"),
    [
        ("nopackage:Law", "controller.law = 'nopackage:Law': No module named 'nopackage'"),
        (f"{__name__}:Broken", "ValueError: no gains"),
    ],
)
def test_a_law_of_ones_own_that_fails_is_a_finding_and_ends_no_check(
    law: str, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(check_shell, "open_board_link", lambda board: (Autopilot(1), None))
    settings = (f"controller.law={law}",)
    board = AgentConfig(
        robot=1, experiment="pool", station=f"tcp/127.0.0.1:{free_port()}", link="udp:127.0.0.1:9", settings=settings
    )
    findings = {finding.what: finding for finding in check_shell.run_preflight(board, None)}
    step = findings["control step"]
    assert step.verdict is CheckVerdict.FAIL and step.detail.startswith(says), step.detail
    assert "autopilot" in findings["thruster board"].detail


def test_check_says_of_a_depth_that_cannot_be_read_why_the_robot_will_not_arm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "depth-zero.json").write_text("")  # a loss of power has cut it
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    monkeypatch.setattr(check_shell, "open_board_link", lambda board: (Autopilot(1), None))
    monkeypatch.setattr(check_shell, "REHEARSED", check_shell.WARM_UP + 1)
    board = AgentConfig(robot=1, experiment="pool", station=f"tcp/127.0.0.1:{free_port()}", link="udp:127.0.0.1:9")
    zero = {finding.what: finding for finding in check_shell.run_preflight(board, None)}["depth zero"]
    assert zero.verdict is CheckVerdict.WARN and "depth-zero.json: holds no depth" in zero.detail, zero.detail
    assert "confirm-zero" in zero.detail


CHANGED = {"SLEW_US_S": 3e4, "CMD_AGE_MS": 300.0, "CRV02_N": -1.9, "BAT_WARN_V": 11.0, "THR_MAX_US": 1890.0}
CHANGED_SAYS = (
    "the robot does not arm (`robot-agent params set` changes one): CMD_AGE_MS is 300 (experiment: 250), SLEW_US_S is 30000 "
    "(experiment: 8000), THR_MAX_US is 1890 (experiment: 1900), BAT_WARN_V is 11 (experiment: 10.8), CRV02_N is -1.9 "
    "(experiment: -1.975)"
)
OWN_SAYS = "; the board's own: THR3_TRIM_US is -12 (experiment: 0)"


@pytest.mark.parametrize(
    ("changes", "says", "verdict"),
    [
        ({}, "46 as in the experiment", CheckVerdict.OK),
        ({"THR3_TRIM_US": -12.0}, "46 as in the experiment" + OWN_SAYS, CheckVerdict.OK),
        (CHANGED | {"THR3_TRIM_US": -12.0}, CHANGED_SAYS + OWN_SAYS, CheckVerdict.FAIL),
    ],
    ids=["none", "a trim", "five and a trim"],
)
def test_check_lists_every_difference_between_the_boards_parameters_and_the_experiments(
    changes: dict[str, float], says: str, verdict: CheckVerdict, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = RestartedBoard(BoardStart(1, True, None), STILL)
    assert [there.board.rules.change(name, value) for name, value in changes.items()] == [None] * len(changes)
    assert parameters_line(there, monkeypatch) == CheckFinding("parameters", verdict, says)


def test_a_board_that_tells_no_parameters_fails_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(check_shell, "PARAMETERS_WITHIN_S", 0.05)
    line = parameters_line(Told(False, 0), monkeypatch)
    assert line.verdict is CheckVerdict.FAIL and line.detail.startswith("0 of 46 came within"), line.detail


def parameters_line(board: Link, monkeypatch: pytest.MonkeyPatch) -> CheckFinding:
    """The preflight's line about a board's parameters."""
    monkeypatch.setattr(check_shell, "open_board_link", lambda config: (board, None))
    monkeypatch.setattr(check_shell, "REHEARSED", check_shell.WARM_UP + 1)
    config = AgentConfig(robot=1, experiment="pool", station=f"tcp/127.0.0.1:{free_port()}", link="udp:127.0.0.1:9")
    return {finding.what: finding for finding in check_shell.run_preflight(config, None)}["parameters"]


class Told(obedient_board.Board):
    """A thruster board that tells whether it is armed only after `late` reads, and then every time."""

    def __init__(self, armed: bool, late: int) -> None:
        super().__init__()
        self._armed, self._late = armed, late

    def read(self) -> bytes:
        self._late -= 1
        self._ms += 50
        parts = [self._link.status(12.1, 0, 0, 0), self._link.pressure(self._ms, 0.3), self._link.attitude(self._ms, 0.2, 0.0)]
        return b"".join(parts + ([self._link.heartbeat(self._armed, True)] if self._late < 0 else []))


@pytest.mark.parametrize(
    ("armed", "late", "says", "turns"),
    [
        (False, 3, "disarmed", True),
        (True, 3, "ARMED: by whom?", False),
        (True, 10**9, "does not say whether it is armed", False),
    ],
)
def test_thrusters_are_turned_only_on_a_board_that_says_it_is_disarmed(
    armed: bool, late: int, says: str, turns: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Somebody else may fly the robot: an agent of another fleet's name, or one whose station is off."""
    monkeypatch.setattr(check_shell, "open_board_link", lambda board: (Told(armed, late), None))
    monkeypatch.setattr(check_shell, "BOARD_WITHIN_S", 0.05)
    monkeypatch.setattr(check_shell, "PARAMETERS_WITHIN_S", 0.05)
    monkeypatch.setattr(check_shell, "REHEARSED", check_shell.WARM_UP + 1)
    turned: list[str] = []

    def turn(experiment: Experiment) -> Iterator[CheckFinding]:
        turned.append(experiment.name)
        yield CheckFinding("thruster 1", CheckVerdict.OK, "turned")

    board = AgentConfig(robot=1, experiment="pool", station=f"tcp/127.0.0.1:{free_port()}", link="udp:127.0.0.1:9")
    findings = {finding.what: finding for finding in check_shell.run_preflight(board, turn)}
    assert says in findings["thruster board"].detail
    assert findings["thruster board"].verdict is (CheckVerdict.OK if turns else CheckVerdict.WARN)
    assert turned == (["pool"] if turns else [])
    assert ("thrusters" in findings) is not turns


def test_a_board_that_may_have_armed_unheard_is_told_to_disarm_more_than_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """It says that it is disarmed, and has answered nothing: the last word may be of before it was asked to arm."""
    orders: list[bool] = []

    class Mute(obedient_board.Board):
        def send(self, data: bytes) -> None:
            orders.extend(event.arm for _, event in self._link.receive(data, 0) if isinstance(event, Arm))

    monkeypatch.setattr(thrusters, "open_board_link", lambda board: (Mute(), None))
    monkeypatch.setattr(thrusters, "ARM_WITHIN_S", 0.3)
    board = AgentConfig(robot=1, experiment="pool", station=f"tcp/127.0.0.1:{free_port()}", link="udp:127.0.0.1:9")
    (finding,) = thrusters.turn_thrusters(load_experiment("pool"), board)
    assert finding.detail.startswith(thrusters.NOT_ARMED)
    assert orders.count(True) > 1 and orders.count(False) > 1, orders


def test_an_agent_whose_presence_is_told_late_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """The router tells who is there when it comes to that; the station's heartbeat may be here before."""
    hub, stop = MemoryHub(), threading.Event()
    station, agent = Bus(MemoryTransport(hub)), Bus(MemoryTransport(hub))
    agent.announce("agent-1")

    class Late(MemoryTransport):
        def __init__(self, *arguments: object, **options: object) -> None:
            super().__init__(hub)

        def watch(self, key: str, presence: Presence, anew: bool = False) -> None:
            threading.Timer(0.1, super().watch, (key, presence, anew)).start()

    def beat() -> None:
        while not stop.wait(0.01):
            station.publish(topics.HEARTBEAT, StationHeartbeat(), time.time_ns())

    monkeypatch.setattr(network, "ZenohTransport", Late)
    monkeypatch.setattr(network, "trouble_reaching", lambda *_: "")
    monkeypatch.setattr(network, "PRESENT_WITHIN_S", 20.0)
    beating = threading.Thread(target=beat)
    beating.start()
    look = network.check_network(AgentConfig(robot=1, experiment="pool", station="tcp/127.0.0.1:9"))
    try:
        while True:
            next(look)
    except StopIteration as end:
        assert end.value is True
    finally:
        stop.set()
        beating.join()


# --- the whole, on a board that is there


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Path]:
    """A station with keys that beats, and the simulator's thruster boards. Gives the folder with agent.toml."""
    ring, address = tmp_path / "keys", f"tls/127.0.0.1:{free_port()}"
    key_ring.init(ring, [], "shoal", datetime.now(UTC))
    key_ring.add(ring, "robot", 1, datetime.now(UTC))
    ports = free_base_port((1, 2))
    stop = threading.Event()
    station = Bus(ZenohTransport(endpoint(address, "groundstation", ring, router=True), gate=Gate))

    def beat() -> None:
        while not stop.wait(0.05):
            station.publish(topics.HEARTBEAT, StationHeartbeat(mission="WAITING"), time.time_ns())

    beating = threading.Thread(target=beat)
    beating.start()
    pool = ["pool", "pool", "--poses", "--station", address, "--ports", str(ports), "--keys", str(ring)]
    pool += ["--set", "robots.0.start=[-0.6, 0.0, 0.3, 0.0]", "--set", "robots.1.start=[0.6, 0.0, 0.3, 0.0]"]
    with subprocess.Popen([sys.executable, "-m", "sim_bridge", *pool], stderr=subprocess.DEVNULL) as simulator:
        try:
            wanted = ["--robot", "1", "--station", address, "--keys", "keys", "--link", f"udp:127.0.0.1:{ports + 1}"]
            assert invoke("init", *wanted, "--out", str(tmp_path / "agent.toml")).exit_code == 0
            station.watch_presence()
            assert station.wait(lambda: "sim-bridge" in station.present, 30.0)
            yield tmp_path
        finally:
            simulator.terminate()
            stop.set()
            beating.join()
            station.close()


def checked(folder: Path, *more: str) -> tuple[int, dict[str, tuple[str, str]]]:
    done = invoke("check", "--config", str(folder / "agent.toml"), "--json", *more)
    rows = json.loads(done.stdout[done.stdout.index("[\n") :])
    return done.exit_code, {row["what"]: (row["verdict"], row["detail"]) for row in rows}


def test_a_board_where_all_is_well_passes_and_its_thrusters_turn(site: Path) -> None:
    code, results = checked(site, "--thrusters", "--yes")
    bad = {what: row for what, row in results.items() if row[0] == "fail" and what != "control step"}  # that is this machine's
    assert bad == {}
    assert code in (0, int(results["control step"][0] == "fail"))
    assert "robot 1 of 2" in results["experiment"][1]
    assert "disarmed" in results["thruster board"][1]
    assert "its mission is WAITING" in results["station"][1]
    assert results["clock"][0] == "ok"
    assert results["code"][0] == "warn" and "an earlier version" in results["code"][1], "this one's heartbeat says no code"
    assert [results[f"{part} {i}"][0] for part in ("thruster", "ankle") for i in (1, 2, 3, 4)] == ["ok"] * 8
    answers = "y\n" + "y\ny\n" * 4 + "y\n\nn\n" + "n\n" + "y\ny\n" * 2  # ankle 1 is seen to move wrongly, 2 is left out
    person = CliRunner().invoke(cli, ["check", "--config", str(site / "agent.toml"), "--thrusters", "--json"], input=answers)
    rows = {row["what"]: row for row in json.loads(person.stdout[person.stdout.index("[\n") :])}
    assert [rows[f"thruster {i}"]["detail"][-6:] for i in (1, 2, 3, 4)] == ["; seen"] * 4
    assert [rows[f"ankle {i}"]["verdict"] for i in (1, 2, 3, 4)] == ["fail", "skipped", "ok", "ok"], "Enter alone is no answer"
    assert "  3 [*]----'-----'----[ ] 4" in person.stderr
    assert "thruster 3, rear left, turns slowly and pushes ahead" in person.stderr
    assert checked(site)[1]["thrusters"][0] == "skipped"
    assert "disarmed" in checked(site)[1]["thruster board"][1]  # as it was left
    board = load_agent_config(site / "agent.toml")
    agent = Bus(ZenohTransport(endpoint(board.station, "agent-1", site / "keys"), patience_s=5.0))
    try:
        agent.announce("agent-1")  # it flies: hands off its thrusters
        results = checked(site, "--thrusters", "--yes")[1]
        assert [results[what][0] for what in ("thruster board", "thrusters")] == ["skipped", "skipped"]
    finally:
        agent.close()


def test_a_board_that_was_left_in_hil_mode_is_named_as_such(tmp_path: Path) -> None:
    """From the desk to the bench without power off: it measures nothing, and nobody is to look for a broken sensor."""
    port, station = tmp_path / "board", f"tcp/127.0.0.1:{free_port()}"
    command = [sys.executable, "-m", "sim_bridge", "board", "pool", "--robot", "1", "--port", f"pty:{port}"]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as board:
        try:
            assert eventually(port.exists, 60.0)
            link = ["--link", f"serial:{port}"]
            assert invoke("params", "set", "HIL_MODE", "1", *link).exit_code == 0
            assert (
                invoke("init", "--robot", "1", "--station", station, *link, "--out", str(tmp_path / "agent.toml")).exit_code
                == 0
            )
            row = checked(tmp_path)[1]["thruster board"]
        finally:
            board.terminate()
    assert row[0] == "fail" and "it is in HIL mode, and nothing simulates its measurements" in row[1]


def test_failed_check_is_named(tmp_path: Path) -> None:
    file = tmp_path / "agent.toml"
    text = 'experiment = "pool"\nrobot = 9\nstation = "{}"\nlink = "serial:/dev/nothing-here"\nkeys = "keys"\n'
    file.write_text(text.format(f"tls/127.0.0.1:{free_port()}"))
    code, rows = checked(tmp_path, "--thrusters", "--yes")
    assert code == 1
    assert rows["thrusters"][0] == "skipped"  # nobody turns what is not heard
    for what, says in (
        ("experiment", "robot"),
        ("device", "/dev/nothing-here: not there"),
        ("thruster board", "silent"),
        ("certificate", "is missing"),
    ):
        assert rows[what][0] == "fail"
        assert says in rows[what][1]
    ring = tmp_path / "keys"
    key_ring.init(ring, [], "shoal", datetime.now(UTC))
    key_ring.add(ring, "robot", 9, datetime.now(UTC))
    shutil.copytree(ring / "viewer", ring / "agent-9", dirs_exist_ok=True)
    assert "'s, this is agent-9" in checked(tmp_path)[1]["certificate"][1]
    key_ring.add(ring, "robot", 9, datetime.now(UTC))
    assert "no station listens" in checked(tmp_path)[1]["station"][1]


def test_a_port_that_is_missing_or_shares_its_kind_is_told_with_those_that_are_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two boards exchange the names /dev/ttyACM0 and /dev/ttyACM1 at a reboot."""
    names = [tmp_path / "usb-1", tmp_path / "usb-2"]
    for name in names:
        name.touch()
    monkeypatch.setattr(board_address, "PORTS_BY_ID", tmp_path)
    both = ", ".join(map(str, names))
    board = AgentConfig(robot=1, experiment="pool", station="tcp/127.0.0.1:9", link="serial:/dev/ttyACM77")
    missing = next(check_shell.check_device(board))
    assert missing.verdict is CheckVerdict.FAIL and missing.detail.endswith(f"; there are {both}")
    monkeypatch.setattr(check_shell, "serial_trouble", lambda device: "")
    assert next(check_shell.check_device(board)).detail.endswith(f"several are plugged in: choose of {both}")
    assert next(check_shell.check_device(board)).verdict is CheckVerdict.WARN
    by_id = board.model_copy(update={"link": f"serial:{names[0]}"})
    assert next(check_shell.check_device(by_id)).verdict is CheckVerdict.OK


def test_a_board_that_is_reset_by_the_opening_and_has_another_rate_is_heard_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mega = ResettingBoard(tmp_path / "plug", baud=250_000)
    monkeypatch.setattr(check_shell, "REHEARSED", check_shell.WARM_UP + 1)
    try:
        link = f"serial:{mega.path}:115200"
        (tmp_path / "agent.toml").write_text(
            f'experiment = "pool"\nrobot = 1\nstation = "tcp/127.0.0.1:{free_port()}"\nlink = "{link}"\n'
        )
        rows = checked(tmp_path)[1]
        assert rows["thruster board"][1].startswith("heard; ")
        assert rows["baud rate"] == (
            "warn", f"{mega.path}: the board speaks at 250000 baud, not at 115200 as configured: set the link to "
            f"serial:{mega.path}:250000",
        )  # fmt: skip
        output = CliRunner().invoke(cli, ["params", "get", "CMD_AGE_MS", "--link", link])
        assert output.stdout == "250\n"
        assert mega.resets == 1 and mega.bytes_in_bootloader == 0
    finally:
        mega.close()


def test_a_router_without_a_station_is_told_from_a_station(tmp_path: Path) -> None:
    address = f"tcp/127.0.0.1:{free_port()}"
    router = ZenohTransport(Endpoint(address, router=True))
    try:
        (tmp_path / "agent.toml").write_text(
            f'experiment = "pool"\nrobot = 1\nstation = "{address}"\nlink = "udp:127.0.0.1:9"\n'
        )
        assert "no station is heard" in checked(tmp_path)[1]["station"][1]
    finally:
        router.close()


def test_a_person_is_asked_before_anything_turns(tmp_path: Path) -> None:
    (tmp_path / "agent.toml").write_text(
        f'experiment = "pool"\nrobot = 1\nstation = "tcp/127.0.0.1:{free_port()}"\nlink = "udp:127.0.0.1:9"\n'
    )
    done = CliRunner().invoke(cli, ["check", "--config", str(tmp_path / "agent.toml"), "--thrusters"], input="n\n")
    assert "Each thruster will turn" in done.output
    assert "not turned" in done.output


def test_the_base_install_is_enough(tmp_path: Path) -> None:
    """Every command of the board, with what only the other roles install made impossible to import."""
    blocked = (
        "cv2",
        "mcap",
        "mcap_protobuf",
        "starlette",
        "uvicorn",
        "websockets",
        "matplotlib",
        "msgspec",
        "pyarrow",
    )
    block = f"import sys; sys.modules.update(dict.fromkeys({blocked})); from robot_agent.__main__ import app; app()"
    file = str(tmp_path / "agent.toml")
    for arguments in (
        ["init", "--robot", "1", "--station", f"tcp/127.0.0.1:{free_port()}", "--link", "udp:127.0.0.1:9", "--out", file],
        ["check", "--config", file],
        ["modes"],
        ["run", "--help"],
    ):
        done = subprocess.run(
            [sys.executable, "-c", block, *arguments],
            capture_output=True,
            text=True,
            check=False,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        )
        assert "Traceback" not in done.stderr, done.stderr
        assert done.returncode == (1 if arguments[0] == "check" else 0), done.stderr
