"""Orders about trajectories: every refusal by name, starts taken late, and a reference that no heartbeat can throw about."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from groundstation.planning import planner
from robot_agent.guidance.reference import ReferenceSampler, pose_at
from robot_agent.guidance.trajectory_check import unflyable
from robot_agent.guidance.trajectory_clock import FASTER, TrajectoryClock
from robot_agent.inputs import StationView
from shoal.config.experiment import load_experiment
from shoal.frames import Array
from shoal.messages.messages import ALONE, Command, CommandKind, Trajectory

EXPERIMENT = load_experiment("pool", ["duration_s=20"])
ME, STATION, NS = 1, 7, 1_000_000_000
AHEAD_NS = 40 * NS  # of our clock, before the station's
STEP_NS = NS // 20


def straight(begin_s: float = 0.0, speed_mps: float = 0.1, seconds: float = 10.0, path: str = "straight") -> Trajectory:
    """Along x from -0.5 m, as from time 0 of the path, at half a metre's depth."""
    t = begin_s + 0.05 * np.arange(round((seconds - begin_s) / 0.05) + 1, dtype=np.float64)
    eta, velocity = np.zeros((len(t), 4)), np.zeros((len(t), 4))
    eta[:, 0], eta[:, 2], velocity[:, 0] = speed_mps * t - 0.5, 0.5, speed_mps
    return Trajectory(path, 0.05, eta, velocity, np.zeros_like(eta), begin_s)


def changed(**fields: Any) -> Trajectory:
    return replace(straight(), **fields)


def bent(name: str, row: int, column: int, by: float) -> Trajectory:
    """With one number of one array changed."""
    array = getattr(straight(), name).copy()
    array[row, column] += by
    return replace(straight(), **{name: array})


def moving(velocity: tuple[float, float, float, float], acceleration: tuple[float, float, float, float]) -> Trajectory:
    """A second of a consistent motion with these at its middle."""
    t = (0.05 * np.arange(21, dtype=np.float64) - 0.5)[:, None]
    v, a = np.array(velocity), np.array(acceleration)
    eta = np.array([0.0, 0.0, 0.6, 0.0]) + v * t + 0.5 * a * t**2
    return Trajectory("moving", 0.05, eta, v + a * t, np.tile(a, (21, 1)))


class ClockedRobot:
    """A clock with the clocks around it: the station's is AHEAD_NS behind ours."""

    def __init__(self, loaded: Trajectory | None = None) -> None:
        self.clock, self.now_ns = TrajectoryClock(EXPERIMENT, ME), 100 * NS
        self.lag_s = self.slowing = 0.0
        self.eta: Array | None = np.array([-0.5, 0.0, 0.5, 0.0])
        if loaded is not None:
            assert self.give(Command(CommandKind.LOAD, ME, trajectory=loaded)) == ""

    @property
    def station(self) -> StationView:
        return StationView(STATION, self.now_ns - AHEAD_NS, 0.0, self.lag_s, self.slowing)

    def give(self, command: Command, under_way: bool = False) -> str:
        begins_ns = command.start_ns + AHEAD_NS
        reason = self.clock.objection(command, under_way, self.station, begins_ns, self.now_ns, self.eta)
        if not reason:
            self.clock.apply(command, under_way, self.station, begins_ns)
        return reason

    def start(
        self, in_s: float = 0.0, at_s: float = 0.0, path: str = "straight", order: CommandKind = CommandKind.START
    ) -> str:
        start_ns = self.station.clock_ns + round(in_s * NS)
        return self.give(Command(order, ME, trajectory_id=path, trajectory_s=at_s, start_ns=start_ns))

    def reaches(self, seconds: float = 0.0) -> float:
        """Time along the path after so many seconds."""
        for _ in range(max(round(seconds * NS / STEP_NS), 1)):
            self.now_ns += STEP_NS if seconds else 0
            assert self.clock.goal(self.station, self.now_ns) is not None
        return self.clock.reached_s


# --- LOAD: what is flown at all


@pytest.mark.parametrize(
    ("loaded", "says"),
    [
        (None, "carries no trajectory"),
        (changed(id=""), "id is empty"),
        (changed(period_s=0.0005), "period_s = 0.0005: must be 0.001 to 1"),
        (changed(period_s=1.5), "period_s = 1.5: must be 0.001 to 1"),
        (changed(period_s=float("nan")), "period_s = nan"),
        (changed(begin_s=-0.05), "begin_s = -0.05: must be 0 to 1e+06"),
        (changed(begin_s=2e6), "begin_s = 2e+06"),
        (changed(begin_s=float("nan")), "begin_s = nan"),
        (changed(velocity=np.zeros((3, 4))), "same number of samples, at least 2"),
        (changed(acceleration=np.zeros((3, 4))), "same number of samples, at least 2"),
        (Trajectory("one", 0.05, np.zeros((1, 4)), np.zeros((1, 4)), np.zeros((1, 4))), "at least 2"),
        (bent("eta", 7, 0, 9.0), "leaves the pool at 0.35 s"),
        (bent("eta", 0, 1, -9.0), "leaves the pool at 0.00 s"),
        (bent("eta", 0, 2, 9.0), "leaves the pool"),
        (bent("eta", 7, 2, -0.51), "leaves the pool at 0.35 s"),
        (bent("eta", 0, 2, float("nan")), "leaves the pool"),
        (bent("eta", 7, 0, 0.4), "eta moves by 0.405 m in x at 0.30 s, its velocities say 0.005 m"),
        (bent("eta", 7, 3, 1.0), "eta moves by 1 rad in yaw at 0.30 s, its velocities say 0 rad"),
        (bent("eta", 7, 3, float("nan")), "in yaw at 0.30 s"),
        (bent("velocity", 7, 2, 0.2), "velocity changes by 0.2 m/s in z at 0.30 s, its accelerations say 0 m/s"),
        (bent("velocity", 7, 3, float("nan")), "in yaw at 0.30 s"),
        (bent("acceleration", 7, 1, 4.0), "velocity changes by 0 m/s in y at 0.30 s, its accelerations say 0.1 m/s"),
        (bent("acceleration", 7, 1, float("nan")), "in y at 0.30 s"),
        (moving((0.51, 0, 0, 0), (0, 0, 0, 0)), "takes a speed of 0.51 m/s at 0.00 s, this robot's limit is 0.48"),
        (moving((0, 0, 0.28, 0), (0, 0, 0, 0)), "heave of 0.28 m/s"),
        (moving((0, 0, 0, 2.1), (0, 0, 0, 0)), "yaw rate of 2.1 rad/s"),
        (moving((0, 0, 0, 0), (0.6, 0, 0, 0)), "takes a thrust of"),
        (moving((0, 0, 0, 0), (0, 0, 0.25, 0)), "heave thrust of"),
        (moving((0, 0, 0, 0), (0, 0, 0, 3.4)), "yaw moment of"),
    ],
)  # fmt: skip
def test_a_trajectory_that_cannot_be_flown_is_refused(loaded: Trajectory | None, says: str) -> None:
    robot = ClockedRobot()
    assert says in robot.give(Command(CommandKind.LOAD, ME, trajectory=loaded))
    assert robot.clock.trajectory is None


@pytest.mark.parametrize("scene", ["pool", "figure-eight", "straight", "islands", "numeric", "swap", "blocked-path"])
def test_trajectory_of_the_planner_is_loaded(scene: str) -> None:
    experiment = load_experiment(scene)
    for trajectory in planner.plan(experiment).values():
        assert unflyable(trajectory, experiment.pool, experiment.vehicle) == ""


def test_a_path_may_set_off_and_stop_at_once() -> None:
    rests = straight()
    eta, velocity = rests.eta.copy(), rests.velocity.copy()
    eta[:21], velocity[:21], eta[101:], velocity[101:] = eta[20], 0.0, eta[100], 0.0
    assert ClockedRobot().give(Command(CommandKind.LOAD, ME, trajectory=replace(rests, eta=eta, velocity=velocity))) == ""


# --- LOAD and SWITCH under way


def test_a_switch_names_the_trajectory_that_is_loaded() -> None:
    robot = ClockedRobot(straight())
    assert robot.start() == ""
    switch = Command(CommandKind.SWITCH, ME, trajectory_id="b")
    assert robot.give(switch, under_way=True) == "trajectory b is not loaded"
    assert robot.give(Command(CommandKind.LOAD, ME, trajectory=straight(2.0, path="b")), under_way=True) == ""
    assert robot.clock.id == "straight"
    assert robot.give(replace(switch, trajectory_id="c"), under_way=True) == "trajectory c is not loaded"
    assert robot.give(switch, under_way=True) == ""
    assert robot.clock.id == "b"
    assert robot.give(switch, under_way=True) == "trajectory b is not loaded"  # once


def test_a_trajectory_that_begins_in_the_past_is_not_gone_over_to() -> None:
    robot = ClockedRobot(straight())
    assert robot.start() == ""
    robot.reaches(1.0)
    late = Command(CommandKind.LOAD, ME, trajectory=straight(1.0, path="b"))
    assert robot.give(late, under_way=True) == "too late: it begins at 1.00 s, 1.00 s have gone by"
    assert robot.give(replace(late, trajectory=straight(2.0, path="b")), under_way=True) == ""
    robot.reaches(1.5)
    switch = Command(CommandKind.SWITCH, ME, trajectory_id="b")
    assert robot.give(switch, under_way=True) == "too late: it begins at 2.00 s, 2.50 s have gone by"
    assert robot.clock.id == "straight"


def test_a_robot_that_stops_flying_forgets_the_next_trajectory() -> None:
    robot = ClockedRobot(straight())
    assert robot.start() == ""
    assert robot.give(Command(CommandKind.LOAD, ME, trajectory=straight(2.0, path="b")), under_way=True) == ""
    robot.clock.drop_next()
    assert "not loaded" in robot.give(Command(CommandKind.SWITCH, ME, trajectory_id="b"), under_way=True)


def test_nothing_is_loaded_for_later_by_a_robot_that_flies_nothing() -> None:
    assert (
        ClockedRobot().give(Command(CommandKind.LOAD, ME, trajectory=straight()), under_way=True) == "no trajectory is flown"
    )


# --- START and RESUME


@pytest.mark.parametrize("order", [CommandKind.START, CommandKind.RESUME])
def test_a_start_is_for_the_trajectory_that_is_loaded(order: CommandKind) -> None:
    assert ClockedRobot().start(order=order) == "no trajectory is loaded"
    robot = ClockedRobot(straight())
    assert robot.start(path="b", order=order) == "names trajectory b, this robot has straight"
    assert robot.start(path="", order=order) == "names trajectory (none), this robot has straight"
    assert robot.start(order=order) == ""


def test_a_start_an_hour_ahead_or_over_is_refused() -> None:
    robot = ClockedRobot(straight())
    assert robot.start(in_s=3600.0) == "begins 3600.0 s from now, allowed are -60 to 60 s"
    assert robot.start(in_s=-3600.0) == "begins -3600.0 s from now, allowed are -60 to 60 s"
    assert robot.start(in_s=59.0) == ""


def test_a_robot_that_does_not_know_where_it_is_does_not_start() -> None:
    robot = ClockedRobot(straight())
    robot.eta = None
    assert robot.start() == "the robot does not know where it is"


@pytest.mark.parametrize("order", [CommandKind.START, CommandKind.RESUME])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_robot_far_from_its_path_does_not_start(order: CommandKind, axis: int) -> None:
    """Robot 1 of `pool` is put 0.15 m from its path's beginning: it may be that and safety.join_within_m away."""
    robot = ClockedRobot(straight())
    assert robot.eta is not None
    planned_m = float(np.linalg.norm(EXPERIMENT.robot(ME).start_offset[:3]))
    robot.eta[axis] += 1.02 + planned_m
    answer = robot.start(order=order)
    assert f"is {1.02 + planned_m:.2f} m from where its path is at 0.00 s" in answer
    assert f"allowed are {1.0 + planned_m:.2f} m" in answer and "safety.join_within_m" in answer
    robot.eta[axis] -= 0.04
    assert robot.start(order=order) == ""


def test_a_robot_whose_experiment_puts_it_far_from_its_path_starts_there() -> None:
    experiment = load_experiment("islands")
    trajectories = planner.plan(experiment)
    starts = planner.start_poses(experiment, trajectories)
    for robot, trajectory in trajectories.items():
        clock, view = TrajectoryClock(experiment, robot), StationView(STATION, NS, 0.0)
        clock.apply(Command(CommandKind.LOAD, robot, trajectory=trajectory), False, view, NS)
        start = Command(CommandKind.START, robot, trajectory_id=trajectory.id)
        away = np.array([5.0, 5.0, 5.0, 0.0])
        assert clock.objection(start, False, view, NS, NS, starts[robot]) == ""
        assert "from where its path is" in clock.objection(start, False, view, NS, NS, starts[robot] + away)


def test_the_rate_that_is_told_is_the_references_own_while_it_catches_up() -> None:
    """A formation is half a second behind, and then is not. The prediction over the horizon goes by this rate."""
    robot = ClockedRobot(straight())
    assert robot.start() == ""
    goals = []
    for k in range(100):
        robot.lag_s = 0.51 if 20 <= k < 40 else 0.0
        robot.now_ns += STEP_NS
        goal = robot.clock.goal(robot.station, robot.now_ns)
        assert goal is not None
        goals.append(goal)
    for goal, later in pairwise(goals):
        if goal.rate == pytest.approx(later.rate, abs=1e-6):  # else a heartbeat came, or the lag was caught up, between them
            assert goal.rate == pytest.approx((later.time_s - goal.time_s) * NS / STEP_NS, abs=1e-6)
    assert max(goal.rate for goal in goals) == pytest.approx(1.0 + FASTER)


def test_a_trajectorys_flaw_is_found_beside_the_steps() -> None:
    """The check of an hour takes 40 ms: with its result nothing of it is looked at again."""
    robot, wrong = ClockedRobot(), Command(CommandKind.LOAD, ME, trajectory=changed(id=""))
    assert robot.clock.flaw(wrong) == "trajectory.id is empty"
    arguments = wrong, False, robot.station, 0, robot.now_ns, robot.eta
    assert robot.clock.objection(*arguments) == robot.clock.objection(*arguments, flaw="trajectory.id is empty") != ""
    assert robot.clock.objection(*arguments, flaw="") == ""


def test_a_start_taken_late_keeps_the_timetable() -> None:
    robots = [ClockedRobot(straight()), ClockedRobot(straight())]
    start = Command(
        CommandKind.START, ME, trajectory_id="straight", trajectory_s=0.0, start_ns=robots[0].station.clock_ns + NS // 2
    )
    assert robots[0].give(start) == ""
    robots[1].now_ns += round(2.3 * NS)
    assert robots[1].give(start) == ""
    robots[0].reaches(3.0)
    robots[1].reaches(0.7)
    assert robots[0].now_ns == robots[1].now_ns
    assert robots[0].reaches() == robots[1].reaches() == pytest.approx(2.5)


def test_a_start_taken_so_late_that_the_path_is_far_away_is_refused() -> None:
    robot = ClockedRobot(straight(speed_mps=0.2))
    start = Command(CommandKind.START, ME, trajectory_id="straight", start_ns=robot.station.clock_ns)
    robot.now_ns += 7 * NS
    assert "is 1.40 m from where its path is at 7.00 s" in robot.give(start)
    robot.now_ns -= 3 * NS
    assert robot.give(start) == ""


def test_before_its_instant_a_robot_waits_where_it_is_to_go_on() -> None:
    robot = ClockedRobot(straight())
    assert robot.start(in_s=0.5, at_s=3.0) == ""
    assert robot.reaches(0.4) == 3.0
    assert robot.reaches(0.6) == pytest.approx(3.5)


def test_a_robot_that_waits_foresees_when_it_will_go_on() -> None:
    """Its plan 2 s ahead is where its path leads by then, also half a second before it sets out."""
    robot, ahead = ClockedRobot(straight()), ReferenceSampler(np.array([2.0]))
    assert robot.start(in_s=0.5, at_s=3.0) == ""
    foreseen, sets_out_ns = [], robot.now_ns + NS // 2
    for _ in range(20):
        robot.now_ns += STEP_NS
        goal = robot.clock.goal(robot.station, robot.now_ns)
        assert goal is not None
        expected_m = straight().eta[0, 0] + 0.1 * (3.0 + (robot.now_ns - sets_out_ns) / NS + 2.0)
        foreseen.append(ahead.sample(goal).eta[1, 0] - expected_m)
    assert foreseen == pytest.approx(np.zeros(20), abs=1e-6)


def test_the_lag_of_the_formation_counts_from_the_start_on() -> None:
    robot = ClockedRobot(straight())
    robot.lag_s = 2.0
    assert robot.start(at_s=5.0) == ""
    assert robot.reaches(1.0) == pytest.approx(4.0)


def test_a_second_start_begins_with_the_lag_that_the_station_tells_then() -> None:
    """The lag of a run that is over is not caught up with slowly in the next one."""
    robot = ClockedRobot(straight())
    robot.lag_s = 2.0
    assert robot.start(at_s=5.0) == ""
    robot.reaches(1.0)
    robot.lag_s = 0.0
    assert robot.start(at_s=0.0) == ""
    assert robot.reaches(1.0) == pytest.approx(1.0)


def test_a_later_trajectory_is_not_begun_from_as_far_as_the_runs_own() -> None:
    """Robots that get a new plan rest at its beginning, however far from its path the run's start was."""
    experiment = load_experiment("islands")
    robot, trajectory = 1, planner.plan(experiment)[1]
    start = planner.start_poses(experiment, {1: trajectory, 2: trajectory, 3: trajectory})[robot]
    far_m = float(np.linalg.norm(start[:3] - trajectory.eta[0, :3]))
    assert far_m > 1.1
    clock, view = TrajectoryClock(experiment, robot), StationView(STATION, NS, 0.0)
    clock.apply(Command(CommandKind.LOAD, robot, trajectory=trajectory), False, view, NS)
    later = replace(trajectory, id="later", begin_s=30.0, eta=trajectory.eta + (start - trajectory.eta[0]) * [1, 1, 1, 0])
    clock.apply(Command(CommandKind.LOAD, robot, trajectory=later), False, view, NS)
    begin = Command(CommandKind.START, robot, trajectory_id="later", trajectory_s=30.0)
    assert clock.objection(begin, False, view, NS, NS, start) == ""
    beside = start + np.array([0.0, 1.1, 0.0, 0.0])
    assert "allowed are 1.00 m (safety.join_within_m)" in clock.objection(begin, False, view, NS, NS, beside)


# --- heartbeats that cannot be true


def under_way() -> ClockedRobot:
    robot = ClockedRobot(straight())
    assert robot.start() == ""
    robot.reaches(3.0)
    return robot


@pytest.mark.parametrize(
    ("lag_s", "slowing", "low_s", "high_s"),
    [
        (0.0, 0.0, 1.0, 1.0),
        (0.3, 0.0, 0.7, 0.7),  # taken over within the second
        (1e6, 0.0, 0.0, 0.0),  # it stands, and does not go back
        (-1e6, 0.0, 1.0, 1.0),  # nobody is ahead of the timetable
        (0.0, 50.0, 1.0, 1.0),
        (0.0, -50.0, 1.0, 1.0),
    ],
)
def test_a_heartbeat_moves_no_reference_at_once(lag_s: float, slowing: float, low_s: float, high_s: float) -> None:
    robot = under_way()
    before_s = robot.reaches()
    robot.lag_s, robot.slowing = lag_s, slowing
    along = [before_s, *(robot.reaches(0.05) for _ in range(20))]
    steps = np.diff(along)
    assert steps.min() >= -1e-9 and steps.max() <= 0.05 * (1.0 + FASTER) + 1e-9
    assert low_s - 1e-9 <= along[-1] - before_s <= high_s + 1e-9
    goal = robot.clock.goal(robot.station, robot.now_ns)
    assert goal is not None and 0.0 <= goal.rate <= 1.0


def test_a_lag_that_is_taken_back_is_caught_up_with_slowly() -> None:
    robot = ClockedRobot(straight())
    robot.lag_s = 2.0
    assert robot.start(at_s=4.0) == ""
    robot.reaches(1.0)
    before_s, robot.lag_s = robot.reaches(), 0.0
    assert robot.reaches(1.0) - before_s == pytest.approx(1.0 + FASTER)
    assert robot.reaches(3.0) - before_s == pytest.approx(6.0)
    assert pose_at(straight(), 3.0)[0] == pytest.approx(-0.2)


@pytest.mark.parametrize("time_s", [-5.0, 0.0, 1e6])
def test_a_pose_before_and_after_a_trajectory_is_its_first_and_last(time_s: float) -> None:
    """A START that comes late may name an instant at which the trajectory is over."""
    expected = straight().eta[0 if time_s <= 0.0 else -1]
    assert pose_at(straight(), time_s) == pytest.approx(expected)


def test_the_lag_of_another_station_does_not_count() -> None:
    robot = under_way()
    before_s = robot.reaches()
    robot.now_ns += NS
    goal = robot.clock.goal(StationView(STATION + 1, robot.now_ns, 0.0, 1e6, 1.0), robot.now_ns)
    assert goal is not None
    assert goal.time_s == pytest.approx(before_s + 1.0)
    assert goal.rate == 1.0


def test_the_clock_of_a_flight_alone_is_not_the_formations() -> None:
    """Gains that begin with a lap of the formation wait for its clock."""
    robot = ClockedRobot(replace(straight(), id=f"{ALONE}x"))
    assert robot.start(path=f"{ALONE}x") == ""
    assert robot.reaches(2.0) == pytest.approx(2.0) and robot.clock.formation_s == 0.0
    assert under_way().clock.formation_s > 0.0
