"""The mission against a fleet of simple obedient (or not) robots, with time as an argument."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from groundstation.asking import Answer
from groundstation.crew import Crew
from groundstation.fleet import RobotView, casualty, preflight
from groundstation.legs import Leg
from groundstation.mission import PATIENCE_S, Mission
from groundstation.phases import Phase
from groundstation.wishes import objection
from wire.experiment import Experiment, load_experiment
from wire.messages import Command, Mode, Order, Pose, Reply, RobotState, Track, Trajectory

STEP_NS = 50_000_000


@dataclass
class Robot:
    """Obeys at once unless told to refuse; tells its state when asked."""

    experiment: Experiment
    mode: Mode = Mode.DISARMED
    loaded: str = ""
    refuses: frozenset[Order] = frozenset()
    silent: bool = False
    fault: str = ""
    trajectory_s: float = 0.0
    starts_at_ns: int = 0
    battery_v: float = 12.0
    verified: bool = True
    got: list[Command] = field(default_factory=list)

    def obey(self, command: Command, now_ns: int) -> Reply:
        self.got.append(command)
        if self.silent or command.order in self.refuses:
            return Reply(command.robot, False, "no answer" if self.silent else "I refuse")
        leads = {Order.ARM: Mode.ARMED, Order.START: Mode.TRACKING, Order.HOLD: Mode.HOLDING, Order.RESUME: Mode.TRACKING,
                 Order.DISARM: Mode.DISARMED, Order.STOP: Mode.STOPPED, Order.CLEAR_STOP: Mode.DISARMED}  # fmt: skip
        if command.order is Order.LOAD:
            assert command.trajectory is not None
            self.loaded = command.trajectory.id
        self.mode = leads.get(command.order, self.mode)
        if command.order in (Order.START, Order.RESUME):
            self.trajectory_s = command.trajectory_s
            self.starts_at_ns = now_ns + round(command.start_in_s * 1e9)
        return Reply(command.robot, True)

    def view(self) -> RobotView:
        pose = Pose(0, 0, 0, np.eye(3), Track.MARKER, self.verified)
        state = RobotState(
            mode=self.mode, fault=self.fault, experiment_hash=self.experiment.hash, trajectory_id=self.loaded,
            trajectory_s=self.trajectory_s, battery_v=self.battery_v,
        )  # fmt: skip
        return RobotView(state, 9.0 if self.silent else 0.02, pose, 0.02)


class Run:
    """A mission and its robots, stepped together."""

    def __init__(self, automatic: bool = True, settings: Sequence[str] = ()) -> None:
        self.experiment = load_experiment("pool", ["duration_s=2", *settings])
        two = np.zeros((2, 4))
        trajectories = {r: Trajectory(f"t{r}", 0.05, two, two, two) for r in self.experiment.robot_ids}
        starts = dict.fromkeys(self.experiment.robot_ids, np.zeros(4))
        self.mission = Mission(self.experiment, Leg(trajectories, trajectories[1], 2.0), starts, automatic)
        self.robots = {r: Robot(self.experiment) for r in self.experiment.robot_ids}
        self.now_ns = 0
        self.answers: list[Answer] = []
        self.phases: list[Phase] = []

    def fleet(self) -> dict[int, RobotView]:
        return {r: robot.view() for r, robot in self.robots.items()}

    def at(self, phase: Phase) -> bool:
        return self.mission.phase is phase

    def in_mode(self, robot: int, mode: Mode) -> bool:
        return self.robots[robot].mode is mode

    def step(self, seconds: float = 0.05) -> None:
        for _ in range(round(seconds / 0.05)):
            self.now_ns += STEP_NS
            commands = self.mission.step(self.fleet(), self.answers, self.now_ns)
            self.answers = [Answer(c, self.robots[c.robot].obey(c, self.now_ns)) for c in commands]
            for robot in self.robots.values():
                if robot.mode is Mode.TRACKING and self.now_ns >= robot.starts_at_ns and not robot.silent:
                    robot.trajectory_s += 0.05
            if not self.phases or self.phases[-1] is not self.mission.phase:
                self.phases.append(self.mission.phase)


def test_an_automatic_mission_goes_from_waiting_to_done() -> None:
    run = Run()
    run.step(6.0)
    flown = [Phase.LOADING, Phase.ARMING, Phase.STARTING, Phase.RUNNING, Phase.ENDING, Phase.DONE]
    assert run.phases == flown
    for robot in run.robots.values():
        assert [c.order for c in robot.got] == [Order.LOAD, Order.ARM, Order.START, Order.DISARM]
        assert all(c.experiment_hash == run.experiment.hash for c in robot.got)
    assert not run.mission.failed


def test_robots_start_at_one_instant_though_one_needs_a_second_order() -> None:
    run = Run()
    run.robots[2].refuses = frozenset({Order.START})
    while not run.robots[1].got or run.robots[1].got[-1].order is not Order.START:
        run.step()
    run.step(0.1)
    run.robots[2].refuses = frozenset()
    run.step(0.6)
    assert run.in_mode(2, Mode.TRACKING)
    assert abs(run.robots[1].starts_at_ns - run.robots[2].starts_at_ns) <= STEP_NS


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"silent": True}, "not heard"),
        ({"battery_v": 10.0}, "battery 10.0 V, needs 10.5 V"),
        ({"verified": False}, "identity not verified"),
        ({"mode": Mode.FAULT, "fault": "no pose"}, "is FAULT: no pose"),
    ],
)
def test_preflight_names_robot_and_reason_and_nothing_is_armed(change: dict[str, object], says: str) -> None:
    run = Run()
    for name, value in change.items():
        setattr(run.robots[2], name, value)
    run.step(3.0)
    assert run.at(Phase.WAITING)
    assert "robot 2" in run.mission.reason
    assert says in run.mission.reason
    assert run.robots[1].got == []


def test_another_experiment_on_a_robot_is_refused() -> None:
    run = Run()
    run.robots[1].experiment = load_experiment("pool", ["duration_s=3"])
    assert "another experiment" in preflight(run.experiment, run.fleet())[0]


def test_an_order_never_obeyed_fails_the_mission_and_disarms_all() -> None:
    run = Run()
    run.robots[1].refuses = frozenset({Order.ARM})
    run.step(PATIENCE_S + 2.0)
    assert run.at(Phase.FAILED)
    assert run.phases[-2:] == [Phase.ABORTING, Phase.FAILED]
    assert run.in_mode(2, Mode.DISARMED)
    assert run.mission.failed


@pytest.mark.parametrize("change", [{"silent": True}, {"mode": Mode.FAULT, "fault": "no pose"}])
def test_a_robot_lost_in_flight_ends_the_mission_and_the_others_are_disarmed(change: dict[str, object]) -> None:
    run = Run()
    while run.mission.phase is not Phase.RUNNING:
        run.step()
    for name, value in change.items():
        setattr(run.robots[2], name, value)
    assert (casualty((1, 2), run.fleet()) or (0, ""))[0] == 2
    run.step(PATIENCE_S + 1.0)
    assert run.at(Phase.FAILED)
    assert run.in_mode(1, Mode.DISARMED)


def test_a_robot_that_holds_makes_all_hold_and_all_go_on_from_one_place() -> None:
    run = Run()
    while run.robots[1].trajectory_s < 0.5:
        run.step()
    run.robots[2].mode, run.robots[2].fault = Mode.HOLDING, "pose late"
    run.step(0.2)
    assert run.at(Phase.PAUSED)
    assert {r.mode for r in run.robots.values()} == {Mode.HOLDING}
    run.step(1.5)
    resumes = [robot.got[-1] for robot in run.robots.values()]
    assert [c.order for c in resumes] == [Order.RESUME, Order.RESUME]
    assert resumes[0].trajectory_s == resumes[1].trajectory_s >= 0.5
    run.step(4.0)
    assert run.at(Phase.DONE)


def test_what_a_person_holds_stays_held_until_a_person_resumes() -> None:
    run = Run()
    while run.mission.phase is not Phase.RUNNING:
        run.step()
    assert run.mission.wish(Order.HOLD, run.fleet(), run.now_ns) == ""
    run.step(5.0)
    assert run.at(Phase.PAUSED)
    assert run.mission.wish(Order.RESUME, run.fleet(), run.now_ns) == ""
    run.step(4.0)
    assert run.at(Phase.DONE)


def test_stop_is_latched_on_every_robot_until_cleared() -> None:
    run = Run(automatic=False)
    assert run.mission.wish(Order.START, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.at(Phase.RUNNING)
    run.robots[2].refuses = frozenset({Order.STOP})
    assert run.mission.wish(Order.STOP, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.in_mode(1, Mode.STOPPED)
    run.robots[2].refuses = frozenset()
    run.step(0.5)  # asked again and again
    assert run.in_mode(2, Mode.STOPPED)
    assert "only when" in run.mission.wish(Order.START, run.fleet(), run.now_ns)
    assert run.mission.wish(Order.CLEAR_STOP, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.at(Phase.WAITING)
    assert {r.mode for r in run.robots.values()} == {Mode.DISARMED}


def test_after_a_cleared_stop_nobody_flies_again_unasked_in_an_automatic_mission_either() -> None:
    """All are still near their starts, fit and disarmed: just what an automatic mission waits for to begin."""
    run = Run()
    while run.mission.phase is not Phase.RUNNING:
        run.step()
    assert run.mission.wish(Order.STOP, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.mission.wish(Order.CLEAR_STOP, run.fleet(), run.now_ns) == ""
    run.step(5.0)
    assert run.at(Phase.WAITING)
    assert {r.mode for r in run.robots.values()} == {Mode.DISARMED}
    assert run.mission.wish(Order.START, run.fleet(), run.now_ns) == ""
    run.step(6.0)
    assert run.at(Phase.DONE)


THREE = "robots=[{id=1,node_m=[0,0.4,0]},{id=2,node_m=[0,-0.4,0]},{id=3,node_m=[0.8,0,0]}]"


def three_running(policy: str) -> Run:
    run = Run(settings=[THREE, f'mission.lost="{policy}"'])
    while run.mission.phase is not Phase.RUNNING:
        run.step()
    run.step(0.5)
    return run


def test_with_policy_hold_a_robot_that_first_holds_and_then_fails_keeps_the_others_holding() -> None:
    """No pose for 0.2 s, then for half a second: the usual way to be lost."""
    run = three_running("hold")
    run.robots[2].mode, run.robots[2].fault = Mode.HOLDING, "pose late"
    run.step(0.3)
    assert run.at(Phase.PAUSED)
    run.robots[2].mode, run.robots[2].fault = Mode.FAULT, "no pose"
    run.step(5.0)
    assert run.at(Phase.PAUSED)
    assert run.mission.reason == "robot 2: fault (no pose)"
    assert {run.robots[r].mode for r in (1, 3)} == {Mode.HOLDING}
    assert run.mission.wish(Order.RESUME, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.at(Phase.DEGRADED)


def test_with_policy_hold_a_robot_lost_while_all_resume_makes_the_others_hold_again() -> None:
    run = three_running("hold")
    run.mission.wish(Order.HOLD, run.fleet(), run.now_ns)
    run.step(0.5)
    run.robots[2].refuses = frozenset({Order.RESUME})
    run.mission.wish(Order.RESUME, run.fleet(), run.now_ns)
    run.step(0.5)
    assert run.at(Phase.RESUMING)
    run.robots[2].silent = True
    run.step(3.0)
    assert run.at(Phase.PAUSED)
    assert {run.robots[r].mode for r in (1, 3)} == {Mode.HOLDING}


def test_a_gap_closes_only_when_those_whom_a_person_holds_may_go_on() -> None:
    run = three_running("close-up")
    run.mission.wish(Order.HOLD, run.fleet(), run.now_ns)
    run.step(0.5)
    run.robots[2].mode, run.robots[2].fault = Mode.FAULT, "no pose"
    run.step(3.0)
    assert run.at(Phase.PAUSED)
    assert run.mission.reason == "robot 2: fault (no pose)"
    assert run.mission.wish(Order.RESUME, run.fleet(), run.now_ns) == ""
    run.step(0.2)
    assert run.at(Phase.HALTING)
    assert set(run.mission.crew.active_slots().values()) == {1, 2}


def test_a_thruster_test_after_a_run_is_for_the_robot_that_fell_out_of_it_too() -> None:
    run = three_running("go-on")
    run.robots[2].mode, run.robots[2].fault = Mode.FAULT, "thrusters do not do as told"
    run.step(0.5)
    assert run.mission.crew.out
    run.mission.wish(Order.DISARM, run.fleet(), run.now_ns)
    run.step(1.0)
    run.robots[2].fault = ""
    assert run.mission.wish(Order.TEST, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.at(Phase.TESTING)
    assert [robot.got[-1].order for robot in run.robots.values()] == [Order.TEST] * 3


def test_a_way_home_asked_for_while_a_detour_is_planned_is_not_that_detour() -> None:
    run = Run(settings=['path={kind="waypoints",points_m=[[-1,0],[1,0]],speed_mps=0.1}'])
    while run.mission.phase is not Phase.RUNNING:
        run.step()
    assert run.mission.wish(Order.GO, run.fleet(), run.now_ns, [(0.5, 0.5)]) == ""
    run.step()
    detour = run.mission.wanted
    assert detour is not None
    assert run.mission.wish(Order.RETURN, run.fleet(), run.now_ns) == ""
    assert run.mission.wanted is None
    run.step(0.5)
    assert run.at(Phase.HALTING)
    assert run.mission.wanted is not None and run.mission.wanted is not detour
    assert run.mission.wanted.plan().home


def test_a_place_outside_the_pool_is_refused_before_anybody_leaves_the_path() -> None:
    """Robots refuse a trajectory that leaves the pool, walls or not; the formation would hold then."""
    straight = ['path={kind="waypoints",points_m=[[-1,0],[1,0]],speed_mps=0.1}', "pool.walls=false"]
    run = Run(settings=straight)
    while run.mission.phase is not Phase.RUNNING:
        run.step()
    places = [(1.0, 1.0), (0.0, 1.3)]
    assert run.mission.wish(Order.GO, run.fleet(), run.now_ns, places) == "(0, 1.3) m is outside the pool"
    assert run.at(Phase.RUNNING)
    assert run.mission.wish(Order.GO, run.fleet(), run.now_ns, places[:1]) == ""


def test_robots_that_an_earlier_station_stopped_are_cleared_by_the_order_that_preflight_asks_for() -> None:
    run = Run(automatic=False)
    run.robots[2].mode, run.robots[2].fault = Mode.STOPPED, "emergency stop"
    run.step(1.0)
    assert "(clear the stop)" in run.mission.reason
    assert run.mission.wish(Order.CLEAR_STOP, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.at(Phase.WAITING)
    assert run.in_mode(2, Mode.DISARMED)


def test_without_being_asked_a_manual_mission_arms_nothing() -> None:
    run = Run(automatic=False)
    run.step(3.0)
    assert all(robot.got == [] for robot in run.robots.values())
    run.robots[1].silent = True
    assert "robot 1: not heard" in run.mission.wish(Order.START, run.fleet(), run.now_ns)
    run.robots[1].silent = False
    assert run.mission.wish(Order.LOAD, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert [c.order for c in run.robots[1].got] == [Order.LOAD]
    assert run.mission.wish(Order.ARM, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.in_mode(1, Mode.ARMED)
    assert run.at(Phase.ARMING)
    assert run.mission.wish(Order.START, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.in_mode(1, Mode.TRACKING)


def test_a_robot_that_falls_out_before_the_start_ends_it_at_once_and_the_reason_is_its_own() -> None:
    """Not ten seconds of orders that it cannot follow, and then what it said to the last of them."""
    run = Run()
    run.robots[2].refuses = frozenset({Order.START})
    while not run.at(Phase.STARTING):
        run.step()
    run.step(0.2)
    run.robots[2].mode, run.robots[2].fault = Mode.FAULT, "no pose"
    run.step(0.1)
    assert run.at(Phase.ABORTING)
    assert run.mission.reason == "robot 2: fault (no pose)"
    run.step(0.5)
    assert run.at(Phase.FAILED)
    assert run.in_mode(1, Mode.DISARMED)


def test_nobody_rejoins_those_who_are_on_their_way_home() -> None:
    """That way has no places for robots that are out."""
    run = Run()
    crew = Crew(run.experiment.robot_ids, run.mission.leg)
    crew.lose(2, "silent")

    def why_not(leg: Leg) -> str:
        return objection(Order.REJOIN, run.experiment, run.fleet(), crew, leg, {}, ())

    home = replace(run.mission.leg, home=True)
    assert "way back" in why_not(home)
    assert "way back" not in why_not(run.mission.leg)
    crew.take_back()
    assert why_not(home) == "nobody is out"
