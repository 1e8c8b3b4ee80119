"""The mission against a fleet of simple obedient (or not) robots, with time as an argument."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from groundstation.asking import Answer
from groundstation.checks import PlanError
from groundstation.crew import Crew
from groundstation.fleet import RobotView, casualty, preflight
from groundstation.legs import Leg
from groundstation.lookout import Surroundings
from groundstation.mission import PATIENCE_S, TEST_PATIENCE_S, Mission
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
    loaded_next: str = ""  # under way
    refuses: frozenset[Order] = frozenset()
    silent: bool = False
    hears: bool = False  # also when silent: nothing that it says arrives
    unknown: bool = False
    test: str = ""
    eta: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    age_s: float = 0.02
    fault: str = ""
    trajectory_s: float = 0.0
    starts_at_ns: int = 0
    battery_v: float = 12.0
    verified: bool = True
    got: list[Command] = field(default_factory=list)

    def obey(self, command: Command, now_ns: int) -> Reply:
        self.got.append(command)
        unheard = self.silent or self.unknown
        if (unheard and not self.hears) or command.order in self.refuses:
            return Reply(command.robot, False, "no answer" if unheard else "I refuse", silent=unheard)
        leads = {Order.ARM: Mode.ARMED, Order.START: Mode.TRACKING, Order.HOLD: Mode.HOLDING, Order.RESUME: Mode.TRACKING,
                 Order.DISARM: Mode.DISARMED, Order.STOP: Mode.STOPPED, Order.CLEAR_STOP: Mode.DISARMED}  # fmt: skip
        if command.order is Order.LOAD:
            assert command.trajectory is not None
            if self.mode is Mode.TRACKING:
                self.loaded_next = command.trajectory.id
            else:
                self.loaded = command.trajectory.id
        if command.order is Order.SWITCH and self.loaded_next == command.trajectory_id:
            self.loaded = command.trajectory_id
        self.mode = leads.get(command.order, self.mode)
        if command.order in (Order.START, Order.RESUME):
            self.trajectory_s = command.trajectory_s + max(now_ns - command.start_ns, 0) * 1e-9
            self.starts_at_ns = command.start_ns
        return Reply(command.robot, not unheard, "no answer" if unheard else "", silent=unheard)

    def view(self) -> RobotView:
        pose = Pose(0, 0, 0, np.eye(3), Track.MARKER, self.verified)
        state = RobotState(
            mode=self.mode, fault=self.fault, experiment_hash=self.experiment.hash, trajectory_id=self.loaded,
            trajectory_s=self.trajectory_s, battery_v=self.battery_v, thruster_test=self.test,
            eta=np.array(self.eta),
        )  # fmt: skip
        if self.unknown:
            return RobotView()
        return RobotView(state, 9.0 if self.silent else self.age_s, pose, 0.02)


class Run:
    """A mission and its robots, stepped together."""

    def __init__(self, automatic: bool = True, settings: Sequence[str] = ()) -> None:
        self.experiment = load_experiment("pool", ["duration_s=2", *settings])
        two = np.zeros((2, 4))
        trajectories = {r: Trajectory(f"t{r}", 0.05, two, two, two) for r in self.experiment.robot_ids}
        starts = dict.fromkeys(self.experiment.robot_ids, np.zeros(4))
        leg = Leg(trajectories, trajectories[1], self.experiment.duration_s)
        self.mission = Mission(self.experiment, leg, starts, automatic)
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


@pytest.mark.parametrize("policy", ["hold", "go-on", "close-up"])
def test_a_robot_that_was_silent_and_flies_on_is_held(policy: str) -> None:
    run = three_running(policy)
    run.robots[2].silent = True
    run.step(0.2)
    assert run.mission.crew.out == {2: "silent"}
    run.robots[2].silent = False
    assert run.in_mode(2, Mode.TRACKING)
    run.step(0.2)
    assert run.in_mode(2, Mode.HOLDING)


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


@pytest.mark.parametrize("phase", [Phase.ARMING, Phase.STARTING])
def test_a_robot_that_was_armed_and_restarts_before_the_start_is_not_armed_again(phase: Phase) -> None:
    run = Run(automatic=False)
    run.robots[1].refuses = frozenset({Order.START})
    order = Order.ARM if phase is Phase.ARMING else Order.START
    assert run.mission.wish(order, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.at(phase)
    run.robots[2].mode, run.robots[2].loaded = Mode.DISARMED, ""
    run.step(0.1)
    assert run.at(Phase.ABORTING) and run.mission.reason == "robot 2: disarmed"
    run.step(0.5)
    assert run.at(Phase.FAILED) and {r.mode for r in run.robots.values()} == {Mode.DISARMED}
    assert [c.order for c in run.robots[2].got].count(Order.ARM) == 1


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


# --- in step


def running(settings: Sequence[str] = (), automatic: bool = True) -> Run:
    run = Run(automatic, ["duration_s=60", *settings])
    if not automatic:
        assert run.mission.wish(Order.START, run.fleet(), run.now_ns) == ""
    while run.mission.phase is not Phase.RUNNING:
        run.step()
    run.step(1.0)
    return run


def test_a_second_start_names_the_same_instant_as_the_first() -> None:
    run = Run()
    run.robots[2].refuses = frozenset({Order.START})
    while not run.at(Phase.STARTING):
        run.step()
    run.step(1.2)
    run.robots[2].refuses = frozenset()
    run.step(0.5)
    assert run.at(Phase.RUNNING)
    (first,), several = ([c for c in r.got if c.order is Order.START] for r in run.robots.values())
    assert len(several) > 3 and {(c.start_ns, c.trajectory_s) for c in several} == {(first.start_ns, first.trajectory_s)}
    assert abs(run.robots[1].trajectory_s - run.robots[2].trajectory_s) < 0.06


@pytest.mark.parametrize(
    ("by_s", "says"), [(-0.8, "robot 2 is 0.8 s behind the others"), (0.7, "is 0.7 s ahead of the others")]
)
def test_a_robot_out_of_step_makes_all_hold_and_all_go_on_from_where_the_others_were(by_s: float, says: str) -> None:
    run = running()
    run.robots[2].trajectory_s += by_s
    run.step(0.25)
    assert run.at(Phase.RUNNING)  # it may be a state that came late
    run.step(0.2)
    assert run.at(Phase.PAUSED) and says in run.mission.reason
    assert {r.mode for r in run.robots.values()} == {Mode.HOLDING}
    others_s = run.robots[1].trajectory_s
    run.step(2.0)
    assert run.at(Phase.RUNNING) and run.mission.reason == ""
    resumed = [r.got[-1] for r in run.robots.values()]
    assert [c.order for c in resumed] == [Order.RESUME] * 2
    assert [c.trajectory_s for c in resumed] == pytest.approx([others_s] * 2, abs=0.11)


@pytest.mark.parametrize("by_s", [-0.4, 0.4])
def test_a_robot_a_little_out_of_step_flies_on(by_s: float) -> None:
    run = running()
    run.robots[2].trajectory_s += by_s
    run.step(3.0)
    assert run.at(Phase.RUNNING)


def test_a_robot_that_is_out_of_step_for_a_moment_now_and_then_flies_on() -> None:
    """States that jump about are no reason to hold; nor is what was seen before a hold one after it."""
    run = running()
    for _ in range(4):
        run.robots[2].trajectory_s -= 0.8
        run.step(0.2)
        run.robots[2].trajectory_s += 0.8
        run.step(0.1)
    assert run.at(Phase.RUNNING)
    run.robots[2].trajectory_s -= 0.8
    run.step(0.2)
    assert run.mission.wish(Order.HOLD, run.fleet(), run.now_ns) == ""
    run.step(0.2)
    assert run.mission.wish(Order.RESUME, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    run.robots[2].trajectory_s -= 0.8
    run.step(0.2)
    assert run.at(Phase.RUNNING)


def test_nobody_goes_back_to_where_one_fell_far_behind() -> None:
    run = running(automatic=False)
    run.step(10.0)
    run.robots[2].trajectory_s = 0.0
    run.step(1.0)
    assert run.at(Phase.PAUSED)
    assert run.mission.wish(Order.RESUME, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    assert {r.got[-1].order for r in run.robots.values()} == {Order.RESUME}
    assert {r.got[-1].trajectory_s > 10.0 for r in run.robots.values()} == {True}


def test_a_robot_that_starts_at_another_instant_than_it_was_told_makes_all_hold() -> None:
    run = Run(settings=["duration_s=60"])
    run.robots[1].refuses = frozenset({Order.START})
    while not run.in_mode(2, Mode.TRACKING):
        run.step()
    run.robots[2].starts_at_ns += 2_000_000_000
    run.step(1.5)
    assert Phase.PAUSED in run.phases and Phase.RUNNING not in run.phases


def test_a_robot_on_another_plan_than_the_others_makes_all_hold() -> None:
    run = running()
    run.robots[2].loaded = "of yesterday"
    run.step(0.5)
    assert run.at(Phase.PAUSED)
    assert run.mission.reason == "robot 2 flies another plan than the others"


def test_all_hold_before_anybody_goes_on() -> None:
    run = running(automatic=False)
    run.robots[2].refuses = frozenset({Order.HOLD})
    assert run.mission.wish(Order.HOLD, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    assert run.mission.wish(Order.RESUME, run.fleet(), run.now_ns) == "robot 2 does not hold yet (TRACKING)"
    run.robots[2].refuses = frozenset()
    run.step(0.5)
    assert run.mission.wish(Order.RESUME, run.fleet(), run.now_ns) == ""


def test_a_stall_of_the_station_moves_nobodys_reference() -> None:
    """The lag that robots extrapolate from the last heartbeat is the one that the next heartbeat tells."""
    run = running(["mission.wait_from_m=0.1", "mission.wait_at_m=0.2"])
    pace = run.mission.pace
    pace.rate, pace.lag_s = 0.1, 1.0
    run.now_ns += 500_000_000
    run.mission.step(run.fleet(), (), run.now_ns)
    assert pace.lag_s == pytest.approx(1.0 + 0.9 * 0.5)
    run.now_ns += 1_000_000  # and one that comes early
    run.mission.step(run.fleet(), (), run.now_ns)
    assert pace.lag_s == pytest.approx(1.45 + 0.9 * 0.001, abs=2e-4)


# --- deadlines


STRAIGHT = 'path={kind="waypoints",points_m=[[-1,0],[1,0]],speed_mps=0.1}'


def next_leg(run: Run, begin_s: float) -> Leg:
    still = np.zeros((200, 4))
    found = {r: Trajectory(f"n{r}", 0.05, still, still, still, begin_s) for r in run.experiment.robot_ids}
    return Leg(found, found[1], 60.0)


def going_elsewhere() -> Run:
    run = running([STRAIGHT, "duration_s=20"], automatic=False)
    assert run.mission.wish(Order.GO, run.fleet(), run.now_ns, [(0.5, 0.5)]) == ""
    return run


def test_a_plan_that_does_not_come_in_time_makes_all_hold() -> None:
    run = going_elsewhere()
    run.step(1.5)
    assert run.at(Phase.SWITCHING)
    run.step(0.5)
    assert run.at(Phase.PAUSED)
    assert run.mission.reason == "no plan in time"
    assert run.mission.wish(Order.RESUME, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.at(Phase.RUNNING)


def test_when_a_robot_has_not_gone_over_in_time_all_hold_and_get_a_new_plan_from_rest() -> None:
    run = going_elsewhere()
    run.robots[2].refuses = frozenset({Order.SWITCH})
    run.mission.planned(next_leg(run, 3.0), run.fleet(), run.now_ns)
    run.step(1.5)
    assert run.robots[1].loaded == "n1" and run.robots[2].loaded == "t2"
    run.step(0.5)
    assert run.at(Phase.PAUSED)
    assert run.mission.reason == "robot 2 has not gone over in time: robot 2 refuses SWITCH: I refuse"
    assert run.mission.wish(Order.RESUME, run.fleet(), run.now_ns) == ""
    assert run.at(Phase.HALTING)
    run.step(0.2)
    assert run.mission.wanted is not None
    run.mission.planned(next_leg(run, 4.0), run.fleet(), run.now_ns)
    run.step(2.0)
    assert run.at(Phase.RUNNING)
    assert {r.loaded for r in run.robots.values()} == {"n1", "n2"}
    assert all(Order.RESUME not in [c.order for c in r.got] for r in run.robots.values())


def test_a_robot_that_does_not_hold_while_all_come_to_rest_ends_the_mission() -> None:
    run = running(automatic=False)
    run.robots[2].refuses = frozenset({Order.HOLD})
    assert run.mission.wish(Order.RETURN, run.fleet(), run.now_ns) == ""
    run.step(PATIENCE_S - 0.5)
    assert run.at(Phase.HALTING)
    run.step(1.0)
    assert Phase.ABORTING in run.phases
    run.step(1.0)
    assert run.at(Phase.FAILED) and run.mission.reason == "robot 2 does not follow HOLD"
    assert {r.mode for r in run.robots.values()} == {Mode.DISARMED}


def test_a_thruster_test_that_does_not_end_is_given_up() -> None:
    run = Run(automatic=False)
    run.robots[1].test = "passed"
    assert run.mission.wish(Order.TEST, run.fleet(), run.now_ns) == ""
    run.step(TEST_PATIENCE_S)
    assert run.at(Phase.TESTING)
    run.robots[2].test = "running"
    run.step(2.0)
    assert run.at(Phase.FAILED) and "the thruster test does not end: {1: 'passed', 2: 'running'}" in run.mission.reason
    assert {r.mode for r in run.robots.values()} == {Mode.DISARMED}


def test_a_robot_is_waited_for_from_when_it_does_not_do_as_told() -> None:
    """Trajectories lie loaded for a while; then an agent is restarted, and has none."""
    run = Run(automatic=False)
    assert run.mission.wish(Order.LOAD, run.fleet(), run.now_ns) == ""
    run.step(PATIENCE_S + 1.0)
    run.robots[2].loaded, run.robots[2].refuses = "", frozenset({Order.LOAD})
    run.step(PATIENCE_S - 1.0)
    assert run.at(Phase.LOADING)
    run.robots[2].refuses = frozenset()
    run.step(0.5)
    assert run.at(Phase.LOADING) and run.robots[2].loaded == "t2"
    run.robots[2].loaded, run.robots[2].refuses = "", frozenset({Order.LOAD})
    run.step(PATIENCE_S + 1.0)
    assert run.phases[-2:] == [Phase.ABORTING, Phase.FAILED]
    assert "robot 2 does not follow LOAD: robot 2 refuses LOAD: I refuse" in run.mission.reason


# --- lost on the way to a new plan


def on_the_way_to_a_plan(policy: str, phase: Phase) -> Run:
    """Three robots, sent home, in this phase."""
    run = running([THREE, f'mission.lost="{policy}"'], automatic=False)
    assert run.mission.wish(Order.RETURN, run.fleet(), run.now_ns) == ""
    run.step(0.2)
    if phase is not Phase.HALTING:
        for robot in run.robots.values():
            robot.refuses = frozenset({Order.LOAD} if phase is Phase.RELOADING else {Order.START})
        run.mission.planned(replace(next_leg(run, 4.0), home=True), run.fleet(), run.now_ns)
        run.step(0.3)
    if phase is Phase.REARMING:  # those who hold are armed, and it takes no time
        run.mission.phase = phase
    assert run.at(phase)
    return run


SILENT: dict[str, object] = {"silent": True}
FAULTY: dict[str, object] = {"mode": Mode.FAULT, "fault": "no pose"}
RESTARTED: dict[str, object] = {"mode": Mode.DISARMED, "loaded": ""}
LOST_WHERE = [Phase.HALTING, Phase.RELOADING, Phase.REARMING, Phase.RELEASING]


@pytest.mark.parametrize("phase", LOST_WHERE)
@pytest.mark.parametrize("how", [SILENT, FAULTY, RESTARTED])
@pytest.mark.parametrize(
    ("policy", "leads_to"),
    [("abort", Phase.ABORTING), ("hold", Phase.PAUSED), ("go-on", Phase.HALTING), ("close-up", Phase.HALTING)],
)
def test_a_robot_lost_while_a_plan_is_made_is_the_policys_affair(
    policy: str, leads_to: Phase, how: dict[str, object], phase: Phase
) -> None:
    run = on_the_way_to_a_plan(policy, phase)
    old = run.mission.wanted
    for name, value in how.items():
        setattr(run.robots[2], name, value)
    run.step()
    assert run.at(leads_to)
    assert "robot 2: " in run.mission.reason
    assert (2 in run.mission.crew.out) == (policy != "abort")
    if leads_to is Phase.HALTING:  # a plan that counts on the robot is not flown
        for robot in run.robots.values():
            robot.refuses = frozenset()
        run.step(0.3)
        assert run.mission.wanted is not None and run.mission.wanted is not old
        assert set(run.mission.wanted.plan().trajectories) == {1, 3}
    elif leads_to is Phase.PAUSED:
        run.step(1.0)
        assert run.at(Phase.PAUSED) and {run.robots[r].mode for r in (1, 3)} == {Mode.HOLDING}


def test_robots_that_lie_disarmed_are_not_lost_while_a_plan_home_is_made() -> None:
    run = Run(automatic=False)
    run.step(0.2)
    assert run.mission.wish(Order.RETURN, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    assert run.at(Phase.HALTING) and run.mission.crew.out == {}
    run.mission.planned(replace(next_leg(run, 0.05), home=True), run.fleet(), run.now_ns)
    run.step(2.0)
    assert run.at(Phase.RETURNING)


def test_robots_that_lie_disarmed_and_have_no_way_home_say_so() -> None:
    run = Run(automatic=False)
    run.step(0.2)
    assert run.mission.wish(Order.RETURN, run.fleet(), run.now_ns) == ""
    run.step(0.2)
    run.mission.planned(PlanError("an island is in the way"), run.fleet(), run.now_ns)
    run.step(1.0)
    assert run.at(Phase.FAILED)
    assert run.mission.reason == "no way from here: an island is in the way"


def test_who_should_rejoin_stays_out_when_there_is_no_way() -> None:
    run = three_running("go-on")
    run.robots[2].mode = Mode.DISARMED
    run.step(0.2)
    assert run.mission.wish(Order.REJOIN, run.fleet(), run.now_ns) == ""
    run.step(0.2)
    run.mission.planned(PlanError("an island is in the way"), run.fleet(), run.now_ns)
    run.step(1.0)
    assert run.at(Phase.PAUSED) and "no way from here" in run.mission.reason
    assert run.mission.crew.out == {2: "disarmed"}
    assert {run.robots[r].mode for r in (1, 3)} == {Mode.HOLDING}


@pytest.mark.parametrize("phase", LOST_WHERE)
def test_a_person_can_hold_robots_that_wait_for_a_plan(phase: Phase) -> None:
    run = on_the_way_to_a_plan("abort", phase)
    assert run.mission.wish(Order.HOLD, run.fleet(), run.now_ns) == ""
    run.step(3.0)
    assert run.at(Phase.PAUSED)
    assert {r.mode for r in run.robots.values()} == {Mode.HOLDING}


def test_robots_that_lie_disarmed_cannot_be_held() -> None:
    run = Run(automatic=False)
    run.step(0.2)
    assert run.mission.wish(Order.RETURN, run.fleet(), run.now_ns) == ""
    run.step(0.2)
    assert run.mission.wish(Order.HOLD, run.fleet(), run.now_ns) == "no robot is armed"
    assert run.at(Phase.HALTING)


def test_a_plan_is_made_of_what_was_known_when_it_was_asked_for() -> None:
    """It is computed in another thread: robots that are lost meanwhile would be missing from one half of it."""
    run = on_the_way_to_a_plan("go-on", Phase.HALTING)
    wanted = run.mission.wanted
    assert wanted is not None
    run.robots[2].silent = True
    run.step(0.2)
    assert run.mission.crew.active == (1, 3)
    assert set(wanted.plan().trajectories) == {1, 2, 3}


def test_what_comes_to_lie_on_an_own_way_has_robots_rest_for_another_one() -> None:
    """With policy go-on the one that is lost was to be gone when the other comes by."""
    run = running([THREE, 'mission.lost="go-on"'], automatic=False)
    assert run.mission.wish(Order.RETURN, run.fleet(), run.now_ns) == ""
    run.step(0.2)
    away = next_leg(run, 3.0)
    eta = np.zeros((200, 4))
    eta[:, 0] = np.linspace(-1.0, 1.0, 200)
    ways = {**away.trajectories, 1: replace(away.trajectories[1], eta=eta), 3: replace(away.trajectories[3], eta=eta + 1.0)}
    home = replace(away, trajectories=ways, home=True, end_s=13.0)
    run.mission.planned(home, run.fleet(), run.now_ns)
    run.step(2.0)
    assert run.at(Phase.RETURNING)
    run.robots[2].mode, run.robots[2].fault = Mode.FAULT, "no pose"
    run.step(0.1)
    assert run.at(Phase.HALTING)
    assert "on the path of robot 1" in run.mission.reason
    run.step(0.3)
    assert run.mission.wanted is not None
    plan = run.mission.wanted.plan()
    assert plan.home and set(plan.trajectories) == {1, 3}


# --- how a run ends


def test_a_run_that_a_person_disarms_has_not_succeeded() -> None:
    run = running()
    assert run.mission.wish(Order.DISARM, run.fleet(), run.now_ns) == ""
    run.robots[2].refuses = frozenset({Order.DISARM})
    run.step(0.5)
    run.robots[2].refuses = frozenset()
    run.step(0.5)
    assert run.at(Phase.CANCELLED)
    assert run.mission.reason == "a person asked for DISARM when RUNNING"
    assert run.mission.wish(Order.DISARM, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    assert run.at(Phase.CANCELLED)
    assert run.mission.wish(Order.LOAD, run.fleet(), run.now_ns) == ""
    assert run.mission.wish(Order.START, run.fleet(), run.now_ns) == ""
    run.step(65.0)
    assert run.at(Phase.DONE)
    assert run.mission.wish(Order.DISARM, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    assert run.at(Phase.DONE)  # what was done stays done


def test_the_reason_why_a_run_failed_is_not_lost_for_a_refusal() -> None:
    run = running()
    run.robots[2].mode, run.robots[2].fault, run.robots[2].refuses = Mode.FAULT, "no pose", frozenset({Order.DISARM})
    run.robots[1].refuses = frozenset({Order.DISARM})
    run.step(1.0)
    run.robots[1].refuses = frozenset()
    run.step(1.0)
    assert run.at(Phase.FAILED)
    assert run.mission.reason == "robot 2: fault (no pose)"


@pytest.mark.parametrize(("order", "ends_in"), [(Order.DISARM, Phase.ENDING), (Order.CLEAR_STOP, Phase.CLEARING)])
def test_a_robot_that_was_never_heard_has_not_done_as_told(order: Order, ends_in: Phase) -> None:
    run = Run(automatic=False)
    run.robots[2].unknown = True
    run.step(0.2)
    assert run.mission.wish(order, run.fleet(), run.now_ns) == ""
    run.step(PATIENCE_S - 1.0)
    assert run.at(ends_in)
    run.step(2.0)
    assert run.at(Phase.ABORTING)
    run.step(PATIENCE_S - 2.0)
    assert run.at(Phase.ABORTING)
    run.step(3.0)
    assert run.at(Phase.FAILED)
    assert f"robot 2 does not follow {order.name}" in run.mission.reason


def test_what_a_robot_told_before_it_was_asked_says_nothing() -> None:
    """Its last word was that it is disarmed; then it was armed, and not heard any more."""
    run = Run(automatic=False)
    run.step(0.2)
    run.robots[2].silent = True
    assert run.mission.wish(Order.DISARM, run.fleet(), run.now_ns) == ""
    run.step(5.0)
    assert run.at(Phase.ENDING)
    run.robots[2].silent = False
    run.step(0.2)
    assert run.at(Phase.CANCELLED)


def test_a_robot_that_takes_an_arm_after_it_was_last_heard_is_disarmed_all_the_same() -> None:
    """Its last state is from before; whoever took that for done would leave an armed robot behind."""
    run = Run(automatic=False)
    assert run.mission.wish(Order.ARM, run.fleet(), run.now_ns) == ""
    while not run.in_mode(2, Mode.ARMED):
        run.step()
    before = run.fleet()
    assert run.in_mode(2, Mode.ARMED) and run.mission.wish(Order.DISARM, before, run.now_ns) == ""
    disarmed = {r: replace(seen, state=replace(seen.state, mode=Mode.DISARMED)) for r, seen in before.items() if seen.state}
    orders = run.mission.step(disarmed, (), run.now_ns + 10_000_000)
    assert [(c.order, c.robot) for c in orders] == [(Order.DISARM, 1), (Order.DISARM, 2)]
    assert run.at(Phase.ENDING)


def test_what_a_robot_tells_of_an_earlier_thruster_test_is_not_the_result_of_this_one() -> None:
    run = Run(automatic=False)
    for robot in run.robots.values():
        robot.test, robot.age_s = "passed", 0.2
    assert run.mission.wish(Order.TEST, run.fleet(), run.now_ns) == ""
    while not run.at(Phase.TESTING):
        run.step()
    run.step(0.2)
    assert run.at(Phase.TESTING)
    for robot in run.robots.values():
        robot.test, robot.age_s = "thruster 3 does not turn", 0.02
    while not run.at(Phase.TEST_ENDING):
        run.step()
    assert run.mission.reason.startswith("robot 1: thruster 3 does not turn")


@pytest.mark.parametrize("order", [Order.START, Order.RESUME])
def test_who_does_not_begin_to_fly_with_the_others_is_waited_for_only_briefly(order: Order) -> None:
    run = running(automatic=False) if order is Order.RESUME else Run(automatic=False, settings=["duration_s=60"])
    if order is Order.RESUME:
        assert run.mission.wish(Order.HOLD, run.fleet(), run.now_ns) == ""
        run.step(0.5)
    run.robots[2].refuses = frozenset({order})
    assert run.mission.wish(order, run.fleet(), run.now_ns) == ""
    while not run.in_mode(1, Mode.TRACKING):
        run.step()
    run.step(3.0)
    assert run.mission.phase in (Phase.STARTING, Phase.RESUMING)
    run.step(1.0)
    assert Phase.ABORTING in run.phases and f"robot 2 refuses {order.name}: I refuse" in run.mission.reason
    assert {r.mode for r in run.robots.values()} == {Mode.DISARMED}


def test_a_formation_on_its_way_home_is_not_sent_elsewhere() -> None:
    run = on_the_way_to_a_plan("abort", Phase.RELEASING)
    for robot in run.robots.values():
        robot.refuses = frozenset()
    while not run.at(Phase.RUNNING):
        run.step()
    assert "on their way back" in run.mission.wish(Order.GO, run.fleet(), run.now_ns, [(0.5, 0.5)])


def test_who_held_on_a_way_of_their_own_that_is_blocked_now_get_another_one() -> None:
    run = running([STRAIGHT, "duration_s=20"], automatic=False)
    assert run.mission.wish(Order.RETURN, run.fleet(), run.now_ns) == ""
    run.step(0.2)
    eta = np.zeros((200, 4))
    eta[:, 0] = np.linspace(-1.0, 1.0, 200)
    leg = next_leg(run, 3.0)
    run.mission.planned(
        replace(leg, trajectories={r: replace(t, eta=eta) for r, t in leg.trajectories.items()}, home=True, end_s=13.0),
        run.fleet(),
        run.now_ns,
    )
    for robot in run.robots.values():
        robot.eta = (-1.0, 0.0, 0.0, 0.0)
    run.step(2.0)
    assert run.at(Phase.RETURNING)
    assert run.mission.wish(Order.HOLD, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    run.mission.itinerary.lookout.see(Surroundings((1,), np.array([[0.5, 0.0, 0.1]])), run.now_ns)
    assert run.mission.wish(Order.RESUME, run.fleet(), run.now_ns) == ""
    assert run.at(Phase.HALTING) and run.mission.itinerary.heads_home


def test_a_robot_that_was_carried_off_while_it_held_is_led_back_before_all_go_on() -> None:
    run = running(automatic=False)
    assert run.mission.wish(Order.HOLD, run.fleet(), run.now_ns) == ""
    run.robots[2].eta = (0.0, 1.1, 0.0, 0.0)
    run.step(0.5)
    assert run.mission.wish(Order.RESUME, run.fleet(), run.now_ns) == ""
    assert run.at(Phase.HALTING) and run.mission.reason == "robot 2 is 1.10 m from its place"
    assert all(Order.RESUME not in [c.order for c in robot.got] for robot in run.robots.values())


# --- after an emergency stop


def test_a_stop_is_not_cleared_while_a_robot_flies_that_it_has_not_reached() -> None:
    run = running(automatic=False)
    run.robots[2].refuses = frozenset({Order.STOP})
    assert run.mission.wish(Order.STOP, run.fleet(), run.now_ns) == ""
    run.step(0.1)
    assert run.mission.wish(Order.CLEAR_STOP, run.fleet(), run.now_ns) == "robot 2 has not stopped yet (TRACKING)"
    assert run.at(Phase.STOPPED)
    run.robots[2].refuses = frozenset()
    run.step(0.5)
    assert run.mission.wish(Order.CLEAR_STOP, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    assert run.at(Phase.WAITING) and {r.mode for r in run.robots.values()} == {Mode.DISARMED}


def test_a_robot_that_is_heard_again_and_flies_while_a_stop_is_cleared_is_disarmed() -> None:
    run = running(automatic=False)
    run.robots[2].silent = True
    assert run.mission.wish(Order.STOP, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    assert run.mission.wish(Order.CLEAR_STOP, run.fleet(), run.now_ns) == ""
    run.step(0.2)
    assert run.at(Phase.CLEARING)
    run.robots[2].silent = False
    run.step(0.5)
    assert run.at(Phase.FAILED) and run.mission.reason == "robot 2 has not stopped: it is TRACKING"
    assert {r.mode for r in run.robots.values()} == {Mode.DISARMED}


def test_a_stop_that_is_cleared_before_robots_have_told_of_it_is_cleared_on_each() -> None:
    """They say that they are disarmed, which was so before the STOP that is on its way."""
    run = Run(automatic=False)
    run.step(0.2)
    before = run.fleet()
    assert run.mission.wish(Order.STOP, before, run.now_ns) == ""
    assert run.mission.wish(Order.CLEAR_STOP, before, run.now_ns) == ""
    orders = run.mission.step(before, (), run.now_ns + 10_000_000)
    assert [(c.order, c.robot) for c in orders] == [(Order.CLEAR_STOP, 1), (Order.CLEAR_STOP, 2)]
    assert run.at(Phase.CLEARING)


def test_a_thruster_test_after_a_cleared_stop_does_not_begin_an_automatic_mission() -> None:
    run = running()
    assert run.mission.wish(Order.STOP, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    assert run.mission.wish(Order.CLEAR_STOP, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    assert run.mission.wish(Order.TEST, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    for robot in run.robots.values():
        robot.test = "passed"
    run.step(3.0)
    assert run.at(Phase.WAITING) and run.phases[-2] is Phase.TEST_ENDING
    assert {r.mode for r in run.robots.values()} == {Mode.DISARMED}


# --- home


def test_nobody_is_armed_for_the_way_home_who_may_not_be_armed_at_all() -> None:
    run = Run(automatic=False, settings=["mission.thruster_test=true"])
    run.step(0.2)
    untested = "thruster test: not done (groundstation order test)"
    refused = f"no robot is fit to move; robot 1: {untested}; robot 2: {untested}"
    assert run.mission.wish(Order.RETURN, run.fleet(), run.now_ns) == refused
    assert run.at(Phase.WAITING)
    run.robots[1].test, run.robots[1].eta = "passed", (0.9, 0.9, 0.0, 0.0)  # far from its start: that is why it returns
    assert run.mission.wish(Order.RETURN, run.fleet(), run.now_ns) == ""
    assert run.mission.crew.out == {2: untested}
    run.step(0.5)
    run.mission.planned(replace(next_leg(run, 0.05), home=True), run.fleet(), run.now_ns)
    run.step(2.0)
    assert run.at(Phase.RETURNING)
    assert run.in_mode(1, Mode.TRACKING) and run.in_mode(2, Mode.DISARMED)


# --- links that lose one way


@pytest.mark.parametrize("policy", ["hold", "go-on", "close-up"])
def test_a_lost_robot_that_still_hears_is_told_to_hold_though_nothing_that_it_says_arrives(policy: str) -> None:
    run = three_running(policy)
    told = run.robots[2].view()
    run.robots[2].silent = run.robots[2].hears = True
    run.robots[2].view = lambda: replace(told, state_age_s=9.0)  # type: ignore[method-assign]  # its last word: TRACKING
    run.step(0.5)
    assert run.mission.crew.out == {2: "silent"}
    assert run.in_mode(2, Mode.HOLDING)


def test_a_lost_robot_that_still_hears_is_disarmed_with_the_others() -> None:
    run = three_running("go-on")
    told = run.robots[2].view()
    run.robots[2].silent = run.robots[2].hears = True
    run.robots[2].view = lambda: replace(told, state_age_s=9.0)  # type: ignore[method-assign]
    run.step(0.5)
    assert run.mission.wish(Order.DISARM, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    assert run.at(Phase.CANCELLED)  # nobody waits for it
    assert run.in_mode(2, Mode.DISARMED)


def test_a_robot_that_was_out_of_the_run_comes_home_after_it_though_the_others_cannot() -> None:
    run = three_running("go-on")
    run.robots[2].mode, run.robots[2].fault = Mode.FAULT, "no pose"
    run.step(0.5)
    assert run.mission.wish(Order.DISARM, run.fleet(), run.now_ns) == ""
    run.step(1.0)
    assert run.at(Phase.CANCELLED) and set(run.mission.crew.out) == {2}
    run.robots[2].fault = ""
    for robot in (1, 3):
        run.robots[robot].battery_v = 10.0
    assert run.mission.wish(Order.RETURN, run.fleet(), run.now_ns) == ""
    assert set(run.mission.crew.out) == {1, 3}


def test_a_robot_far_from_its_place_slows_the_formation() -> None:
    run = Run(settings=["duration_s=60", "mission.wait_from_m=0.1", "mission.wait_at_m=0.4"])
    while not run.at(Phase.RUNNING):
        run.step()
    run.robots[2].eta = (0.35, 0.0, 0.0, 0.0)
    run.step(1.5)
    assert run.at(Phase.SLOWED) and run.mission.reason == "robot 2 is 0.35 m from its place"
