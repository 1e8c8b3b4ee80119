"""The log of a simulated fleet, in memory, and its judgement beside what the robots truly did."""

from typing import Any

import numpy as np

from groundstation.analysis.alignment import align
from groundstation.analysis.metrics import evaluate
from groundstation.analysis.results import WHOLE_RUN
from groundstation.logs.reader import DecodedMessage, RunLog
from groundstation.mission.state_machine import COMMITTED, MissionState
from shoal.messages import topics
from shoal.messages.messages import Mode, RobotState, StationHeartbeat, Trajectory, Truth, required
from shoal.messages.topics import Topic
from tests.groundstation.mission.simulated_fleet import STEP_NS, SimulatedFleet, armed

LATE_S = 1.0  # a state may come as late, and the last one may have been lost
BEYOND_M = 0.1  # of the largest true distance: the reference stands where a robot was told to hold, the robot a little further


class RunRecord:
    """Messages that a recorder would have got, and the truth to compare the judgement with."""

    def __init__(self, fleet: SimulatedFleet) -> None:
        self._fleet, self._entries = fleet, dict[tuple[str, int], list[DecodedMessage[Any]]]()
        self._published: dict[int, Trajectory] = {}
        self._largest_m = dict.fromkeys(fleet.robots, 0.0)  # true distance from the formation's trajectory, flying it
        self._whole = False  # the last run went all its way, with every robot
        self._lost = False
        self._along_s = 0.0  # time of the last flight with a robot on the formation's way, the way home left out
        self._begins, self._is_along, self._is_heard = (
            True,
            False,
            False,
        )  # another flight; in this cycle; and the log knows it
        fleet.on_state, fleet.on_beat = self.take_state, self.take_cycle

    def take_state(self, robot: int, state: RobotState, arrives: bool) -> None:
        """Take a robot's state, and the truth beside it."""
        if arrives:
            self._put(topics.STATE, state, robot)
        mission = self._fleet.mission
        plans = mission.roster.plans(robot, mission.segment, mission.plans.next)
        if state.mode is Mode.TRACKING and plans.include(state.trajectory_id):
            away_m = float(np.linalg.norm(required(state.estimate).eta[:3] - required(state.control).eta_reference[:3]))
            self._largest_m[robot] = max(self._largest_m[robot], away_m)
            is_along = state.trajectory_s > 0.0 and not mission.segment.is_return
            self._is_along |= is_along
            self._is_heard |= is_along and arrives

    def take_cycle(self, beat: StationHeartbeat) -> None:
        """Take what the station publishes in a cycle."""
        fleet, mission = self._fleet, self._fleet.mission
        robots = tuple(fleet.robots)
        eta = np.array([fleet.robots[r].eta for r in robots])
        self._put(topics.TRUTH, Truth(robots, eta, np.zeros_like(eta), np.zeros((len(robots), 3)), np.zeros_like(eta)))
        self._put(topics.HEARTBEAT, beat)
        alone = {robot: trajectory for robot, (trajectory, _) in fleet.single.trips.items()}
        for robot, trajectory in (mission.roster.history | alone).items():
            if self._published.get(robot) is not trajectory:
                self._published[robot] = trajectory
                self._put(topics.TRAJECTORY, trajectory, robot)
        if mission.state is MissionState.STARTING:
            self._whole = self._lost = False
            self._begins = True
        if self._begins and self._is_heard:
            self._along_s, self._begins = 0.0, False
        self._along_s += self._is_along * STEP_NS * 1e-9
        self._is_along = self._is_heard = False
        self._lost = self._lost or (mission.state in COMMITTED and bool(mission.roster.lost))
        if mission.state is MissionState.DONE and mission.verdict is MissionState.DONE and not mission.segment.is_return:
            self._whole = not self._lost

    def judge(self) -> None:
        """The report's figures are those of what was flown with the formation, and of nothing else."""
        experiment = self._fleet.experiment
        log = RunLog(self._entries, {"mode": "lockstep"}, messages=1, complete=True)
        result = evaluate(align(experiment, log), log)
        for robot, body in self._fleet.robots.items():
            end = result.robots[str(robot)].end
            assert (end.mode, end.armed) == (body.mode.name, armed(body)), f"RESULT: {end}, robot {robot} is {body.mode.name}"
            assert end.place_m == tuple(body.eta[:3]), f"RESULT: robot {robot} ends at {end.place_m}"
        for robot, true_m in self._largest_m.items():
            largest = result.robots[str(robot)].max_m
            assert largest is None or max(largest) <= true_m + BEYOND_M, (
                f"RESULT: robot {robot} was {max(largest):.2f} m off by the report, in truth {true_m:.2f} m"
            )
        whole = next(check for check in result.checks if check.name == WHOLE_RUN)
        assert whole.passed or not self._whole, f"RESULT: all was flown, the report says {whole.value} of {whole.limit} s"
        assert whole.value is None or whole.value <= self._along_s + LATE_S, (
            f"RESULT: {self._along_s:.1f} s were flown, the report says {whole.value}"
        )

    def _put(self, topic: Topic, message: Any, robot: int = 0) -> None:
        entries, now_ns = self._entries.setdefault((topic.name, robot), []), self._fleet.now_ns
        entries.append(DecodedMessage(now_ns, now_ns, len(entries) + 1, message))
