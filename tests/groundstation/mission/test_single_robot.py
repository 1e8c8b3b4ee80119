"""Requests for one robot, beside a mission of obedient robots."""

import math
from dataclasses import replace

import numpy as np
import pytest

from groundstation.mission.command_dispatcher import CommandResult
from groundstation.mission.single_robot import VELOCITY_LASTS_S, SingleRobotControl
from groundstation.mission.state_machine import MissionState
from groundstation.planning.feasibility import PlanError
from groundstation.telemetry import RobotView
from shoal.messages.messages import CommandKind, DriveVelocity, Mode, Progress, required
from tests.groundstation.mission.mission_run import MissionRun

AHEAD = DriveVelocity(surge_mps=0.2)
SETTINGS = ("duration_s=20", 'mission.lost="go-on"')


class LedRun(MissionRun):
    """A mission whose robots can be led one by one; robot 2 stands 0.8 m beside robot 1."""

    def __init__(self, *more: str) -> None:
        super().__init__(automatic=False, settings=(*SETTINGS, *more))
        self.single = SingleRobotControl(self.experiment, self.mission)
        self.robots[1].eta, self.robots[2].eta = (-0.4, 0.0, 0.3, 0.0), (0.4, 0.0, 0.3, 0.0)
        self.for_one: list[CommandResult] = []
        self.plan_takes_s, self.planning_s = 0.0, 0.0
        self.nu: dict[int, tuple[float, float, float, float]] = {}  # of robots that do not rest
        self.stuck: set[int] = set()  # robots that something keeps from following their trajectories

    def fleet(self) -> dict[int, RobotView]:
        views = super().fleet()
        for robot, nu in self.nu.items():
            state = views[robot].state
            assert state is not None
            estimate = replace(required(state.estimate), nu=np.array(nu))
            views[robot] = replace(views[robot], state=replace(state, estimate=estimate))
        return views

    def step(self, seconds: float = 0.05) -> None:
        for _ in range(round(seconds / 0.05)):
            super().step()
            for robot, (trajectory, _) in self.single.trips.items():
                if self.in_mode(robot, Mode.TRACKING) and robot not in self.stuck:
                    k = round((self.robots[robot].trajectory_s - trajectory.begin_s) / trajectory.period_s)
                    x_m, y_m, depth_m, yaw_rad = trajectory.eta[min(max(k, 0), len(trajectory.eta) - 1)].tolist()
                    self.robots[robot].eta = (x_m, y_m, depth_m, yaw_rad)
            self.planning_s += 0.05 if self.single.plan_request is not None else -self.planning_s
            if self.single.plan_request is not None and self.planning_s > self.plan_takes_s:
                self.planning_s = 0.0
                self.single.planned(self.single.plan_request.plan(), self.fleet(), self.now_ns)
            commands = self.single.step(self.fleet(), self.for_one, self.now_ns)
            self.for_one = [CommandResult(c, self.robots[c.robot].obey(c, self.now_ns)) for c in commands]

    def ask(self, order: CommandKind, robot: int = 2, place_m: tuple[float, float] | None = None) -> str:
        return self.single.request(order, robot, self.fleet(), self.now_ns, place_m)

    def drive(self, velocity: DriveVelocity = AHEAD, robot: int = 2) -> str:
        return self.single.drive(robot, velocity, self.fleet(), self.now_ns)

    def fly(self) -> None:
        assert self.mission.request(CommandKind.START, self.fleet(), self.now_ns) == ""
        self.step(2.0)
        assert self.at(MissionState.RUNNING)

    def got(self, robot: int) -> list[CommandKind]:
        return [command.order for command in self.robots[robot].got]


def test_one_robot_is_armed_held_driven_and_disarmed_while_the_mission_waits() -> None:
    run = LedRun()
    for order, mode in ((CommandKind.ARM, Mode.ARMED), (CommandKind.HOLD, Mode.HOLDING)):
        assert run.ask(order) == ""
        run.step(0.2)
        assert run.in_mode(2, mode)
        assert run.single.tasks[2].progress is Progress.DONE
    assert run.drive() == ""
    run.step(0.1)
    assert run.in_mode(2, Mode.DRIVEN)
    assert run.single.status() == {2: "driven"}
    refused = run.mission.request(CommandKind.START, run.fleet(), run.now_ns)
    assert refused == "robot 2 is led by a person: let it hold first"
    assert run.ask(CommandKind.DISARM) == ""
    run.step(0.2)
    assert run.in_mode(2, Mode.DISARMED)
    assert run.got(1) == []
    assert run.at(MissionState.WAITING)


def test_a_state_that_comes_late_confirms_a_request_that_was_made_before_it_was_sent() -> None:
    run = LedRun()
    assert run.ask(CommandKind.ARM) == ""
    run.robots[2].age_s = 0.4  # too old to count as heard
    progress = []
    for _ in range(2):
        run.step(0.3)
        progress.append(run.single.tasks[2].progress)
    assert progress == [Progress.UNDER_WAY, Progress.DONE]


def test_a_robot_that_restarts_before_anybody_hears_that_it_was_armed_is_not_armed_again() -> None:
    run = LedRun()
    assert run.ask(CommandKind.ARM) == ""
    while run.robots[2].mode is not Mode.ARMED:
        run.step()
    run.robots[2].mode = Mode.DISARMED
    run.step(1.0)
    assert run.got(2).count(CommandKind.ARM) == 1 and run.in_mode(2, Mode.DISARMED)
    assert run.single.tasks[2].reason == "robot 2 is DISARMED again"


def test_a_robot_that_has_failed_or_was_armed_meanwhile_is_not_sent_arm() -> None:
    """Restarted, it would be armed by a request made before."""
    for mode in (Mode.FAULT, Mode.STOPPED, Mode.TRACKING):
        run = LedRun()
        run.robots[2].refuses = frozenset({CommandKind.ARM})
        assert run.ask(CommandKind.ARM) == ""
        run.step(0.2)
        run.robots[2].mode, tries = mode, run.got(2).count(CommandKind.ARM)
        run.step(1.0)
        assert run.got(2).count(CommandKind.ARM) == tries


def test_a_velocity_that_is_not_repeated_ends_in_a_hold() -> None:
    run = LedRun()
    run.ask(CommandKind.ARM)
    run.step(0.2)
    run.drive()
    run.step(VELOCITY_LASTS_S)
    sent = [command for command in run.robots[2].got if command.order is CommandKind.DRIVE]
    assert sent and all(command.time_to_live_s <= VELOCITY_LASTS_S for command in sent)
    run.step(0.2)
    assert run.in_mode(2, Mode.HOLDING)
    assert run.got(2)[-1] is CommandKind.HOLD
    run.step(1.0)
    assert run.single.led == frozenset()


def test_a_zero_velocity_is_a_hold_and_of_a_robot_that_is_not_driven_nothing() -> None:
    run = LedRun()
    assert run.drive(DriveVelocity()) == ""
    run.ask(CommandKind.ARM)
    run.step(0.2)
    run.drive()
    run.step(0.2)
    assert run.drive(DriveVelocity()) == ""
    run.step(0.1)
    assert run.in_mode(2, Mode.HOLDING)


def test_a_robot_led_in_flight_leaves_the_formation_and_the_other_flies_on() -> None:
    run = LedRun()
    run.fly()
    assert run.drive() == ""
    run.step(0.5 * VELOCITY_LASTS_S)
    run.drive()
    run.step(0.5 * VELOCITY_LASTS_S)
    assert run.in_mode(2, Mode.DRIVEN)
    assert run.in_mode(1, Mode.TRACKING)
    assert run.mission.roster.lost == {2: "led by a person"}
    assert run.at(MissionState.DEGRADED)
    assert run.ask(CommandKind.HOLD, robot=1) == "robot 1 is the only one that flies: hold or disarm the fleet instead"
    run.step(1.0)
    assert run.in_mode(2, Mode.HOLDING)
    assert run.mission.request(CommandKind.REJOIN, run.fleet(), run.now_ns) == ""
    assert run.mission.roster.lost == {}


@pytest.mark.parametrize("begins", [MissionState.SWITCHING, MissionState.RETURNING])
def test_a_robot_is_led_on_while_the_formation_takes_another_path_or_flies_home(begins: MissionState) -> None:
    run = LedRun()
    run.fly()
    for k in range(12):
        assert run.drive() == ""
        run.step(0.1)
        if k == 2:
            run.mission.plans.deadline_s = math.inf
            run.mission.state = begins  # as by itself: an obstacle lies on the path, or the plan leads home
    assert run.in_mode(2, Mode.DRIVEN) and run.single.tasks[2].progress is Progress.UNDER_WAY
    run.drive(DriveVelocity())
    run.step(0.3)
    task = run.single.tasks[2]  # what type checkers know of it is of before
    assert run.in_mode(2, Mode.HOLDING) and task.progress is Progress.DONE
    assert run.at(begins) and run.in_mode(1, Mode.TRACKING)


def test_a_robot_led_while_all_hold_keeps_its_place_in_the_formation() -> None:
    run = LedRun()
    run.fly()
    run.mission.request(CommandKind.HOLD, run.fleet(), run.now_ns)
    run.step(0.5)
    assert run.drive() == ""
    run.step(0.2)
    assert run.in_mode(2, Mode.DRIVEN)  # the paused mission does not call it back
    assert run.mission.roster.lost == {}
    assert "robot 2 does not hold yet" in run.mission.request(CommandKind.RESUME, run.fleet(), run.now_ns)
    run.step(1.0)
    assert run.mission.request(CommandKind.RESUME, run.fleet(), run.now_ns) == ""


def test_a_stop_of_the_fleet_ends_what_one_robot_does() -> None:
    run = LedRun()
    run.ask(CommandKind.ARM)
    run.step(0.2)
    run.drive()
    run.step(0.1)
    run.mission.request(CommandKind.STOP, run.fleet(), run.now_ns)
    run.step(0.2)
    assert run.in_mode(2, Mode.STOPPED)
    assert run.single.tasks[2].reason == "the mission is emergency stop"
    assert "not possible when STOPPED" in run.drive()
    run.step(1.0)
    assert run.in_mode(2, Mode.STOPPED)


def test_a_robot_sent_to_a_place_holds_plans_flies_and_holds_there() -> None:
    run = LedRun()
    run.ask(CommandKind.ARM)
    run.step(0.2)
    assert run.ask(CommandKind.GO, place_m=(0.5, 0.8)) == ""
    run.step(1.0)
    assert run.got(2) == [CommandKind.ARM, CommandKind.HOLD, CommandKind.LOAD, CommandKind.START]
    trajectory, end_s = run.single.trips[2]
    assert trajectory.eta[-1, :2] == pytest.approx((0.5, 0.8), abs=1e-3)
    assert run.single.status() == {2: "on its way to 0.50, 0.80 m"}
    run.robots[2].trajectory_s = end_s
    run.step(0.2)
    assert run.in_mode(2, Mode.HOLDING)
    assert run.single.tasks[2].progress is Progress.DONE
    assert run.got(1) == []


def test_a_robot_of_unknown_place_is_not_taken_to_be_in_the_pools_middle() -> None:
    """It was never heard, or says that it does not know where it is while no camera sees it."""
    run = LedRun()
    for order in (CommandKind.ARM, CommandKind.HOLD):
        assert run.ask(order) == ""
        run.step(0.2)
    view_of_1 = run.fleet()[1]
    lost = replace(view_of_1, state=replace(required(view_of_1.state), estimate=None), pose=None)
    for view in (RobotView(), lost):
        fleet = run.fleet() | {1: view}
        assert run.single.request(CommandKind.GO, 2, fleet, run.now_ns, (0.0, 0.0)) == ""
        assert run.mission.plans.monitor.discs_to_avoid([view]).shape == (0, 3)
    assert "from robot 1" in run.ask(CommandKind.GO, place_m=(-0.4, 0.0))


def test_a_robot_that_lags_may_come_up_and_one_that_something_keeps_away_has_not_arrived() -> None:
    """A robot that yields to another has no fault, and its clock goes on."""
    run = LedRun()
    run.ask(CommandKind.ARM)
    run.step(0.2)
    assert run.ask(CommandKind.GO, place_m=(0.5, 0.8)) == ""
    run.step(1.0)
    run.stuck, run.nu[2] = {2}, (0.05, 0.0, 0.0, 0.0)
    _, end_s = run.single.trips[2]
    run.robots[2].trajectory_s = end_s - 4.0
    run.step(3.5)
    assert run.in_mode(2, Mode.TRACKING)
    run.step(1.0)
    assert run.in_mode(2, Mode.HOLDING)
    assert run.single.tasks[2].progress is Progress.FAILED
    away_m = math.dist(run.robots[2].eta[:2], (0.5, 0.8))
    assert run.single.tasks[2].reason == f"robot 2 holds {away_m:.2f} m from there"


def test_two_robots_that_are_sent_away_wait_for_plans_longer_than_for_an_answer() -> None:
    """A robot that rocks in waves counts as resting after 8 s only; the station allows 15 s for a plan, and makes one at a
    time."""
    run = LedRun()
    for robot in (1, 2):
        run.ask(CommandKind.ARM, robot)
    run.step(0.2)
    assert run.ask(CommandKind.GO, 1, (-0.5, -0.8)) == run.ask(CommandKind.GO, 2, (0.5, 0.8)) == ""
    run.nu[2] = (0.05, 0.0, 0.0, 0.0)
    run.plan_takes_s = 9.0
    run.step(18.5)
    assert run.single.tasks[1].transfer is not None and run.single.plan_request is not None
    run.step(12.0)
    assert run.single.tasks[2].transfer is not None, run.single.tasks[2].reason
    assert Progress.FAILED not in {task.progress for task in run.single.tasks.values()}


def test_requests_that_cannot_be_are_refused_with_the_reason() -> None:
    run = LedRun()
    assert "robot 2 is DISARMED: arm it first" in run.drive()
    assert "no robot 7" in run.ask(CommandKind.ARM, robot=7)
    assert "start is not for one robot (allowed: arm, hold, disarm, go, out, back-in)" in run.ask(CommandKind.START)
    run.robots[2].battery_v = 10.0
    assert "battery 10.0 V" in run.ask(CommandKind.ARM)
    run.robots[2].battery_v = 12.0
    run.ask(CommandKind.ARM)
    run.step(0.2)
    assert "where to?" in run.ask(CommandKind.GO)
    assert "(9, 0) m is outside the pool" in run.ask(CommandKind.GO, place_m=(9.0, 0.0))
    assert "less than 0.6 m from robot 1" in run.ask(CommandKind.GO, place_m=(0.1, 0.0))
    run.robots[2].silent = True
    assert "robot 2 is not heard" in run.drive()


def test_a_robot_that_holds_on_its_way_fails_the_request_with_its_reason() -> None:
    run = LedRun()
    run.ask(CommandKind.ARM)
    run.step(0.2)
    run.ask(CommandKind.GO, place_m=(0.5, 0.8))
    run.step(1.5)
    assert run.in_mode(2, Mode.TRACKING)
    run.robots[2].mode, run.robots[2].fault = Mode.HOLDING, "pose late"
    run.step(0.1)
    task = run.single.tasks[2]
    assert (task.progress, task.reason) == (Progress.FAILED, "robot 2 holds: pose late")


def test_a_hold_of_the_fleet_holds_a_robot_that_is_led_alone() -> None:
    run = LedRun()
    run.fly()
    run.ask(CommandKind.GO, place_m=(0.5, 1.0))
    run.step(2.0)
    assert run.in_mode(2, Mode.TRACKING)
    assert run.mission.request(CommandKind.HOLD, run.fleet(), run.now_ns) == ""
    run.step(0.5)
    assert {robot.mode for robot in run.robots.values()} == {Mode.HOLDING}
    assert run.single.tasks[2].progress is Progress.FAILED


def test_a_trip_of_its_own_is_no_progress_of_the_formation() -> None:
    run = LedRun()
    run.fly()
    run.mission.request(CommandKind.HOLD, run.fleet(), run.now_ns)
    run.step(0.5)
    held_s = run.mission.plans.progress_s
    for robot, place_m in ((2, (0.5, 1.0)), (1, (-0.5, -1.0))):
        assert run.ask(CommandKind.GO, robot, place_m) == ""
        while robot in run.single.led:
            run.step(0.5)
        assert run.robots[robot].trajectory_s > held_s
        run.robots[robot].eta = (*place_m, 0.3, 0.0)
    assert run.mission.plans.progress_s == held_s
    assert run.mission.request(CommandKind.RESUME, run.fleet(), run.now_ns) == ""
    assert "has another plan" in run.mission.reason


def test_another_request_ends_a_task_and_tells_it_so() -> None:
    """A terminal sends robot 2 somewhere; at the page somebody drives it, and lets go."""
    run = LedRun()
    run.ask(CommandKind.ARM)
    run.step(0.2)
    run.ask(CommandKind.GO, place_m=(0.5, 0.8))
    sent = run.single.tasks[2]
    run.step(2.0)
    assert run.drive() == ""
    run.step(2.0)
    assert (sent.progress, sent.reason) == (Progress.FAILED, "drive was asked for instead")
    driven = run.single.tasks[2]
    assert (driven.order, driven.progress) == (CommandKind.DRIVE, Progress.DONE)
    assert run.in_mode(2, Mode.HOLDING)


def test_a_drive_that_was_ended_by_a_hold_goes_on_only_after_letting_go() -> None:
    run = LedRun()
    run.ask(CommandKind.ARM)
    run.step(0.2)
    run.drive()
    run.step(0.1)
    assert run.ask(CommandKind.HOLD) == ""
    for _ in range(10):  # the key is still held down
        assert run.drive() == "hold was asked for instead: let go first"
        run.step(0.1)
    assert run.in_mode(2, Mode.HOLDING)
    assert run.single.tasks[2].progress is Progress.DONE
    assert run.drive(DriveVelocity()) == ""
    assert run.drive() == ""


def test_a_robot_whose_task_has_failed_in_flight_is_held() -> None:
    """Its states do not arrive for a moment; then it is heard again, flying, and the mission waits for the fleet."""
    run = LedRun()
    run.ask(CommandKind.ARM)
    run.step(0.2)
    run.ask(CommandKind.GO, place_m=(0.5, 0.8))
    run.step(1.5)
    assert run.in_mode(2, Mode.TRACKING)
    run.robots[2].silent = True
    run.step(0.2)
    run.robots[2].silent = False
    assert run.single.tasks[2].progress is Progress.FAILED
    run.step(0.5)
    assert run.at(MissionState.WAITING)
    assert run.in_mode(2, Mode.HOLDING)


def test_a_formation_that_makes_itself_a_new_plan_ends_no_request_for_the_robot_that_left_it() -> None:
    run = LedRun('path={kind="waypoints",points_m=[[0.0,0.0],[0.6,0.0],[0.6,0.4]],speed_mps=0.1,depth_m=0.3}')
    run.fly()
    assert run.ask(CommandKind.DISARM) == ""
    run.mission.step(run.fleet(), (), run.now_ns)
    assert run.mission.request(CommandKind.GO, run.fleet(), run.now_ns, [(0.5, 0.5)]) == ""
    assert run.at(MissionState.SWITCHING)
    run.step(0.2)
    assert run.in_mode(2, Mode.DISARMED)
    assert run.single.tasks[2].progress is Progress.DONE


@pytest.mark.parametrize("lost", ["go-on", "abort"])
def test_a_disarm_that_the_missions_own_overtakes_is_done_with_it(lost: str) -> None:
    run = LedRun(f'mission.lost="{lost}"')
    run.fly()
    assert run.ask(CommandKind.DISARM) == ""
    run.robots[1].silent = lost == "abort"
    if lost == "go-on":
        assert run.mission.request(CommandKind.DISARM, run.fleet(), run.now_ns) == ""
    run.step()
    assert run.at(MissionState.ABORTING if lost == "abort" else MissionState.ENDING)
    run.step(0.5)
    assert run.in_mode(2, Mode.DISARMED)
    assert (run.single.tasks[2].progress, run.single.tasks[2].reason) == (Progress.DONE, "")


def test_a_robot_that_is_led_alone_holds_when_its_poses_are_another_experiments() -> None:
    run = LedRun()
    assert run.ask(CommandKind.ARM) == ""
    run.step(0.2)
    assert run.drive() == ""
    run.step(0.2)
    assert run.in_mode(2, Mode.DRIVEN)
    run.robots[2].localizer_hash = "another one"
    run.step(0.2)
    assert run.in_mode(2, Mode.HOLDING) and run.single.tasks[2].progress is Progress.FAILED
    for refused in (run.drive(), run.ask(CommandKind.GO, place_m=(1.0, 0.5))):
        assert refused.startswith("robot 2: its poses are by another experiment")
    assert run.ask(CommandKind.DISARM) == ""


@pytest.mark.parametrize(("policy", "mode"), [("hold", Mode.HOLDING), ("warn", Mode.TRACKING)])
def test_a_robot_that_is_sent_alone_holds_while_obstacles_cannot_be_seen(policy: str, mode: Mode) -> None:
    """Its person has sent it away and does not steer; one who drives a robot looks at the water."""
    run = LedRun(f'mission.blind="{policy}"')
    assert run.ask(CommandKind.ARM) == ""
    run.step(0.2)
    assert run.ask(CommandKind.GO, place_m=(1.5, 0.5)) == ""
    run.step(2.0)
    assert run.in_mode(2, Mode.TRACKING)
    run.robots[2].blind = "nobody tells of obstacles any more"
    run.step(0.5)
    assert run.in_mode(2, mode)
    if policy == "hold":
        assert run.single.tasks[2].reason == "robot 2 blind: nobody tells of obstacles any more"
        assert run.ask(CommandKind.GO, place_m=(1.5, 0.5)).startswith("robot 2 blind")
        assert run.drive() == ""
        run.robots[2].blind = ""
        assert run.ask(CommandKind.GO, place_m=(1.5, 0.5)) == ""


# --- every way in which a task ends or is refused


def test_a_repeated_request_is_the_same_task_and_a_robot_may_be_taken_out_while_it_is_disarmed() -> None:
    run = LedRun()
    assert run.ask(CommandKind.DISARM) == ""
    task = run.single.tasks[2]
    assert run.ask(CommandKind.DISARM) == "" and run.single.tasks[2] is task and run.single.led == {2}
    assert run.ask(CommandKind.OUT) == ""
    assert (task.progress, task.reason) == (Progress.FAILED, "out was asked for instead")
    assert run.single.tasks[2].progress is Progress.DONE and run.single.led == frozenset()
    assert run.ask(CommandKind.OUT) == "robot 2 is out of the water"
    assert run.ask(CommandKind.OUT, robot=1) == "robot 1 is the last one in the water"
    assert run.ask(CommandKind.BACK_IN) == "" and run.ask(CommandKind.BACK_IN) == "robot 2 is not out of the water"
    assert run.ask(CommandKind.OUT, robot=1) == ""


@pytest.mark.parametrize(
    ("silent", "says"), [(False, "robot 2 refuses ARM: I refuse"), (True, "has not answered ARM: no answer")]
)
def test_a_task_that_a_robot_does_not_do_fails_in_the_end_with_its_last_word(silent: bool, says: str) -> None:
    run = LedRun()
    assert run.ask(CommandKind.ARM) == ""
    run.robots[2].refuses, run.robots[2].silent = frozenset({CommandKind.ARM}), silent
    run.step(9.9)
    task = run.single.tasks[2]
    assert run.single.led == {2} and run.single.status()[2].startswith("arming: ")
    run.step(0.3)
    assert task.progress is Progress.FAILED and says in task.reason and run.single.led == frozenset()


def test_a_task_of_a_robot_that_accepts_and_does_nothing_fails_with_its_mode() -> None:
    run = LedRun()
    run.ask(CommandKind.ARM)
    run.step(0.2)
    run.ask(CommandKind.HOLD)
    for _ in range(103):
        run.robots[2].mode = Mode.ARMED  # whatever it said
        run.single.step(run.fleet(), (), run.now_ns)
        run.now_ns += 100_000_000
    assert (run.single.tasks[2].progress, run.single.tasks[2].reason) == (Progress.FAILED, "robot 2 is ARMED")


def test_a_driven_robot_that_fails_ends_its_drive_and_one_that_flies_holds_first() -> None:
    run = LedRun()
    run.ask(CommandKind.ARM)
    run.step(0.2)
    run.drive()
    assert run.got(2) == [CommandKind.ARM]
    run.step(0.05)
    assert run.got(2)[-1] is CommandKind.HOLD, "armed robots hold before they are driven"
    run.step(0.1)
    run.robots[2].mode = Mode.FAULT
    run.step(0.05)
    assert run.single.tasks[2].reason == "robot 2 is FAULT" and run.single.led == frozenset()


def test_a_robot_for_which_there_is_no_way_is_told_so_and_one_that_fails_meanwhile() -> None:
    run = LedRun()
    run.ask(CommandKind.ARM)
    run.step(0.2)
    run.plan_takes_s = 99.0
    assert run.ask(CommandKind.GO, place_m=(0.5, 0.8)) == "" and run.single.status() == {2: "on its way to 0.50, 0.80 m"}
    run.step(0.3)
    request = run.single.plan_request
    assert request is not None
    run.single.planned(PlanError("an island"), run.fleet(), run.now_ns)
    assert run.single.tasks[2].reason == "no way there: an island" and run.single.plan_request is None
    assert run.ask(CommandKind.GO, place_m=(0.5, 0.8)) == ""
    run.step(0.3)
    assert run.ask(CommandKind.HOLD) == ""
    run.single.planned(PlanError("late"), run.fleet(), run.now_ns)
    assert run.single.tasks[2].order is CommandKind.HOLD and run.single.tasks[2].reason == "", "a plan that nobody wants"
    run.step(0.2)
    assert run.ask(CommandKind.GO, place_m=(0.5, 0.8)) == ""
    run.robots[2].silent = True
    run.step(0.1)
    assert run.single.tasks[2].reason == "robot 2 is not heard"


def test_the_status_of_a_led_robot_says_what_it_does() -> None:
    run = LedRun()
    run.ask(CommandKind.ARM)
    assert run.single.status() == {2: "arming"}
    run.step(0.2)
    assert run.single.status() == {}
    run.drive()
    run.step(0.1)
    run.drive(DriveVelocity())
    assert run.single.status() == {2: "coming to rest"}
    run.step(0.2)
    run.ask(CommandKind.DISARM)
    assert run.single.status() == {2: "disarming"}


@pytest.mark.parametrize(
    ("place_m", "says"),
    [
        (None, "where to"),
        ((1.0, 1.5), ""),
        ((1.0, -1.501), "outside the pool"),
        ((2.001, 1.0), "outside the pool"),
        ((-2.0, 1.0), ""),
        ((-0.4, 0.6), ""),
        ((-0.4, 0.599), "less than 0.6 m from robot 1"),
    ],
)
def test_a_place_is_in_the_pool_and_clear_of_the_other_robots(place_m: tuple[float, float] | None, says: str) -> None:
    run = LedRun("pool.size_m=[4.0, 3.0, 1.2]")
    run.ask(CommandKind.ARM)
    run.step(0.2)
    reason = run.ask(CommandKind.GO, place_m=place_m)
    assert says in reason and bool(reason) is bool(says)
