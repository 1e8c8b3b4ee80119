"""Twenty random scripts of two people at pages, one in a terminal and a script, against real processes: station, agents, pool.

What the station says is held against the pool: its thruster boards, and where its robots truly are. The random test of the
same in simulated time is tests/groundstation/mission/test_interruptions.py.
"""

import json
import signal
import subprocess
import sys
import time
from collections import deque
from typing import Any

import numpy as np
import pytest

from shoal.messages import topics
from shoal.messages.codec import Header, decode
from shoal.messages.messages import WHOLE_FLEET, Command, CommandKind, Progress, StationHeartbeat, Truth
from shoal.messages.topics import Topic
from sim_bridge.sil.ports import free_port
from tests.faults.onlooker import Stuck
from tests.faults.people import Crowd, PersonsRequest, ScriptLine, crowd, plan
from tests.faults.rig import Rig
from tests.faults.rigs import SLOWLY
from tests.faults.wires import NetWire

pytestmark = [pytest.mark.slow, pytest.mark.real_time]

READY_WITHIN_S = 180.0
REST_WITHIN_S = 12.0  # of a STOP: a robot that does not hear it comes to rest by itself, and this machine may be busy
ENDS_WITHIN_S = 60.0
THERE_M = 0.35  # from where a robot was sent, in water that moves
# The log ends with the station's cycles, and the pool goes on: robots that were just disarmed coast and drift. So the result's
# place is one of those where the robot was about the station's last heartbeat, to within its way between two truths.
LOG_ENDS_WITHIN_S = 1.0
BETWEEN_M = 0.02  # at 0.4 m/s and 20 Hz
TERMINAL, AT_REST = {"DONE", "CANCELLED", "FAILED"}, {"WAITING", "DONE", "CANCELLED", "FAILED"}
POLICIES = ("go-on", "hold", "close-up", "abort")
ROOM = (
    "pool.size_m=[7.0,5.0,1.0]", "duration_s=30", 'path={kind="circle",lap_s=20,diameter_m=0.8,depth_m=0.5}', "article=[]",
    "robots=[{id=1,node_m=[0.0,0.0,0.0],neighbours=[2]},{id=2,node_m=[0.9,0.0,0.0],neighbours=[1,3]},"
    "{id=3,node_m=[-0.9,0.0,0.0],neighbours=[2]}]",
)  # fmt: skip


class CrowdedLab(Rig):
    """A lab in which each robot has a radio of its own, with the history of where its robots truly were."""

    def __init__(self, seed: int) -> None:
        self.page = f"127.0.0.1:{free_port()}"
        settings = (*SLOWLY, *ROOM, f'mission.lost="{POLICIES[seed % len(POLICIES)]}"')
        super().__init__("pool", settings, seed=seed, poses=True, wires=False, station_options=("--web", self.page))
        self.radios: dict[int, NetWire] = {}
        self.places: dict[int, deque[tuple[int, np.ndarray]]] = {r: deque(maxlen=10_000) for r in self.robots}
        self.missions: list[str] = []

    def agent_station(self, robot: int) -> str:
        """Address of the station for a robot's agent: behind its radio."""
        radio = self.radios.setdefault(robot, NetWire(int(self.address.rpartition(":")[2])))
        return f"tcp/127.0.0.1:{radio.port}"

    def heard(self, topic: Topic, key: str, header: Header, payload: bytes) -> None:
        """Take up a message of the bus."""
        super().heard(topic, key, header, payload)
        if topic is topics.TRUTH:
            truth = decode(Truth, payload, "bus", topic.name)
            for robot, eta in zip(truth.robots, truth.eta, strict=True):
                self.places[robot].append((time.monotonic_ns(), eta[:3].copy()))
        if topic is topics.HEARTBEAT:
            state = decode(StationHeartbeat, payload, "bus", topic.name).mission
            if not self.missions or self.missions[-1] != state:
                self.missions.append(state)

    def __exit__(self, *exception: Any) -> None:
        super().__exit__(*exception)
        for radio in self.radios.values():
            radio.close()

    # --- what the station says, by what the pool saw

    def was_neutral(self, robot: int, from_ns: int, to_ns: int) -> bool:
        """True if a robot's thrusters stood still at an instant of that time."""
        return self._was(robot, from_ns, to_ns, thrusts=False)

    def thrust(self, robot: int, from_ns: int, to_ns: int) -> bool:
        """True if a robot's thrusters ran at an instant of that time."""
        return self._was(robot, from_ns, to_ns, thrusts=True)

    def _was(self, robot: int, from_ns: int, to_ns: int, thrusts: bool) -> bool:
        changes = list(self.boards[robot].changes)
        before = [neutral for ns, neutral, _ in changes if ns <= from_ns][-1:] or [True]
        return any(neutral is not thrusts for neutral in before + [n for ns, n, _ in changes if from_ns < ns <= to_ns])

    def nearest_m(self, robot: int, place_m: np.ndarray, from_ns: int, to_ns: int) -> float:
        """Least distance of a robot from a place x, y in that time."""
        away = [float(np.hypot(*(at[:2] - place_m))) for ns, at in list(self.places[robot]) if from_ns <= ns <= to_ns]
        return min(away, default=float("inf"))

    def succeeded(self) -> bool:
        """True if the last run of the fleet, by the heartbeats, was done."""
        verdict = ""
        for before, state in zip(["", *self.missions], self.missions, strict=False):
            if state in TERMINAL:
                verdict = state
            elif before in AT_REST and state in ("LOADING", "HALTING"):
                verdict = ""
        return verdict == "DONE"


def happen(lab: CrowdedLab, steps: list[ScriptLine], begin_s: float, random: np.random.Generator) -> None:
    """Break and mend robots as the script says. Some that were killed stay dead."""
    due = [(step.at_s, False, step) for step in steps] + [(step.at_s + step.lasts_s, True, step) for step in steps]
    for at_s, mends, step in sorted(due, key=lambda entry: entry[:2]):
        time.sleep(max(begin_s + at_s - time.monotonic(), 0.0))
        name, radio = f"agent-{step.robot}", lab.radios[step.robot]
        dead = lab.process(name).exit_code is not None
        if step.what == "killed" and not mends and not dead:
            lab.signal(name, signal.SIGKILL)
            lab.process(name).process.wait()
        elif step.what == "killed" and mends and dead and random.random() < 0.8:
            lab.restart(name)
        elif step.what == "stopped" and not dead:
            lab.signal(name, signal.SIGCONT if mends else signal.SIGSTOP)
        if step.what in ("cut", "deaf"):
            radio.down = mends
        if step.what in ("cut", "mute"):
            radio.up = mends


def untrue(lab: CrowdedLab, request: PersonsRequest) -> str:
    """Evidence of the pool against a request that is done; empty if there is none."""
    outcome, command = request.outcome, request.command
    assert outcome is not None
    since_ns, over_ns = request.asked_ns, request.over_ns
    if command.order in (CommandKind.STOP, CommandKind.DISARM, CommandKind.END, CommandKind.CLEAR_STOP, CommandKind.RETURN):
        running = [r for r in outcome.confirmed if not lab.was_neutral(r, since_ns, over_ns)]
        return f"robots {running} thrust all the time" if running else ""
    if command.order in (CommandKind.START, CommandKind.RESUME, CommandKind.TEST):
        still = [r for r in outcome.confirmed if not lab.thrust(r, since_ns, over_ns)]
        return f"robots {still} never thrust" if still else ""
    if command.order is CommandKind.GO and command.robot:
        away_m = lab.nearest_m(command.robot, command.via[0], since_ns, over_ns)
        return f"robot {command.robot} came no nearer than {away_m:.2f} m" if away_m > THERE_M else ""
    return ""


def judge_requests(lab: CrowdedLab, people: Crowd) -> list[str]:
    """Each request has an answer and an end; what is done was done by the robots; a STOP stops all that thrusts."""
    wrong = list(people.trouble)
    for request in people.requests:
        if not request.over:
            wrong.append(f"{request}: {'under way at the end' if request.answer else ''}")
            continue
        outcome = request.outcome
        if outcome is not None and outcome.progress is Progress.DONE and (why := untrue(lab, request)):
            wrong.append(f"{request}: is DONE, but {why}")
        if outcome is not None and outcome.progress is Progress.FAILED and not outcome.reason:
            wrong.append(f"{request}: failed without a reason")
        if request.answer is not None and not request.answer.accepted and not request.answer.reason:
            wrong.append(f"{request}: refused without a reason")
        if request.command.order is CommandKind.STOP:
            until_ns = request.asked_ns + round(REST_WITHIN_S * 1e9)
            wrong += [f"{request}: robot {r}" for r in lab.robots if not lab.was_neutral(r, request.asked_ns, until_ns)]
            if request.answer is not None and not request.answer.accepted:
                wrong.append(f"{request}: refused: {request.answer.reason}")
    return wrong


def judge_result(lab: CrowdedLab, exit_code: int | None) -> list[str]:
    """The report says of each robot what the pool says, and the exit codes agree with both."""
    wrong = []
    if exit_code != (0 if lab.succeeded() else 1):
        wrong.append(f"the station's exit code is {exit_code}, its missions were {lab.missions}")
    report = subprocess.run(
        [sys.executable, "-m", "groundstation", "log", "report", str(lab.run_dir)], capture_output=True, text=True, check=False
    )
    result = json.loads((lab.run_dir / "result.json").read_text(encoding="utf-8"))
    if report.returncode != (0 if result["passed"] and result["verdict"] == "passed" else 1):
        wrong.append(f"the report's exit code is {report.returncode}, verdict {result['verdict']}: {report.stderr}")
    if result["passed"] and not lab.succeeded():
        wrong.append("the run passed, and its mission did not succeed")
    if result["log_trouble"]:
        wrong.append(f"the log: {result['log_trouble']}")
    for robot in lab.robots:
        end, board = result["robots"][str(robot)]["end"], lab.boards[robot].changes[-1]
        away_m = [
            (float(np.linalg.norm(at - end["place_m"])), (ns - lab.beats[-1]) * 1e-9) for ns, at in list(lab.places[robot])
        ]
        nearest_m = min((m for m, s in away_m if abs(s) <= LOG_ENDS_WITHIN_S), default=float("inf"))
        if nearest_m > BETWEEN_M:
            wrong.append(f"robot {robot} was {nearest_m:.2f} m from where its result says, when the station ended")
        if end["armed"] is not None and end["armed"] is not board[2]:
            wrong.append(f"robot {robot}: its board is {'armed' if board[2] else 'disarmed'}, its result says {end}")
        if end["armed"] is None and lab.process(f"agent-{robot}").exit_code is None:
            wrong.append(f"robot {robot} runs and is in reach, its result says {end}")
    return wrong


@pytest.mark.parametrize("seed", range(1, 21))
def test_a_random_script_against_real_processes(seed: int) -> None:
    with CrowdedLab(seed) as lab:
        steps, random = plan(seed, lab.robots), np.random.default_rng(seed)
        print(f"seed {seed} ({lab.folder})", *steps, sep="\n")
        lab.wait(lambda: lab.mission == "WAITING" and all(lab.states.values()), "lab", READY_WITHIN_S)
        with crowd(lab.address, lab.page, lambda: lab.mission) as people:
            terminal = people.people["terminal"]
            _wait_until_fit(lab, people)
            begin_s = time.monotonic()
            people.act(steps[1:], begin_s)
            happen(lab, [step for step in steps if step.robot], begin_s, random)
            people.finish()
            for radio in lab.radios.values():
                radio.up = radio.down = True
            alive = [r for r in lab.robots if lab.process(f"agent-{r}").exit_code is None]
            since_ns = time.monotonic_ns()
            lab.wait(lambda: all(any(lab.since(r, since_ns)) for r in alive), "robots in reach again", READY_WITHIN_S)
            end = people.ask(terminal, ScriptLine(0.0, "terminal", "end", Command(CommandKind.END, WHOLE_FLEET)))
            lab.wait(lambda: end.over, "end", ENDS_WITHIN_S)
            people.leave()
        station = lab.process("groundstation")
        station.process.wait(ENDS_WITHIN_S)
        wrong = judge_requests(lab, people) + judge_result(lab, station.exit_code)
        wrong += [f"{log.name}: a traceback" for log in lab.folder.glob("logs/*.log") if "Traceback" in log.read_text()]
        print(f"missions: {' '.join(lab.missions)}", *people.requests, sep="\n")
        assert not wrong, "\n".join(wrong)


def _wait_until_fit(lab: CrowdedLab, people: Crowd) -> None:
    """The script's START, until it is taken: robots that have just started are not fit at once."""
    script, step = people.people["script"], ScriptLine(0.0, "script", "start", Command(CommandKind.START, WHOLE_FLEET))
    end_s = time.monotonic() + READY_WITHIN_S
    while True:
        answer = people.ask(script, step).answer
        if answer is not None and answer.accepted:
            return
        if time.monotonic() > end_s:
            raise Stuck(f"no start: {answer} ({lab.folder})")
        time.sleep(0.5)
